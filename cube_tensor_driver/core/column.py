"""The cube column of a message: which cube each row is of. A hub's cubes stay the same, and so what is made of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

COLUMNS_KEPT = 64
"""Cube columns remembered at a time: one per hub."""

Made = TypeVar("Made")


class Columns(Generic[Made]):
    """What `make` makes of a column (N,) alone, kept from call to call."""

    def __init__(self, make: Callable[[np.ndarray], Made]) -> None:
        self._make = make
        self._kept: dict[tuple[int, ...], tuple[bytes, Made]] = {}

    def of(self, cube: np.ndarray) -> Made:
        key = (len(cube), cube[0], cube[-1]) if len(cube) else (0,)
        kept = self._kept.get(key)
        # Bytes are compared in a fifth of the time that numbers are.
        if kept is not None and kept[0] == cube.tobytes():
            return kept[1]
        made = self._make(cube)
        if len(self._kept) >= COLUMNS_KEPT:
            self._kept.clear()
        self._kept[key] = cube.tobytes(), made
        return made

    def clear(self) -> None:
        self._kept.clear()


def turns(cube: np.ndarray) -> int:
    """How many times the same rising cubes stand one after the other in a column (N,); 0: it is none such."""
    falls = np.flatnonzero(cube[1:] <= cube[:-1])
    n = int(falls[0]) + 1 if len(falls) else len(cube)
    if not n or len(cube) % n or (cube.reshape(-1, n) != cube[:n]).any():
        return 0
    return len(cube) // n
