# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Processor time and memory of the processes of a skin."""

from __future__ import annotations

import time
from collections.abc import Iterable

import psutil

from ..processes.children import Children

BYTES_PER_MB = 2**20
"""Number of bytes in one MiB, the unit of the reported memory."""


class Usage:
    """Processor time and memory of child processes.

    The processor time is counted from the moment at which the object is made.
    """

    def __init__(self, children: Children, names: Iterable[str]) -> None:
        """Start to count processor time.

        Args:
            children: The child processes.
            names: Names of the child processes to measure, such as "driver".
        """
        self._processes = {name: psutil.Process(children.find_pid(name)) for name in names}
        self._start_s = time.monotonic()
        self._start_cpu_s = self._sum_cpu_seconds()

    def measure_cpu_percent(self) -> dict[str, float]:
        """Return the processor time of each process since this object was made, divided by the
        elapsed time, in percent of one core."""
        elapsed_s = time.monotonic() - self._start_s
        percent = {}
        for name, now_s in self._sum_cpu_seconds().items():
            used_s = now_s - self._start_cpu_s[name]
            percent[name] = 100 * used_s / elapsed_s
        return percent

    def measure_memory_mb(self) -> dict[str, float]:
        """Return the resident memory of each process, in MiB."""
        return {
            name: process.memory_info().rss / BYTES_PER_MB
            for name, process in self._processes.items()
        }

    def _sum_cpu_seconds(self) -> dict[str, float]:
        seconds = {}
        for name, process in self._processes.items():
            times = process.cpu_times()
            # System time counts as well, because messages are sent and received in the kernel.
            seconds[name] = times.user + times.system
        return seconds
