# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Meshes of a box with a cube |x_k| <= 1 in it, or of the positive part where a mirror allows that.

Lengths are in d0, the half side of the cube. The stress is infinite at the corner (in space, at the
edges) of the cube, so elements shrink towards it. Elements end at the edges of pads. Meshes are
symmetric under exchange of axes where the box and the pads are.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
import skfem

from cube_tensor_driver.core.arrays import Array, Index

DECAY_DISTANCE = 1.5
"""Distance from the cube's faces, in d0 (half the side of the cube), at which the stress that the
cube adds has decayed. Beyond it, where the field is linear, bricks grow by `FAR_GROWTH`."""
FAR_GROWTH = 3.0
"""Ratio of the sizes of two neighbouring bricks (box-shaped elements) beyond `DECAY_DISTANCE`."""
SECTION_GROWTH = 2.0
"""Ratio of the sizes of two neighbouring triangles away from the cube."""
RING_HALF_SIDE = 0.5
"""Half side of the largest square ring of triangles around the cube's corner, in d0 (half the side
of the cube)."""
_RING_POINTS = np.array(
    [
        (1.0, 0.0),
        (1.0, 1.0),
        (0.0, 1.0),
        (-1.0, 1.0),
        (-1.0, 0.0),
        (-1.0, -1.0),
        (0.0, -1.0),
        (1.0, -1.0),
    ]
)
"""Points (8, 2) of a square ring of half side 1 around the origin, anticlockwise. Those with an odd
number are corners, the others the middles of sides."""


def mesh_quarter(
    half: Sequence[float],
    stops: Iterable[float],
    level: int = 1,
    smallest: float = 1e-8,
    largest: float = np.inf,
    ring: float = RING_HALF_SIDE,
) -> skfem.MeshTri:
    """Mesh [0, half[0]] x [0, half[1]] with triangles in rings around the cube's corner (1, 1).

    Lengths are in d0 (half the side of the cube), from the cube's centre.

    Args:
        half: Half width and half height of the section.
        stops: Pad edges on [0, 1], at which elements end.
        level: 0 is coarse, 1 has twice as many rings, each further one cuts all triangles in four.
        smallest: Ratio of the last ring's size to the first one's. What the rings leave out at 1e-8
            is less than 1e-4 of any entry of the response.
        largest: Longest side of a triangle away from the cube.
        ring: Half side of the first ring, which is smaller where this does not fit.
    """
    inner = sorted({0.0, *(s for s in stops if 0.0 < s < 1.0)})
    # The rings must reach neither a pad's edge nor the surface of the body.
    rho = min(ring, 1.0 - inner[-1], *(h - 1.0 for h in half))
    face = np.append(_split(inner, 1.0 - rho, 0.5), 1.0)
    lines = []
    for end in half:
        outer = _grow_to(1.0 + rho, end, rho, SECTION_GROWTH, largest)
        lines.append(np.concatenate([face, outer]))

    # A product grid has a square hole around the corner, which the rings fill.
    base = skfem.MeshTri.init_tensor(*lines)
    centres = base.p[:, base.t].mean(axis=1)
    from_corner = np.abs(centres - 1.0)
    outside_rings = np.any(from_corner > rho, axis=0)
    ring_points, ring_triangles = _make_rings(
        rho,
        0.25 if level == 0 else 0.5,
        smallest,
    )
    points = np.concatenate([base.p.T, ring_points])
    # The points of the rings are numbered after those of the grid.
    ring_triangles = ring_triangles + base.nvertices
    triangles = np.concatenate([base.t.T[outside_rings], ring_triangles])
    mesh = _merge_points(points.T, triangles.T)
    return mesh.refined(level - 1) if level > 1 else mesh


def mesh_section(
    lower: Sequence[float],
    upper: Sequence[float],
    stops: Iterable[float],
    level: int,
) -> skfem.MeshTri:
    """Mesh [-lower[0], upper[0]] x [-lower[1], upper[1]] as `mesh_quarter` meshes a quarter.

    Where `lower` is 0, only the positive part is meshed.
    """
    stops = list(stops)
    # All quarters need rings of the same size, or the points on their common edges would differ.
    meshed = [length for length in (*lower, *upper) if length > 0]
    ring = min(RING_HALF_SIDE, min(meshed) - 1.0)
    # The sign and the length of each half that is meshed, along each axis.
    sides = []
    for below, above in zip(lower, upper, strict=True):
        halves = [(1, above)]
        if below > 0:
            halves.append((-1, below))
        sides.append(halves)
    parts = []
    for (sign_x, x), (sign_z, z) in itertools.product(*sides):
        quarter = mesh_quarter((x, z), stops, level, ring=ring)
        parts.append((quarter, (sign_x, sign_z)))
    return _join_quarters(parts)


def mirror_quarter(quarter: skfem.MeshTri) -> skfem.MeshTri:
    """Return the mesh of the whole section from that of its positive quarter."""
    all_signs = itertools.product((1, -1), repeat=2)
    return _join_quarters([(quarter, signs) for signs in all_signs])


def _join_quarters(
    parts: Sequence[tuple[skfem.MeshTri, tuple[int, ...]]],
) -> skfem.MeshTri:
    """Return one mesh of quarters that share their edges; the signs of a quarter mirror its
    axes."""
    points: list[Array] = []
    triangles: list[Index] = []
    first = 0
    for quarter, signs in parts:
        points.append(quarter.p * np.array(signs)[:, None])
        triangles.append(quarter.t + first)
        first += quarter.nvertices
    all_points = np.concatenate(points, axis=1)
    all_triangles = np.concatenate(triangles, axis=1)
    return _merge_points(all_points, all_triangles)


