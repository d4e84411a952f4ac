"""Drawing for docs/build.md: a cube in its skin and the pads on the cube, to scale, in mm."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cube_tensor_driver.core.calibration import Calibration
from cube_tensor_driver.core.defaults import SURFACE_DEPTH
from cube_tensor_driver.views.figures.style import print_style

PITCH = 12e-3
"""Of the cubes that `./cube config grid` writes, m."""
FOAM = 0.2e-3
"""Thickness of the foam in the drawing, m."""


@print_style()
def draw_cube(calibration: Calibration) -> Figure:
    """Left: a section of the skin through two cubes. Right: one cube with its pads."""
    figure = Figure(figsize=(9, 4))
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1))
    half, depth = 1e3 * calibration.half_side, 1e3 * SURFACE_DEPTH
    pitch, thickness = 1e3 * PITCH, 1e3 * FOAM

    bottom = -2 * depth
    left.add_patch(Rectangle((-8, bottom), 2 * 8 + pitch, depth - bottom, fc="0.93", ec="none"))
    left.add_patch(Rectangle((-8, bottom - 1), 2 * 8 + pitch, 1, fc="0.6", ec="none"))
    left.text(pitch / 2, bottom - 0.5, "ground, bonded", ha="center", va="center", fontsize=8)
    left.text(pitch / 2, bottom + 1.5, "elastomer", ha="center", fontsize=8)
    for x in (0.0, pitch):
        _draw_cube(left, calibration, x, half, thickness)
    _measure(left, (0, 5.0), (pitch, 5.0), f"pitch {pitch:g}")
    _measure(left, (-4, 0), (-4, depth), f"depth {depth:g}")
    left.axhline(depth, color="black", lw=1)
    left.axhline(0, color="0.6", lw=0.6, ls=":")
    left.set(xlim=(-8, pitch + 8), ylim=(bottom - 1, 6.5), title="section of the skin / mm")

    _draw_cube(right, calibration, 0.0, half, thickness)
    layout = calibration.layout
    size = half * layout.pad_size
    for name, centre, normal in zip(layout.pads, layout.positions, layout.normals, strict=True):
        shown = half * centre + 0.85 * normal
        right.text(shown[0], shown[2], name, ha="center", va="center", fontsize=7)
    right.axhline(0, color="0.6", lw=0.6, ls=":")
    right.axvline(0, color="0.6", lw=0.6, ls=":")
    _measure(right, (-half, -3.6), (half, -3.6), f"$2\\,d_0$ = {2 * half:g}")
    centre = half * abs(layout.positions[0, 0])
    _measure(right, (0, 1.2), (centre, 1.2), f"{centre:g}")
    _measure(right, (centre - size / 2, 0.5), (centre + size / 2, 0.5), f"{size:g}")
    for tip, name in (((1.0, 0.0), "x"), ((0.0, 1.0), "z")):
        start = np.array([-1.4, -1.4])
        arrow = {"arrowstyle": "-|>", "color": "tab:blue", "shrinkA": 0, "shrinkB": 0}
        right.annotate("", xy=start + tip, xytext=start, arrowprops=arrow)
        right.text(*(start + 1.15 * np.array(tip)), f"${name}$", color="tab:blue", fontsize=8)
    right.set(xlim=(-3.9, 3.9), ylim=(-4.4, 3.6), title="cube and pads / mm")
    for axis in (left, right):
        axis.set_aspect("equal")
        axis.axis("off")
    return figure


def _draw_cube(axis: Any, calibration: Calibration, x: float, half: float, foam: float) -> None:
    """A cube at x and its pads; sizes in mm."""
    axis.add_patch(Rectangle((x - half, -half), 2 * half, 2 * half, fc="0.75", ec="black"))
    layout = calibration.layout
    for centre, normal in zip(layout.positions, layout.normals, strict=True):
        place, out = half * centre[[0, 2]], normal[[0, 2]]
        size = np.where(out == 0, half * layout.pad_size, foam)
        corner = place + foam / 2 * out - size / 2
        axis.add_patch(Rectangle((x + corner[0], corner[1]), *size, fc="tab:orange", ec="black"))


def _measure(axis: Any, first: tuple[float, float], last: tuple[float, float], text: str) -> None:
    """A dimension line with its text above it, or to its left."""
    arrow = {"arrowstyle": "<->", "color": "black", "lw": 0.8, "shrinkA": 0, "shrinkB": 0}
    axis.annotate("", xy=last, xytext=first, arrowprops=arrow)
    x, y = np.add(first, last) / 2
    if first[0] == last[0]:
        axis.text(x - 0.3, y, text, ha="right", va="center", fontsize=8)
    else:
        axis.text(x, y + 0.15, text, ha="center", va="bottom", fontsize=8)
