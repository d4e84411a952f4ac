"""What every cube showed in the last seconds, at the rate of the eye."""

from __future__ import annotations

import numpy as np

from ..core.modes import COMPONENTS
from ..core.scene import Newest


class History:
    """A ring of `length` pictures of all cubes' values."""

    COLUMNS = (*COMPONENTS, "residual")

    def __init__(self, cubes: int, length: int) -> None:
        self._values = np.full((length, cubes, len(self.COLUMNS)), np.nan, np.float32)
        self._times = np.full(length, np.nan)
        self._next = 0

    def add(self, now: float, newest: Newest) -> None:
        """Keep the newest rows as they are at `now` in s."""
        at = self._next % len(self._times)
        self._values[at, :, :-1], self._values[at, :, -1] = newest.values, newest.residual
        self._times[at] = now
        self._next += 1

    def clear(self) -> None:
        """Forget them: what comes does not follow on them."""
        self._next = 0

    def of(self, cube: int) -> tuple[np.ndarray, np.ndarray]:
        """Times (M,) in s before the last one, never positive, and values (M, 16) of a cube, oldest
        first."""
        count = len(self._times)
        order = np.arange(max(0, self._next - count), self._next) % count
        times = self._times[order]
        return times - times[-1:].sum(), self._values[order, cube].astype(float)
