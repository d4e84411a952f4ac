"""Hermite interpolation between cubes by radial functions.

Every cube has a patch of points, which its nearest neighbours make. The interpolant meets the value
of every cube and, along the cube's own x and y where it observes them, the derivatives
(gradient-enhanced interpolation; in statistics, co-kriging with derivatives). With a length c and
the quantity p at the places a and b::

    φ(r) = (1 + r²/c²)^(−5/2)
    cov(p(a), p(b)) = φ,   cov(p(a), ∂_v p(b)) = ∂φ/∂b·v,   cov(∂_u p(a), ∂_v p(b)) = u·∂²φ/∂a∂b·v

The exponent is that of a point force's pressure at a depth (Boussinesq). Source: G. E. Fasshauer,
Meshfree Approximation Methods with MATLAB (2007), ch. 36 (Hermite interpolation).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from ..core.arrays import Array, Mask
from ..core.poses import CubePoses

NEIGHBOURS = 9
"""Nearest cubes, the own one included, that make the points of a cube's patch."""
RIDGE = 1e-6
"""Added to φ(0) = 1. A thousandth of a value then counts as noise: close cubes stay solvable."""


class Interpolation:
    """From values of cubes to points: a patch of equally many points for each cube.

    poses: of the cubes; patches: (cubes, points, 3) m; length: c of the radial function, m
    """

    def __init__(self, poses: CubePoses, patches: Array, length: float) -> None:
        self._poses, self._patches, self._length = poses, patches, length
        self._near = _nearest(poses)
        self._weights: dict[tuple[int, ...], _Weights] = {}

    def values(self, values: Array, columns: list[int]) -> Array:
        """(M,) on all points; NaN on patches of which no neighbour has a value.

        values: (cubes, C), NaN where unknown
        columns: that of the quantity, then those of its derivatives along the cubes' x and y, if
        any
        """
        known = np.isfinite(values)
        n_points = self._patches.shape[0] * self._patches.shape[1]
        if not known[:, columns[0]].any():
            return np.full(n_points, np.nan)
        weights = self._solved(known, columns)
        scale = np.array([1.0, self._length, self._length])[: len(columns)]
        scaled = np.where(known, values, 0)[:, columns] * scale
        result: Array = weights.matrix @ scaled.ravel()
        result[np.repeat(weights.empty, self._patches.shape[1])] = np.nan
        return result

    def uncertainty(self, values: Array, columns: list[int]) -> Array:
        """(M,) standard deviation on all points, as a part of the quantity's own size: 0 to 1."""
        return self._solved(np.isfinite(values), columns).uncertainty.ravel()

    def _solved(self, known: Mask, columns: list[int]) -> _Weights:
        """Weights of these columns.

        They depend only on what is known: they are kept, and solved again where that has changed.
        """
        wanted = known[:, columns]
        key = tuple(columns)
        if key not in self._weights:
            n_points = self._patches.shape[1]
            self._weights[key] = _Weights(self._near, n_points, ~wanted)
        weights = self._weights[key]
        if not np.array_equal(wanted, weights.known):
            changed = np.flatnonzero((wanted != weights.known)[self._near].any(axis=(1, 2)))
            weights.data[changed], weights.uncertainty[changed] = self._solve(changed, wanted)
            weights.known = wanted
            weights.empty = ~wanted[self._near, 0].any(axis=1)
        return weights

    def _solve(self, chosen: NDArray[np.intp], known: Mask) -> tuple[Array, Array]:
        """Weights and relative uncertainty of some patches.

        known: (cubes, width). Returns (patches, points, neighbours × width), (patches, points).
        """
        near, n, width = self._near[chosen], len(chosen), known.shape[1]
        size = near.shape[1] * width
        seen = known[near].reshape(n, size)
        cubes = self._poses.position[near] / self._length
        # (n, neighbours, 2 or 0, 3): the axes along which derivatives are known
        axes = np.swapaxes(self._poses.rotation[:, :, : width - 1], 1, 2)[near]
        points = self._patches[chosen] / self._length
        matrix = _covariance(cubes[:, :, None] - cubes[:, None], axes[:, :, None], axes[:, None])
        matrix = np.moveaxis(matrix, 3, 2).reshape(n, size, size)
        matrix *= seen[:, :, None] & seen[:, None]
        matrix[:, np.arange(size), np.arange(size)] += np.where(seen, RIDGE, 1.0)
        no_axes = np.zeros((n, points.shape[1], 1, 0, 3))
        to_points = _covariance(points[:, :, None] - cubes[:, None], no_axes, axes[:, None])
        to_points = to_points.reshape(n, -1, size) * seen[:, None]
        weights = np.swapaxes(np.linalg.solve(matrix, np.swapaxes(to_points, 1, 2)), 1, 2)
        explained = np.einsum("nqd,nqd->nq", weights, to_points)
        return weights, np.sqrt(np.clip(1 - explained, 0, 1))


class _Weights:
    """A sparse matrix from cubes to points, whose entries can be replaced patch by patch.

    matrix: (M, cubes × width); data: its entries (cubes, points, neighbours × width)
    known: (cubes, width) what they were solved for; uncertainty: (cubes, points), relative
    empty: (cubes,) none of the neighbours has a value
    """

    def __init__(self, near: NDArray[np.intp], points: int, known: Mask) -> None:
        """near (cubes, neighbours); points: of a patch."""
        n, width = known.shape
        columns = (near[:, :, None] * width + np.arange(width)).reshape(n, -1)
        rows = n * points
        self.known, self.empty = known, np.zeros(n, bool)
        self.uncertainty = np.zeros((n, points))
        self.data = np.zeros((n, points, columns.shape[1]))
        indices = np.repeat(columns, points, axis=0).ravel()
        starts = np.arange(rows + 1) * columns.shape[1]
        self.matrix = csr_matrix(
            (self.data.ravel(), indices, starts), shape=(rows, n * width), copy=False
        )


def _nearest(poses: CubePoses) -> NDArray[np.intp]:
    """(cubes, neighbours) numbers of the nearest cubes; of cubes equally far, the first ones."""
    n = len(poses.position)
    count = min(NEIGHBOURS, n)
    distance, near = cKDTree(poses.position).query(poses.position, min(3 * count, n))
    distance, near = distance.reshape(n, -1), near.reshape(n, -1)
    # Rounding of the distances must not decide.
    order = np.lexsort((near, (distance / poses.pitch).round(6)))[:, :count]
    return np.take_along_axis(near, order, axis=1)


def _covariance(d: Array, u: Array, v: Array) -> Array:
    """(..., 1 + A, 1 + B) covariances of value and derivatives at two places.

    d: (..., 3) the first place minus the second, over c
    u: (..., A, 3), v: (..., B, 3) directions of the derivatives at the first and second place
    """
    b = 1 + np.einsum("...i,...i->...", d, d)
    f, f1, f2 = b**-2.5, -2.5 * b**-3.5, 8.75 * b**-4.5
    du, dv = (np.einsum("...i,...ai->...a", d, axes) for axes in (u, v))
    result = np.empty((*b.shape, 1 + du.shape[-1], 1 + dv.shape[-1]))
    result[..., 0, 0] = f
    result[..., 0, 1:] = -2 * f1[..., None] * dv
    result[..., 1:, 0] = 2 * f1[..., None] * du
    straight = -2 * f1[..., None, None] * np.einsum("...ai,...bi->...ab", u, v)
    curved = 4 * f2[..., None, None] * du[..., None] * dv[..., None, :]
    result[..., 1:, 1:] = straight - curved
    return result
