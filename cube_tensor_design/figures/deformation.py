# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of σzz on the deformed section of a body, with the cube in it."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.tri import Triangulation

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.views.figures.style import (
    SIGNED_COLOURS,
    print_style,
    symbol,
)

from ..paper.virtual_bench import Deformation

FIGURE_4_TITLES = {
    "zx": r"(a) shear alone: $\sigma_{zx}$ = 10 kPa",
    "zz_x": r"(b) $\sigma_{zz}$ grows along $x$: $d_0\,\partial\sigma_{zz}/\partial x$ = 10 kPa",
}
"""Titles of the panels of the paper's Fig. 4, by the name of the mode (linear stress field)
shown."""
MAX_DISPLACEMENT = 0.4
"""Largest displacement that is drawn, in d0 (half the side of the cube); all are scaled to it."""
COLOUR_PERCENTILE = 95
"""Percentile of the stress around the cube at which the colour scale ends. The maximum would not
do, because the stress is infinite at the corners of the cube."""


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
        scale = _draw_deformation(axis, deformation, 4)
        axis.set_title(f"{symbol(name)}, 10 kPa (displacements times {scale:.2g})")
        _draw_pads(axis, layout, 1e3 * deformation.half_side)
    pad = Patch(
        facecolor="white",
        edgecolor="black",
        hatch="||||",
        label="pad",
    )
    axes.flat[-1].axis("off")
    axes.flat[-1].legend(
        handles=[pad],
        loc="center",
        handlelength=4,
    )
    figure.supxlabel(r"$x$ / mm")
    return figure


@print_style()
def draw_figure_4(deformations: dict[str, Deformation]) -> Figure:
    """Draw the paper's Fig. 4: the section under shear alone, and under a growing normal stress.

    Args:
        deformations: Deformation under 10 kPa of the modes zx and zz_x.
    """
    figure = Figure(figsize=(6, 6))
    axes = figure.subplots(2, 1)
    for axis, (name, deformation) in zip(axes, deformations.items(), strict=True):
        scale = _draw_deformation(axis, deformation, 6)
        axis.set(title=FIGURE_4_TITLES[name])
    axes[-1].set_xlabel(r"$x$ / mm")
    figure.supxlabel(
        f"White: the cube. Outlines are displaced by {scale:.2g} times\n"
        r"the displacements, arrows show their direction. $d_0$: half side of the cube, 2 mm.",
        fontsize=8,
    )
    return figure


def _draw_pads(
    axis: Any,
    layout: Layout,
    half_side: float,
) -> None:
    """Draw pads on the faces of an undeformed cube whose half side is `half_side` mm."""
    centres = layout.positions[:, [0, 2]]
    normals = layout.normals[:, [0, 2]]
    for centre, normal in zip(centres, normals, strict=True):
        along = layout.pad_size * (1 - np.abs(normal))
        ends = half_side * (centre + np.outer((-0.5, 0.5), along)).T
        axis.plot(
            *ends,
            color="black",
            linewidth=7,
            solid_capstyle="butt",
        )
        # White dashes on the black line are the hatches of the pad.
        dashes = (0, (0.5, 0.5))
        axis.plot(
            *ends,
            color="white",
            linewidth=3.5,
            linestyle=dashes,
            dash_capstyle="butt",
        )


def _draw_deformation(
    axis: Any,
    deformation: Deformation,
    window: float,
) -> float:
    """Draw σzz on the deformed body within `window` d0 of the cube.

    Returns:
        Scale of the displacements.
    """
    d0 = deformation.half_side
    points = deformation.points
    moved = deformation.displacement
    # Displacements far away are large and not drawn.
    is_near = np.abs(points[0]) < window
    scale = MAX_DISPLACEMENT * d0 / np.hypot(*moved[:, is_near]).max()
    drawn = 1e3 * (d0 * points + scale * moved)
    half_width = 1e3 * d0 * window
    limits = np.array([half_width, min(half_width, 600 * deformation.height)])
    _draw_stress(axis, deformation, drawn, window)
    _draw_arrows(axis, deformation, drawn, limits)

    # The cube before the deformation is dotted, and after it white.
    side = 2e3 * d0
    place = (-side / 2, -side / 2)
    axis.add_patch(Rectangle(place, side, side, fill=False, linestyle=":", linewidth=0.8))
    ring = np.abs(points).max(axis=0)
    face = np.flatnonzero(np.isclose(ring, 1))
    by_angle = np.argsort(np.arctan2(*points[::-1, face]))
    outline = drawn[:, face[by_angle]]
    axis.fill(
        *outline,
        facecolor="white",
        edgecolor="black",
        linewidth=1.2,
    )
    x, z = limits
    axis.set(
        xlim=(-x, x),
        ylim=(-z, z),
        aspect="equal",
        ylabel=r"$z$ / mm",
    )
    axis.grid(False)
    return float(scale)


