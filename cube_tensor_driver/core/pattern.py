"""Cache for quantities that depend only on the cube numbers of a message.

A hub sends the same cubes in the same order in every sample. So the column of cube numbers of a
message (its pattern) is one of a few, and what depends on the pattern alone is computed only once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

from .arrays import AnyArray

MAX_ROWS_PER_CUBE = 4
"""Maximum total length of the cached columns of cube numbers, per cube of the skin.

This is enough for the columns of a message of the whole skin, of a message of each hub, and of a
message of a few scans (a scan has one row per cube).
"""

Computed = TypeVar("Computed")


class PatternCache(Generic[Computed]):
    """Cache of the results of a function of a column of cube numbers (one for each row).

    If the cache is full, the columns that were not used for longest are removed.
    """

    def __init__(self, compute: Callable[[AnyArray], Computed], n_cubes: int) -> None:
        self._compute = compute
        self._max_rows = MAX_ROWS_PER_CUBE * n_cubes
        self._entries: dict[tuple[int, ...], tuple[bytes, Computed]] = {}
        self._rows = 0

    def get(self, cube: AnyArray) -> Computed:
        """Return the function's result for a column of cube numbers (N,), from the cache if
        possible."""
        # The key holds only length, first and last number of the column, so that the search is
        # fast. Two columns may have the same key, so the cached column is compared with the given
        # one below.
        key: tuple[int, ...] = (0,)
        if len(cube):
            key = (len(cube), int(cube[0]), int(cube[-1]))
        # Comparing two columns as bytes takes a fifth of the time of comparing their numbers.
        content = cube.tobytes()
        entry = self._entries.pop(key, None)
        if entry is None or entry[0] != content:
            if entry is not None:
                self._rows -= len(cube)
            entry = content, self._compute(cube)
            self._rows += len(cube)
        # The dictionary keeps the order of insertion, so the newest entry is the last one.
        self._entries[key] = entry
        while self._rows > self._max_rows and len(self._entries) > 1:
            oldest = next(iter(self._entries))
            del self._entries[oldest]
            self._rows -= oldest[0]
        return entry[1]

    def clear(self) -> None:
        """Remove all results."""
        self._entries.clear()
        self._rows = 0


def count_repeats(cube: AnyArray) -> int:
    """Count the scans in a column of cube numbers (N,).

    A scan is one row of each of some cubes. Several scans in a message are the same rising cube
    numbers, repeated, such as 0 1 2 0 1 2.

    Returns:
        Number of scans; 0 if the column does not have this form.
    """
    is_new_scan = cube[1:] <= cube[:-1]
    starts = np.flatnonzero(is_new_scan)
    length = len(cube)
    if len(starts):
        length = int(starts[0]) + 1
    if not length or len(cube) % length:
        return 0
    scans = cube.reshape(-1, length)
    if (scans != scans[0]).any():
        return 0
    return len(scans)
