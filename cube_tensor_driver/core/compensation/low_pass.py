# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""First-order low-pass filters, advanced exactly over intervals of any length.

    time dx/dt = u - x

The input u is a straight line from u_0 to u_1 over an interval of length t. How far the output
lags behind is d = u - x. It changes from d_0 to d_1 over the interval:

    d_1 = (1 - m) d_0 + (m time / t) (u_1 - u_0),      m = 1 - exp(-t / time)

A straight line is used, because what is filtered is continuous: an input that is constant between
samples would delay every change by half an interval.

Source: R. L. Taylor, K. S. Pister, G. L. Goudreau, Int. J. Numer. Methods Eng. 2 (1970), 45-59.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array, Real
from ..kernel.contract import MAX_GAP_NS

STEP_NS = 100_000_000
"""Duration of one step of the compensation, in ns. Within a step, the temperature counts as
constant, and the readings of the pads as linear in time.

A skin that warms suddenly by 15 K, with a time constant of 100 s and an effect of 150 Pa/K, changes
the stress on a pad by 2 Pa within one step, less than the noise of one sample (3 Pa).
"""

MAX_STEP_NS = MAX_GAP_NS + STEP_NS
"""Longest interval between a cube's newest rows at two successive steps, in ns, in which load and
temperature count as known.

It is `MAX_GAP_NS`, the same limit for two successive rows, plus one step, because more rows may
follow a gap before the next step.
"""

HALVINGS = 10
"""Number of times that the argument x is halved before 1 - exp(-x) is computed by a Taylor series,
which converges quickly only for small arguments."""

SERIES_TERMS = 9
"""Number of terms of the Taylor series of 1 - exp(-x), where x is the ratio of a time to a time
constant, divided by 2**`HALVINGS`.

Ratios are limited to 64, so x is at most 1/16. The first term that is left out is then 4e-18 of the
sum.
"""


def relaxed_share(ratio: Array) -> Array:
    """Return 1 - exp(-ratio) for ratios from 0 on, with the same bits on every processor.

    The exponential function of a mathematical library differs in its last bit by processor.
    """
    # exp(-64) is 2e-28, so 1 - exp(-ratio) is 1 in double precision for all larger ratios.
    part = np.minimum(ratio, 64.0) / 2**HALVINGS
    share: Array = np.zeros_like(part)
    # Taylor series 1 - exp(-x) = x (1 - x/2 (1 - x/3 (1 - ...))).
    for n in range(SERIES_TERMS, 0, -1):
        share = part / n * (1 - share)
    # The halvings are undone: 1 - exp(-2 x) = m (2 - m) with m = 1 - exp(-x).
    for _ in range(HALVINGS):
        share *= 2 - share
    return share


class LowPass:
    """K low-pass filters for each of C cubes, each of which filters P signals.

    The cubes are the last axis of all arrays, because numpy is fastest along it.

    Attributes:
        lag: How far the outputs of the filters lag behind the inputs (K, P, C).
    """

    def __init__(self, time: Array, n_signals: int) -> None:
        """Begin with outputs that equal the inputs.

        Args:
            time: Time constants (K, C), in s.
            n_signals: Number P of signals.
        """
        self._time = time
        # Whether a cube has other time constants than the cube with the number before.
        is_different = time[:, 1:] != time[:, :-1]
        self._is_other = is_different.any(axis=0)
        n_times, n_cubes = time.shape
        self.lag = np.zeros((n_times, n_signals, n_cubes))

    def advance(self, elapsed_s: Real, change: Real) -> Array:
        """Advance the filters by one interval for each cube.

        Args:
            elapsed_s: Lengths of the intervals (C,), in s; 0 leaves the outputs unchanged.
            change: Changes of the inputs (P, C), along straight lines.

        Returns:
            Fraction m = 1 - exp(-elapsed_s / time) of each output that the interval replaced, as an
            array (K, C).
        """
        share, mean = self.find_shares(elapsed_s)
        kept = 1 - share
        for k, lag in enumerate(self.lag):
            lag *= kept[k]
            lag += mean[k] * change
        return share

    def find_shares(self, elapsed_s: Real) -> tuple[Array, Array]:
        """Return m = 1 - exp(-ratio) and m / ratio, both (K, C).

        The ratio is the length of an interval divided by the time constant of a filter.

        Args:
            elapsed_s: Lengths of the intervals (C,), in s.
        """
        # The cubes of one hub follow each other and have equal intervals, so one computation serves
        # them all.
        is_other = self._is_other | (elapsed_s[1:] != elapsed_s[:-1])
        begins_run = np.append(True, is_other)
        begins = np.flatnonzero(begins_run)
        ratio = elapsed_s[begins] / self._time[:, begins]
        share = relaxed_share(ratio)
        # The quotient share / ratio tends to 1 as the length of the interval tends to 0.
        divisor = np.maximum(ratio, 1e-300)
        mean = np.where(ratio > 0, share / divisor, 1.0)
        run = np.cumsum(begins_run) - 1
        return share.take(run, axis=1), mean.take(run, axis=1)
