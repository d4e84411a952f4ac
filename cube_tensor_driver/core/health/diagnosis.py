"""Diagnosis: which pads are stuck, noisy or drifting, and which cubes are still, by statistics.

All arrays are (cubes, pads); nothing loops over cubes.
"""

from __future__ import annotations

import numpy as np

from ..status import DRIFT, LEFT_OUT, NOISY, OPEN, RANGE, SHORT, STUCK
from .statistics import Window

MIN_COUNT = 20
"""Rows in a window below which its statistics say nothing."""
NOISY_ENTER, NOISY_LEAVE = 10.0, 5.0
"""Times the calibration's noise and times the cube's other pads, to become noisy and to stay so."""
JUMP = 60.0
"""Times the usual noise to which a second difference is bounded: two of them in 20 rows stay below
NOISY_ENTER."""
STUCK_MOVING = 5.0
"""Times its noise that the cube's pads must have moved before a pad that did not move is stuck."""
STILL = 8.0
"""Times its noise, peak to peak, within which a pad is still: noise alone spans 6 in 1000 rows."""
RESIDUAL_ENTER, RESIDUAL_LEAVE = 0.5, 0.1
"""Shares of a window's rows with a residual above its limit, for a cube to become strained and to
stay so."""
DRIFT_LIMIT = 2e-4
"""Of the rest frequency: how far one pad wanders while all are still before it is drifting."""


class PadDiagnosis:
    """Compares the windows of a skin with what its pads should do.

    still: (cubes,) bool, nothing moved in the last window
    noise: (cubes, P) Hz, the calibration's
    bound: (cubes, P) Hz², to which the statistics of the next window cut squared second differences
    """

    def __init__(self, exists: np.ndarray) -> None:
        """exists: (cubes, P) bool, which pads there are."""
        self._exists = exists
        self.still = np.zeros(len(exists), bool)
        self._mean_at_rest = np.full(exists.shape, np.nan)  # since the cube is still
        self._mean_before = self._mean_at_rest.copy()  # of the last window with data

    def set_reference(self, rest_frequency: np.ndarray, noise: np.ndarray) -> None:
        """Rest frequency and noise of the pads, (cubes, P) Hz, NaN where there is none."""
        self._rest, self.noise = rest_frequency, noise
        self.bound = _bound(noise)

    def examine(self, window: Window, state: np.ndarray) -> np.ndarray:
        """(cubes, P) bits found in a window that ended; state: (cubes, P) bits known before it."""
        enough = window.rows >= MIN_COUNT
        span = window.highest - window.lowest
        found = np.zeros(state.shape, np.uint16)
        with np.errstate(invalid="ignore"):
            found[self._noisy(window, state)] |= NOISY
            found[self._stuck(span, state)] |= STUCK
            self._update_still(window, span, enough, state)
            found[self._drifting(window)] |= DRIFT
        return found * (enough[:, None] & self._exists)

    def _noisy(self, window: Window, state: np.ndarray) -> np.ndarray:
        usual = np.fmax(self.noise, _lower_median(window.noise))
        self.bound = _bound(usual)
        was_noisy = state & NOISY > 0
        limit = np.where(was_noisy, NOISY_LEAVE, NOISY_ENTER) * usual
        # One that is noisy already stays so while a load moves it.
        return (window.noise > limit) & (window.rough | was_noisy)

    def _stuck(self, span: np.ndarray, state: np.ndarray) -> np.ndarray:
        others_moved = _lower_median(span / self.noise) > STUCK_MOVING
        # A pad that comes and goes shows a single value now and then and is not stuck.
        return (span == 0) & others_moved & (state & (OPEN | SHORT | RANGE) == 0)

    def _update_still(
        self, window: Window, span: np.ndarray, enough: np.ndarray, state: np.ndarray
    ) -> None:
        # A step that falls between two windows shows in neither.
        jumped = np.abs(window.mean - self._mean_before) > STILL * self.noise
        unmoved = (span < STILL * self.noise) & ~jumped
        unused = (state & LEFT_OUT > 0) | ~self._exists
        self.still = enough & (unmoved | unused).all(axis=1)
        self._mean_before = np.where(np.isnan(window.mean), self._mean_before, window.mean)

    def _drifting(self, window: Window) -> np.ndarray:
        moved = ~self.still & (window.rows > 0)
        self._mean_at_rest[moved] = np.nan
        fresh = self.still[:, None] & np.isnan(self._mean_at_rest)
        self._mean_at_rest[fresh] = window.mean[fresh]
        wander = (window.mean - self._mean_at_rest) / self._rest
        limit = np.maximum(DRIFT_LIMIT, STILL * self.noise / self._rest)
        # What all pads do together is temperature or a load.
        return np.abs(wander - _lower_median(wander)) > limit


def still_strained(strained: np.ndarray, over: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(cubes,) bool: whose residual stayed above its limit, after a window.

    strained: (cubes,) bool before it; over: (cubes,) how many of its rows (cubes,) had a residual
    above the limit, as noise alone has in one of a thousand. Cubes without rows stay as they were.
    """
    limit = np.where(strained, RESIDUAL_LEAVE, RESIDUAL_ENTER)
    return np.where(rows > 0, over > limit * rows, strained)


def _bound(noise: np.ndarray) -> np.ndarray:
    bound: np.ndarray = ((JUMP * noise) ** 2).astype(np.float32)
    return bound


def _lower_median(values: np.ndarray) -> np.ndarray:
    """(cubes, 1): the lower median over each cube's pads that have a value."""
    ordered = np.sort(values, axis=1)  # NaN last
    known = values.shape[1] - np.isnan(ordered).sum(axis=1)
    middle = np.maximum((known - 1) // 2, 0)
    return np.take_along_axis(ordered, middle[:, None], axis=1)
