# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of `./cube study`: where each layout can be trusted."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.modes import COMPONENTS, STRESS
from cube_tensor_driver.views.figures.style import (
    choose_curve_style,
    format_symbol,
    print_style,
)

from ..studies.layout_study import DEPTH, MAX_TRUSTED_ERROR, LayoutStudy

DIRECTION_DASHES = ("--", "-.", ":")
"""Line styles of the curves of gradients along x, y and z."""
DIRECTION_COLOURS = ("0.0", "0.35", "tab:cyan")
"""Colours of the curves of gradients along x, y and z."""
MAX_SHOWN_ERROR = 20
"""Upper end of the axis of errors, which are relative to the range of a component."""


@print_style()
def draw_trust(result: LayoutStudy) -> Figure:
    """Draw the error over the width of the indenter, in one panel per layout and side of the cube.

    Errors in the grey area are too large to trust the component.
    Full lines are stresses. Dashed lines are gradients: the marker stands for the component, the
    colour for the direction.
    """
    rows = len(result.sides)
    columns = len(result.error)
    figure = Figure(figsize=(4 * columns, 3 * rows))
    axes = figure.subplots(
        rows,
        columns,
        sharex=True,
        sharey=True,
        squeeze=False,
    )
    for by_side, (name, error) in zip(axes.T, result.error.items(), strict=True):
        for axis, side, errors in zip(by_side, result.sides, error, strict=True):
            _draw_errors(axis, 1e3 * result.widths, errors)
            axis.set_title(f"layout {name}, side {1e3 * side:g} mm")
    # NaN is a component that the layout does not observe.
    smallest = np.nanmin(list(result.error.values()))
    axes[0, 0].set_ylim(0.7 * smallest, MAX_SHOWN_ERROR)

    handles, labels = axes[0, -1].get_legend_handles_labels()
    handles.append(Patch(facecolor="0.92", edgecolor="0.7"))
    labels.append(f"error above {100 * MAX_TRUSTED_ERROR:g} %:\nnot to be trusted")
    # The legend is no higher than a panel, or the layout would move the rows apart.
    axes[0, -1].legend(
        handles,
        labels,
        loc="upper left",
        bbox_to_anchor=(1.0, 1.03),
        handlelength=4,
        fontsize="small",
        labelspacing=0.1,
    )
    depth = f"the cube's centre is {1e3 * DEPTH:g} mm deep"
    figure.supxlabel(f"width of the indenter / mm ({depth})")
    figure.supylabel("largest error over all positions / range of the component")
    return figure


def _draw_errors(axis: Axes, widths: Array, errors: Array) -> None:
    """Draw one panel: errors (W, C) over widths (W,) in mm."""
    axis.axhspan(MAX_TRUSTED_ERROR, 100, color="0.92")
    for number, component in enumerate(COMPONENTS):
        is_observed = not np.isnan(errors[0, number])
        if is_observed:
            (curve,) = axis.loglog(
                widths,
                errors[:, number],
                label=format_symbol(component),
            )
            curve.set(**_choose_component_style(number))


def _choose_component_style(number: int) -> dict[str, object]:
    """Return the style of a component: six stresses, then the gradients xx_x, xx_y, xx_z, ..."""
    if number < len(STRESS):
        return choose_curve_style(number) | {"linestyle": "-"}
    component, direction = divmod(number - len(STRESS), 3)
    dashes = DIRECTION_DASHES[direction]
    colour = DIRECTION_COLOURS[direction]
    return choose_curve_style(component) | {"linestyle": dashes, "color": colour}
