"""The cube column of a message: which cube each row is of. A hub's cubes stay the same, and so what
is made of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

SKINS_KEPT = 4
"""Columns of so many times all cubes stay: the whole skin's, each hub's, of a few scans at once.
Others come and go."""

Made = TypeVar("Made")


class Columns(Generic[Made]):
    """What `make` makes of a column (N,) alone, kept from call to call; the least recently asked
    for go first."""

    def __init__(self, make: Callable[[np.ndarray], Made], cubes: int) -> None:
        """cubes: how many the skin has."""
        self._make, self._most = make, SKINS_KEPT * cubes
        self._kept: dict[tuple[int, ...], tuple[bytes, Made]] = {}
        self._rows = 0

    def of(self, cube: np.ndarray) -> Made:
        key = (len(cube), int(cube[0]), int(cube[-1])) if len(cube) else (0,)
        kept = self._kept.pop(key, None)
        # Bytes are compared in a fifth of the time that numbers are.
        if kept is None or kept[0] != cube.tobytes():
            self._rows -= len(cube) if kept else 0
            kept = cube.tobytes(), self._make(cube)
            self._rows += len(cube)
        self._kept[key] = kept
        while self._rows > self._most and len(self._kept) > 1:
            oldest = next(iter(self._kept))
            del self._kept[oldest]
            self._rows -= oldest[0]
        return kept[1]

    def clear(self) -> None:
        self._kept.clear()
        self._rows = 0


def turns(cube: np.ndarray) -> int:
    """How many times the same rising cubes stand one after the other in a column (N,); 0: it is
    none such."""
    falls = np.flatnonzero(cube[1:] <= cube[:-1])
    n = int(falls[0]) + 1 if len(falls) else len(cube)
    if not n or len(cube) % n or (cube.reshape(-1, n) != cube[:n]).any():
        return 0
    return len(cube) // n
