"""When a person presses a cube, and when the press is steady enough to be read."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

NOISE_TIMES, LEAST = 30.0, 2e-4
"""A change that counts as a press: so many times the noise, and at least this, relative."""
STEADY = 0.1
"""Share of a press by which two averages that follow each other may differ."""
RELEASED = 0.4
"""Share of the limit below which the press is over."""


class Press(NamedTuple):
    """cube: its number. change: (P,) relative change of the frequencies of its pads."""

    cube: int
    change: np.ndarray


class PressWatch:
    """Finds presses in averages of the frequencies that follow each other.

    strongest: the cube that changes most, its pad, and by how much, relative.
    """

    def __init__(self, rest: np.ndarray, noise: np.ndarray, works: np.ndarray) -> None:
        """rest (C, P) Hz; noise (C, P) relative; works (C, P) bool, the pads to look at."""
        self._rest, self._works = rest, works
        usable = noise[works]
        self._limit = max(LEAST, NOISE_TIMES * float(np.median(usable)) if len(usable) else LEAST)
        self._before: np.ndarray | None = None
        self._is_held = False
        self.strongest = (0, 0, 0.0)

    def update(self, mean: np.ndarray) -> Press | None:
        """A press that is steady, once; mean: (C, P) Hz of the newest average."""
        with np.errstate(invalid="ignore"):
            change = np.where(self._works, mean / self._rest - 1, np.nan)
        size = np.nan_to_num(np.abs(change))
        cube, pad = (int(each) for each in np.unravel_index(size.argmax(), size.shape))
        self.strongest = cube, pad, float(np.nan_to_num(change[cube, pad]))
        before, self._before = self._before, change
        if size[cube, pad] < RELEASED * self._limit:
            self._is_held = False
        if self._is_held or before is None or size[cube, pad] < self._limit:
            return None
        if np.nanmax(np.abs(change[cube] - before[cube])) > STEADY * size[cube, pad]:
            return None
        self._is_held = True
        return Press(cube, change[cube])

    @property
    def is_held(self) -> bool:
        """Whether the press that was read last goes on."""
        return self._is_held
