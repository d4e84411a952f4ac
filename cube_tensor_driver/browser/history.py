"""What every cube showed in the last seconds, and how often its rows come."""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Index, Mask
from ..core.modes import COMPONENTS


class History:
    """The values of all cubes in the last pictures, in a ring buffer."""

    COLUMNS = (*COMPONENTS, "residual")
    """Names of the values of a cube."""

    def __init__(self, cubes: int, length: int) -> None:
        """length: number of pictures that are kept."""
        self._values = np.full((length, cubes, len(self.COLUMNS)), np.nan, np.float32)
        self._times = np.full(length, np.nan)
        self._count = 0

    def add(
        self,
        now: float,
        values: Array,
        residual: Array,
    ) -> None:
        """Add values (cubes, 15) and residual (cubes,) as they are at the time `now`, in s."""
        slot = self._count % len(self._times)
        self._values[slot, :, :-1] = values
        self._values[slot, :, -1] = residual
        self._times[slot] = now
        self._count += 1

    def clear(self) -> None:
        """Forget everything, because a replay has jumped to another time."""
        self._count = 0

    def of(self, cube: int, column: int) -> Array:
        """Return one of `COLUMNS` of a cube (M,), in SI units, the oldest value first."""
        return np.asarray(self._values[self._slots(), cube, column], float)

    @property
    def times(self) -> Array:
        """(M,) times relative to the last one, in s: zero or negative."""
        times = self._times[self._slots()]
        # The newest value is at the right end of the plots, at zero.
        return times - times[-1] if len(times) else times

    @property
    def observed(self) -> Mask:
        """(16,) whether any cube has shown a value of each of `COLUMNS`."""
        return np.asarray(np.isfinite(self._values[self._slots()]).any(axis=(0, 1)))

    def _slots(self) -> Index:
        """Return the places (M,) in the buffer, in the order of time."""
        length = len(self._times)
        numbers = np.arange(max(0, self._count - length), self._count)
        return np.asarray(numbers % length)


class RowRate:
    """Counts the rows per second of each cube.

    Attributes:
        rate: (cubes,) Hz; NaN until the first period is over.
    """

    def __init__(
        self,
        cubes: int,
        now: float,
        period: float = 1.0,
    ) -> None:
        """Start at the time `now`, in s; rows are counted over at least `period` s."""
        self.rate = np.full(cubes, np.nan)
        self._period = period
        self._count = np.zeros(cubes, np.int64)
        self._counted_s = now

    def update(self, now: float, count: Index) -> None:
        """Set the rate from the number of rows (cubes,) that have come until `now`, in s."""
        elapsed_s = now - self._counted_s
        if elapsed_s > self._period:
            self.rate = (count - self._count) / elapsed_s
            self._count, self._counted_s = count.copy(), now
