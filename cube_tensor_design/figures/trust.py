"""The picture of `./cube study`: where each layout can be trusted."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from cube_tensor_driver.core.modes import COMPONENTS, STRESS
from cube_tensor_driver.views.figures.style import curve_style, print_style, symbol

from ..studies.layout_study import TRUSTED_ERROR, LayoutStudy

_DIRECTION_DASHES = ("--", "-.", ":")
_DIRECTION_COLOURS = ("0.0", "0.35", "tab:cyan")


@print_style()
def draw_trust(result: LayoutStudy) -> Figure:
    """Error over indenter width, one panel per layout and cube side; too large where it is grey.

    Full lines are stresses. Dashed lines are gradients: the marker tells the component, the colour
    the direction.
    """
    names = list(result.error)
    rows, columns = len(result.sides), len(names)
    figure = Figure(figsize=(4 * columns, 3 * rows))
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for row, side in enumerate(result.sides):
        for axis, name in zip(axes[row], names, strict=True):
            _draw_errors(axis, 1e3 * result.widths, result.error[name][row])
            axis.set_title(f"layout {name}, side {1e3 * side:g} mm")
    handles, labels = axes[0][-1].get_legend_handles_labels()
    handles.append(Patch(facecolor="0.92", edgecolor="0.7"))
    labels.append(f"error above {100 * TRUSTED_ERROR:g} %:\nnot to be trusted")
    smallest = min(float(np.nanmin(error)) for error in result.error.values())
    axes[0][0].set_ylim(0.7 * smallest, 20)
    # No higher than a panel: the layout would put the rows apart.
    axes[0][-1].legend(
        handles,
        labels,
        loc="upper left",
        bbox_to_anchor=(1.0, 1.03),
        handlelength=4,
        fontsize="small",
        labelspacing=0.1,
    )
    figure.supxlabel(
        f"width of the indenter / mm (the cube's centre is {1e3 * result.depth:g} mm deep)"
    )
    figure.supylabel("largest error over all positions / range of the component")
    return figure


def _draw_errors(axis: Any, widths: np.ndarray, errors: np.ndarray) -> None:
    """One panel: errors (W, C) over widths (W,) in mm."""
    axis.axhspan(TRUSTED_ERROR, 100, color="0.92")
    for number, component in enumerate(COMPONENTS):
        observed = not np.isnan(errors[0, number])
        if observed:
            style = _component_style(number)
            axis.loglog(widths, errors[:, number], label=symbol(component), **style)


def _component_style(number: int) -> dict[str, Any]:
    """Style of a component: six stresses, then the gradients xx_x, xx_y, xx_z, yy_x, ..."""
    if number < len(STRESS):
        return curve_style(number) | {"linestyle": "-"}
    component, direction = divmod(number - len(STRESS), 3)
    return curve_style(component) | {
        "linestyle": _DIRECTION_DASHES[direction],
        "color": _DIRECTION_COLOURS[direction],
    }
