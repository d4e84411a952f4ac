"""A smooth curve through points at equal intervals: a cubic spline, in numpy alone."""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array


class CubicSpline:
    """A twice continuously differentiable curve through points (K, D), K ≥ 2, reached at the times
    0, 1/(K − 1), … 1.

    closed: the last point is the first one, and the curve passes it smoothly; else the velocity is
    0 at both ends. Between two points p, q with slopes m, n per interval the curve is Hermite's
    cubic; continuous curvature asks for m[i−1] + 4 m[i] + m[i+1] = 3 (p[i+1] − p[i−1]).

    Source: C. de Boor, A Practical Guide to Splines (1978), chapter IV.
    """

    def __init__(self, points: Array, *, closed: bool) -> None:
        self._points = np.asarray(points, float)
        n = len(points)
        if closed:
            # One equation for each point but the last, which is the first again.
            around = np.eye(n - 1)
            matrix = 4 * around + np.roll(around, 1, axis=1) + np.roll(around, -1, axis=1)
            ring = self._points[:-1]
            slopes = np.linalg.solve(matrix, 3 * (np.roll(ring, -1, 0) - np.roll(ring, 1, 0)))
            self._slopes = np.concatenate([slopes, slopes[:1]])
        else:
            inner = np.eye(n - 2)
            matrix = 4 * inner + np.eye(n - 2, k=1) + np.eye(n - 2, k=-1)
            self._slopes = np.zeros_like(self._points)
            self._slopes[1:-1] = np.linalg.solve(matrix, 3 * (points[2:] - points[:-2]))

    def position(self, time: float) -> Array:
        """(D,) at a time from 0 to 1."""
        t, p, q, m, n = self._interval(time)
        return (
            (1 + 2 * t) * (1 - t) ** 2 * p
            + t**2 * (3 - 2 * t) * q
            + t * (1 - t) ** 2 * m
            + t**2 * (t - 1) * n
        )

    def velocity(self, time: float) -> Array:
        """(D,) derivative of the position by time."""
        t, p, q, m, n = self._interval(time)
        per_interval = 6 * t * (1 - t) * (q - p) + (1 - t) * (1 - 3 * t) * m + t * (3 * t - 2) * n
        return per_interval * (len(self._points) - 1)

    def _interval(self, time: float) -> tuple[float, Array, Array, Array, Array]:
        """How far time is into its interval, 0 to 1; points and slopes at both ends of that."""
        scaled = time * (len(self._points) - 1)
        i = min(int(scaled), len(self._points) - 2)
        return (
            scaled - i,
            self._points[i],
            self._points[i + 1],
            self._slopes[i],
            self._slopes[i + 1],
        )
