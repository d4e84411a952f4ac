# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Round numbers for axes and scale bars."""

from __future__ import annotations

import numpy as np

NOISE_SHARE = 0.02
"""Fraction of the largest absolute value in a chart up to which values are considered as noise.

If the values on one side of zero are all noise, the axis ends at zero on that side.
"""


def round_down(length: float) -> float:
    """Return the largest number of the form 1, 2 or 5 times a power of ten that is at most
    `length`, which must be positive."""
    # The tolerance keeps a rounding error from turning a length of exactly 1, 2 or 5 into the next
    # smaller number.
    limit = length * (1 + 1e-9)
    return max(number for number in _round_numbers(length) if number <= limit)


def round_range(low: float, high: float) -> tuple[float, float]:
    """Return the range of an axis that contains zero and the values from `low` to `high`.

    Its ends are multiples of a step, which is half of 1, 2, 5 or 10 times a power of ten. The range
    therefore changes seldom while the values change. A side on which no value exceeds `NOISE_SHARE`
    of the largest one ends at zero.
    """
    size = max(-low, high, 1e-9)
    # One noisy value below zero would add a whole step of empty space below positive values.
    noise = NOISE_SHARE * size
    if abs(low) <= noise:
        low = 0.0
    if abs(high) <= noise:
        high = 0.0
    # The tolerance keeps a rounding error from giving a size of exactly 1, 2 or 5 the next larger
    # step.
    min_step = size * (1 - 1e-9)
    step = min(number for number in _round_numbers(size) if number >= min_step) / 2
    n_below = np.floor(min(low, 0) / step)
    n_above = np.ceil(max(high, 0) / step)
    return float(n_below * step), float(n_above * step)


def _round_numbers(size: float) -> list[float]:
    """Return 1, 2, 5 and 10 times the largest power of ten that is at most `size`."""
    power = float(10.0 ** np.floor(np.log10(size)))
    return [power, 2 * power, 5 * power, 10 * power]
