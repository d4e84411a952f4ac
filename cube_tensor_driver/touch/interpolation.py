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

from ..core.arrays import Array, Index
from ..core.poses import CubePoses

NEIGHBOURS = 9
"""Number of cubes from whose values a patch (grid of points around a cube) is interpolated: the
cube in the centre of the patch and those nearest to it."""

RIDGE = 1e-6
"""Noise variance of each value, divided by the prior variance of the values. It is added to the
diagonal of their covariance matrix, so that the matrix stays invertible if two cubes are close to
each other."""

_BLOCK = 32
"""Number of patches (grids of points around cubes) whose weights are computed at once. More would
need more memory and not less time."""


class Interpolation:
    """Interpolates one quantity from the cubes to a patch of points around each cube.

    The weights of the interpolation depend only on which values are known. The weights of a patch
    are computed again only if a value of a neighbouring cube has become known or unknown.
    """

    def __init__(
        self,
        poses: CubePoses,
        near: Index,
        patches: Array,
        length: float,
        columns: list[int],
    ) -> None:
        """Set up the interpolation without any known value.

        Args:
            poses: Poses of the cubes.
            near: Indices (cubes, neighbours) of the cubes from which each patch is interpolated.
            patches: Positions (cubes, points, 3) in m of the points around each cube to which
                values are interpolated, in the skin's parent frame.
            length: Length c of the radial basis function, in m.
            columns: Column of the quantity in the values of the cubes. If its derivatives along the
                cubes' x and y axes are to be used, too, their two columns come after it.
        """
        n, width = len(near), len(columns)
        # Lengths are divided by c, so derivatives are multiplied by c.
        self._near = near
        self._columns = columns
        self._unit_factors = np.where(np.arange(width) > 0, length, 1.0)
        self._position = poses.position / length
        self._patches = patches / length
        # The direction 0 stands for the quantity itself instead of a derivative.
        self._directions = np.zeros((n, width, 3))
        self._directions[:, 1:] = poses.rotation[:, :, : width - 1].swapaxes(1, 2)
        self._known = np.zeros((n, width), bool)
        self._weights = np.zeros((*patches.shape[:2], near.shape[1] * width))
        self._deviation = np.ones(patches.shape[:2])

    def interpolate(self, values: Array) -> Array:
        """Interpolate the quantity to the points of all patches.

        Args:
            values: Values and derivatives (cubes, C), NaN where unknown.

        Returns:
            Values (cubes, points); NaN on patches for which no neighbouring cube has a value.
        """
        self._update_weights(values)
        scaled = np.where(
            self._known,
            values[:, self._columns] * self._unit_factors,
            0.0,
        )
        near_values = scaled.take(self._near, axis=0).reshape(
            len(scaled),
            -1,
            1,
        )
        result = (self._weights @ near_values)[:, :, 0]
        result[~self._known[self._near, 0].any(axis=1)] = np.nan
        return result

    def compute_uncertainty(self, values: Array) -> Array:
        """Compute the uncertainty of the result of `interpolate`, with the same argument.

        Returns:
            Standard deviation (cubes, points) of each interpolated value divided by the standard
            deviation of the quantity over the skin: 0 at a cube with a value, 1 far from all cubes.
        """
        self._update_weights(values)
        return self._deviation

    def _update_weights(self, values: Array) -> None:
        """Compute the weights of the patches near which values have become known or unknown."""
        known = np.isfinite(values[:, self._columns])
        if np.array_equal(known, self._known):
            return
        is_changed = (known != self._known)[self._near].any(axis=(1, 2))
        self._known = known
        changed = np.flatnonzero(is_changed)
        for chosen in np.split(changed, range(_BLOCK, len(changed), _BLOCK)):
            self._solve(chosen)

    def _solve(self, chosen: Index) -> None:
        """Compute the weights and the uncertainty of the patches with the indices `chosen` (n,)."""
        near = self._near[chosen]
        known = self._known[near].reshape(len(near), -1)
        position = np.repeat(
            self._position[near],
            self._known.shape[1],
            axis=1,
        )
        directions = self._directions[near].reshape(position.shape)

        # The covariances of unknown values with all others are set to 0, so that unknown values get
        # the weight 0.
        matrix = _compute_covariance(
            position,
            directions,
            position,
            directions,
        )
        matrix *= known[:, :, None] & known[:, None]
        np.einsum("ndd->nd", matrix)[:] += np.where(known, RIDGE, 1.0)
        points = self._patches[chosen]
        to_points = _compute_covariance(
            points,
            np.zeros_like(points),
            position,
            directions,
        )
        to_points *= known[:, None]
        weights = np.linalg.solve(matrix, to_points.swapaxes(1, 2)).swapaxes(1, 2)
        explained = np.einsum("nqd,nqd->nq", weights, to_points)
        self._weights[chosen] = weights
        self._deviation[chosen] = np.sqrt(np.clip(1 - explained, 0, 1))


def _compute_covariance(a: Array, u: Array, b: Array, v: Array) -> Array:
    """Compute the covariances of a quantity and its derivatives at n sets of positions.

    The head of this file states the covariance φ of the quantity and the length c. Derivatives are
    by positions divided by c.

    Args:
        a: Positions (n, A, 3), divided by c.
        u: Directions (n, A, 3) in which the quantity is differentiated at `a`; 0: the quantity
            itself is meant.
        b: Other positions (n, B, 3), divided by c.
        v: Directions (n, B, 3) of the derivatives at `b`.

    Returns:
        Covariances (n, A, B).
    """
    offset = a[:, :, None] - b[:, None]
    along_u = np.einsum("nabi,nai->nab", offset, u)
    along_v = np.einsum("nabi,nbi->nab", offset, v)
    u_dot_v = np.einsum("nai,nbi->nab", u, v)
    is_value = np.all(u == 0, axis=2)[:, :, None]
    is_other_value = np.all(v == 0, axis=2)[:, None]
    # The covariance φ = s^(-5/2) depends on s = 1 + r². `phi1` and `phi2` are its first and second
    # derivatives by s.
    s = 1 + np.einsum("nabi,nabi->nab", offset, offset)
    phi = s**-2.5
    phi1 = -2.5 * phi / s
    phi2 = -3.5 * phi1 / s
    first = is_other_value * along_u - is_value * along_v - u_dot_v
    covariance: Array = (is_value & is_other_value) * phi + 2 * phi1 * first
    covariance -= 4 * phi2 * along_u * along_v
    return covariance
