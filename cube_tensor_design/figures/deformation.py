# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of σzz on the deformed section of a body, with the cube in it."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.tri import LinearTriInterpolator, Triangulation

from cube_tensor_driver.core.arrays import Array, Mask
from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.views.figures.style import SIGNED_COLOURS, format_symbol, print_style

from ..paper.virtual_bench import Deformation

TITLES = {
    "zx": r"(a) shear alone: $\sigma_{zx}$ = 10 kPa",
    "zz_x": r"(b) $\sigma_{zz}$ grows along $x$: $d_0\,\partial\sigma_{zz}/\partial x$ = 10 kPa",
}
"""Titles of the panels of the paper's Fig. 4, by the name of the mode (linear stress field)
shown."""
FIGURE_4_WINDOW = 6.0
"""Half width of the part of the body that Fig. 4 shows, in d0 (half the side of the cube)."""
LOADS_WINDOW = 4.0
"""Half width of the part of the body in pictures of loads, in d0: pads must be large enough."""
MAX_DISPLACEMENT = 0.4
"""Largest displacement that is drawn, in d0 (half the side of the cube); all are scaled to it."""
COLOUR_PERCENTILE = 95
"""Percentile of the stress around the cube at which the colour scale ends. The maximum would not
do, because the stress is infinite at the corners of the cube."""
CONTOURS = np.linspace(-0.9, 0.9, 10)
"""Stresses of the contour lines, relative to the end of the colour scale. None of them is 0, which
large parts of a body under shear have."""
ARROW_COLUMNS = 12
"""Number of displacement arrows along x."""
ARROW_ROWS = 6
"""Number of displacement arrows along z."""


@print_style()
def draw_figure_4(deformations: dict[str, Deformation]) -> Figure:
    """Draw the paper's Fig. 4: the section under shear alone, and under a growing normal stress.

    Args:
        deformations: Deformation under 10 kPa of each mode of `TITLES`.
    """
    figure = Figure(figsize=(6, 6))
    axes = figure.subplots(len(TITLES), 1)
    for axis, (name, deformation) in zip(axes, deformations.items(), strict=True):
        scale = _draw_deformation(axis, deformation, FIGURE_4_WINDOW)
        axis.set(title=TITLES[name])
    axes[-1].set_xlabel(r"$x$ / mm")
    figure.supxlabel(
        f"White: the cube. Outlines are displaced by {scale:.2g} times\n"
        r"the displacements, arrows show their direction. $d_0$: half side of the cube, 2 mm.",
        fontsize=8,
    )
    return figure


@print_style()
def draw_loads(layout: Layout, deformations: dict[str, Deformation]) -> Figure:
    """Draw the section under every plane mode, with pads, deformed outline and displacements.

    Args:
        layout: Pads of the cube.
        deformations: Deformation under 10 kPa of each plane mode, by the mode's name.
    """
    figure = Figure(figsize=(10, 12))
    axes = figure.subplots(4, 2)
    for axis, (name, deformation) in zip(axes.flat, deformations.items(), strict=False):
        scale = _draw_deformation(axis, deformation, LOADS_WINDOW)
        axis.set_title(f"{format_symbol(name)}, 10 kPa (displacements times {scale:.2g})")
        _draw_pads(axis, layout, 1e3 * deformation.half_side)
    pad = Patch(color="tab:red", label="pad")
    axes.flat[-1].axis("off")
    axes.flat[-1].legend(handles=[pad], loc="center")
    figure.supxlabel(r"$x$ / mm")
    return figure


def _draw_pads(axis: Axes, layout: Layout, half_side: float) -> None:
    """Draw pads on the faces of an undeformed cube whose half side is `half_side` mm."""
    centres = layout.positions[:, [0, 2]]
    # A pad is as long as its size along the face, which is across its normal.
    halves = layout.pad_size / 2 * (1 - np.abs(layout.normals[:, [0, 2]]))
    x, z = half_side * np.stack([centres - halves, centres + halves], axis=-1).swapaxes(0, 1)
    axis.plot(x.T, z.T, color="tab:red", linewidth=5, solid_capstyle="butt")


