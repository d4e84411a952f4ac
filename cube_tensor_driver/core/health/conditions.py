"""Conditions of pads. One lasts until HOLD windows were without it, so that nothing flickers."""

from __future__ import annotations

import numpy as np

from ..status import LEFT_OUT

HOLD = 3


class Conditions:
    """Bits of status.py for every pad.

    state: (cubes, P) uint16 now
    mask: (cubes,) uint32, bit p: pad p is left out
    status: (cubes,) uint16, the bits of all pads of a cube together
    """

    def __init__(self, n_cubes: int, n_pads: int) -> None:
        self._recent = np.zeros((HOLD, n_cubes, n_pads), np.uint16)  # this window, the one before
        self._pad_bit = np.uint32(1) << np.arange(n_pads, dtype=np.uint32)
        self._since_collected = np.zeros((n_cubes, n_pads), np.uint16)
        self._combine()

    def add(self, cube: np.ndarray, bits: np.ndarray) -> None:
        """Bits (n, P) found now on cubes (n,)."""
        # A pad that is broken for good says nothing new.
        if (bits & ~self._recent[0][cube]).any():
            np.bitwise_or.at(self._recent[0], cube, bits)
            self._combine()

    def end_window(self, found: np.ndarray, came: np.ndarray) -> None:
        """A window is over: bits (cubes, P) found in it; came (cubes,) bool, whether rows did."""
        self._recent[0] |= found
        self._combine()
        # Cubes without rows keep what was found: silence is no recovery.
        self._recent[1:, came] = self._recent[:-1, came]
        self._recent[0, came] = 0

    def collect(self) -> np.ndarray:
        """(cubes, P) all bits since the last call, those of now included."""
        found = self._since_collected | self.state
        self._since_collected = np.zeros_like(found)
        return found

    def _combine(self) -> None:
        self.state = np.bitwise_or.reduce(self._recent, axis=0)
        self._since_collected |= self.state
        left_out = self.state & LEFT_OUT > 0
        self.mask = (left_out * self._pad_bit).sum(axis=1, dtype=np.uint32)
        self.status = np.bitwise_or.reduce(self.state, axis=1)
