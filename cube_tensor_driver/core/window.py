"""Windows: statistics of pads over half a second, what they say of the pads, and what tare averages.

    noise of a pad    sqrt(mean((f[n] - 2 f[n-1] + f[n-2])²) / 6), each term bounded so that one jump is no noise; a
                      load that moves slowly leaves no second difference

All arrays are (cubes, pads); nothing loops over cubes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .status import DRIFT, LEFT_OUT, NOISY, OPEN, RANGE, SHORT, STUCK

MIN_COUNT = 20
"""Rows in a window below which its statistics say nothing."""
NOISY_ENTER, NOISY_LEAVE = 10.0, 5.0
"""Times the calibration's noise and times the cube's other pads, to become noisy and to stay so."""
JUMP = 60.0
"""Times the usual noise, to which a second difference is bounded: two of them in 20 rows stay below NOISY_ENTER."""
STUCK_MOVING = 5.0
"""Times its noise that the cube's pads must have moved, before one that did not move at all is called stuck."""
STILL = 8.0
"""Times its noise, peak to peak, within which a pad stands still: noise alone spans 6 in 1000 rows."""
DRIFT_LIMIT = 2e-4
"""Of the rest frequency: how far one pad wanders while all stand still, before it is called drifting."""


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


class Judge:
    """What windows say of pads: stuck, noisy, drifting. still: (cubes,) bool, nothing moved in the last one; noise:
    (cubes, P) Hz, by the calibration; bound: for the statistics of the next window."""

    def __init__(self, exists: np.ndarray) -> None:
        self._exists = exists
        self.still = np.zeros(len(exists), bool)
        self._reference = np.full(exists.shape, np.nan)
        self._middle = self._reference.copy()  # means of the window before

    def set(self, rest: np.ndarray, noise: np.ndarray) -> None:
        """Rest frequencies and noise of the pads, (cubes, P) Hz, NaN where there is none."""
        self._rest, self.noise = rest, noise
        self.bound = self._bound(noise)

    def judge(self, window: Window, state: np.ndarray) -> np.ndarray:
        """(cubes, P) bits found in a window that ended; state: bits of the pads until now."""
        enough = window.rows >= MIN_COUNT
        noise, span, middle = window.noise, window.highest - window.lowest, window.mean
        found = np.zeros(state.shape, np.uint16)
        with np.errstate(invalid="ignore"):
            times = np.where(state & NOISY, NOISY_LEAVE, NOISY_ENTER)
            usual = np.fmax(self.noise, _median(noise))
            found[noise > times * usual] |= NOISY
            self.bound = self._bound(usual)
            moving = _median(span / self.noise) > STUCK_MOVING
            # What comes and goes shows a single value now and then, which is not stuck.
            found[(span == 0) & moving & (state & (OPEN | SHORT | RANGE) == 0)] |= STUCK
            healthy = state & LEFT_OUT == 0
            # A step that falls between two windows shows in neither.
            jumped = np.abs(middle - self._middle) > STILL * self.noise
            unmoved = (span < STILL * self.noise) & ~jumped
            self.still = enough & (unmoved | ~healthy | ~self._exists).all(axis=1)
            self._middle = np.where(np.isnan(middle), self._middle, middle)
            self._reference[~self.still & (window.rows > 0)] = np.nan
            fresh = self.still[:, None] & np.isnan(self._reference)
            self._reference[fresh] = middle[fresh]
            wander = (middle - self._reference) / self._rest
            limit = np.maximum(DRIFT_LIMIT, STILL * self.noise / self._rest)
            found[np.abs(wander - _median(wander)) > limit] |= DRIFT
        return found * (enough[:, None] & self._exists)

    @staticmethod
    def _bound(noise: np.ndarray) -> np.ndarray:
        bound: np.ndarray = ((JUMP * noise) ** 2).astype(np.float32)
        return bound


def _median(values: np.ndarray) -> np.ndarray:
    """(cubes, 1): the lower median over each cube's pads that have a value."""
    ordered = np.sort(values, axis=1)  # NaN last
    known = values.shape[1] - np.isnan(ordered).sum(axis=1)
    return np.take_along_axis(ordered, np.maximum((known - 1) // 2, 0)[:, None], axis=1)
