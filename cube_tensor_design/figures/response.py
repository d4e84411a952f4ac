# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of a computed response matrix, and of influence functions."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.mechanics.influence import Influence
from cube_tensor_driver.views.figures.style import (
    SIGNED_COLOURS,
    choose_curve_style,
    format_symbol,
    print_style,
)

from ..fem.fem import Response
from .curves import add_legend_below, draw_curves

MAX_COEFFICIENTS = 12
"""Maximum number of coefficients in the picture of convergence; the largest ones are drawn."""
MIN_LABELLED = 5e-3
"""Share of the largest entry of the response matrix below which no number is drawn on an entry."""
POINTS = 201
"""Number of points of a curve of influence (stress of a pad over the place of a force)."""
REACH = 8
"""Half width of the picture of influence functions, in half sides of the cube."""
SAME_CURVE = 1e-3
"""Share of the largest stress up to which the curves of two pads may differ to share one curve."""


@print_style()
def draw_convergence(result: Response) -> Figure:
    """Draw the distance of each coefficient from its value on the finest mesh, over unknowns.

    The distance is relative to the largest coefficient.
    """
    figure = Figure(figsize=(6, 4))
    axis = figure.subplots()
    *coarser, finest = result.convergence
    values = finest["coefficients"]
    largest = max(map(abs, values.values()))
    unknowns = [row["unknowns"] for row in coarser]
    shown = sorted(values, key=lambda name: -abs(values[name]))[:MAX_COEFFICIENTS]
    for number, name in enumerate(shown):
        change = np.array([row["coefficients"][name] - values[name] for row in coarser])
        (curve,) = axis.loglog(
            unknowns,
            100 * abs(change) / largest,
            label=name,
        )
        curve.set(**choose_curve_style(number))
    label = f"distance from the result with {finest['unknowns']} unknowns / % of the largest"
    axis.set(xlabel="unknowns of the mesh", ylabel=label)
    # A single mesh has nothing to compare it with.
    if unknowns:
        axis.set_xticks(unknowns, [str(n) for n in unknowns], minor=False)
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:.2g}")
        axis.legend(fontsize="small", ncol=2, handlelength=4)
    return figure


@print_style()
def draw_response(result: Response) -> Figure:
    """Draw the response matrix, with a row for each pad and a column for each mode.

    Negative entries are dark, so that a print in grey shows the sign, too.
    """
    n_pads, n_modes = result.matrix.shape
    figure = Figure(figsize=(0.6 * n_modes + 2.5, 0.35 * n_pads + 1.5))
    axis = figure.subplots()
    limit = np.abs(result.matrix).max()
    image = axis.imshow(result.matrix, cmap=SIGNED_COLOURS, aspect="auto")
    image.set_clim(-limit, limit)
    axis.grid(False)
    labels = [format_symbol(mode) for mode in result.modes]
    axis.set_xticks(range(n_modes), labels, rotation=60 if n_modes > 7 else 0)
    pads = [f"V{k}  {pad}" for k, pad in enumerate(result.layout.pads, 1)]
    axis.set_yticks(range(n_pads), pads)
    for (pad, mode), value in np.ndenumerate(result.matrix):
        if abs(value) > MIN_LABELLED * limit:
            # The colour map is dark below zero.
            color = "black" if value > -0.1 * limit else "white"
            text = f"{value:.2f}"
            axis.text(
                mode,
                pad,
                text,
                ha="center",
                va="center",
                fontsize=7,
                color=color,
            )
    figure.colorbar(
        image,
        ax=axis,
        label="pad stress over amplitude of the mode / (Pa/Pa)",
    )
    return figure


@print_style()
def draw_influence(influence: Influence) -> Figure:
    """Draw the stress of each pad over the place of a force along x, above the cube's centre line.

    There is a panel for each direction of the force. Pads with the same curve share one.
    """
    layout = influence.layout
    # The picture ends where the influence functions end.
    ends = influence.place[[0, -1], 0]
    reach = min(REACH * influence.side / 2, *np.abs(ends))
    x = np.linspace(-reach, reach, POINTS)
    along_x = np.eye(influence.place.shape[1])[0]
    forces = influence.interpolate(x[:, None] * along_x)
    # The forces that are drawn press against z, or push along x.
    stress = forces[:, :, [-1, 0]] * [-1, 1]
    # A stress in Pa under 1 N/m has the same number in kPa under 1 N/mm.
    unit, force = (1.0, "1 N/mm") if layout.planar else (1e3, "1 N")
    figure = Figure(figsize=(10, 4.5))
    titles = (f"a force of {force} pressing", f"a force of {force} along x")
    groups = _find_equal_curves(stress)
    labels = [", ".join(layout.pads[pad] for pad in pads) for pads in groups]
    # The factor 1e3 is undone by draw_curves, which draws Pa as kPa.
    shown = 1e3 / unit * stress[[pads[0] for pads in groups]].T
    for axis, title, direction in zip(figure.subplots(1, 2), titles, shown, strict=True):
        curves = dict(zip(labels, direction.T, strict=True))
        draw_curves(axis, x, curves, spacing=20)
        axis.set(
            xlabel="place of the force from the cube's centre, x / mm",
            ylabel="stress of the pad / kPa",
            title=title,
        )
    add_legend_below(figure)
    return figure


def _find_equal_curves(stress: Array) -> list[list[int]]:
    """Group the numbers of pads (P, ...) that have the same values."""
    groups: list[list[int]] = []
    tolerance = SAME_CURVE * np.abs(stress).max()
    for pad, values in enumerate(stress):
        for group in groups:
            if np.abs(stress[group[0]] - values).max() < tolerance:
                group.append(pad)
                break
        else:
            groups.append([pad])
    return groups
