"""Diagnosis of pads from the statistics of a window, and how long a condition lasts.

All arrays are (cubes, pads); nothing loops over cubes.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array, Index, Mask, PadMasks, Real, StatusBits
from ..status import DRIFT, LEFT_OUT, NOISY, OPEN, RANGE, SHORT, STUCK
from .statistics import Window

HOLD_WINDOWS = 3
"""Number of windows without a condition after which the condition ends, so that it does not flicker
while a pad has an intermittent contact."""

MIN_COUNT = 20
"""Minimum number of rows in a window for its statistics to be used.

With fewer rows, the noise is too uncertain for the limits below.
"""

NOISY_ENTER = 10.0
"""Ratio of a pad's noise to its usual noise above which the pad becomes noisy.

The usual noise is the larger of the calibration's noise and the median over the cube's pads.
"""

NOISY_LEAVE = 5.0
"""Ratio of a noisy pad's noise to its usual noise below which the pad is no longer noisy."""

MAX_SECOND_DIFFERENCE = 60.0
"""Limit of a second difference in the noise, as a multiple of the usual noise.

Two second differences of this size in `MIN_COUNT` rows are a noise below `NOISY_ENTER`, so one jump
of the frequency does not make a pad noisy.
"""

STUCK_MIN_SPAN = 5.0
"""Span of the other pads of a cube, as a multiple of their noise, above which a pad that shows a
single value is stuck."""

STILL_MAX_SPAN = 8.0
"""Span (peak to peak) of a pad, as a multiple of its noise, below which the pad is still.

In 1000 rows, noise alone spans 6 times its standard deviation.
"""

RESIDUAL_ENTER = 0.5
"""Share of a window's rows with a residual above its limit for a cube's residual to become high."""

RESIDUAL_LEAVE = 0.1
"""Share of a window's rows with a residual above its limit for a high residual to stay high."""

DRIFT_LIMIT = 2e-4
"""Distance, relative to the rest frequency, that one pad of a still cube moves away from the others
before it is drifting."""


class Conditions:
    """Present conditions of all pads; each lasts until `HOLD_WINDOWS` windows were without it.

    Attributes:
        state: Conditions of each pad (cubes, P), bits of `status.py`.
        mask: Bit masks of the pads that are left out (cubes,).
        status: Conditions of all pads of a cube together (cubes,).
    """

    def __init__(self, n_cubes: int, n_pads: int) -> None:
        # Conditions found in the present window come first, then those of the windows before.
        shape = (n_cubes, n_pads)
        self._recent = np.zeros((HOLD_WINDOWS, *shape), np.uint16)
        self._since_collected = np.zeros(shape, np.uint16)
        pads = np.arange(n_pads, dtype=np.uint32)
        self._pad_bit = np.uint32(1) << pads
        self._combine()

    def add(self, cube: Index, bits: StatusBits) -> None:
        """Add conditions (n, P) that were just found on cubes (n,)."""
        # A pad that is broken for good brings the same bits with every row, which need no work.
        if (bits & ~self._recent[0][cube]).any():
            np.bitwise_or.at(self._recent[0], cube, bits)
            self._combine()

    def end_window(self, found: StatusBits, has_rows: Mask) -> None:
        """End a window.

        Args:
            found: Conditions found in the window (cubes, P).
            has_rows: Whether a cube had rows in the window (cubes,).
        """
        self._recent[0] |= found
        self._combine()
        # A cube without rows keeps its conditions, because silence does not show recovery.
        self._recent[1:, has_rows] = self._recent[:-1, has_rows]
        self._recent[0, has_rows] = 0

    def collect(self) -> StatusBits:
        """Return all conditions (cubes, P) since the last call, including the present ones."""
        found: StatusBits = self._since_collected | self.state
        self._since_collected = np.zeros_like(found)
        return found

    def _combine(self) -> None:
        self.state: StatusBits = np.bitwise_or.reduce(self._recent, axis=0)
        self._since_collected |= self.state
        is_left_out = self.state & LEFT_OUT > 0
        bits = is_left_out * self._pad_bit
        self.mask: PadMasks = bits.sum(axis=1, dtype=np.uint32)
        self.status: StatusBits = np.bitwise_or.reduce(self.state, axis=1)


