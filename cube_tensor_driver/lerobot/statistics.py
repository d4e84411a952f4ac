"""Statistics of a feature (column of a data set), with which policies normalise its values.

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

MAX_SAMPLE_ROWS = 10_000
"""Approximate number of rows of a feature from which its quantiles are computed.

Quantiles, unlike means, require all values in memory, so they are computed from a random sample of
the rows.
"""


class Statistics:
    """Minimum, maximum, mean, standard deviation and quantiles of the D columns of a feature.

    The rows are added in parts, so that they need not be in memory together. A column without any
    known value has mean 0 and standard deviation 1, which leave values unchanged on normalisation.
    """

    def __init__(self, width: int, rows: int) -> None:
        """Prepare for the rows (values of D numbers) of a feature (column of a data set).

        Args:
            width: Number of columns D of the feature.
            rows: Approximate number of rows that will be added, which determines the fraction of
                them that is kept for the quantiles.
        """
        self._count = np.zeros(width)
        self._mean = np.zeros(width)
        self._squares = np.zeros(width)  # sum of squared differences from the mean
        self._min = np.full(width, np.inf)
        self._max = np.full(width, -np.inf)
        self._share = min(1.0, MAX_SAMPLE_ROWS / max(1, rows))
        self._random = np.random.default_rng(0)
        self._sample: list[Array] = []

    def add(self, rows: AnyArray) -> None:
        """Add n rows of the feature's D columns to the statistics.

        Args:
            rows: (n, D) values, n at least 1. NaN and infinite values are left out.
        """
        values = rows.astype(np.float64)
        known = np.isfinite(values)
        count = known.sum(axis=0)
        total = np.where(known, values, 0).sum(axis=0)
        mean = total / np.maximum(count, 1)
        deviation = np.where(known, values - mean, 0)
        squares = (deviation**2).sum(axis=0)

        # Means and sums of squared deviations of two parts are combined as in Chan, Golub and
        # LeVeque (1983). The simpler difference of sums of squares would lose small deviations of
        # large numbers in rounding.
        both = np.maximum(self._count + count, 1)
        difference = mean - self._mean
        self._squares += squares + difference**2 * self._count * count / both
        self._mean += difference * count / both
        self._count += count

        # Unknown values (NaN, infinite) are replaced by +infinity for the minimum and by -infinity
        # for the maximum, so that they never become either.
        for_min = np.where(known, values, np.inf)
        for_max = np.where(known, values, -np.inf)
        self._min = np.minimum(self._min, for_min.min(axis=0))
        self._max = np.maximum(self._max, for_max.max(axis=0))
        is_chosen = self._random.random(len(rows)) < self._share
        self._sample.append(values[is_chosen])

    def result(self, frames: int) -> dict[str, AnyArray]:
        """Return the statistics of all rows added so far.

        Args:
            frames: Number of frames, which LeRobot uses as the weight when it merges data sets.

        Returns:
            An array (D,) for each statistic, by its name in LeRobot, and ``count`` (1,).
        """
        is_empty = self._count == 0
        variance = self._squares / np.maximum(self._count, 1)
        deviation = np.sqrt(variance)
        result = {
            "min": np.where(is_empty, 0, self._min),
            "max": np.where(is_empty, 0, self._max),
            "mean": self._mean,
            "std": np.where(is_empty, 1, deviation),
            "count": np.array([frames]),
        }
        sample = np.concatenate(self._sample)
        # The random sample may be empty by chance; then the mean is used for all quantiles.
        if not len(sample):
            sample = self._mean[np.newaxis]
        columns = [column[np.isfinite(column)] for column in sample.T]
        for name, share in QUANTILES.items():
            quantiles = np.zeros(len(columns))
            for number, column in enumerate(columns):
                if len(column):
                    quantiles[number] = np.quantile(column, share)
            result[name] = quantiles
        return result
