# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Statistics of a feature (column of a LeRobot data set), with which policies normalise its values.

NaN, which stands for an unknown value, is left out of all statistics.
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import AnyArray, Array

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


class Statistics:
    """Minimum, maximum, mean, standard deviation and quantiles of the D numbers of a feature.

    The rows (one value of each number) are added in parts, so that they need not be in memory
    together. A number without any known value has mean 0 and standard deviation 1, which leave
    values unchanged on normalisation.
    """

    def __init__(self, rows: int) -> None:
        """Prepare for the rows of a feature.

        Args:
            rows: Approximate number of rows in the whole data set, which determines the fraction of
                them that is kept for the quantiles.
        """
        self._share = MAX_SAMPLE_ROWS / max(1, rows)
        self._random = np.random.default_rng(0)
        # For each part, an array (5, …): count, mean, variance, minimum and maximum.
        self._parts: list[Array] = []
        self._sample: list[Array] = []

    def add(self, rows: AnyArray) -> None:
        """Add n rows (values of the feature, such as one per frame) to the statistics.

        Args:
            rows: (n, …) values, n at least 1. NaN and infinite values are left out. All calls must
                have the same shape after n, such as (D,).
        """
        values = np.ma.masked_invalid(rows.astype(np.float64))
        part = [
            values.count(axis=0),
            values.mean(axis=0).filled(0),
            values.var(axis=0).filled(0),
            values.min(axis=0).filled(np.inf),
            values.max(axis=0).filled(-np.inf),
        ]
        self._parts.append(np.array(part))
        is_chosen = self._random.random(len(rows)) < self._share
        chosen = values[is_chosen]
        self._sample.append(chosen.filled(np.nan))

    def merge(self, other: Statistics) -> None:
        """Add all rows that were added to another object, such as the statistics of an episode."""
        self._parts += other._parts
        self._sample += other._sample

    def result(self) -> dict[str, Array]:
        """Return the statistics of all rows added so far.

        Returns:
            An array of the shape of a row for each statistic, by its name in LeRobot.
        """
        parts = np.stack(self._parts, axis=1)
        count, means, variances, lowest, highest = parts
        total = count.sum(axis=0)
        is_empty = total == 0
        weight = count / np.maximum(total, 1)
        mean = (weight * means).sum(axis=0)
        # Law of total variance: the total variance is the mean of the variances within the parts
        # plus the variance of the means of the parts.
        within = (weight * variances).sum(axis=0)
        differences = (means - mean) ** 2
        between = (weight * differences).sum(axis=0)
        deviation = np.sqrt(within + between)
        low = lowest.min(axis=0)
        high = highest.max(axis=0)

        drawn = np.concatenate(self._sample)
        # If a number is NaN in most rows, the rows that were drawn may contain only NaN for it.
        # Then its mean is used for all of its quantiles.
        is_drawn = np.isfinite(drawn).any(axis=0)
        substitute = np.where(is_drawn, np.nan, mean)
        known = np.concatenate([drawn, substitute[np.newaxis]])
        shares = list(QUANTILES.values())
        quantiles = np.nanquantile(known, shares, axis=0)
        return {
            "min": np.where(is_empty, 0, low),
            "max": np.where(is_empty, 0, high),
            "mean": mean,
            "std": np.where(is_empty, 1, deviation),
            **dict(zip(QUANTILES, quantiles, strict=True)),
        }
