"""Statistics of a feature, with which policies normalise it. NaN does not count."""

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
"""Quantiles of a feature that LeRobot expects, by the names that it gives them."""

MAX_SAMPLE_ROWS = 10_000
"""Number of rows from which quantiles are computed. They are a random sample of all rows, because
quantiles need the sampled rows in memory."""


class Statistics:
    """Minimum, maximum, mean, standard deviation and quantiles of the columns of rows (n, D).

    The rows come in parts. A column without values has mean 0 and deviation 1.
    """

    def __init__(self, width: int, rows: int) -> None:
        """Prepare for rows of `width` columns, of which about `rows` are to come."""
        self._count = np.zeros(width)
        self._mean = np.zeros(width)
        self._squares = np.zeros(width)  # sum of squared differences from the mean
        self._min = np.full(width, np.inf)
        self._max = np.full(width, -np.inf)
        self._share = min(1.0, MAX_SAMPLE_ROWS / max(1, rows))
        self._random = np.random.default_rng(0)
        self._sample: list[Array] = []

    def add(self, rows: AnyArray) -> None:
        """Add rows (n, D), at least one."""
        values = rows.astype(np.float64)
        known = np.isfinite(values)
        count = known.sum(axis=0)
        total = np.where(known, values, 0).sum(axis=0)
        mean = total / np.maximum(count, 1)
        deviation = np.where(known, values - mean, 0)
        squares = (deviation**2).sum(axis=0)

        # Means and squares of two parts are joined as in Chan, Golub and LeVeque (1983).
        # Sums of squares of large numbers would lose the small deviations.
        both = np.maximum(self._count + count, 1)
        difference = mean - self._mean
        self._squares += squares + difference**2 * self._count * count / both
        self._mean += difference * count / both
        self._count += count

        # Values that are not known must not become a minimum or a maximum.
        for_min = np.where(known, values, np.inf)
        for_max = np.where(known, values, -np.inf)
        self._min = np.minimum(self._min, for_min.min(axis=0))
        self._max = np.maximum(self._max, for_max.max(axis=0))
        is_chosen = self._random.random(len(rows)) < self._share
        self._sample.append(values[is_chosen])

    def result(self, frames: int) -> dict[str, AnyArray]:
        """Return the statistics by LeRobot's names.

        Args:
            frames: Number of frames, by which LeRobot weighs data sets that it joins.
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
        # By chance no row may have been chosen; the mean stands for all quantiles then.
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
