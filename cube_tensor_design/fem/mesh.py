"""Meshes of a box with a cube |x_k| <= 1 in it, of the positive part where a mirror allows that.

Lengths are in d0. The stress is infinite at the corner (in space, the edges) of the cube, so
elements shrink towards it. Elements end at the edges of pads. Meshes are symmetric under exchange
of axes where the box and the pads are.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
import skfem
from numpy.typing import NDArray

from cube_tensor_driver.core.arrays import Array

_NEAR = 1.5
"""What the cube adds to the stress has decayed at this distance from its faces, d0."""
_FAR_GROWTH = 3.0
_DIRECTIONS = np.array(
    [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)], dtype=float
)


def section(
    half: Sequence[float],
    stops: Iterable[float],
    level: int = 1,
    smallest: float = 1e-8,
    largest: float = np.inf,
    ring: float = 0.5,
) -> skfem.MeshTri:
    """Triangles on [0, half[0]] x [0, half[1]], in rings around the cube's corner (1, 1).

    stops: pad edges on [0, 1]
    level: 0 is coarse, 1 has twice as many rings, each further one cuts all triangles in four
    smallest: size of the last ring over the first; what the rings leave out at 1e-8 is less than
    1e-4 of any entry of the response
    largest: the longest side of a triangle away from the cube
    ring: the half side of the first ring, or less where it does not fit
    """
    inner = sorted({0.0, *(s for s in stops if 0.0 < s < 1.0)})
    rho = min(ring, 1.0 - inner[-1], *(h - 1.0 for h in half))
    face = np.append(_inner(inner, 1.0 - rho, 0.5), 1.0)
    lines = [np.concatenate([face, _outer(1.0 + rho, h, rho, 2.0, largest)]) for h in half]
    base = skfem.MeshTri.init_tensor(*lines)
    away = np.any(np.abs(base.p[:, base.t].mean(axis=1) - 1.0) > rho, axis=0)
    ring_points, ring_triangles = _rings(rho, 0.25 if level == 0 else 0.5, smallest)
    points = np.concatenate([base.p.T, ring_points])
    triangles = np.concatenate([base.t.T[away], ring_triangles + base.p.shape[1]])
    mesh = _joined(points.T, triangles.T)
    return mesh.refined(level - 1) if level > 1 else mesh


def sections(
    lower: Sequence[float], upper: Sequence[float], stops: Iterable[float], level: int
) -> skfem.MeshTri:
    """The same on [-lower[0], upper[0]] x [-lower[1], upper[1]].

    Where `lower` is 0, there is the positive part only.
    """
    stops = list(stops)
    present = [h for h in (*lower, *upper) if h > 0]
    ring = min(0.5, *(h - 1.0 for h in present))
    sides = [((1, u), (-1, l)) if l > 0 else ((1, u),) for l, u in zip(lower, upper, strict=True)]
    return _glued(
        [
            (section((x, z), stops, level, ring=ring), (sx, sz))
            for (sx, x), (sz, z) in itertools.product(*sides)
        ]
    )


def mirrored(quarter: skfem.MeshTri) -> skfem.MeshTri:
    """All of the section from its positive quarter."""
    return _glued([(quarter, signs) for signs in itertools.product((1, -1), repeat=2)])


def _glued(parts: Sequence[tuple[skfem.MeshTri, tuple[int, ...]]]) -> skfem.MeshTri:
    """One mesh of quarters, each with the signs of its axes, which share their edges' points."""
    points: list[Array] = []
    triangles: list[NDArray[np.int64]] = []
    first = 0
    for quarter, signs in parts:
        points.append(quarter.p * np.array(signs)[:, None])
        triangles.append(quarter.t + first)
        first += quarter.nvertices
    return _joined(np.concatenate(points, axis=1), np.concatenate(triangles, axis=1))


