# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Round numbers for axes and scale bars."""

from __future__ import annotations

import math

NOISE_SHARE = 0.02
"""Fraction of the largest absolute value in a chart up to which values are considered as noise.

If the values on one side of zero are all noise, the axis ends at zero on that side.
"""


ROUNDING_ERROR = 1e-9
"""Relative tolerance that allows for rounding errors of floating-point numbers. Without it, a
length of exactly 1, 2 or 5 could be rounded to another round number."""


def round_down(length: float) -> float:
    """Return the largest number of the form 1, 2 or 5 times a power of ten that is at most
    `length`, which must be positive."""
    limit = length * (1 + ROUNDING_ERROR)
    fitting = [number for number in _round_numbers(length) if number <= limit]
    return max(fitting)


def round_range(low: float, high: float) -> tuple[float, float]:
    """Return the range of an axis that contains zero and the values from `low` to `high`.

    The ends are multiples of a step: half of the smallest number of the form 1, 2 or 5 times a
    power of ten that is not below the largest absolute value. So the range changes seldom while the
    values change. On a side of zero on which no absolute value exceeds `NOISE_SHARE` of the largest
    one, the range ends at zero.
    """
    size = max(-low, high, 1e-9)
    min_step = size * (1 - ROUNDING_ERROR)
    fitting = [number for number in _round_numbers(size) if number >= min_step]
    step = min(fitting) / 2
    # One noisy value below zero would add a whole step of empty space below positive values.
    noise = NOISE_SHARE * size
    n_below = n_above = 0
    if low < -noise:
        n_below = math.floor(low / step)
    if high > noise:
        n_above = math.ceil(high / step)
    return n_below * step, n_above * step


def _round_numbers(size: float) -> list[float]:
    """Return 1, 2, 5 and 10 times the largest power of ten that is at most `size`."""
    power = 10.0 ** math.floor(math.log10(size))
    return [
        power,
        2 * power,
        5 * power,
        10 * power,
    ]
