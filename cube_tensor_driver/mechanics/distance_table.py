# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Interpolation of tables over the distance between a load and a cube, or between two cubes.

A layer is the same everywhere and in all directions. Quantities that depend on the offset of two
positions are therefore tabulated over their distance only: the direction of the offset multiplies
circular components (circular.py) by a phase.
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array

POINTS_PER_DEPTH = 32
"""Depth of the cubes' centres below the surface, divided by the step of the tabulated distances
between load and cube. The error of the cubic interpolation is then 1e-4 of the largest value."""

REACH_DEPTHS = 20
"""Largest tabulated distance along the surface from a load to a cube, divided by the depth of the
cubes' centres below the surface. Beyond it, responses and covariances fall with the inverse square
of the distance, like the stress under a tangential force on a half space."""

_POWERS = np.vander([-1, 0, 1, 2], increasing=True)
"""Powers 1, t, t^2, t^3 (4 table entries, 4 powers) at the entries t = -1, 0, 1, 2."""

_VALUE = np.round(6 * np.linalg.inv(_POWERS).T) / 6
"""Coefficients (4 table entries, 4 powers) of the cubic polynomials in t that are 1 at one of the
entries t = -1, 0, 1, 2 and 0 at the others. They are multiples of 1/6."""

_DERIVATIVE = np.diag([1.0, 2.0, 3.0], -1)
"""Matrix (4, 4) from the coefficients of a cubic polynomial to those of its derivative."""

_SLOPE = _VALUE @ _DERIVATIVE
"""Coefficients (4 table entries, 4 powers) of the first derivatives of the four interpolation
polynomials, whose own coefficients are `_VALUE`."""

_CURVATURE = _SLOPE @ _DERIVATIVE
"""Coefficients (4 table entries, 4 powers) of the second derivatives of the four interpolation
polynomials, whose own coefficients are `_VALUE`."""

_CUBIC_LAGRANGE = np.stack([_VALUE, _SLOPE, _CURVATURE])
"""Coefficients (3, 4 table entries, 4 powers) of the weights of cubic Lagrange interpolation, and
of the first and second derivatives of these weights.

The weight of an entry is the sum of its coefficients times 1, t, t^2, t^3. t is 0 at the second of
the four entries and 1 at the third.
"""


class DistanceTable:
    """Equally spaced distances, and the interpolation of values that are tabulated at them.

    Cubic interpolation uses two table entries on each side. So the table has one distance before 0,
    and two beyond the largest distance.

    Attributes:
        step: Difference of two neighbouring distances in m.
        last: Index of the largest distance, counted from the distance 0.
        distances: Tabulated distances (distances,) in m, from -`step` on.
    """

    def __init__(self, depth: float) -> None:
        """Compute the distances at which values are tabulated.

        Args:
            depth: Distance from the centres of the cubes to the surface, in m.
        """
        self.step = depth / POINTS_PER_DEPTH
        self.last = REACH_DEPTHS * POINTS_PER_DEPTH
        index = np.arange(-1.0, self.last + 3)
        self.distances = index * self.step

    def compute_weights(
        self,
        distance: Array,
        count: int = 1,
    ) -> tuple[Array, ...]:
        """Return the rows and weights of the interpolation of a table over the distance.

        Args:
            distance: Distances (N,) in m.
            count: Number of sets of weights. The first set is for the value, the second and third
                are for its first and second derivative by the row number.

        Returns:
            Index (N,) of the first of the four rows from which each value is interpolated, and the
            sets of weights (4, N) of these rows.
        """
        index, decay = self.locate(distance)
        # Row 0 is one step before the distance 0. So row `below` is one step before the largest
        # tabulated distance that is not above the given one, and is the first of the four rows.
        below, *weights = compute_cubic_weights(index, count)
        return below, *(one * decay for one in weights)

    def locate(self, distance: Array) -> tuple[Array, Array]:
        """Return fractional indices (N,) of distances, and factors (N,) of the tabulated values.

        Beyond `REACH_DEPTHS` depths, the index stays at `last`, and the factor falls from 1 with
        the inverse square of the distance.

        Args:
            distance: Distances (N,) in m.
        """
        index = distance / self.step
        ratio = self.last / np.maximum(index, self.last)
        decay = ratio**2
        return np.minimum(index, self.last), decay

    def interpolate(
        self,
        table: Array,
        distance: Array,
    ) -> Array:
        """Interpolate a table over the distance between load and cube, or between two cubes.

        Args:
            table: Values (distances, ...) at the tabulated distances.
            distance: Distances (N,) in m.

        Returns:
            Values (N, ...).
        """
        first, weights = self.compute_weights(distance)
        value_axes = (1,) * (table.ndim - 1)
        weights = weights.reshape(4, len(distance), *value_axes)
        terms = []
        for j, weight in enumerate(weights):
            row = table[first + j]
            terms.append(weight * row)
        return np.asarray(sum(terms))


def compute_cubic_weights(
    index: Array | float,
    count: int = 1,
) -> tuple[Array, ...]:
    """Return the weights of cubic Lagrange interpolation from four neighbouring table entries.

    Args:
        index: Fractional index (...), which lies between the second and the third entry.
        count: Number of sets of weights. The first set is for the value, the second and third are
            for its first and second derivative by the index.

    Returns:
        Index (...) of the second entry, and the sets of weights (4, ...) of all four entries.
    """
    first = np.floor(index).astype(np.intp)
    t = index - first
    square = t * t
    cube = square * t
    powers = np.stack([np.ones_like(t), t, square, cube])
    weights = _CUBIC_LAGRANGE[:count] @ powers
    return first, *weights


def to_polar(place: Array) -> tuple[Array, Array]:
    """Convert positions (N, 2) in the x-y plane to polar coordinates about the origin.

    Returns:
        Distances (N,) from the origin, and directions (N,), as angles from the x axis, in rad.
    """
    x, y = place.T
    return np.hypot(x, y), np.arctan2(y, x)