def _joined(points: Array, triangles: NDArray[np.int64]) -> skfem.MeshTri:
    """A mesh of points (2, n) of which some are the same, and triangles (3, m)."""
    # As complex numbers: np.unique of rows (axis=0) swallows Ctrl-C. + 0.0: no negative zeros.
    unique, inverse = np.unique(
        (points + 0.0).T[triangles.T.ravel()] @ [1, 1j], return_inverse=True
    )
    return skfem.MeshTri(np.array([unique.real, unique.imag]), inverse.reshape(-1, 3).T.copy())


def block(
    half: Sequence[float],
    stops: Iterable[float],
    size: float,
    smallest: float,
    growth: float,
    lower: Sequence[float] = (0.0, 0.0, 0.0),
    largest: float = np.inf,
) -> skfem.MeshHex:
    """Bricks on the product of [-lower[k], half[k]]: `size` on a face, `smallest` at the cube's
    edges, `largest` far away.

    Away from the cube they grow by the factor `growth`. Where the cube's part of the stress has
    decayed, a linear field needs no fine mesh: there they grow faster.
    """
    inner = sorted({0.0, *(s for s in stops if 0.0 < s < 1.0)})
    fine = 1.0 - _graded(1.0 - inner[-1], smallest, growth)[::-1]
    face = np.concatenate([_inner(inner, inner[-1], size), fine[1:]])

    def line(h: float) -> Array:
        near = 1.0 + _graded(min(h - 1.0, _NEAR), smallest, growth)
        far = _outer(near[-1], h, near[-1] - near[-2], _FAR_GROWTH, largest)
        return np.concatenate([face, near[1:], far[1:]])

    lines = [
        np.concatenate([-line(l)[:0:-1], line(h)]) if l > 0 else line(h)
        for l, h in zip(lower, half, strict=True)
    ]
    return skfem.MeshHex.init_tensor(*lines)


def _inner(stops: Sequence[float], end: float, size: float) -> Array:
    """Points through all stops to the end, no further apart than size."""
    stops = sorted({*stops, end})
    points = [np.array([stops[0]])]
    for a, b in pairwise(stops):
        count = int(np.ceil((b - a) / size - 1e-9))
        points.append(np.linspace(a, b, count + 1)[1:])
    return np.concatenate(points)


def _outer(start: float, end: float, first: float, growth: float, largest: float) -> Array:
    """Points from start to end, both included; steps grow from about `first` up to `largest`."""
    if start == end:
        return np.array([start])
    points = start + _graded(end - start, first * growth, growth)
    return points if np.isinf(largest) else _inner(points.tolist(), end, largest)


def _graded(length: float, first: float, growth: float) -> Array:
    """Points 0 ... length; steps grow by the same factor, starting at or below `first`."""
    n = max(1, int(np.ceil(np.log1p(length * (growth - 1.0) / first) / np.log(growth) - 1e-9)))
    steps = growth ** np.arange(n, dtype=float)
    points = np.concatenate([[0.0], np.cumsum(steps)]) * (length / steps.sum())
    points[-1] = length
    return points


def _rings(rho: float, ratio: float, smallest: float) -> tuple[Array, NDArray[np.int64]]:
    """Points (n, 2) and triangles (m, 3): rings of eight trapezoids about (1, 1).

    Each ring is the one before it times `ratio`; the first has the half side `rho`.
    """
    n = int(np.ceil(np.log(smallest) / np.log(ratio)))
    radii = rho * ratio ** np.arange(n + 1)
    around = 1.0 + np.multiply.outer(radii, _DIRECTIONS).reshape(-1, 2)
    points = np.concatenate([around, [[1.0, 1.0]]])
    triangles = []
    for outer in range(0, 8 * n, 8):  # number of the ring's first point
        inner = outer + 8
        for middle in range(0, 8, 2):  # of a side; its neighbours are corners
            for corner in ((middle + 1) % 8, (middle - 1) % 8):
                # Cut the trapezoid along its shorter diagonal.
                triangles += [
                    (outer + middle, outer + corner, inner + corner),
                    (outer + middle, inner + corner, inner + middle),
                ]
    last = 8 * n
    triangles += [(last + j, last + (j + 1) % 8, len(points) - 1) for j in range(8)]
    return points, np.array(triangles)
