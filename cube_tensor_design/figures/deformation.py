"""Pictures of σzz on the deformed section of a body, with the cube in it."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.tri import Triangulation

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.views.figures.style import SIGNED_COLOURS, print_style, symbol

from ..paper.virtual_bench import Deformation

_FIGURE_4_TITLES = {
    "zx": r"(a) shear alone: $\sigma_{zx}$ = 10 kPa",
    "zz_x": r"(b) $\sigma_{zz}$ grows along $x$: $d_0\,\partial\sigma_{zz}/\partial x$ = 10 kPa",
}


@print_style()
def draw_loads(layout: Layout, deformations: dict[str, Deformation]) -> Figure:
    """The section under every plane mode, with pads, deformed outline and displacements.

    deformations: of 10 kPa of each plane mode, by the mode's name
    """
    figure = Figure(figsize=(10, 12))
    axes = figure.subplots(4, 2)
    for axis, (name, deformation) in zip(axes.flat, deformations.items(), strict=False):
        scale = _draw_deformation(axis, deformation, 4)
        axis.set_title(f"{symbol(name)}, 10 kPa (displacements times {scale:.2g})")
        _draw_pads(axis, layout, 1e3 * deformation.half_side)
    pad = Patch(facecolor="white", edgecolor="black", hatch="||||", label="pad")
    axes.flat[-1].axis("off")
    axes.flat[-1].legend(handles=[pad], loc="center", handlelength=4)
    figure.supxlabel(r"$x$ / mm")
    return figure


@print_style()
def draw_figure_4(deformations: dict[str, Deformation]) -> Figure:
    """The paper's Fig. 4: the section under shear alone, and under a growing normal stress.

    deformations: of 10 kPa of the modes zx and zz_x
    """
    figure = Figure(figsize=(6, 6))
    axes = figure.subplots(2, 1)
    scale = 1.0
    for axis, (name, deformation) in zip(axes, deformations.items(), strict=True):
        scale = _draw_deformation(axis, deformation, 6)
        axis.set(title=_FIGURE_4_TITLES[name])
    axes[-1].set_xlabel(r"$x$ / mm")
    figure.supxlabel(
        f"White: the cube. Outlines are displaced by {scale:.2g} times\n"
        r"the displacements, arrows show their direction. $d_0$: half side of the cube, 2 mm.",
        fontsize=8,
    )
    return figure


def _draw_pads(axis: Any, layout: Layout, half_side: float) -> None:
    """Pads on the faces of an undeformed cube; half_side in mm."""
    faces = layout.normals[:, [0, 2]]
    for centre, normal in zip(layout.positions[:, [0, 2]], faces, strict=True):
        along = layout.pad_size * (1 - np.abs(normal))
        ends = half_side * (centre + np.outer((-0.5, 0.5), along)).T
        axis.plot(*ends, color="black", linewidth=7, solid_capstyle="butt")
        axis.plot(
            *ends,
            color="white",
            linewidth=3.5,
            linestyle=(0, (0.5, 0.5)),
            dash_capstyle="butt",
        )


def _draw_deformation(axis: Any, deformation: Deformation, window: float) -> float:
    """σzz on the deformed body within `window` d0 of the cube. Returns the displacements' scale."""
    d0, points, moved = deformation.half_side, deformation.points, deformation.displacement
    near = np.abs(points[0]) < window
    scale = 0.4 * d0 / np.hypot(*moved[:, near]).max()
    drawn = 1e3 * (d0 * points + scale * moved)
    _draw_stress(axis, deformation, drawn, window)
    _draw_arrows(axis, deformation, drawn, window)
    corners = 1e3 * d0 * np.array([[-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1]])
    axis.plot(*corners, "k:", linewidth=0.8)
    ring = np.abs(points).max(axis=0)
    face = np.flatnonzero(np.isclose(ring, 1))
    by_angle = np.argsort(np.arctan2(*points[::-1, face]))
    outline = drawn[:, face[by_angle]]
    axis.fill(*outline, facecolor="white", edgecolor="black", linewidth=1.2)
    edge = 1e3 * d0 * window
    top = min(edge, 600 * deformation.height)
    axis.set(xlim=(-edge, edge), ylim=(-top, top), aspect="equal", ylabel=r"$z$ / mm")
    axis.grid(False)
    return float(scale)


