"""How the pads of cubes behave while nothing touches them: frequency, noise, drift, and what is
wrong.

    noise    sqrt(mean(e²) / 6),   e[n] = f[n] - 2 f[n-1] + f[n-2]    (`core/health/statistics.py`)
    drift    the slope of the straight line through all samples
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..core.health.diagnosis import NOISY_ENTER

SILENT = 0.5
"""Share of samples without a frequency from which a pad is silent."""
LEAST_SAMPLES = 3
"""That second differences need."""
MINUTE = 60.0


class PadsAtRest(NamedTuple):
    """frequency: (C, P) Hz, the mean. noise: (C, P) relative. drift: (C, P) relative, per minute.
    silent, stuck, noisy: (C, P) bool."""

    frequency: np.ndarray
    noise: np.ndarray
    drift: np.ndarray
    silent: np.ndarray
    stuck: np.ndarray
    noisy: np.ndarray

    @property
    def works(self) -> np.ndarray:
        """(C, P) bool: pads that can be used."""
        works: np.ndarray = ~(self.silent | self.stuck)
        return works


def pads_at_rest(frequency: np.ndarray, seconds: np.ndarray) -> PadsAtRest:
    """Statistics of S samples: frequency (S, C, P) Hz, NaN where nothing was measured; when (S,) s.

    A pad is stuck if it shows a single value while others of its cube do not, and noisy if its
    noise is NOISY_ENTER times the median of its cube.
    """
    measured = np.isfinite(frequency)
    counts = measured.sum(axis=0)
    known = np.maximum(counts, 1)
    mean = np.where(measured, frequency, 0).sum(axis=0) / known
    above = np.where(measured, frequency - mean, 0)
    second = np.diff(frequency, n=2, axis=0)
    differences = np.maximum(np.isfinite(second).sum(axis=0), 1)
    noise = np.sqrt(np.nansum(second**2, axis=0) / (6 * differences))
    time = np.where(measured, (seconds - seconds.mean())[:, None, None], 0)
    slope = (above * time).sum(axis=0) / np.maximum((time**2).sum(axis=0), 1e-12)
    silent = counts < SILENT * len(frequency)
    span = np.where(measured, above, -np.inf).max(axis=0) - np.where(measured, above, np.inf).min(
        axis=0
    )
    moves = ~silent & (span > 0)
    stuck = ~silent & (span == 0) & moves.any(axis=1, keepdims=True)
    scale = np.where(silent | (mean <= 0), np.nan, mean)
    relative = noise / scale
    usual = np.array(
        [
            np.median(of[use]) if use.any() else np.inf
            for of, use in zip(relative, moves, strict=True)
        ]
    )
    noisy = moves & (relative > NOISY_ENTER * usual[:, None])
    return PadsAtRest(scale, relative, MINUTE * slope / scale, silent, stuck, noisy)