def _draw_stress(
    axis: Any,
    deformation: Deformation,
    drawn: Array,
    window: float,
) -> None:
    """Draw σzz of the elastomer as colours and contour lines on the points `drawn` (2, n), mm."""
    points = deformation.points
    triangles = deformation.triangles
    ring = np.abs(points).max(axis=0)
    outside_cube = ring[triangles].max(axis=0) > 1 + 1e-9
    # Labels of the contour lines must be in view.
    in_view = np.all(np.abs(points[0, triangles]) < window + 1, axis=0)
    chosen = outside_cube & in_view
    around = triangles[:, chosen]

    # The value of a node is the mean of the triangles around it.
    stress = np.tile(deformation.stress_zz[chosen] / 1e3, 3)
    total = np.bincount(around.ravel(), stress, len(ring))
    count = np.bincount(around.ravel(), minlength=len(ring))
    kilopascal = total / np.maximum(count, 1)
    is_near = (np.abs(points[0]) < window) & (ring >= 1)
    limit = np.percentile(np.abs(kilopascal[is_near]), COLOUR_PERCENTILE)

    mesh = Triangulation(drawn[0], drawn[1], around.T)
    image = axis.tripcolor(mesh, kilopascal, shading="gouraud", cmap=SIGNED_COLOURS)
    image.set_clim(-limit, limit)
    # matplotlib dashes the lines below zero.
    levels = _contour_levels(limit)
    lines = axis.tricontour(mesh, kilopascal, levels, colors="black", linewidths=0.7)
    for label in axis.clabel(
        lines,
        fontsize=7,
        fmt="%g",
        inline=False,
    ):
        label.set_rotation(0)
        label.set_path_effects([withStroke(linewidth=2, foreground="white")])
        beside_cube = np.abs(label.get_position()).max() < 1.5e3 * deformation.half_side
        if beside_cube:  # There is no room for a label beside the cube.
            label.remove()
    colorbar = axis.figure.colorbar(image, ax=axis, label=r"$\sigma_{zz}$ / kPa (dashed: negative)")
    colorbar.add_lines(lines)


def _contour_levels(limit: float) -> Array:
    """Return ten levels of stress for contour lines, in kPa, at round steps. None of them is 0 or
    10 kPa, which large parts of a body have."""
    powers = 10.0 ** np.arange(-9, 10)
    steps = np.multiply.outer([1, 2, 3, 5], powers).ravel()
    # Four steps should be about the range of the colours on one side of zero.
    step = steps[np.argmin(np.abs(np.log(4 * steps / limit)))]
    return step * (np.arange(-5, 5) + 0.5)


def _draw_arrows(
    axis: Any,
    deformation: Deformation,
    drawn: Array,
    limits: Array,
) -> None:
    """Draw the displacements of the nodes that are nearest to the points of a regular grid.

    Args:
        axis: Panel.
        deformation: Deformation whose displacements are drawn.
        drawn: (2, nodes) positions at which the nodes are drawn, in mm.
        limits: (2,) largest distances from the centre along x and z that are in view, in mm.
    """
    d0 = deformation.half_side
    window = limits[0] / (1e3 * d0)
    height = min(window, deformation.height / 2 / d0) - 0.25
    grid = np.mgrid[-window + 1 : window - 0.9, -height : height + 0.1 : height / 2.5]
    from_points = deformation.points[:, None] - grid.reshape(2, -1, 1)
    nodes = np.hypot(*from_points).argmin(axis=1)
    # Nodes are drawn where they have moved to, as the body is.
    tails = drawn[:, nodes]
    moved = deformation.displacement[:, nodes]
    # The longest arrow is as long as d0. Arrows that would leave the view are not drawn.
    arrows = 1e3 * d0 * moved / np.hypot(*moved).max()
    ends = np.abs([tails, tails + arrows])
    in_view = np.all(ends < limits[:, None], axis=(0, 1))
    axis.quiver(
        *tails[:, in_view],
        *arrows[:, in_view],
        color="black",
        edgecolor="white",
        linewidth=0.3,
        width=0.004,
        angles="xy",
        scale_units="xy",
        scale=1,
    )
