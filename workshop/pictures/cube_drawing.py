# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Drawing for docs/build.md: a cube in its skin and the pads on the cube, to scale, in mm."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cube_tensor_driver.core.calibration import Calibration
from cube_tensor_driver.core.defaults import SURFACE_DEPTH
from cube_tensor_driver.views.figures.style import print_style

PITCH_MM = 12.0
"""Distance between the cubes that `./cube config grid` writes, in mm."""
FOAM_MM = 0.2
"""Thickness of the foam of a pad, in mm."""
DEPTH_MM = 1e3 * SURFACE_DEPTH
"""Depth of the cubes' centres below the surface, in mm."""
MARGIN_MM = 8.0
"""Width of the skin beside the two cubes, in mm."""
MARGIN_IN = 0.15
"""Width of the empty margin of the picture, in inches."""
CENTRE_LINE: dict[str, Any] = {"color": "0.6", "lw": 0.6, "ls": ":"}
"""Style of a line through the centre of a cube."""


@print_style()
def draw_cube(calibration: Calibration) -> Figure:
    """Draw a section of the skin through two cubes, and beside it one cube with its pads."""
    figure = Figure(figsize=(9, 4))
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1))
    _draw_section(left, calibration)
    _draw_pads(right, calibration)
    for axis in (left, right):
        axis.set_aspect("equal")
        axis.axis("off")
    figure.set_layout_engine("constrained", h_pad=MARGIN_IN, w_pad=MARGIN_IN)
    return figure


def _draw_section(axis: Any, calibration: Calibration) -> None:
    """Draw ground, elastomer and two cubes, with pitch and depth."""
    bottom = -2 * DEPTH_MM
    width = PITCH_MM + 2 * MARGIN_MM
    elastomer = Rectangle((-MARGIN_MM, bottom), width, DEPTH_MM - bottom, fc="0.93", ec="none")
    axis.add_patch(elastomer)
    axis.add_patch(Rectangle((-MARGIN_MM, bottom - 1), width, 1, fc="0.6", ec="none"))
    centre = PITCH_MM / 2
    axis.text(centre, bottom - 0.5, "ground, bonded", ha="center", va="center", fontsize=8)
    axis.text(centre, bottom + 1.5, "elastomer", ha="center", fontsize=8)
    for x in (0.0, PITCH_MM):
        _draw_cube(axis, calibration, x)
    _draw_dimension(axis, (0, 5.0), (PITCH_MM, 5.0), f"pitch {PITCH_MM:g}")
    _draw_dimension(axis, (-4, 0), (-4, DEPTH_MM), f"depth {DEPTH_MM:g}")
    axis.axhline(DEPTH_MM, color="black", lw=1)
    axis.axhline(0, **CENTRE_LINE)
    axis.set(
        xlim=(-MARGIN_MM, PITCH_MM + MARGIN_MM),
        ylim=(bottom - 1, 6.5),
        title="section of the skin / mm",
    )


def _draw_pads(axis: Any, calibration: Calibration) -> None:
    """Draw one cube with the names and the dimensions of its pads, and its frame."""
    half = 1e3 * calibration.half_side
    _draw_cube(axis, calibration, 0.0)
    layout = calibration.layout
    for name, position, normal in zip(layout.pads, layout.positions, layout.normals, strict=True):
        # The name stands outside of the pad.
        x, _, z = half * position + 0.85 * normal
        axis.text(x, z, name, ha="center", va="center", fontsize=7)
    axis.axhline(0, **CENTRE_LINE)
    axis.axvline(0, **CENTRE_LINE)

    _draw_dimension(axis, (-half, -3.6), (half, -3.6), f"$2\\,d_0$ = {2 * half:g}")
    centre = half * abs(layout.positions[0, 0])
    size = half * layout.pad_size
    _draw_dimension(axis, (0, 1.2), (centre, 1.2), f"{centre:g}")
    _draw_dimension(axis, (centre - size / 2, 0.5), (centre + size / 2, 0.5), f"{size:g}")
    origin = np.array([-1.4, -1.4])
    style = {"arrowstyle": "-|>", "color": "tab:blue", "shrinkA": 0, "shrinkB": 0}
    for name, direction in (("x", np.array([1.0, 0.0])), ("z", np.array([0.0, 1.0]))):
        axis.annotate("", xy=origin + direction, xytext=origin, arrowprops=style)
        label = origin + 1.15 * direction
        axis.text(*label, f"${name}$", color="tab:blue", fontsize=8)
    axis.set(xlim=(-3.9, 3.9), ylim=(-4.4, 3.6), title="cube and pads / mm")


def _draw_cube(axis: Any, calibration: Calibration, x: float) -> None:
    """Draw a cube with its centre at x, and its pads."""
    half = 1e3 * calibration.half_side
    axis.add_patch(Rectangle((x - half, -half), 2 * half, 2 * half, fc="0.75", ec="black"))
    layout = calibration.layout
    centres = half * layout.positions[:, [0, 2]]
    normals = layout.normals[:, [0, 2]]
    for centre, normal in zip(centres, normals, strict=True):
        size = np.where(normal == 0, half * layout.pad_size, FOAM_MM)
        # The foam lies outside of the face.
        corner = centre + FOAM_MM / 2 * normal - size / 2
        axis.add_patch(Rectangle((x + corner[0], corner[1]), *size, fc="tab:orange", ec="black"))


def _draw_dimension(
    axis: Any,
    first: tuple[float, float],
    last: tuple[float, float],
    text: str,
) -> None:
    """Draw a dimension line with its text above it, or to its left if it is vertical."""
    arrow = {"arrowstyle": "<->", "color": "black", "lw": 0.8, "shrinkA": 0, "shrinkB": 0}
    axis.annotate("", xy=last, xytext=first, arrowprops=arrow)
    x, y = np.add(first, last) / 2
    if first[0] == last[0]:
        axis.text(x - 0.3, y, text, ha="right", va="center", fontsize=8)
    else:
        axis.text(x, y + 0.15, text, ha="center", va="bottom", fontsize=8)
