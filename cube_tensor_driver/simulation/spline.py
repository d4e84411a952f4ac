# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Cubic splines through points at equal intervals.

They are computed here, because importing scipy.interpolate would more than double the time that the
simulator needs to start.

The curve is a sum of cubic B-splines with control points c. Its position at the point i is
(c[i-1] + 4 c[i] + c[i+1]) / 6. In an open curve, the control points beyond an end mirror those
inside, so that the velocity at the end is 0. In a closed curve, the control points repeat.

Source: C. de Boor, A Practical Guide to Splines (1978), chapter IX.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from ..core.arrays import Array

_POWERS = (
    np.array(
        [
            [1, 4, 1, 0],
            [-3, 0, 3, 0],
            [3, -6, 3, 0],
            [-1, 3, -3, 1],
        ]
    )
    / 6
)
"""Coefficients (4, 4) of the part of the curve between two points, in which t runs from 0 to 1. Row
k has the coefficients of t^k, one for each of the four control points that determine this part."""


class CubicSpline:
    """A twice continuously differentiable curve through K >= 2 points.

    The time runs from 0 to 1, and point i is reached at the time i / (K - 1).
    """

    def __init__(self, points: Array, *, closed: bool) -> None:
        """Compute the control points of the curve.

        Args:
            points: Positions (K, D) of the points.
            closed: Whether the last point is the first one and the curve passes it smoothly.
                Otherwise the velocity is 0 at both ends.
        """
        knots = points[:-1] if closed else points
        n = len(knots)
        # Row i + 1 of `extend` selects the control point c[i] from the n control points of the
        # knots. The rows before the first and after the last of these are for control points beyond
        # the ends, which mirror or repeat some of them.
        rows_added = ((1, 1 + closed), (0, 0))
        identity = np.eye(n)
        if closed:
            extend = np.pad(identity, rows_added, "wrap")
        else:
            extend = np.pad(identity, rows_added, "reflect")
        before = extend[:n]
        here = extend[1 : n + 1]
        after = extend[2 : n + 2]
        passed = (before + 4 * here + after) / 6
        control = np.linalg.solve(passed, knots)
        self._control = extend @ control

    def interpolate(self, time: float) -> tuple[Array, Array]:
        """Return the position (D,) at a time from 0 to 1, and its derivative (D,) by the time."""
        intervals = len(self._control) - 3
        i = min(int(time * intervals), intervals - 1)
        elapsed = time * intervals - i
        coefficients = _POWERS @ self._control[i : i + 4]
        position = np.asarray(polyval(elapsed, coefficients))
        per_interval = polyval(elapsed, polyder(coefficients))
        return position, intervals * per_interval