def _merge_points(points: Array, triangles: Index) -> skfem.MeshTri:
    """Return a mesh of triangles (3, m, numbers of points) in which equal points (2, n) are one."""
    # The points are complex numbers here, because np.unique of rows (axis=0) swallows Ctrl-C.
    # Adding 0.0 turns -0.0 into 0.0.
    x, y = points + 0.0
    corners = (x + 1j * y)[triangles.T.ravel()]
    unique, inverse = np.unique(corners, return_inverse=True)
    merged = np.array([unique.real, unique.imag])
    # skfem (the finite element library) wants contiguous arrays.
    by_triangle = inverse.reshape(-1, 3)
    return skfem.MeshTri(merged, by_triangle.T.copy())


def mesh_box(
    lower: Sequence[float],
    upper: Sequence[float],
    stops: Iterable[float],
    *,
    size: float,
    smallest: float,
    growth: float,
    largest: float = np.inf,
) -> skfem.MeshHex:
    """Mesh the product of the intervals [-lower[k], upper[k]] with bricks.

    Away from the cube bricks grow by the factor `growth`, and faster where the stress that the cube
    adds has decayed. Lengths are in d0 (half the side of the cube), from the cube's centre.

    Args:
        lower: Length on the negative side of each axis; 0 where there is a mirror.
        upper: Length on the positive side of each axis.
        stops: Pad edges on [0, 1], at which bricks end.
        size: Size of a brick on a face of the cube.
        smallest: Size of a brick at an edge of the cube.
        growth: Ratio of the sizes of two neighbouring bricks.
        largest: Size of a brick far away from the cube.
    """
    inner = sorted({0.0, *(s for s in stops if 0.0 < s < 1.0)})
    from_edge = _grade_nodes(1.0 - inner[-1], smallest, growth)
    to_edge = 1.0 - from_edge[::-1]
    to_last_pad = _split(inner, inner[-1], size)
    face = np.concatenate([to_last_pad, to_edge[1:]])

    def make_half_line(end: float) -> Array:
        decay_end = min(end - 1.0, DECAY_DISTANCE)
        near = 1.0 + _grade_nodes(decay_end, smallest, growth)
        # The first brick far away continues from the last one that is near.
        last_step = near[-1] - near[-2]
        far = _grow_to(near[-1], end, last_step, FAR_GROWTH, largest)
        return np.concatenate([face, near[1:], far[1:]])

    lines = []
    for below, above in zip(lower, upper, strict=True):
        line = make_half_line(above)
        if below > 0:
            negative = -make_half_line(below)[:0:-1]
            line = np.concatenate([negative, line])
        lines.append(line)
    return skfem.MeshHex.init_tensor(*lines)


def _split(
    stops: Sequence[float],
    end: float,
    size: float,
) -> Array:
    """Return points (n,) that contain all stops and the end, and are at most `size` apart."""
    stops = sorted({*stops, end})
    points = [np.array([stops[0]])]
    for a, b in pairwise(stops):
        exact = (b - a) / size
        count = int(np.ceil(exact - 1e-9))
        points.append(np.linspace(a, b, count + 1)[1:])
    return np.concatenate(points)


def _grow_to(
    start: float,
    end: float,
    first: float,
    growth: float,
    largest: float,
) -> Array:
    """Return points (n,) from start to end inclusive. Steps begin near `first` and grow by the
    factor `growth` up to `largest`."""
    if start == end:
        return np.array([start])
    points = start + _grade_nodes(end - start, first * growth, growth)
    return points if np.isinf(largest) else _split(points.tolist(), end, largest)


def _grade_nodes(
    length: float,
    first: float,
    growth: float,
) -> Array:
    """Return points (n,) from 0 to length in steps that grow by the factor `growth`; the first step
    is at most `first`."""
    # The geometric series of n steps from `first` must reach the length.
    ratio = length * (growth - 1.0) / first
    exact = np.log1p(ratio) / np.log(growth)
    n = max(1, int(np.ceil(exact - 1e-9)))
    steps = growth ** np.arange(n, dtype=float)
    # The n steps are shrunk together so that they end at the length.
    points = np.zeros(n + 1)
    points[1:] = np.cumsum(steps)
    points *= length / steps.sum()
    points[-1] = length  # Free of rounding, so that the next part begins at the same point.
    return points


def _make_rings(
    rho: float,
    ratio: float,
    smallest: float,
) -> tuple[Array, Index]:
    """Return points (n, 2) and triangles (m, 3) of rings of eight trapezoids about (1, 1).

    Each ring is the one before times `ratio`; the first has the half side `rho`, the last
    `smallest` times that."""
    n = int(np.ceil(np.log(smallest) / np.log(ratio)))
    radii = rho * ratio ** np.arange(n + 1)
    from_corner = np.multiply.outer(radii, _RING_POINTS)
    around = 1.0 + from_corner.reshape(-1, 2)
    # The corner of the cube is the last point.
    points = np.concatenate([around, [[1.0, 1.0]]])
    # The triangles of the first ring; the points of the next ring in are numbered from 8 on.
    pattern = []
    for side in range(0, 8, 2):  # The points in the middle of a side, between two corners.
        for corner in ((side + 1) % 8, (side - 1) % 8):
            # Cut the trapezoid along its shorter diagonal.
            pattern += [(side, corner, 8 + corner), (side, 8 + corner, 8 + side)]
    first_points = 8 * np.arange(n)[:, None, None]
    rings = (np.array(pattern) + first_points).reshape(-1, 3)
    # The last ring is closed by triangles to the corner of the cube itself.
    turn = np.arange(8)
    fan = np.stack([turn, (turn + 1) % 8, np.full(8, 8)], axis=1)
    return points, np.concatenate([rings, 8 * n + fan])
