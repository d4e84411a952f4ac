"""Statistics of a feature, which policies normalise with. NaN counts for nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
SAMPLE = 10_000
"""Rows that quantiles are taken from, chosen at random."""


class Statistics:
    """Of rows (n, D) that come in parts: per column minimum, maximum, mean, standard deviation, and
    quantiles of a random sample. A column of nothing has mean 0 and deviation 1."""

    def __init__(self, width: int, rows: int) -> None:
        """rows: about how many are to come."""
        self._count = np.zeros(width)
        self._mean = np.zeros(width)
        self._squares = np.zeros(width)  # sum of squared differences from the mean
        self._least = np.full(width, np.inf)
        self._most = np.full(width, -np.inf)
        self._share = min(1.0, SAMPLE / max(1, rows))
        self._random = np.random.default_rng(0)
        self._sample: list[NDArray[Any]] = []

    def add(self, rows: NDArray[Any]) -> None:
        """(n, D), n at least 1."""
        values = rows.astype(np.float64)
        known = np.isfinite(values)
        count = known.sum(axis=0)
        mean = np.where(known, values, 0).sum(axis=0) / np.maximum(count, 1)
        squares = (np.where(known, values - mean, 0) ** 2).sum(axis=0)
        least = np.where(known, values, np.inf).min(axis=0)
        most = np.where(known, values, -np.inf).max(axis=0)
        self._combine(count, mean, squares, least, most)
        chosen = self._random.random(len(rows)) < self._share
        if chosen.any():
            self._sample.append(values[chosen])

    def add_all(self, other: Statistics) -> None:
        """Take in what another one has."""
        self._combine(other._count, other._mean, other._squares, other._least, other._most)
        # Each part has a sample of its own share; all are to have the same.
        for values in other._sample:
            chosen = self._random.random(len(values)) < self._share / other._share
            self._sample.append(values[chosen])

    def _combine(
        self,
        count: NDArray[Any],
        mean: NDArray[Any],
        squares: NDArray[Any],
        least: NDArray[Any],
        most: NDArray[Any],
    ) -> None:
        """The means and squares of two parts, as in Chan, Golub and LeVeque, 1983."""
        total = np.maximum(self._count + count, 1)
        apart = mean - self._mean
        self._squares += squares + apart**2 * self._count * count / total
        self._mean += apart * count / total
        self._count += count
        self._least = np.minimum(self._least, least)
        self._most = np.maximum(self._most, most)

    def result(self, frames: int) -> dict[str, NDArray[Any]]:
        """By LeRobot's names. frames: the count, by which LeRobot weighs."""
        nothing = self._count == 0
        spread = np.sqrt(self._squares / np.maximum(self._count, 1))
        result = {
            "min": np.where(nothing, 0, self._least),
            "max": np.where(nothing, 0, self._most),
            "mean": self._mean,
            "std": np.where(nothing, 1, spread),
            "count": np.array([frames]),
        }
        sample = np.concatenate([np.array([self._mean]), *self._sample])
        for name, share in QUANTILES.items():
            result[name] = quantile(sample[1:] if len(sample) > 1 else sample, share)
        return result


def quantile(values: NDArray[Any], share: float) -> NDArray[Any]:
    """(D,) of the finite values of each column (n, D); 0 where there are none."""
    columns = (column[np.isfinite(column)] for column in values.T)
    return np.array([np.quantile(column, share) if len(column) else 0.0 for column in columns])
