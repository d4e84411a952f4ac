# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of the rows of a live source to scans (one row of every cube) and to averages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from ..core.arrays import Array
from ..core.rows import FrequencyRows


def split_into_scans(rows: FrequencyRows, n_cubes: int) -> tuple[Array, Array]:
    """Arrange rows by scan (one row of every cube) and cube.

    Args:
        rows: Rows (samples of cubes) of a live source. Within a scan, the index of the cube
            increases.
        n_cubes: Number of cubes of the skin.

    Returns:
        Frequencies (S, n_cubes, P) in Hz of S scans and P pads per cube, NaN where a cube has no
        row; and the time stamps (S,) of the first rows of the scans, in s since the Unix epoch.
    """
    # Within a scan the index of the cube increases. So a row whose index is not larger than that of
    # the row before is the first row of the next scan.
    cube = rows.cube.astype(int)
    is_first = np.diff(cube, prepend=n_cubes) <= 0
    scan = np.cumsum(is_first) - 1
    n_scans = int(is_first.sum())
    n_pads = rows.frequency.shape[1]

    frequency = np.full((n_scans, n_cubes, n_pads), np.nan)
    frequency[scan, rows.cube] = rows.frequency
    return frequency, rows.stamp_ns[is_first].astype(np.float64) * 1e-9


def average_over_time(
    source: Iterable[FrequencyRows],
    n_cubes: int,
    duration_s: float,
) -> Iterator[Array]:
    """Yield the mean frequency of each pad over successive intervals of time.

    Args:
        source: Source of rows (samples of cubes), for example a live source.
        n_cubes: Number of cubes of the skin.
        duration_s: Minimum length of each interval, in s of the time stamps of the rows.

    Yields:
        Mean frequencies (n_cubes, P) in Hz of P pads per cube; NaN for a pad that was not measured
        in the interval.
    """
    parts: list[Array] = []
    end_s = np.inf
    for rows in source:
        frequency, seconds = split_into_scans(rows, n_cubes)
        end_s = min(end_s, seconds[0] + duration_s)
        parts.append(frequency)
        if seconds[-1] >= end_s:
            values = np.ma.masked_invalid(np.concatenate(parts))
            yield values.mean(axis=0).filled(np.nan)
            parts, end_s = [], np.inf
