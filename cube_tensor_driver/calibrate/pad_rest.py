# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Behaviour of the pads while nothing touches them: frequency, noise, drift and faults.

f[n]     frequency of a pad in sample n
noise    sqrt(mean(e²) / 6),   e[n] = f[n] - 2 f[n-1] + f[n-2]    (`core/health/statistics.py`)
drift    slope of the straight line fitted to f[n] over time
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..core.arrays import Array, Mask
from ..core.health.diagnosis import NOISY_ENTER

MIN_MEASURED_SHARE = 0.5
"""Minimum fraction of the samples in which a pad must have a frequency; with less, the pad is
reported as silent."""

MIN_SAMPLES = 3
"""Minimum number of samples of the pads: the noise is computed from second differences, each of
which needs three samples."""

MINUTE_S = 60.0
"""Duration of a minute in s, because drift is stated per minute."""


class PadsAtRest(NamedTuple):
    """Statistics of P unloaded pads of C cubes, all of shape (C, P).

    Attributes:
        frequency: Mean frequency, in Hz; NaN for silent pads.
        noise: Standard deviation of the frequency without drift, relative to the mean frequency.
        drift: Change of the frequency per minute, relative to the mean frequency.
        silent: Whether most samples of the pad have no frequency.
        stuck: Whether the pad keeps a single value while other pads of its cube do not.
        noisy: Whether the noise is more than `NOISY_ENTER` times the median noise of the pads of
            the cube.
    """

    frequency: Array
    noise: Array
    drift: Array
    silent: Mask
    stuck: Mask
    noisy: Mask

    @property
    def works(self) -> Mask:
        """Whether each pad can be used: it is neither silent nor stuck (C, P)."""
        works: Mask = ~(self.silent | self.stuck)
        return works


def measure_pads_at_rest(frequency: Array, seconds: Array) -> PadsAtRest:
    """Compute the statistics of unloaded pads from S samples of C cubes with P pads.

    Args:
        frequency: Frequencies (S, C, P), in Hz; NaN where nothing was measured.
        seconds: Times of the samples (S,), in s.
    """
    measured = np.ma.masked_invalid(frequency)
    counts = measured.count(axis=0)
    mean = measured.mean(axis=0).filled(np.nan)
    silent = counts < MIN_MEASURED_SHARE * len(frequency)

    # Second differences remove drift, which would count as noise in a standard deviation.
    second = np.diff(frequency, n=2, axis=0)
    squares = np.ma.masked_invalid(second**2)
    mean_square = squares.mean(axis=0).filled(0)
    noise = np.sqrt(mean_square / 6)

    # Slope of the straight line that is fitted to the measured samples of each pad.
    centred = seconds - seconds.mean()
    is_measured = ~np.ma.getmaskarray(measured)
    time = np.where(is_measured, centred[:, None, None], 0)
    deviation = measured - mean
    covariance = (deviation * time).sum(axis=0).filled(0)
    sum_time_squares = (time**2).sum(axis=0)
    slope = covariance / np.maximum(sum_time_squares, 1e-12)

    span = np.ma.ptp(measured, axis=0).filled(0)
    varies = ~silent & (span > 0)
    # If all pads of a cube keep a single value, the cube may be a simulated one without noise, so
    # none of its pads counts as stuck.
    others_vary = varies.any(axis=1, keepdims=True)
    stuck = ~silent & ~varies & others_vary

    has_frequency = ~silent & (mean > 0)
    scale = np.where(has_frequency, mean, np.nan)
    relative_noise = noise / scale
    # Pads that keep a single value are left out of the median noise of their cube (NaN). If all
    # pads do, the median is infinite, so that no pad of the cube counts as noisy.
    left_out = np.where(others_vary, np.nan, np.inf)
    of_varying = np.where(varies, relative_noise, left_out)
    usual = np.nanmedian(of_varying, axis=1, keepdims=True)
    noisy = varies & (relative_noise > NOISY_ENTER * usual)
    return PadsAtRest(
        frequency=scale,
        noise=relative_noise,
        drift=MINUTE_S * slope / scale,
        silent=silent,
        stuck=stuck,
        noisy=noisy,
    )
