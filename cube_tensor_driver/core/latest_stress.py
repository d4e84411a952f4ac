"""The latest stress of each cube of a skin, and whether it is usable."""

from __future__ import annotations

import numpy as np

from .arrays import Array, Index, Mask
from .health.diagnosis import has_high_residual
from .health.statistics import WINDOW_S
from .modes import COMPONENTS, STRESS
from .rows import StressRows
from .status import INVALID, RESIDUAL

FINE = 0
"""Health of a cube: its latest row is usable without reservation."""
DOUBTFUL = 1
"""Health of a cube: a status bit is set, or many rows have a high residual."""
FAULTY = 2
"""Health of a cube: all components of its latest row are unknown (NaN)."""
STALE = 3
"""Health of a cube: no row of it has arrived for some time."""

HEALTH_WORDS = ("ok", "doubtful", "no tensor", "stale")
"""Words for `FINE`, `DOUBTFUL`, `FAULTY` and `STALE`, in this order."""

STALE_S = 1.0
"""Time without a row, in seconds, after which a cube is stale."""


class LatestStress:
    """The latest row of each of N cubes, and its time of arrival.

    The caller states the time, in seconds from any origin.

    Attributes:
        values: Components (N, 15), in Pa and Pa/m; NaN before the first row of a cube.
        residual: Residual (N,).
        status: Status bits (N,).
        left_out: Bit masks of the pads that were not used (N,).
        arrived: Time of arrival (N,), in s; minus infinity before the first row.
        count: Number of rows so far (N,).
        high_residual: Whether many rows of a cube have a residual above its limit (N,), decided as
            `Health` does. Noise alone exceeds the limit in one row of a thousand, so on a large
            skin some cube exceeds it at any moment.
    """

    def __init__(self, n_cubes: int) -> None:
        shape = (n_cubes, len(COMPONENTS))
        self.values = np.full(shape, np.nan)
        self.residual = np.full(n_cubes, np.nan)
        self.status = np.zeros(n_cubes, np.uint16)
        self.left_out = np.zeros(n_cubes, np.uint32)
        self.arrived = np.full(n_cubes, -np.inf)
        self.count = np.zeros(n_cubes, np.int64)
        self.high_residual = np.zeros(n_cubes, bool)
        self._window_start = -np.inf
        self._count_at_start = self.count.copy()
        self._over_limit = np.zeros(n_cubes, np.int64)

    def update(self, rows: StressRows, now: float) -> None:
        """Take over rows; of several rows of a cube the last remains.

        Rows of cubes that the skin does not have are ignored.

        Args:
            rows: New rows.
            now: Time of their arrival, in s.
        """
        is_known = rows.cube < len(self.status)
        if not is_known.all():
            rows = rows.select(is_known)
        cube = rows.cube
        self.values[cube, : len(STRESS)] = rows.stress
        self.values[cube, len(STRESS) :] = rows.gradient
        self.residual[cube] = rows.residual
        self.status[cube] = rows.status
        self.left_out[cube] = rows.left_out
        self.arrived[cube] = now

        self._close_window_when_over(now)
        # A cube may have several rows, which an indexed += would count once.
        np.add.at(self.count, cube, 1)
        is_over_limit = rows.status & RESIDUAL != 0
        if is_over_limit.any():
            exceeding = cube[is_over_limit]
            np.add.at(self._over_limit, exceeding, 1)

    def health(self, now: float, stale_after: float) -> Index:
        """Judge each cube.

        Args:
            now: Present time, in s.
            stale_after: Time without a row after which a cube is stale, in s.

        Returns:
            `FINE`, `DOUBTFUL`, `FAULTY` or `STALE` of each cube (N,).
        """
        # A single high residual is normal noise; many of them are counted in `high_residual`.
        other_bits = self.status & ~np.uint16(RESIDUAL)
        is_doubtful = self.high_residual | (other_bits != 0)
        health = np.where(is_doubtful, DOUBTFUL, FINE)
        health[self.status & INVALID != 0] = FAULTY
        health[now - self.arrived > stale_after] = STALE
        return health

    def usable_values(self, health: Index) -> Array:
        """Return the components (N, 15), NaN for cubes that are `FAULTY` or `STALE`."""
        is_usable: Mask = health < FAULTY
        return np.where(is_usable[:, None], self.values, np.nan)

    def _close_window_when_over(self, now: float) -> None:
        """Close the window that counts high residuals if it is over, or if time jumped back."""
        if 0 <= now - self._window_start < WINDOW_S:
            return
        rows = self.count - self._count_at_start
        self.high_residual = has_high_residual(self.high_residual, self._over_limit, rows)
        self._window_start = now
        self._count_at_start = self.count.copy()
        self._over_limit[:] = 0