class PadDiagnosis:
    """Finds stuck, noisy and drifting pads, and still cubes, in the windows of a skin.

    Attributes:
        still: Whether no usable pad of a cube moved in the last window (cubes,).
        noise: Noise of each pad (cubes, P) as the calibration states it, in Hz.
        bound: Limit of squared second differences in the next window (cubes, P), in Hz².
    """

    def __init__(self, exists: Mask) -> None:
        """Prepare the diagnosis of a skin.

        Args:
            exists: Whether a cube has this pad (cubes, P).
        """
        self._exists = exists
        self.still: Mask = np.zeros(len(exists), bool)
        # Mean frequencies of the first window since the cube is still; NaN while it moves.
        self._mean_at_rest = np.full(exists.shape, np.nan)
        # Mean frequencies of the last window with rows.
        self._mean_before = self._mean_at_rest.copy()

    def set_reference(self, rest_frequency: Array, noise: Array) -> None:
        """Set rest frequency and noise of the pads (cubes, P), in Hz, NaN for missing pads."""
        self._rest = rest_frequency
        self.noise = noise
        self.bound = _squared_bound(noise)

    def examine(self, window: Window, state: StatusBits) -> StatusBits:
        """Find the conditions of a window that has ended.

        Args:
            window: Statistics of the window.
            state: Conditions known before the window ended (cubes, P).

        Returns:
            Conditions found in the window (cubes, P).
        """
        has_enough_rows = window.rows >= MIN_COUNT
        span = window.highest - window.lowest
        found = np.zeros(state.shape, np.uint16)
        with np.errstate(invalid="ignore"):  # NaN where a cube has no such pad, or no rows
            found[self._find_noisy(window, state)] |= NOISY
            found[self._find_stuck(span, state)] |= STUCK
            self._update_still(window, span, has_enough_rows, state)
            found[self._find_drifting(window)] |= DRIFT
        is_valid = has_enough_rows[:, None] & self._exists
        valid: StatusBits = found * is_valid
        return valid

    def _find_noisy(self, window: Window, state: StatusBits) -> Mask:
        # Vibration raises the noise of all pads of a cube, so the median is what is usual now.
        usual = np.fmax(self.noise, _lower_median(window.noise))
        self.bound = _squared_bound(usual)
        was_noisy = state & NOISY > 0
        limit = np.where(was_noisy, NOISY_LEAVE, NOISY_ENTER) * usual
        # A moving load looks like noise but is smooth. It must not end a noisy pad's condition.
        is_noise = window.rough | was_noisy
        noisy: Mask = (window.noise > limit) & is_noise
        return noisy

    def _find_stuck(self, span: Real, state: StatusBits) -> Mask:
        others_moved = _lower_median(span / self.noise) > STUCK_MIN_SPAN
        # A pad with an intermittent contact shows a single value now and then and is not stuck.
        is_intermittent = state & (OPEN | SHORT | RANGE) > 0
        stuck: Mask = (span == 0) & others_moved & ~is_intermittent
        return stuck

    def _update_still(
        self,
        window: Window,
        span: Real,
        has_enough_rows: Mask,
        state: StatusBits,
    ) -> None:
        limit = STILL_MAX_SPAN * self.noise
        # A step between two windows is visible in the span of neither.
        jumped = np.abs(window.mean - self._mean_before) > limit
        is_unmoved = (span < limit) & ~jumped
        is_unused = (state & LEFT_OUT > 0) | ~self._exists
        self.still = has_enough_rows & (is_unmoved | is_unused).all(axis=1)
        has_mean = ~np.isnan(window.mean)
        self._mean_before = np.where(has_mean, window.mean, self._mean_before)

    def _find_drifting(self, window: Window) -> Mask:
        moved = ~self.still & (window.rows > 0)
        self._mean_at_rest[moved] = np.nan
        has_come_to_rest = self.still[:, None] & np.isnan(self._mean_at_rest)
        self._mean_at_rest[has_come_to_rest] = window.mean[has_come_to_rest]

        shift = (window.mean - self._mean_at_rest) / self._rest
        # The means of two windows of a still cube may differ by the span that counts as still.
        still_span = STILL_MAX_SPAN * self.noise / self._rest
        limit = np.maximum(DRIFT_LIMIT, still_span)
        # A shift that all pads share is temperature or a slow load, not a fault of one pad.
        drifting: Mask = np.abs(shift - _lower_median(shift)) > limit
        return drifting


def has_high_residual(
    was_high: Mask,
    over_limit: Index,
    rows: Index,
) -> Mask:
    """Decide, with hysteresis, which cubes have a high residual after a window.

    Noise alone exceeds the limit in one row of a thousand, so a share of the rows decides. Cubes
    without rows keep their state.

    Args:
        was_high: Whether the residual was high before the window (cubes,).
        over_limit: Number of rows in the window with a residual above its limit (cubes,).
        rows: Number of rows in the window (cubes,).
    """
    share = np.where(was_high, RESIDUAL_LEAVE, RESIDUAL_ENTER)
    return np.where(rows > 0, over_limit > share * rows, was_high)


def _squared_bound(noise: Array) -> Array:
    bound: Array = ((MAX_SECOND_DIFFERENCE * noise) ** 2).astype(np.float32)
    return bound


def _lower_median(values: Real) -> Real:
    """Return the lower median (cubes, 1) over the pads of each cube that have a value."""
    ordered = np.sort(values, axis=1)  # NaN is sorted to the end
    n_unknown = np.isnan(ordered).sum(axis=1)
    n_known = values.shape[1] - n_unknown
    place = np.maximum((n_known - 1) // 2, 0)
    return np.take_along_axis(ordered, place[:, None], axis=1)
