"""Pictures of a computed response matrix."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from cube_tensor_driver.views.figures.style import SIGNED_COLOURS, curve_style, print_style, symbol

from ..fem.fem import Response

_MOST_COEFFICIENTS = 12
"""The largest ones are drawn."""


@print_style()
def draw_convergence(result: Response) -> Figure:
    """How far each coefficient on the coarser meshes is from that on the finest mesh.

    The distance is relative to the largest coefficient.
    """
    figure = Figure(figsize=(6, 4))
    axis = figure.subplots()
    rows = result.convergence
    last = rows[-1]["coefficients"]
    largest = max(map(abs, last.values()))
    unknowns = [row["unknowns"] for row in rows[:-1]]
    shown = sorted(last, key=lambda name: -abs(last[name]))[:_MOST_COEFFICIENTS]
    for number, name in enumerate(shown):
        distance = [
            100 * abs(row["coefficients"][name] - last[name]) / largest for row in rows[:-1]
        ]
        axis.loglog(unknowns, distance, label=name, **curve_style(number))
    finest = f"distance from the result with {rows[-1]['unknowns']} unknowns / % of the largest"
    axis.set(xlabel="unknowns of the mesh", ylabel=finest)
    if unknowns:
        axis.set_xticks(unknowns, [str(n) for n in unknowns], minor=False)
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:.2g}")
        axis.legend(fontsize="small", ncol=2, handlelength=4)
    return figure


@print_style()
def draw_response(result: Response) -> Figure:
    """The response matrix, pads down and modes across. Below zero is dark, in grey too."""
    n_pads, n_modes = result.matrix.shape
    figure = Figure(figsize=(0.6 * n_modes + 2.5, 0.35 * n_pads + 1.5))
    axis = figure.subplots()
    limit = np.abs(result.matrix).max()
    image = axis.imshow(result.matrix, cmap=SIGNED_COLOURS, vmin=-limit, vmax=limit, aspect="auto")
    axis.grid(False)
    axis.set_xticks(
        range(n_modes), [symbol(mode) for mode in result.modes], rotation=60 if n_modes > 7 else 0
    )
    axis.set_yticks(range(n_pads), [f"V{k + 1}  {pad}" for k, pad in enumerate(result.layout.pads)])
    for (pad, mode), value in np.ndenumerate(result.matrix):
        if abs(value) > 5e-3 * limit:
            color = "black" if value > -0.1 * limit else "white"
            axis.text(mode, pad, f"{value:.2f}", ha="center", va="center", fontsize=7, color=color)
    figure.colorbar(image, ax=axis, label="pad stress over amplitude of the mode / (Pa/Pa)")
    return figure
