# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of pads from statistics over windows of 0.5 s, and the present conditions of pads.

All arrays are (cubes, pads); nothing loops over cubes.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array, Index, Mask, Real, StatusBits
from ..kernel.contract import HealthState
from ..kernel.rows import pack_bits
from ..status import DRIFT, LEFT_OUT, NOISY, OPEN, RANGE, REPORTED, SHORT, STUCK
from .statistics import Window

HOLD_WINDOWS = 3
"""Number of successive windows (of 0.5 s) without a condition of a pad after which the condition
ends. Several are needed, so that the condition of a pad with an intermittent contact does not
flicker."""

MIN_ROWS = 20
"""Minimum number of rows (samples of a cube) in a window of 0.5 s for its statistics to be used.

With fewer rows, the measured noise is too uncertain to be compared with limits.
"""

NOISY_ENTER = 10.0
"""Ratio of the measured noise of a pad to its usual noise above which the pad is reported as noisy.

The usual noise is the larger of the noise in the calibration and the median of the measured noise
of the cube's pads. Noise is the standard deviation of the frequency.
"""

NOISY_LEAVE = 5.0
"""Ratio of the measured noise of a noisy pad to its usual noise below which the pad is no longer
reported as noisy.

The usual noise is the larger of the noise in the calibration and the median of the measured noise
of the cube's pads.
"""

MAX_SECOND_DIFFERENCE = 60.0
"""Limit to which a second difference of a pad's frequency, f[n] - 2 f[n-1] + f[n-2], is cut before
the noise is computed, as a multiple of the pad's usual noise.

One jump of the frequency gives two large second differences. Cut to this limit, they raise the
noise of 20 rows to less than 10 times the usual noise, above which a pad is reported as noisy.
"""

STUCK_MIN_SPAN = 5.0
"""Median span (highest minus lowest frequency in a window of 0.5 s) of the pads of a cube, as a
multiple of their noise, above which the cube counts as loaded.

A pad of a loaded cube that keeps a single value is reported as stuck.
"""

STILL_MAX_SPAN = 8.0
"""Span (highest minus lowest frequency in a window) below which a pad counts as still, as a
multiple of the noise (standard deviation) in its calibration.

In 1000 rows, noise alone spans 6 times its standard deviation.
"""

RESIDUAL_ENTER = 0.5
"""Largest fraction of rows with a residual above its limit, in a window of 0.5 s, at which a cube
is not yet reported with a high residual.

The limit of the residual (from the chi-square distribution) is exceeded by noise alone in one row
of a thousand.
"""

RESIDUAL_LEAVE = 0.1
"""Largest fraction of rows with a residual above its limit, in a window of 0.5 s, at which a cube
is no longer reported with a high residual.

The residual measures how far the signals of a cube's pads contradict each other.
"""

DRIFT_LIMIT = 2e-4
"""Shift of a pad's frequency, divided by its rest frequency (frequency without load), minus the
median of the shifts of all pads of the cube, above which the pad is reported as drifting.

The shift is measured from the mean frequency at the time at which the cube came to rest.
"""


SINGLE_ROW_CONDITIONS = OPEN | SHORT | RANGE | REPORTED
"""Conditions of a pad, as a bit mask, that a single row (sample of a cube) shows: open, short, out
of range, reported by the device. All others need the statistics of a window of 0.5 s."""


class Conditions:
    """Present conditions (such as open, stuck or noisy) of all pads of a skin.

    A condition ends when `HOLD_WINDOWS` successive windows were without it.
    """

    def __init__(self, sums: HealthState, exists: Mask) -> None:
        """Start without conditions.

        Args:
            sums: State that the kernel reads. Its bit masks of pads and its conditions of cubes are
                kept up to date here.
            exists: Whether each cube has each pad (cubes, P).
        """
        self._sums = sums
        # Row 0 holds the conditions found in the present window, the next rows those of the windows
        # before it.
        shape = (HOLD_WINDOWS + 1, *exists.shape)
        self._recent = np.zeros(shape, np.uint16)
        self._since_collected = np.zeros_like(self._recent[0])

    @property
    def state(self) -> StatusBits:
        """Conditions of each pad (cubes, P), bits of `status.py`."""
        state: StatusBits = np.bitwise_or.reduce(self._recent, axis=0)
        return state

    def add(self, cube: Index, bits: StatusBits) -> None:
        """Add conditions that rows of the present window of 0.5 s show.

        Only the first condition of a pad in a window is added, because a broken pad shows its
        condition in every row. The kernel (the function that computes stress from rows) stops for
        this call only at the first such row, so that later ones cost no time.

        Args:
            cube: Numbers of different cubes (n,).
            bits: Conditions of their pads (n, P), bits of `status.py`.
        """
        cubes = self._sums.cubes
        present = self._recent[0]
        is_first = present[cube] & SINGLE_ROW_CONDITIONS == 0
        new_bits = np.where(is_first, bits, 0)
        present[cube] |= new_bits
        pads = pack_bits(bits > 0)
        cubes["found"][cube] |= pads
        cubes["mask"][cube] |= pads
        cubes["status"][cube] |= np.bitwise_or.reduce(new_bits, axis=1)

    def end_window(self, found: StatusBits, has_rows: Mask) -> None:
        """Add the conditions that the statistics of a window show, and start the next window.

        Args:
            found: Conditions found in the window that ends (cubes, P).
            has_rows: Whether a cube had rows in this window (cubes,).
        """
        self._recent[0] |= found
        state = self.state
        self._since_collected |= state
        # A cube without rows keeps its conditions, because nothing shows that its pads recovered.
        self._recent[1:, has_rows] = self._recent[:-1, has_rows]
        self._recent[0, has_rows] = 0
        cubes = self._sums.cubes
        state = self.state
        cubes["found"][has_rows] = 0
        cubes["mask"] = pack_bits(state & LEFT_OUT > 0)
        cubes["status"] = np.bitwise_or.reduce(state, axis=1)

    def collect(self) -> StatusBits:
        """Return all conditions (cubes, P) that each pad had since the last call of this method."""
        found: StatusBits = self._since_collected | self.state
        self._since_collected = np.zeros_like(found)
        return found


