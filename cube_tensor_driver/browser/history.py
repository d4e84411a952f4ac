"""What every cube showed in the last seconds, and how often its rows come."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.modes import COMPONENTS


class History:
    """The last `length` pictures of all cubes' values, in a ring buffer."""

    COLUMNS = (*COMPONENTS, "residual")

    def __init__(self, cubes: int, length: int) -> None:
        self._values = np.full((length, cubes, len(self.COLUMNS)), np.nan, np.float32)
        self._times = np.full(length, np.nan)
        self._count = 0

    def add(self, now: float, values: NDArray[np.float64], residual: NDArray[np.float64]) -> None:
        """Keep values (cubes, 15) and residual (cubes,) as they are at `now`, s."""
        slot = self._count % len(self._times)
        self._values[slot, :, :-1] = values
        self._values[slot, :, -1] = residual
        self._times[slot] = now
        self._count += 1

    def clear(self) -> None:
        """Forget everything, because what comes next is of another time."""
        self._count = 0

    def of(self, cube: int, column: int) -> NDArray[np.float64]:
        """(M,) values of one of `COLUMNS` of a cube, SI; the oldest is first."""
        return self._values[self._slots(), cube, column].astype(float)

    @property
    def times(self) -> NDArray[np.float64]:
        """(M,) s; the last one is 0, the others are negative."""
        times = self._times[self._slots()]
        return times - times[-1] if len(times) else times

    @property
    def observed(self) -> NDArray[np.bool_]:
        """(16,) which of `COLUMNS` some cube has shown."""
        return np.asarray(np.isfinite(self._values[self._slots()]).any(axis=(0, 1)))

    def _slots(self) -> NDArray[np.int64]:
        length = len(self._times)
        return np.arange(max(0, self._count - length), self._count) % length


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
