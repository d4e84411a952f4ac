# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Hermite interpolation between cubes by radial basis functions.

Every cube has a patch, a grid of points around it. The quantity p (for example the pressure) at
these points is interpolated from the cube and its nearest neighbours. The interpolant has the
measured value at every cube and also, where the cube observes them, the measured derivatives along
the cube's x and y axes (gradient-enhanced interpolation; in statistics, co-kriging with
derivatives). With the length c of the basis function φ, the distance r of two positions a and b,
and directions u and v of derivatives::

    φ(r) = (1 + r²/c²)^(−5/2)
    cov(p(a), p(b)) = φ,   cov(p(a), ∂_v p(b)) = ∂φ/∂b·v,   cov(∂_u p(a), ∂_v p(b)) = u·∂²φ/∂a∂b·v

The exponent is that of the pressure of a point force at a depth (Boussinesq). Source: G. E.
Fasshauer, Meshfree Approximation Methods with MATLAB (2007), ch. 36 (Hermite interpolation).
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from ..core.arrays import Array, Index, Mask
from ..core.poses import CubePoses
from .nearest_cubes import find_nearest_cubes

NEIGHBOURS = 9
"""Number of cubes from whose values a patch (grid of points around a cube) is interpolated: the
cube in the centre of the patch and those nearest to it."""

RIDGE = 1e-6
"""Noise variance of each value, divided by the prior variance of the values. It is added to the
diagonal of their covariance matrix, so that the matrix stays invertible if two cubes are close to
each other."""


class Interpolation:
    """Interpolates values of cubes to a patch of points around each cube."""

    def __init__(
        self,
        poses: CubePoses,
        patches: Array,
        length: float,
    ) -> None:
        """Find the neighbours of each cube.

        Args:
            poses: Poses of the cubes.
            patches: Positions (cubes, points, 3) in m of the points around each cube to which
                values are interpolated, in the skin's parent frame.
            length: Length c of the radial basis function, in m.
        """
        self._poses = poses
        self._patches = patches
        self._length = length
        self._near = find_nearest_cubes(poses, NEIGHBOURS)
        self._weights: dict[tuple[int, ...], _Weights] = {}

    def interpolate(self, values: Array, columns: list[int]) -> Array:
        """Interpolate one quantity to the M points of all patches.

        Args:
            values: Values and derivatives (cubes, C), NaN where unknown.
            columns: Column of the quantity in `values`. If its derivatives along the cubes' x and y
                axes are to be used, too, their two columns come after it.

        Returns:
            Values (M,) on all points; NaN on patches for which no neighbouring cube has a value.
        """
        n_cubes, n_points, _ = self._patches.shape
        known = np.isfinite(values)
        if not known[:, columns[0]].any():
            return np.full(n_cubes * n_points, np.nan)

        weights = self._solve_weights(known, columns)
        # Positions are divided by the length c of the radial basis function. So derivatives by the
        # position are multiplied by c.
        scale = np.full(len(columns), self._length)
        scale[0] = 1.0
        known_values = np.where(known, values, 0)
        scaled = known_values[:, columns] * scale
        result: Array = weights.matrix @ scaled.ravel()
        is_unknown = np.repeat(weights.empty, n_points)
        result[is_unknown] = np.nan
        return result

    def compute_uncertainty(self, values: Array, columns: list[int]) -> Array:
        """Compute the uncertainty of the result of `values`, with the same arguments.

        Returns:
            Standard deviation (M,) of each interpolated value divided by the standard deviation of
            the quantity over the skin: 0 at a cube with a value, 1 far from all cubes.
        """
        known = np.isfinite(values)
        weights = self._solve_weights(known, columns)
        return weights.uncertainty.ravel()

    def _solve_weights(self, known: Mask, columns: list[int]) -> _Weights:
        """Return the interpolation weights for some columns of the values.

        The weights depend only on which values are known. For each patch, they are computed again
        only if this has changed for one of its neighbouring cubes since the previous call.

        Args:
            known: Whether each value and derivative (cubes, C) is known.
            columns: Column of the quantity and, if they are used, columns of its two derivatives.
        """
        wanted = known[:, columns]
        key = tuple(columns)
        if key not in self._weights:
            n_points = self._patches.shape[1]
            # `known` of new weights starts as the opposite of `wanted`. So every patch counts as
            # changed, and its weights are computed below.
            self._weights[key] = _Weights(self._near, n_points, ~wanted)

        weights = self._weights[key]
        if not np.array_equal(wanted, weights.known):
            differs = wanted != weights.known
            is_changed = differs[self._near].any(axis=(1, 2))
            changed = np.flatnonzero(is_changed)
            data, uncertainty = self._solve(changed, wanted)
            weights.data[changed] = data
            weights.uncertainty[changed] = uncertainty
            weights.known = wanted
            has_value = wanted[self._near, 0]
            weights.empty = ~has_value.any(axis=1)
        return weights

    def _solve(self, chosen: Index, known: Mask) -> tuple[Array, Array]:
        """Compute the interpolation weights of some patches (grids of points around cubes).

        Args:
            chosen: Indices (patches,) of the patches.
            known: Whether each number of a cube is known (cubes, width). The numbers are the value
                alone (width 1), or the value and its derivatives along x and y (width 3).

        Returns:
            Weights (patches, points, neighbours x width) of the neighbours' values, and the
            uncertainty (patches, points) as from `compute_uncertainty`.
        """
        near = self._near[chosen]
        n, n_near = near.shape
        width = known.shape[1]
        size = n_near * width
        is_known = known[near].reshape(n, size)

        cubes = self._poses.position[near] / self._length
        points = self._patches[chosen] / self._length
        # `axes` (n, neighbours, 2 or 0, 3) are the directions of the derivatives that are used: the
        # x and y axes of the cubes, or none.
        columns = self._poses.rotation[:, :, : width - 1]
        axes = np.swapaxes(columns, 1, 2)[near]

        offset = cubes[:, :, None] - cubes[:, None]
        matrix = _compute_covariance(
            offset,
            axes[:, :, None],
            axes[:, None],
        )
        matrix = np.moveaxis(matrix, 3, 2)
        matrix = matrix.reshape(n, size, size)
        # The covariances of unknown values with all others are set to 0, so that unknown values get
        # the weight 0.
        are_both_known = is_known[:, :, None] & is_known[:, None]
        matrix *= are_both_known
        diagonal = np.arange(size)
        noise_variance = np.where(is_known, RIDGE, 1.0)
        matrix[:, diagonal, diagonal] += noise_variance

        offset = points[:, :, None] - cubes[:, None]
        n_points = points.shape[1]
        no_axes = np.zeros((n, n_points, 1, 0, 3))
        to_points = _compute_covariance(offset, no_axes, axes[:, None])
        to_points = to_points.reshape(n, -1, size)
        to_points = to_points * is_known[:, None]

        from_points = np.swapaxes(to_points, 1, 2)
        solution = np.linalg.solve(matrix, from_points)
        weights = np.swapaxes(solution, 1, 2)
        explained = np.einsum("nqd,nqd->nq", weights, to_points)
        variance = np.clip(1 - explained, 0, 1)
        return weights, np.sqrt(variance)


