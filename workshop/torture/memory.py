# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Memory and threads of the nodes over time."""

from __future__ import annotations

import time

import numpy as np
import psutil

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.demo.usage import Usage
from cube_tensor_driver.processes.children import Children

PERIOD_S = 1.0
"""Time, in seconds, between two measurements of the memory of the nodes."""

SETTLE_S = 45.0
"""Time, in seconds, after the start of a process in which its memory grows in steps. Only growth
after this time counts."""

MIN_DURATION_S = 60.0
"""Shortest time, in seconds, over which the growth of the memory of a process is computed."""


class MemoryMonitor:
    """Measures the memory of processes once a second."""

    def __init__(self, children: Children, names: tuple[str, ...]) -> None:
        self._children, self._names = children, names
        self._next_s = 0.0
        # Process id -> pairs of time in s and memory in MB. A process that is started again has a
        # new id, so that its memory is not compared with that of the earlier one.
        self._sizes: dict[int, list[tuple[float, float]]] = {}

    def measure(self) -> None:
        """Measure the memory if a period is over. The caller calls this repeatedly."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = now_s + PERIOD_S
        running = set(self._names).intersection(self._children.list_names())
        # A process that is being started again does not run for a moment.
        usage = Usage(self._children, running)
        for name, size_mb in usage.measure_memory_mb().items():
            sizes = self._sizes.setdefault(self._children.find_pid(name), [])
            sizes.append((now_s, size_mb))

    def count_threads(self) -> dict[str, int]:
        """Return the number of threads of each process."""
        ids = {name: self._children.find_pid(name) for name in self._names}
        return {name: psutil.Process(pid).num_threads() for name, pid in ids.items()}

    def compute_growth_mb_per_min(self) -> float | None:
        """Return the growth of the process that grows fastest, None if no process ran long enough.

        See `compute_median_slope`."""
        slopes = []
        for sizes in self._sizes.values():
            times_s, sizes_mb = np.array(sizes).T
            settled = times_s > times_s[0] + SETTLE_S
            if times_s[-1] - times_s[0] >= SETTLE_S + MIN_DURATION_S:
                slopes.append(compute_median_slope(times_s[settled], sizes_mb[settled]))
        return round(60 * max(slopes), 2) if slopes else None


def compute_median_slope(x: Array, y: Array) -> float:
    """Return the median of the slopes dy/dx between all pairs of points (Theil, Sen), which a
    single step does not change."""
    later, earlier = np.tril_indices(len(x), -1)
    rise, run = y[later] - y[earlier], x[later] - x[earlier]
    return float(np.median(rise / run))
