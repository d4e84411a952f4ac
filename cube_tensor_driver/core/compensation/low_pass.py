# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""First-order low-pass filters, advanced exactly over intervals of any length.

    time dx/dt = u - x

The input u is a straight line from u_0 to u_1 over an interval of length t. How far the output
lags behind, d = u - x, then follows from

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
"""Duration of a step, in ns, within which temperature counts as constant, and the readings of the
pads as straight lines for creep.

With a lag of 100 s and 150 Pa/K, the effect of temperature changes by 2 Pa within a step after the
skin warmed by 15 K at once, less than the noise of one sample (3 Pa).
"""

MAX_STEP_NS = MAX_GAP_NS + STEP_NS
"""Longest time between the rows of two steps, in ns, in which all rows of a cube can be at most
`MAX_GAP_NS` apart."""

HALVINGS = 10
"""Number of times that the argument of the exponential function is halved for its series."""

SERIES_TERMS = 9
"""Number of terms of this series. With 64 / 2**10 as the largest argument, the first term that is
left out is 1e-17 of the sum."""


def relaxed_share(ratio: Array) -> Array:
    """Return 1 - exp(-ratio) for ratios from 0 on, with the same bits on every processor.

    The exponential function of a mathematical library differs in its last bit by processor.
    """
    # exp(-64) is far below the resolution of the sum, so larger ratios need no other value.
    part = np.minimum(ratio, 64.0) / 2**HALVINGS
    share: Array = np.zeros_like(part)
    # Taylor series 1 - exp(-x) = x (1 - x/2 (1 - x/3 (1 - ...))).
    for n in range(SERIES_TERMS, 0, -1):
        share = part / n * (1 - share)
    # 1 - exp(-2 x) = m (2 - m) with m = 1 - exp(-x).
    for _ in range(HALVINGS):
        share *= 2 - share
    return share


class LowPass:
    """K low-pass filters for each of C cubes, each of which filters P signals.

    Attributes:
        time: Time constants (K, C), or (K, 1) if all cubes have the same, in s.
        lag: How far the outputs of the filters lag behind the inputs (K, C, P).
    """

    def __init__(self, time: Array, n_cubes: int, n_signals: int) -> None:
        self.time = time
        self.lag = np.zeros((len(time), n_cubes, n_signals))

    def advance(self, elapsed_s: Real, change: Real) -> Array:
        """Advance the filters by one interval for each cube.

        Args:
            elapsed_s: Lengths of the intervals (C,), in s; the outputs stay where it is 0.
            change: Changes of the inputs (C, P), along straight lines.

        Returns:
            Shares m of the intervals (K, C).
        """
        share, mean = self.find_shares(elapsed_s)
        for lag, m, part in zip(self.lag, share[..., None], mean[..., None], strict=True):
            lag *= 1 - m
            lag += part * change
        return share

    def find_shares(self, elapsed_s: Real) -> tuple[Array, Array]:
        """Return the shares m and m time / t of intervals t (C,), in s, as (K, C)."""
        if self.time.shape[1] > 1:
            return self._find_shares(elapsed_s)
        # The cubes of a hub have equal intervals, so few shares are computed.
        begins = np.flatnonzero(np.diff(elapsed_s, prepend=-1.0))
        counts = np.diff(begins, append=len(elapsed_s))
        share, mean = self._find_shares(elapsed_s[begins])
        return np.repeat(share, counts, axis=1), np.repeat(mean, counts, axis=1)

    def _find_shares(self, elapsed_s: Real) -> tuple[Array, Array]:
        ratio = elapsed_s / self.time
        share = relaxed_share(ratio)
        # A step without duration changes the lag as much as the input.
        return share, np.where(ratio > 0, share / np.maximum(ratio, 1e-300), 1.0)
