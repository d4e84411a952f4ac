"""Whether the host's clock was set: it moves against the monotonic clock, which nobody sets."""

from __future__ import annotations

import time
from collections.abc import Callable

MIN_SET_NS = 1_000_000
"""By less nobody sets a clock; and reading two clocks one after the other takes time."""
READ_NS, READS = 100_000, 3
"""Two clocks are compared if reading them took less; otherwise it is tried again so often."""


class HostClockWatch:
    """Sees at once when the host's clock was set.

    clock_ns: the clock that is watched; steady_ns: one that nobody sets.
    """

    def __init__(
        self,
        clock_ns: Callable[[], int],
        steady_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._clock_ns, self._steady_ns = clock_ns, steady_ns
        self._offset: int | None = None

    def look(self) -> tuple[int, int]:
        """The time, and by how much the clock was set since the last call, ns; mostly 0."""
        for _ in range(READS):
            before = self._steady_ns()
            now = self._clock_ns()
            if self._steady_ns() - before < READ_NS:
                break
        else:
            return now, 0
        offset = now - before
        step = 0 if self._offset is None else offset - self._offset
        if self._offset is not None and abs(step) < MIN_SET_NS:
            return now, 0
        self._offset = offset
        return now, step