class _Weights:
    """Interpolation weights as a sparse matrix, whose entries can be replaced patch by patch.

    In the shapes, M is the number of points of all patches, and `width` the number of values of a
    cube: 1 without derivatives and 3 with both.

    Attributes:
        matrix: Matrix (M, cubes x width) from the value and derivatives of all cubes to all points.
        data: View (cubes, points, neighbours x width) of the entries of `matrix`.
        known: Whether each value and derivative (cubes, width) was known when the weights were
            computed.
        uncertainty: Uncertainty (cubes, points) as from `Interpolation.compute_uncertainty`.
        empty: Whether no neighbour of a cube (cubes,) has a value.
    """

    def __init__(
        self,
        near: Index,
        points: int,
        known: Mask,
    ) -> None:
        """Create a matrix of zeros.

        Args:
            near: Indices (cubes, neighbours) of the cubes from which each patch is interpolated.
            points: Number of points of a patch (grid of points around a cube).
            known: Initial value (cubes, width) of the attribute `known`.
        """
        n, width = known.shape
        first_column = near[:, :, None] * width
        columns = first_column + np.arange(width)
        columns = columns.reshape(n, -1)
        per_row = columns.shape[1]
        rows = n * points

        self.known = known
        self.empty = np.zeros(n, bool)
        self.uncertainty = np.zeros((n, points))
        self.data = np.zeros((n, points, per_row))
        indices = np.repeat(columns, points, axis=0).ravel()
        # `starts` are the row starts of the CSR format (compressed sparse rows). All rows have
        # equally many entries.
        starts = np.arange(rows + 1) * per_row
        self.matrix = csr_matrix(
            (
                self.data.ravel(),
                indices,
                starts,
            ),
            shape=(rows, n * width),
            copy=False,
        )


def _compute_covariance(
    d: Array,
    u: Array,
    v: Array,
) -> Array:
    """Compute the covariances of a quantity and its derivatives at two positions (file head).

    Args:
        d: First position minus the second (..., 3), divided by the length c.
        u: Directions (..., A, 3) of the derivatives at the first position.
        v: Directions (..., B, 3) of the derivatives at the second position.

    Returns:
        Covariances (..., 1 + A, 1 + B). Rows: value and A derivatives at the first position;
        columns: value and B derivatives at the second one. Derivatives are by position / c.
    """
    # The covariance φ = b^(-5/2) depends on b = 1 + |d|². Its derivatives by b follow below.
    b = 1 + np.einsum("...i,...i->...", d, d)
    phi = b**-2.5
    phi1 = -2.5 * b**-3.5
    phi2 = 8.75 * b**-4.5
    along_u = np.einsum("...i,...ai->...a", d, u)
    along_v = np.einsum("...i,...ai->...a", d, v)

    n_rows = 1 + u.shape[-2]
    n_columns = 1 + v.shape[-2]
    slope = 2 * phi1[..., None]
    result = np.empty((*b.shape, n_rows, n_columns))
    result[..., 0, 0] = phi
    result[..., 0, 1:] = -slope * along_v
    result[..., 1:, 0] = slope * along_u
    u_dot_v = np.einsum("...ai,...bi->...ab", u, v)
    product = along_u[..., None] * along_v[..., None, :]
    first = -slope[..., None] * u_dot_v
    second = -4 * phi2[..., None, None] * product
    result[..., 1:, 1:] = first + second
    return result
