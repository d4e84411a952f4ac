# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Statistics of a feature (column of a LeRobot data set), with which policies normalise its values.

NaN, which stands for an unknown value, is left out of all statistics. The values are described in
parts, so that they need not be in memory together.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..core.arrays import AnyArray, Array, Mask

QUANTILES = {
    "q01": 0.01,
    "q10": 0.10,
    "q50": 0.50,
    "q90": 0.90,
    "q99": 0.99,
}
"""Quantiles of each feature that LeRobot expects: the name of each in LeRobot, and the fraction of
the values that lie below it."""

MAX_SAMPLE_ROWS = 20_000
"""Approximate number of rows of a feature (column of a data set) from which its quantiles in the
whole data set are computed. Quantiles, unlike means, require all values in memory, so they are
computed from rows that are chosen at random.
"""


Part = tuple[Array, Array]
"""Description of some rows of a feature: count, mean, variance, minimum and maximum of the known
values (5, …), and some of the rows (M, …), for the quantiles."""


def describe(rows: AnyArray, is_chosen: Mask) -> Part:
    """Return the statistics of n rows of a feature, and the rows that are chosen (see `Part`).

    Args:
        rows: (n, …) values of the feature, such as one per frame, n at least 1. NaN and infinite
            values are unknown.
        is_chosen: (n,) whether each row is kept for the quantiles.
    """
    values = np.ma.masked_invalid(rows.astype(np.float64))
    moments = [
        values.count(axis=0),
        values.mean(axis=0),
        values.var(axis=0),
        values.min(axis=0),
        values.max(axis=0),
    ]
    return np.ma.stack(moments), values[is_chosen].filled(np.nan)


def summarise(parts: Sequence[Part], frames: int) -> dict[str, list[object]]:
    """Return the statistics of all rows of a feature.

    An element of the rows that has no known value gets mean 0 and standard deviation 1, which leave
    values unchanged on normalisation.

    Args:
        parts: Results of `describe`, which together cover all rows.
        frames: Number of frames, which LeRobot uses as the weight of the statistics when it merges
            data sets.

    Returns:
        Each statistic, as nested lists of the shape of a row, by its name in LeRobot.
    """
    moments, samples = zip(*parts, strict=True)
    count, means, variances, lows, highs = np.ma.stack(moments, axis=1)
    weight = count / np.maximum(count.sum(axis=0), 1)
    mean = (weight * means).sum(axis=0).filled(0)
    # Law of total variance: the total variance is the mean of the variances within the parts plus
    # the variance of the means of the parts.
    squares = variances + (means - mean) ** 2
    variance = (weight * squares).sum(axis=0)

    # If a number is NaN in most rows, the sample may contain only NaN for it. Then its mean is used
    # for all of its quantiles.
    sample = np.concatenate(samples)
    is_sampled = np.isfinite(sample).any(axis=0)
    known = np.vstack([sample, np.where(is_sampled, np.nan, mean)[np.newaxis]])
    quantiles = np.nanquantile(known, list(QUANTILES.values()), axis=0)
    statistics = {
        "min": lows.min(axis=0).filled(0),
        "max": highs.max(axis=0).filled(0),
        "mean": mean,
        "std": np.sqrt(variance).filled(1),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }
    return {"count": [frames]} | {name: value.tolist() for name, value in statistics.items()}
