"""Patterns of cube numbers in messages, and a cache of what is computed from them.

A hub sends the same cubes in the same order in every sample, so the column of cube numbers of a
message is one of a few. Whatever depends on this column alone is computed once per pattern.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

from .arrays import AnyArray

MAX_SKINS = 4
"""Maximum number of rows in the cache, as a multiple of the number of cubes of the skin.

This is enough for the pattern of the whole skin, of each hub, and of a few scans in one message.
"""

Computed = TypeVar("Computed")


class PatternCache(Generic[Computed]):
    """Cache of what a function computes from a column of cube numbers (N,).

    If the cache is full, the least recently used patterns are removed.
    """

    def __init__(self, compute: Callable[[AnyArray], Computed], n_cubes: int) -> None:
        self._compute = compute
        self._max_rows = MAX_SKINS * n_cubes
        self._entries: dict[tuple[int, ...], tuple[bytes, Computed]] = {}
        self._rows = 0

    def get(self, cube: AnyArray) -> Computed:
        """Return the result for a column of cube numbers (N,); compute it if it is not cached."""
        # A short key finds the entry; its content decides, because other columns may share the key.
        key: tuple[int, ...] = (0,)
        if len(cube):
            key = (len(cube), int(cube[0]), int(cube[-1]))
        # Bytes are compared in a fifth of the time that numbers are.
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
        """Remove all patterns."""
        self._entries.clear()
        self._rows = 0


def count_repeats(cube: AnyArray) -> int:
    """Count the scans in a column of cube numbers (N,): the same rising numbers, repeated.

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
