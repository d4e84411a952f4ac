"""The pattern of cube indices in a message, and what is computed from it once and kept.

A hub sends the same cubes in the same order in every sample, so the index column (N,) of a message
is one of a few. Whatever depends on it alone is made once per pattern.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

SKINS_KEPT = 4
"""Patterns of so many times all cubes are kept: the whole skin's, each hub's, those of a few scans
in one message."""

Made = TypeVar("Made")


class PatternCache(Generic[Made]):
    """What `make` computes from a column of cube indices (N,); the least recently used go first."""

    def __init__(self, make: Callable[[np.ndarray], Made], n_cubes: int) -> None:
        self._make = make
        self._most_rows = SKINS_KEPT * n_cubes
        self._kept: dict[tuple[int, ...], tuple[bytes, Made]] = {}
        self._rows = 0

    def get(self, cube: np.ndarray) -> Made:
        """What belongs to this column, made now if it is not kept."""
        key = (len(cube), int(cube[0]), int(cube[-1])) if len(cube) else (0,)
        # Bytes are compared in a fifth of the time that numbers are.
        content = cube.tobytes()
        kept = self._kept.pop(key, None)
        if kept is None or kept[0] != content:
            self._rows -= len(cube) if kept else 0
            kept = content, self._make(cube)
            self._rows += len(cube)
        self._kept[key] = kept
        while self._rows > self._most_rows and len(self._kept) > 1:
            oldest = next(iter(self._kept))
            del self._kept[oldest]
            self._rows -= oldest[0]
        return kept[1]

    def clear(self) -> None:
        self._kept.clear()
        self._rows = 0


def count_repeats(cube: np.ndarray) -> int:
    """How many scans a column (N,) holds: the same rising indices, again and again. 0: it does not
    have this form."""
    falls = np.flatnonzero(cube[1:] <= cube[:-1])
    scan = int(falls[0]) + 1 if len(falls) else len(cube)
    if not scan or len(cube) % scan or (cube.reshape(-1, scan) != cube[:scan]).any():
        return 0
    return len(cube) // scan
