"""Rows of a live source as whole scans and as averages, for commands that watch pads."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from ...core.arrays import Array
from ...core.rows import FrequencyRows


def scans(rows: FrequencyRows, n_cubes: int) -> tuple[Array, Array]:
    """Frequency (S, n_cubes, P) Hz of the scans in rows, NaN where a cube has no row; when each
    began (S,) s."""
    begins = np.diff(rows.cube.astype(int), prepend=n_cubes) <= 0
    number = np.cumsum(begins) - 1
    frequency = np.full((int(begins.sum()), n_cubes, rows.frequency.shape[1]), np.nan)
    frequency[number, rows.cube] = rows.frequency
    return frequency, rows.stamp_ns[begins].astype(np.float64) * 1e-9


def averages(source: Iterable[FrequencyRows], n_cubes: int, span_s: float) -> Iterator[Array]:
    """(n_cubes, P) Hz, the mean of the rows of each span of time; NaN without a row."""
    kept: list[Array] = []
    begun = None
    for rows in source:
        frequency, seconds = scans(rows, n_cubes)
        kept.append(frequency)
        begun = seconds[0] if begun is None else begun
        if seconds[-1] - begun >= span_s:
            together = np.concatenate(kept)
            measured = np.isfinite(together)
            count = np.where(measured.any(axis=0), measured.sum(axis=0), np.nan)
            yield np.where(measured, together, 0).sum(axis=0) / count
            kept, begun = [], None