class PadDiagnosis:
    """Finds stuck, noisy and drifting pads, and still cubes, from the statistics of windows.

    Attributes:
        still: Whether each cube is still (cubes,): in the last window of 0.5 s, the frequency of no
            usable pad moved.
        noise: Standard deviation of the frequency of each pad (cubes, P), in Hz, by the
            calibration.
        bound: Limit to which squared second differences of the frequency are cut in the next window
            (cubes, P), in Hz².
    """

    def __init__(self, exists: Mask, is_dummy: Mask) -> None:
        """Prepare the diagnosis of the pads of a skin.

        Args:
            exists: Whether each cube has each pad (cubes, P), with P the largest number of pads.
            is_dummy: Whether it is a dummy pad, whose frequency no load changes (cubes, P).
        """
        self._exists = exists
        self._is_dummy = is_dummy
        self.still: Mask = np.zeros(len(exists), bool)
        # Mean frequencies in the window in which the cube came to rest; NaN while it moves.
        self._mean_at_rest = np.full(exists.shape, np.nan)
        # Mean frequencies in the last window with rows of the cube.
        self._mean_before = self._mean_at_rest.copy()

    def set_reference(self, rest_frequency: Array, noise: Array) -> None:
        """Set the quantities to which measured frequencies are compared.

        Args:
            rest_frequency: Frequencies without load (cubes, P), in Hz; NaN where a cube has no such
                pad.
            noise: Standard deviations of the frequencies (cubes, P), in Hz; NaN where a cube has no
                such pad.
        """
        self._rest = rest_frequency
        self.noise = noise
        self.bound = _compute_square_bound(noise)

    def examine(self, window: Window, state: StatusBits) -> StatusBits:
        """Find the conditions of a window that has ended.

        Args:
            window: Statistics of the window.
            state: Conditions known before the window ended (cubes, P).

        Returns:
            Conditions found in the window (cubes, P).
        """
        has_enough_rows = window.rows >= MIN_ROWS
        span = window.highest - window.lowest
        found = np.zeros(state.shape, np.uint16)
        with np.errstate(invalid="ignore"):  # NaN where a cube has no such pad, or no rows
            found[self._find_noisy(window, state)] |= NOISY
            found[self._find_stuck(span, state)] |= STUCK
            self._update_still(
                window,
                span,
                has_enough_rows,
                state,
            )
            found[self._find_drifting(window)] |= DRIFT
        # Under a slow load, a dummy pad seems to be stuck, or to drift relative to the others.
        found[self._is_dummy] &= NOISY
        is_valid = has_enough_rows[:, None] & self._exists
        return found * is_valid

    def _find_noisy(self, window: Window, state: StatusBits) -> Mask:
        """Find the pads whose noise is high (cubes, P), with hysteresis, and set the new `bound`.

        Args:
            window: Statistics of the window that has ended.
            state: Conditions known before the window ended (cubes, P).
        """
        # Vibration raises the noise of all pads of a cube. They must not be reported as noisy then,
        # so the median noise of the pads is the usual noise if it is above that of the calibration.
        usual = np.fmax(self.noise, _compute_lower_median(window.noise))
        self.bound = _compute_square_bound(usual)
        was_noisy = state & NOISY > 0
        ratio = np.where(was_noisy, NOISY_LEAVE, NOISY_ENTER)
        limit = ratio * usual
        # A moving load raises the computed noise, too, but the frequency is then smooth, not rough.
        # A pad that was noisy before stays noisy even if the load now makes its frequency smooth.
        is_noise = window.rough | was_noisy
        return (window.noise > limit) & is_noise

    def _find_stuck(self, span: Real, state: StatusBits) -> Mask:
        """Find the pads that keep a single value while the other pads of the cube move (cubes, P).

        Args:
            span: Highest minus lowest frequency in the window (cubes, P), in Hz.
            state: Conditions known before the window ended (cubes, P).
        """
        usual_span = _compute_lower_median(span / self.noise)
        others_moved = usual_span > STUCK_MIN_SPAN
        # A pad with a loose wire may show a single frequency for a window. It is not stuck, and has
        # the condition open, short or range already.
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
        """Determine which cubes are still: no usable pad's frequency moved in the window.

        Args:
            window: Statistics of the window that has ended.
            span: Highest minus lowest frequency in the window (cubes, P), in Hz.
            has_enough_rows: Whether a cube has at least `MIN_ROWS` rows in the window.
            state: Conditions of the pads (cubes, P).
        """
        limit = STILL_MAX_SPAN * self.noise
        # A step of the frequency between two windows is not visible in the span of either of them.
        jumped = np.abs(window.mean - self._mean_before) > limit
        is_unmoved = (span < limit) & ~jumped
        is_left_out = state & LEFT_OUT > 0
        is_unused = is_left_out | ~self._exists
        all_unmoved = (is_unmoved | is_unused).all(axis=1)
        self.still = has_enough_rows & all_unmoved
        has_mean = ~np.isnan(window.mean)
        self._mean_before = np.where(has_mean, window.mean, self._mean_before)

    def _find_drifting(self, window: Window) -> Mask:
        """Return a mask (cubes, P) of the pads that drift.

        The frequency of a drifting pad moves away from its value at rest, while the frequencies of
        the other pads of the cube do not. Only cubes that are still (constant frequencies) are
        examined.

        Args:
            window: Statistics of the window that has ended.
        """
        has_rows = window.rows > 0
        moved = ~self.still & has_rows
        self._mean_at_rest[moved] = np.nan
        has_come_to_rest = self.still[:, None] & np.isnan(self._mean_at_rest)
        self._mean_at_rest[has_come_to_rest] = window.mean[has_come_to_rest]

        shift = (window.mean - self._mean_at_rest) / self._rest
        # While a cube is still, its mean frequencies in two windows may differ by up to the span
        # that counts as still.
        still_span = STILL_MAX_SPAN * self.noise / self._rest
        limit = np.maximum(DRIFT_LIMIT, still_span)
        # A shift that all pads share is caused by temperature or a slow load, not by a fault.
        own_shift = shift - _compute_lower_median(shift)
        drifting: Mask = np.abs(own_shift) > limit
        return drifting


