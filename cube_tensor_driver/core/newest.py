"""The newest stress of each cube of a skin, and whether it can be believed."""

from __future__ import annotations

import numpy as np

from .health.diagnosis import still_strained
from .health.statistics import WINDOW_S
from .modes import COMPONENTS, STRESS
from .rows import StressRows
from .status import INVALID, RESIDUAL

FINE, DOUBTFUL, FAULTY, STALE = range(4)
HEALTH = ("ok", "doubtful", "no tensor", "stale")
"""Words of `Newest.health`. doubtful: a status bit is set, RESIDUAL in many rows; no tensor:
INVALID; stale: no row came lately."""
STALE_S = 1.0
"""A cube is stale when no row of it has come for so long."""


class Newest:
    """The newest row of each of n cubes and when it came. Time is what the caller counts, in s.

    strained: (n,) bool, many rows with a residual above its limit, as `Health` has it; noise alone
    is above it in one row of a thousand, on a large skin in every picture.
    """

    def __init__(self, n: int) -> None:
        self.values = np.full((n, len(COMPONENTS)), np.nan)
        self.residual = np.full(n, np.nan)
        self.status = np.zeros(n, np.uint16)
        self.left_out = np.zeros(n, np.uint32)
        self.arrived = np.full(n, -np.inf)
        self.count = np.zeros(n, np.int64)
        self.strained = np.zeros(n, bool)
        self._window = -np.inf, np.zeros(n, np.int64)  # when it began, and `count` then
        self._over = np.zeros(n, np.int64)  # rows of the window with RESIDUAL

    def update(self, rows: StressRows, now: float) -> None:
        """Keep rows, of several rows of a cube the last. Rows of unknown cubes are ignored."""
        known = rows.cube < len(self.status)
        if not known.all():
            rows = rows.select(known)
        cube = rows.cube
        self.values[cube, : len(STRESS)], self.values[cube, len(STRESS) :] = (
            rows.stress,
            rows.gradient,
        )
        self.residual[cube], self.status[cube], self.arrived[cube] = rows.residual, rows.status, now
        self.left_out[cube] = rows.left_out
        self._close_window(now)
        np.add.at(self.count, cube, 1)
        over = rows.status & RESIDUAL != 0
        if over.any():
            np.add.at(self._over, cube[over], 1)

    def health(self, now: float, stale: float) -> np.ndarray:
        """(N,) FINE, DOUBTFUL, FAULTY or STALE; stale after so many s without a row."""
        health = np.where(self.strained | (self.status & ~np.uint16(RESIDUAL) != 0), DOUBTFUL, FINE)
        health[self.status & INVALID != 0] = FAULTY
        health[now - self.arrived > stale] = STALE
        return health

    def believed(self, health: np.ndarray) -> np.ndarray:
        """(N, 15) the values, NaN where the health is FAULTY or STALE."""
        return np.where((health < FAULTY)[:, None], self.values, np.nan)

    def _close_window(self, now: float) -> None:
        """Where it is over, or time fell back."""
        begun, count = self._window
        if 0 <= now - begun < WINDOW_S:
            return
        self.strained = still_strained(self.strained, self._over, self.count - count)
        self._window, self._over[:] = (now, self.count.copy()), 0
