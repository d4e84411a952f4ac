# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of docs/stress_tensor.md: loads on a cube, its pads' stresses, two pads' wrong shear."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.calibration import Calibration
from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.views.figures.style import SIGNED_COLOURS, print_style

from ..studies.pads_example import BALL_X, LOAD, Sweep, make_simple_loads
from .curves import draw_curves

ARROWS = np.linspace(-0.8, 0.8, 5)
"""Positions along a face at which arrows of the load are drawn, in half sides of the square."""
ARROW_LENGTH = 0.45
"""Length of the arrow for the stress `LOAD`, in half sides of the square."""
PAD_WIDTH = 0.85
"""Width of a drawn pad along its face, in half sides of the cube."""
PAD_THICKNESS = 0.22
"""Thickness of a drawn pad, in half sides of the cube."""


@print_style()
def draw_pads(calibration: Calibration) -> Figure:
    """Draw three loads as arrows on a piece of the elastomer, and the pads' stresses below."""
    loads = make_simple_loads(calibration)
    figure = Figure(figsize=(9, 5.6))
    axes = figure.subplots(2, len(loads))
    states = np.array(list(loads.values()))
    pads = 1e-3 * states @ calibration.response.T
    # One scale for all loads.
    limit = np.abs(pads).max()
    colours = ScalarMappable(Normalize(-limit, limit), colormaps[SIGNED_COLOURS])
    for (above, below), (title, state), values in zip(axes.T, loads.items(), pads, strict=True):
        _draw_load(above, dict(zip(calibration.modes.names, state, strict=True)))
        _draw_frame(above, title)
        _draw_cube(below, calibration.layout, values, colours)
        _draw_frame(below, "stress of the pads / kPa")
        below.set_xlabel("$x\\,/\\,d_0$")
    for axis in axes[:, 0]:
        axis.set_ylabel("$z\\,/\\,d_0$")
    # A colour bar of both rows keeps their columns aligned.
    label = "stress of the pads / kPa, tension positive"
    figure.colorbar(colours, ax=axes, label=label, aspect=40)
    return figure


def _draw_load(axis: Axes, state: dict[str, float]) -> None:
    """Draw the forces that the surroundings exert on the faces of a square around the cube."""
    arrows = []
    for side in (1.0, -1.0):
        for x in ARROWS:
            # The stress grows with x / d0 by its gradient times d0.
            stress = abs(state["zz"] + state["zz_x"] * x)
            length = ARROW_LENGTH * stress / abs(LOAD)
            if length > 0.1:
                arrows.append(((x, side * (1 + length)), (x, side)))
        # Shear on one face needs shear on the other ones, or the square would turn.
        if state["zx"]:
            near, far = 1.15 * side, 0.9 * side
            arrows += [((-far, near), (far, near)), ((near, -far), (near, far))]
    style = {"arrowstyle": "-|>", "color": "tab:blue", "shrinkA": 0, "shrinkB": 0}
    for tail, tip in arrows:
        axis.annotate("", xy=tip, xytext=tail, arrowprops=style)


def _draw_cube(
    axis: Axes,
    layout: Layout,
    pads: Array,
    colours: ScalarMappable,
) -> None:
    """Draw pads on the section of the cube in the colour and with the number of their stress."""
    centres = layout.positions[:, [0, 2]]
    normals = layout.normals[:, [0, 2]]
    for centre, normal, value in zip(centres, normals, pads, strict=True):
        size = np.where(normal == 0, PAD_WIDTH, PAD_THICKNESS)
        corner = centre + PAD_THICKNESS / 2 * normal - size / 2
        axis.add_patch(Rectangle(corner, *size, fc=colours.to_rgba(value), ec="black"))
        text = f"{value:.1f}".replace("-", "−")
        x, z = centre + 0.55 * normal
        axis.text(x, z, text, ha="center", va="center", fontsize=8)


def _draw_frame(axis: Axes, title: str) -> None:
    axis.add_patch(Rectangle((-1, -1), 2, 2, fc="0.93", ec="black", zorder=0.5))
    limits = {"xlim": (-2, 2), "ylim": (-2, 2), "xticks": (-1, 0, 1), "yticks": (-1, 0, 1)}
    axis.set(aspect="equal", title=title, **limits)
    axis.grid(False)


@print_style()
def draw_sweep(sweep: Sweep) -> Figure:
    """Draw the stress under a ball, and beside it true and measured shear over the ball's place.

    On the left, a line shows value and slope at the sensor.
    """
    figure = Figure(figsize=(9, 3.4))
    left, right = figure.subplots(1, 2)
    stress = {"$\\sigma_{zz}$ in the plane of the sensor": sweep.profile}
    draw_curves(left, sweep.place, stress, marker="")
    near = np.array([-2.5e-3, 2.5e-3])
    tangent = {"value and slope at a cube": sweep.value + sweep.slope * near}
    draw_curves(left, near, tangent, color="tab:red", linewidth=3, marker="")
    left.plot(0, 1e-3 * sweep.value, "s", color="tab:red")
    left.axvline(
        1e3 * BALL_X,
        color="0.6",
        ls=":",
        label="the ball presses here",
    )
    left.set(xlabel="$x$ / mm", ylabel="$\\sigma_{zz}$ / kPa")
    curves = {"true": sweep.truth, "eight pads": sweep.cube, "two upper pads": sweep.pair}
    draw_curves(right, sweep.place, curves, spacing=16)
    right.set(xlabel="place of the ball, $x$ / mm", ylabel="shear $\\sigma_{zx}$ / kPa")
    for axis in (left, right):
        axis.legend(fontsize=7)
    return figure