def _draw_deformation(
    axis: Axes,
    deformation: Deformation,
    window: float,
) -> float:
    """Draw σzz on the deformed body within `window` d0, the cube, and displacements as arrows.

    Returns:
        Scale of the displacements.
    """
    mm = 1e3 * deformation.half_side
    points = deformation.points
    moved = deformation.displacement
    # Displacements far away are large and not drawn.
    is_near = np.abs(points[0]) < window
    largest = np.hypot(*moved[:, is_near]).max()
    scale = float(MAX_DISPLACEMENT * deformation.half_side / largest)
    drawn = mm * points + 1e3 * scale * moved
    _draw_stress(axis, deformation, drawn, is_near)
    _draw_arrows(axis, deformation, window)

    # The cube before the deformation is dotted, and after it white.
    square = Rectangle(
        (-mm, -mm),
        2 * mm,
        2 * mm,
        fill=False,
        linestyle=":",
        linewidth=0.8,
    )
    axis.add_patch(square)
    face = np.flatnonzero(np.isclose(np.abs(points).max(axis=0), 1))
    x, z = points[:, face]
    outline = drawn[:, face[np.argsort(np.arctan2(z, x))]]
    axis.fill(*outline, facecolor="white", edgecolor="black", linewidth=1.2)

    half_height = min(mm * window, 600 * deformation.height)
    limits = {"xlim": (-mm * window, mm * window), "ylim": (-half_height, half_height)}
    axis.set(aspect="equal", ylabel=r"$z$ / mm", **limits)
    axis.grid(False)
    return scale


def _draw_stress(
    axis: Axes,
    deformation: Deformation,
    drawn: Array,
    is_near: Mask,
) -> None:
    """Draw σzz of the elastomer as colours and contour lines on the points `drawn` (2, n), mm.

    The colour scale follows the stress of the points that are near the cube.
    """
    from_cube = np.abs(deformation.points).max(axis=0)
    is_outside = from_cube[deformation.triangles].max(axis=0) > 1 + 1e-9
    triangles = deformation.triangles[:, is_outside]

    # The value of a node is the mean of the triangles around it.
    stress = np.tile(deformation.stress_zz[is_outside] / 1e3, 3)
    total = np.bincount(triangles.ravel(), stress, len(from_cube))
    count = np.bincount(triangles.ravel(), minlength=len(from_cube))
    kilopascal = total / np.maximum(count, 1)
    magnitude = np.abs(kilopascal[is_near & (from_cube >= 1)])
    limit = np.percentile(magnitude, COLOUR_PERCENTILE)

    mesh = Triangulation(drawn[0], drawn[1], triangles.T)
    image = axis.tripcolor(
        mesh,
        kilopascal,
        shading="gouraud",
        cmap=SIGNED_COLOURS,
    )
    image.set_clim(-limit, limit)
    # matplotlib dashes the lines below zero.
    lines = axis.tricontour(
        mesh,
        kilopascal,
        limit * CONTOURS,
        colors="black",
        linewidths=0.7,
    )
    label = r"$\sigma_{zz}$ / kPa (dashed: negative)"
    colorbar = axis.figure.colorbar(image, ax=axis, label=label)
    colorbar.add_lines(lines)


def _draw_arrows(axis: Axes, deformation: Deformation, window: float) -> None:
    """Draw the displacements at the points of a regular grid within `window` d0 of the cube.

    The longest arrow is as long as d0.
    """
    mm = 1e3 * deformation.half_side
    # Arrows at the edges of the picture would leave it.
    body_half_height = deformation.height / 2 / deformation.half_side
    half_height = min(window - 1, body_half_height - 0.5)
    columns = np.linspace(1 - window, window - 1, ARROW_COLUMNS)
    rows = np.linspace(-half_height, half_height, ARROW_ROWS)
    tails = np.array(np.meshgrid(columns, rows))
    x, z = deformation.points
    mesh = Triangulation(x, z, deformation.triangles.T)
    moved = [LinearTriInterpolator(mesh, along)(*tails) for along in deformation.displacement]
    arrows = moved / np.hypot(*moved).max()
    axis.quiver(
        *(mm * tails),
        *(mm * arrows),
        color="black",
        edgecolor="white",
        linewidth=0.3,
        width=0.004,
        angles="xy",
        scale_units="xy",
        scale=1,
    )
