"""What every cube showed in the last seconds, and how often its rows come."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.modes import COMPONENTS
from ..core.scene import Newest


class History:
    """The last `length` pictures of all cubes' values, in a ring buffer."""

    COLUMNS = (*COMPONENTS, "residual")

    def __init__(self, cubes: int, length: int) -> None:
        self._values = np.full((length, cubes, len(self.COLUMNS)), np.nan, np.float32)
        self._times = np.full(length, np.nan)
        self._count = 0

    def add(self, now: float, newest: Newest) -> None:
        """Keep the newest rows as they are at `now`, s."""
        slot = self._count % len(self._times)
        self._values[slot, :, :-1] = newest.values
        self._values[slot, :, -1] = newest.residual
        self._times[slot] = now
        self._count += 1

    def clear(self) -> None:
        """Forget everything, because what comes next is of another time."""
        self._count = 0

    def of(self, cube: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times (M,) in s, the last one 0 and the others negative, and values (M, 16) of a cube.

        The oldest is first. The columns of the values are `COLUMNS`.
        """
        length = len(self._times)
        slots = np.arange(max(0, self._count - length), self._count) % length
        times = self._times[slots]
        if len(times):
            times = times - times[-1]
        return times, self._values[slots, cube].astype(float)


class RowRate:
    """Rows per second of each cube, counted over at least `period` s; NaN until then."""

    def __init__(self, cubes: int, now: float, period: float = 1.0) -> None:
        self.rate = np.full(cubes, np.nan)
        self._period = period
        self._count = np.zeros(cubes, np.int64)
        self._counted_at = now

    def update(self, now: float, count: NDArray[np.int64]) -> None:
        """count: (cubes,) rows that have come up to `now`, s."""
        seconds = now - self._counted_at
        if seconds > self._period:
            self.rate = (count - self._count) / seconds
            self._count, self._counted_at = count.copy(), now
