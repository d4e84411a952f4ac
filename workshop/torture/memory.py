"""Memory and threads of child processes over time."""

from __future__ import annotations

import time
from collections.abc import Iterable

import numpy as np
import psutil

from cube_tensor_driver.processes.children import Children

EVERY_S = 1.0
SETTLE_S, LEAST_S = 45.0, 60.0
"""s: memory grows in steps at first; then its slope is taken, over so long at least."""


class Memory:
    """Looks at processes once a second. A process that is started again has a new life."""

    def __init__(self, children: Children, names: Iterable[str]) -> None:
        self._children, self._names = children, tuple(names)
        self._next_s = 0.0
        # By process id: times in s and MB resident.
        self._lives: dict[int, tuple[list[float], list[float]]] = {}

    def look(self) -> None:
        """To be called again and again."""
        now = time.monotonic()
        if now < self._next_s:
            return
        self._next_s = now + EVERY_S
        for name in set(self._names).intersection(self._children.names()):
            pid = self._children.pid(name)
            times, sizes = self._lives.setdefault(pid, ([], []))
            times.append(now)
            sizes.append(psutil.Process(pid).memory_info().rss / 2**20)

    def threads(self) -> dict[str, int]:
        """By process."""
        return {
            name: psutil.Process(self._children.pid(name)).num_threads() for name in self._names
        }

    def slope_mb_per_min(self) -> float | None:
        """The steepest of all lives: the median of the slopes between all pairs of times (Theil,
        Sen), which a step does not change. None: no life was long enough."""
        slopes = [
            slope
            for times, sizes in self._lives.values()
            if (slope := _slope(np.array(times), np.array(sizes))) is not None
        ]
        return round(60 * max(slopes), 2) if slopes else None


def _slope(times: np.ndarray, sizes: np.ndarray) -> float | None:
    """Per s, after settling."""
    settled = times > times[0] + SETTLE_S
    times, sizes = times[settled], sizes[settled]
    if not len(times) or times[-1] - times[0] < LEAST_S:
        return None
    later, earlier = np.tril_indices(len(times), -1)
    return float(np.median((sizes[later] - sizes[earlier]) / (times[later] - times[earlier])))
