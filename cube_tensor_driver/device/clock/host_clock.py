# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Detection of steps of the host's clock by comparison with the monotonic clock."""

from __future__ import annotations

import time
from collections.abc import Callable

MIN_HOST_STEP_NS = 1_000_000
"""Smallest step of the host's clock, in ns, that is detected. Smaller steps are detected together,
once their sum reaches this size."""
MAX_READ_NS = 100_000
"""Longest time, in ns, that reading the host's clock may take. If it takes longer, the thread was
interrupted, and the clocks are compared at the next reading."""


class HostClockWatch:
    """Detects steps of the host's clock.

    Args:
        clock_ns: Clock that is checked, in ns.
        steady_ns: Clock that is never set, in ns.
    """

    def __init__(
        self,
        clock_ns: Callable[[], int],
        steady_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._clock_ns = clock_ns
        self._steady_ns = steady_ns
        self._offset = clock_ns() - steady_ns()

    def look(self) -> tuple[int, int]:
        """Return the time of the host's clock and the step detected since the last call, in ns."""
        before = self._steady_ns()
        now = self._clock_ns()
        was_interrupted = self._steady_ns() - before >= MAX_READ_NS
        step = now - before - self._offset
        if was_interrupted or abs(step) < MIN_HOST_STEP_NS:
            return now, 0
        self._offset += step
        return now, step
