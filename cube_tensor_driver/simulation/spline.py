# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Cubic splines through points at equal intervals.

They are computed here, because importing scipy.interpolate would more than double the time that the
simulator needs to start.
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array


class CubicSpline:
    """A twice continuously differentiable curve through K >= 2 points.

    The time runs from 0 to 1, and point i is reached at the time i / (K - 1). Between two points,
    the curve is the cubic Hermite polynomial with given slopes m (change per interval) at both
    points p. A continuous second derivative requires m[i-1] + 4 m[i] + m[i+1] = 3 (p[i+1] -
    p[i-1]).

    Source: C. de Boor, A Practical Guide to Splines (1978), chapter IV.
    """

    def __init__(self, points: Array, *, closed: bool) -> None:
        """Compute the slopes of the curve at all points.

        Args:
            points: Positions (K, D) of the points.
            closed: Whether the last point is the first one and the curve passes it smoothly.
                Otherwise the velocity is 0 at both ends.
        """
        self._points = np.asarray(points, float)
        n = len(points)
        if closed:
            # There is one equation for each point except the last, which is equal to the first.
            ring = self._points[:-1]
            identity = np.eye(n - 1)
            before = np.roll(identity, 1, axis=1)
            after = np.roll(identity, -1, axis=1)
            matrix = 4 * identity + before + after
            next_point = np.roll(ring, -1, axis=0)
            last_point = np.roll(ring, 1, axis=0)
            right = 3 * (next_point - last_point)
            slopes = np.linalg.solve(matrix, right)
            self._slopes = np.concatenate([slopes, slopes[:1]])
        else:
            size = n - 2
            identity = np.eye(size)
            before = np.eye(size, k=1)
            after = np.eye(size, k=-1)
            matrix = 4 * identity + before + after
            right = 3 * (points[2:] - points[:-2])
            self._slopes = np.zeros_like(self._points)
            self._slopes[1:-1] = np.linalg.solve(matrix, right)

    def position(self, time: float) -> Array:
        """Return the position (D,) at a time from 0 to 1."""
        # Cubic Hermite polynomial of t (0 to 1 from one point to the next) between the points p and
        # q, with the slopes m and n there.
        t, p, q, m, n = self._interval(time)
        left = 1 - t
        value = (1 + 2 * t) * left**2 * p
        value = value + t**2 * (3 - 2 * t) * q
        value = value + t * left**2 * m
        return value - t**2 * left * n

    def velocity(self, time: float) -> Array:
        """Return the derivative (D,) of the position by the time, at a time from 0 to 1."""
        t, p, q, m, n = self._interval(time)
        per_interval = 6 * t * (1 - t) * (q - p)
        per_interval = per_interval + (1 - t) * (1 - 3 * t) * m
        per_interval = per_interval + t * (3 * t - 2) * n
        return per_interval * (len(self._points) - 1)

    def _interval(self, time: float) -> tuple[float, Array, Array, Array, Array]:
        """Return the interval between two points in which a time from 0 to 1 lies.

        Returns:
            Elapsed fraction t of the interval, the points p and q (D,) at its start and end, and
            the slopes m and n (D,) there.
        """
        scaled = time * (len(self._points) - 1)
        i = min(int(scaled), len(self._points) - 2)
        points = self._points[i : i + 2]
        slopes = self._slopes[i : i + 2]
        return scaled - i, *points, *slopes
