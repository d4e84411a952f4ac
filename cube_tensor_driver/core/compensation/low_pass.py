# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""First-order low-pass filters, advanced exactly over intervals of any length.

    time dx/dt = u - x

x is the output, `time` the time constant. The input u is a straight line from u_0 to u_1 over an
interval of length t. The lag d = u - x of the output changes from d_0 to d_1 over the interval:

    d_1 = (1 - m) d_0 + (m time / t) (u_1 - u_0),      m = 1 - exp(-t / time)

A straight line is used, because what is filtered is continuous: an input that is constant between
samples would delay every change by half an interval.

Source: R. L. Taylor, K. S. Pister, G. L. Goudreau, Int. J. Numer. Methods Eng. 2 (1970), 45-59.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array, Real
from ..kernel import run as kernel
from ..kernel.contract import MAX_GAP_NS

STEP_NS = 100_000_000
"""Duration of one step of the compensation, in ns. Within a step, the temperature counts as
constant, and the readings of the pads as linear in time.

A skin that warms suddenly by 15 K, with a time constant of 100 s and an effect of 150 Pa/K, changes
the stress on a pad by 2 Pa within one step, less than the noise of one sample (3 Pa).
"""

MAX_STEP_NS = MAX_GAP_NS + STEP_NS
"""Longest interval, in ns, from the newest row (sample) of a cube at one step to its newest row at
the next step, in which load and temperature count as known. In a longer one they count as unknown.

For two successive rows, the limit is `MAX_GAP_NS`. A step is added to it here, because more rows
may follow a gap before the next step.
"""

HALVINGS = 10
"""Number of times that the argument x is halved before 1 - exp(-x) is computed by a Taylor series,
which converges quickly only for small arguments."""

SERIES_TERMS = 9
"""Number of terms of the Taylor series of 1 - exp(-x).

x is the ratio of a time to a time constant, limited to 64 and then halved `HALVINGS` times, so it
is at most 1/16. The first term that is left out is then 4e-18 of the sum.
"""


def compute_relaxed_share(ratio: Array) -> Array:
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


def find_shares(ratio: Array) -> tuple[Array, Array]:
    """Return m = 1 - exp(-ratio), and m / ratio, which is 1 for the ratio 0.

    Args:
        ratio: Length of an interval divided by the time constant of a filter, from 0 on.
    """
    share = compute_relaxed_share(ratio)
    divisor = np.maximum(ratio, 1e-300)
    return share, np.where(ratio > 0, share / divisor, 1.0)


class LowPass:
    """K low-pass filters of each of P signals of C cubes, and weighted sums over the K filters.

    Attributes:
        lag: How far the outputs of the filters lag behind the inputs (K, C, P).
        sums: The arrays `output`, `slope` and `gain` in one (3, C, P).
        output: Sum of weight × output over the filters (C, P), at the end of the last interval.
            At the time t after it, the sum is output + (slope + gain u) t, if the input has changed
            to u along a straight line.
        slope: Factor of t (C, P), per second.
        gain: Factor of u t (C, P), per second.
    """

    def __init__(self, time: Array, weight: Array) -> None:
        """Begin with outputs that equal the inputs.

        Args:
            time: Time constants (K, C), in s.
            weight: Weights in the sums (K, C, P).
        """
        self._constants = np.ascontiguousarray(time), np.ascontiguousarray(weight)
        self.lag = np.zeros(weight.shape)
        self._share = np.zeros(time.shape)
        self.sums = np.zeros((3, *weight.shape[1:]))
        self.output, self.slope, self.gain = self.sums

    def advance(
        self,
        elapsed_s: Real,
        before: Array,
        now: Array,
        ahead_s: Real,
    ) -> Array:
        """Advance the filters by one interval for each cube, and compute their weighted sums.

        Args:
            elapsed_s: Lengths of the intervals (C,), in s; 0 leaves the lags unchanged.
            before: Inputs at the start of the interval (C, P).
            now: Inputs at its end (C, P); in between, they are straight lines.
            ahead_s: Time t after the interval (C,), in s, at which output + (slope + gain u) t is
                exact; at other times, it is an approximation. Infinity makes slope and gain 0.

        Returns:
            Fraction m = 1 - exp(-elapsed_s / time) of each output that the interval replaced, as an
            array (K, C), which the next call overwrites.
        """
        advance = _advance if kernel.native is None else kernel.native.filter
        given = elapsed_s, before, now, ahead_s
        advance(*self._constants, *given, self.lag, self._share, self.sums)
        return self._share


def _advance(
    time: Array,
    weight: Array,
    elapsed_s: Real,
    before: Array,
    now: Array,
    ahead_s: Real,
    lag: Array,
    share: Array,
    sums: Array,
) -> None:
    """Advance the filters in numpy, with the same bits as the function in C.

    The arguments are those of `LowPass` and its method `advance`. `lag`, `share` (the result of
    `advance`) and `sums` are changed in place.
    """
    output, slope, gain = sums
    sums[:] = 0
    for k, lag_k in enumerate(lag):
        share[k], mean = find_shares(elapsed_s / time[k])
        ahead_share, ahead_mean = find_shares(ahead_s / time[k])
        of_lag = ahead_share / ahead_s
        of_change = (1 - ahead_mean) / ahead_s
        lag_k *= (1 - share[k])[:, None]
        lag_k += mean[:, None] * (now - before)
        output += weight[k] * (now - lag_k)
        slope += weight[k] * lag_k * of_lag[:, None]
        gain += weight[k] * of_change[:, None]
    slope -= gain * now
