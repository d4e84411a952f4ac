"""Statistics of pads over a window: what `Health` judges at its end, and what tare averages.

    noise of a pad    sqrt(mean((f[n] - 2 f[n-1] + f[n-2])²) / 6), each term bounded so that one jump is no noise; a
                      load that moves slowly leaves no second difference

All arrays are (cubes, pads); nothing loops over cubes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Window(NamedTuple):
    """What is kept of a window: rows (cubes,) that came, and (cubes, P) in Hz, NaN where nothing was measured."""

    rows: np.ndarray
    mean: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray
    noise: np.ndarray


class Statistics:
    """Of the window that is not over yet.

    last: (cubes, P) Hz float32, newest frequencies; count: (cubes,) rows in the window; bound: (cubes, P) Hz², to which
    a squared second difference is cut.
    """

    def __init__(self, rest: np.ndarray, bound: np.ndarray) -> None:
        """rest: (cubes, P) Hz, NaN where there is no pad; float32 sums are of what is above it."""
        self._all = np.full((8, *rest.shape), np.nan, np.float32)
        # step: the newest first difference; bend: sum of squared second differences.
        self.last, self._step, self._bend, self._sum, self._lowest, self._highest, self._base, self.bound = self._all
        self._base[:] = np.nan_to_num(rest)
        self.bound[:] = bound
        self.count = np.zeros(len(rest), int)
        self.clear()

    def clear(self) -> None:
        """Begin a window; differences go on."""
        self._bend[:] = self._sum[:] = self.count[:] = 0
        self._lowest[:] = self._highest[:] = np.nan

    def add(self, cubes: slice | np.ndarray, frequency: np.ndarray) -> None:
        """Rows (N, P) of different cubes."""
        part = self._all[:, cubes]
        last, step, bend, total, lowest, highest, base, bound = part
        new = frequency - last
        work = new - step
        work *= work
        bend += np.minimum(work, bound, out=work)
        step[:] = new
        np.fmin(lowest, frequency, out=lowest)
        np.fmax(highest, frequency, out=highest)
        total += np.subtract(frequency, base, out=work)
        last[:] = frequency
        if not isinstance(cubes, slice):
            self._all[:, cubes] = part
        self.count[cubes] += 1

    def add_many(self, cubes: slice | np.ndarray, frequency: np.ndarray) -> None:
        """`add` of (B, N, P), one after the other, to the same bits: sums go batch by batch."""
        part = self._all[:, cubes]
        last, step, bend, total, lowest, highest, base, bound = part
        new = np.diff(np.concatenate([last[None], frequency]), axis=0)
        work = np.diff(np.concatenate([step[None], new]), axis=0)
        work *= work
        np.minimum(work, bound, out=work)
        bend[:] = np.add.reduce(np.concatenate([bend[None], work]), axis=0)
        np.subtract(frequency, base, out=work)
        total[:] = np.add.reduce(np.concatenate([total[None], work]), axis=0)
        np.fmin(lowest, np.fmin.reduce(frequency, axis=0), out=lowest)
        np.fmax(highest, np.fmax.reduce(frequency, axis=0), out=highest)
        step[:], last[:] = new[-1], frequency[-1]
        if not isinstance(cubes, slice):
            self._all[:, cubes] = part
        self.count[cubes] += len(frequency)

    def window(self) -> Window:
        """The statistics so far."""
        count = np.maximum(self.count, 1)[:, None]
        with np.errstate(invalid="ignore"):
            mean = np.where(self.count[:, None] > 0, self._base + self._sum / count, np.nan)
        noise = np.sqrt(self._bend / count / 6)
        return Window(self.count.copy(), mean, self._lowest.copy(), self._highest.copy(), noise)