def has_high_residual(
    was_high: Mask,
    over_limit: Index,
    rows: Index,
) -> Mask:
    """Decide, with hysteresis, which cubes have a high residual after a window of 0.5 s.

    Noise alone exceeds the limit of the residual (misfit of the pads) in one row of a thousand, so
    the fraction of the window's rows above the limit decides. A residual becomes high at
    `RESIDUAL_ENTER` and stays high down to `RESIDUAL_LEAVE`. Cubes without rows keep their state.

    Args:
        was_high: Whether the residual of a cube was high before the window (cubes,).
        over_limit: Number of rows in the window with a residual above its limit (cubes,).
        rows: Number of all rows in the window (cubes,).

    Returns:
        Whether the residual of a cube is high now (cubes,).
    """
    share = np.where(was_high, RESIDUAL_LEAVE, RESIDUAL_ENTER)
    is_high = over_limit > share * rows
    return np.where(rows > 0, is_high, was_high)


def _compute_square_bound(noise: Array) -> Array:
    """Return the limit, in Hz², to which squared second differences of the frequency are cut.

    Without the cut, one jump of the frequency would count as high noise.

    Args:
        noise: Usual noise (standard deviation of the frequency) of each pad, in Hz.
    """
    limit = MAX_SECOND_DIFFERENCE * noise
    return (limit**2).astype(np.float32)


def _compute_lower_median(values: Real) -> Real:
    """Return the median over the pads of each cube (cubes, 1), without NaN.

    Of an even number of values, it is the lower one of the two in the middle.

    Args:
        values: Value of each pad (cubes, P); NaN where a cube has no such pad.
    """
    ordered = np.sort(values, axis=1)  # NaN is sorted to the end
    n_unknown = np.isnan(ordered).sum(axis=1)
    n_known = values.shape[1] - n_unknown
    place = np.maximum((n_known - 1) // 2, 0)
    return np.take_along_axis(ordered, place[:, None], axis=1)
