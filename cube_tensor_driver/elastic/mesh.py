"""Meshes of the positive quarter or eighth of a box with a cube |x_k| <= 1 in its middle (lengths
in d0).

The stress is infinite at the corner (in 3-D the edges) of the cube, so elements shrink towards it.
Pad edges are element ends. Everything is symmetric under exchange of axes where the box and the
pads are.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
import skfem
from numpy.typing import NDArray

Array = NDArray[np.float64]

_NEAR = 1.5
_FAR = 3.0
_DIRECTIONS = np.array(
    [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)], dtype=float
)


def section(
    half: Sequence[float],
    stops: Iterable[float],
    level: int = 1,
    smallest: float = 1e-8,
    largest: float = np.inf,
) -> skfem.MeshTri:
    """Triangles on [0, half[0]] x [0, half[1]], with self-similar rings around the cube's corner
    (1, 1).

    stops: pad edges on [0, 1]; level: 0 coarse, 1 with twice as many rings, then all triangles cut
    in four.
    smallest: size of the last ring over the first; what it leaves out at 1e-8 is below 1e-4 of any
    entry.
    largest: the longest side of a triangle away from the cube.
    """
    inner = sorted({0.0, *(s for s in stops if 0.0 < s < 1.0)})
    rho = min(0.5, 1.0 - inner[-1], *(h - 1.0 for h in half))
    face = np.append(_inner(inner, 1.0 - rho, 0.5), 1.0)
    lines = [np.concatenate([face, _outer(1.0 + rho, h, rho, 2.0, largest)]) for h in half]
    base = skfem.MeshTri.init_tensor(*lines)
    away = np.any(np.abs(base.p[:, base.t].mean(axis=1) - 1.0) > rho, axis=0)
    ring, corner = _rings(rho, 0.25 if level == 0 else 0.5, smallest)
    points = np.concatenate([base.p.T, ring])
    triangles = np.concatenate([base.t.T[away], corner + base.p.shape[1]])
    # As complex numbers: comparing rows (axis=0) swallows Ctrl-C.
    unique, inverse = np.unique(points[triangles.ravel()] @ [1, 1j], return_inverse=True)
    mesh = skfem.MeshTri(np.array([unique.real, unique.imag]), inverse.reshape(-1, 3).T.copy())
    return mesh.refined(level - 1) if level > 1 else mesh


def mirrored(quarter: skfem.MeshTri) -> skfem.MeshTri:
    """The whole section from its positive quarter."""
    points: list[Array] = []
    triangles: list[NDArray[np.int64]] = []
    for sx, sz in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
        points.append(quarter.p * np.array([[sx], [sz]]) + 0.0)  # + 0.0: no negative zeros
        triangles.append(quarter.t + quarter.nvertices * len(triangles))
    unique, inverse = np.unique(np.concatenate(points, axis=1), axis=1, return_inverse=True)
    return skfem.MeshTri(
        np.ascontiguousarray(unique), inverse.reshape(-1)[np.concatenate(triangles, axis=1)]
    )


def block(
    half: Sequence[float], stops: Iterable[float], size: float, smallest: float, growth: float
) -> skfem.MeshHex:
    """Bricks on the product of [0, half[k]]: `size` on a face, shrinking to `smallest` at its
    edges.

    They grow by `growth` up to _NEAR from the face; what the cube adds to the stress has decayed
    there, and the linear field that is left needs no fine mesh: beyond they grow by _FAR.
    """
    inner = sorted({0.0, *(s for s in stops if 0.0 < s < 1.0)})
    fine = 1.0 - _graded(1.0 - inner[-1], smallest, growth)[::-1]
    face = np.concatenate([_inner(inner, inner[-1], size), fine[1:]])
    lines = []
    for h in half:
        near = 1.0 + _graded(min(h - 1.0, _NEAR), smallest, growth)
        far = _outer(near[-1], h, near[-1] - near[-2], _FAR, np.inf)
        lines.append(np.concatenate([face, near[1:], far[1:]]))
    return skfem.MeshHex.init_tensor(*lines)


def _inner(stops: Sequence[float], end: float, size: float) -> Array:
    """Points through all stops to end, no further apart than size."""
    stops = sorted({*stops, end})
    steps = [
        np.linspace(a, b, int(np.ceil((b - a) / size - 1e-9)) + 1)[1:] for a, b in pairwise(stops)
    ]
    return np.concatenate([[stops[0]], *steps])


def _outer(start: float, end: float, first: float, growth: float, largest: float) -> Array:
    """Points from start to end, both included, with steps that grow from about `first` up to
    `largest`."""
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
    """Points (n, 2) and triangles (m, 3): rings of eight trapezoids about (1, 1), each a ratio of
    the last."""
    n = int(np.ceil(np.log(smallest) / np.log(ratio)))
    radii = rho * ratio ** np.arange(n + 1)
    points = np.concatenate(
        [1.0 + np.multiply.outer(radii, _DIRECTIONS).reshape(-1, 2), [[1.0, 1.0]]]
    )
    triangles = []
    for k in range(n):
        for j in range(0, 8, 2):  # j: mid of a side; its neighbours are corners
            for i in ((j + 1) % 8, (j - 1) % 8):
                out, out_corner, into, into_corner = (
                    8 * k + j,
                    8 * k + i,
                    8 * k + 8 + j,
                    8 * k + 8 + i,
                )
                # cut along the shorter diagonal
                triangles += [(out, out_corner, into_corner), (out, into_corner, into)]
    last = 8 * n
    triangles += [(last + j, last + (j + 1) % 8, len(points) - 1) for j in range(8)]
    return points, np.array(triangles)