def _draw_stress(axis: Any, deformation: Deformation, drawn: Array, window: float) -> None:
    """σzz of the elastomer as colours and contour lines on the points `drawn` (2, nodes), mm."""
    points, triangles = deformation.points, deformation.triangles
    ring = np.abs(points).max(axis=0)
    outside_cube = ring[triangles].max(axis=0) > 1 + 1e-9
    # Labels of the contour lines must be in view.
    in_view = np.all(np.abs(points[0, triangles]) < window + 1, axis=0)
    chosen = outside_cube & in_view
    around = triangles[:, chosen]
    stress = np.tile(deformation.stress_zz[chosen] / 1e3, 3)
    total = np.bincount(around.ravel(), stress, len(ring))
    count = np.bincount(around.ravel(), minlength=len(ring))
    kilopascal = total / np.maximum(count, 1)
    near = np.abs(points[0]) < window
    limit = np.percentile(np.abs(kilopascal[near & (ring >= 1)]), 95)
    mesh = Triangulation(drawn[0], drawn[1], around.T)
    image = axis.tripcolor(
        mesh, kilopascal, cmap=SIGNED_COLOURS, vmin=-limit, vmax=limit, shading="gouraud"
    )
    levels = _contour_levels(limit)
    # matplotlib dashes the lines below zero.
    lines = axis.tricontour(mesh, kilopascal, levels, colors="black", linewidths=0.7)
    for label in axis.clabel(lines, fontsize=7, fmt="%g", inline=False):
        label.set_rotation(0)
        label.set_path_effects([withStroke(linewidth=2, foreground="white")])
        beside_cube = np.abs(label.get_position()).max() < 1.5e3 * deformation.half_side
        if beside_cube:  # too narrow for a label
            label.remove()
    colorbar = axis.figure.colorbar(image, ax=axis, label=r"$\sigma_{zz}$ / kPa (dashed: negative)")
    colorbar.add_lines(lines)


def _contour_levels(limit: float) -> Array:
    """Ten levels at round steps. None is 0 or 10 kPa, which large parts of the body may have."""
    steps = np.multiply.outer([1, 2, 3, 5], 10.0 ** np.arange(-9, 10)).ravel()
    step = steps[np.argmin(np.abs(np.log(4 * steps / limit)))]
    levels: Array = step * (np.arange(-5, 5) + 0.5)
    return levels


def _draw_arrows(axis: Any, deformation: Deformation, drawn: Array, window: float) -> None:
    """Displacements of the mesh's nodes next to a regular grid."""
    tall = min(window, deformation.height / 2 / deformation.half_side) - 0.25
    grid = np.mgrid[-window + 1 : window - 0.9, -tall : tall + 0.1 : tall / 2.5]
    nodes = [
        np.argmin(np.hypot(*(deformation.points - point[:, None])))
        for point in grid.reshape(2, -1).T
    ]
    tails, moved = drawn[:, nodes], deformation.displacement[:, nodes]
    # As long as d0, the longest one; only those that are in view as a whole.
    arrows = 1e3 * deformation.half_side * moved / np.hypot(*moved).max()
    tips = tails + arrows
    edge = 1e3 * deformation.half_side * window
    top = min(edge, 600 * deformation.height)
    limits = np.array([[edge], [top]])
    whole = (np.abs(tips) < limits).all(axis=0) & (np.abs(tails) < limits).all(axis=0)
    axis.quiver(
        *tails[:, whole],
        *arrows[:, whole],
        color="black",
        edgecolor="white",
        linewidth=0.3,
        width=0.004,
        angles="xy",
        scale_units="xy",
        scale=1,
    )
