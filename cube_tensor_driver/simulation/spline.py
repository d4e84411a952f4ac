# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Cubic splines through points at equal intervals.

They are computed here, because importing scipy.interpolate would more than double the time that the
simulator needs to start.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from ..core.arrays import Array


class CubicSpline:
    """A twice continuously differentiable curve through K >= 2 points.

    The time runs from 0 to 1, and the point p[i] is reached at the time i / (K - 1). Between two
    points, the curve is the cubic Hermite polynomial with the slopes m (change per interval) at
    both. The slopes follow from a continuous second derivative, m[i-1] + 4 m[i] + m[i+1] =
    3 (p[i+1] - p[i-1]), and are 0 at the ends unless the curve is closed.

    Source: C. de Boor, A Practical Guide to Splines (1978), chapter IV.
    """

    def __init__(self, points: Array, *, closed: bool) -> None:
        """Compute the slopes of the curve at all points.

        Args:
            points: Positions (K, D) of the points.
            closed: Whether the last point is the first one and the curve passes it smoothly.
                Otherwise the velocity is 0 at both ends.
        """
        points = np.asarray(points, float)
        # The last point of a closed curve equals the first one and is left out.
        knots = points[:-1] if closed else points
        identity = np.eye(len(knots))
        before = np.roll(identity, 1, axis=0)
        after = np.roll(identity, -1, axis=0)
        matrix = 4 * identity + before + after
        right = 3 * (after - before) @ knots
        if not closed:
            ends = [0, -1]
            matrix[ends] = identity[ends]
            right[ends] = 0.0
        slopes = np.linalg.solve(matrix, right)
        if closed:
            slopes = np.append(slopes, slopes[:1], axis=0)

        step = np.diff(points, axis=0)
        first, last = slopes[:-1], slopes[1:]
        square = 3 * step - 2 * first - last
        cube = first + last - 2 * step
        # Coefficients (K - 1, 4, D) of the powers of t, which runs from 0 to 1 between two points.
        powers = [points[:-1], first, square, cube]
        self._coefficients = np.stack(powers, axis=1)

    def position(self, time: float) -> Array:
        """Return the position (D,) at a time from 0 to 1."""
        t, coefficients = self._find_interval(time)
        return np.asarray(polyval(t, coefficients))

    def velocity(self, time: float) -> Array:
        """Return the derivative (D,) of the position by the time, at a time from 0 to 1."""
        t, coefficients = self._find_interval(time)
        per_interval = polyval(t, polyder(coefficients))
        return np.asarray(per_interval * len(self._coefficients))

    def _find_interval(self, time: float) -> tuple[float, Array]:
        """Return the interval between two points in which a time from 0 to 1 lies.

        Returns:
            Elapsed fraction of the interval, and the coefficients (4, D) of its polynomial.
        """
        scaled = time * len(self._coefficients)
        i = min(int(scaled), len(self._coefficients) - 1)
        return scaled - i, self._coefficients[i]
