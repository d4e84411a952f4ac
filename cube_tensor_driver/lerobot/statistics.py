"""Statistics of a feature, with which policies normalise it. NaN does not count."""

from __future__ import annotations

import numpy as np

from ..core.arrays import AnyArray, Array

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
"""Quantiles by LeRobot's names."""

MAX_SAMPLE_ROWS = 10_000
"""Expected number of rows, chosen at random, from which quantiles are taken."""


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
        mean = np.where(known, values, 0).sum(axis=0) / np.maximum(count, 1)
        squares = (np.where(known, values - mean, 0) ** 2).sum(axis=0)

        # Means and squares of two parts are joined as in Chan, Golub and LeVeque (1983).
        total = np.maximum(self._count + count, 1)
        difference = mean - self._mean
        self._squares += squares + difference**2 * self._count * count / total
        self._mean += difference * count / total
        self._count += count
        self._min = np.minimum(self._min, np.where(known, values, np.inf).min(axis=0))
        self._max = np.maximum(self._max, np.where(known, values, -np.inf).max(axis=0))
        self._sample.append(values[self._random.random(len(rows)) < self._share])

    def result(self, frames: int) -> dict[str, AnyArray]:
        """Return the statistics by LeRobot's names.

        Args:
            frames: Number of frames, by which LeRobot weighs data sets that it joins.
        """
        is_empty = self._count == 0
        deviation = np.sqrt(self._squares / np.maximum(self._count, 1))
        result = {
            "min": np.where(is_empty, 0, self._min),
            "max": np.where(is_empty, 0, self._max),
            "mean": self._mean,
            "std": np.where(is_empty, 1, deviation),
            "count": np.array([frames]),
        }
        sample = np.concatenate(self._sample)
        if not len(sample):
            sample = self._mean[np.newaxis]
        columns = [column[np.isfinite(column)] for column in sample.T]
        for name, share in QUANTILES.items():
            result[name] = np.array(
                [np.quantile(column, share) if len(column) else 0.0 for column in columns]
            )
        return result
