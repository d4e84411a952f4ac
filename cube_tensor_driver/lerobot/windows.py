# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Arrangement of stress in windows: all samples of every cube in one frame of a data set."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain

import numpy as np

from ..core.arrays import AnyArray, Index
from ..core.rows import COLUMN_TYPES, StressRows, concatenate

TACTILE = "observation.tactile"
"""Name of the feature (column of a data set) that contains the stress of all cubes."""

WINDOW_COLUMNS: dict[str, type] = {
    name: COLUMN_TYPES[name]
    for name in ("stamp_ns", "sequence", "residual", "status", "observed", "left_out")
}
"""Columns of `StressRows` that a data set contains beside stress and gradient, with their types."""


def stream_windows(
    parts: Iterable[tuple[Index, StressRows]],
    blocks: Iterable[range],
    counts: AnyArray,
    depth: int,
) -> Iterator[dict[str, AnyArray]]:
    """Arrange rows that arrive in parts, and yield the windows of one block of frames at a time.

    A window contains all samples of every cube in one frame. Rows may arrive in any order of
    frames, because hubs deliver with different delays. The counts tell when all rows of a block
    have arrived.

    Args:
        parts: Frame number (N,) of N rows, and the rows.
        blocks: Ranges of frame numbers, in rising order, that contain the frames of all rows.
        counts: (frames, cubes) number of rows of each cube in each frame.
        depth: Number of samples of each cube that a window has room for.

    Yields:
        Features of the frames of each block, as `arrange_windows` returns them.
    """
    unread = iter(parts)
    waiting: list[tuple[Index, StressRows]] = []
    for block in blocks:
        missing = counts[block.start : block.stop].sum()
        taken = []
        for frame, rows in chain(waiting, unread):
            taken.append((frame, rows))
            missing -= np.count_nonzero(frame < block.stop)
            if missing <= 0:
                break
        frames, tables = zip(*taken, strict=True)
        frame, rows = np.concatenate(frames), concatenate(tables)
        is_due = frame < block.stop
        shape = len(block), depth, counts.shape[1]
        yield arrange_windows(frame[is_due] - block.start, rows.select(is_due), shape)
        waiting = [(frame[~is_due], rows.select(~is_due))]


def arrange_windows(
    frame: Index,
    rows: StressRows,
    shape: tuple[int, int, int],
) -> dict[str, AnyArray]:
    """Arrange all rows of successive frames in windows.

    The samples of a cube stand in the order of recording, with the newest at the end of the window.
    Empty places in front of them are NaN, or 0 in columns of integers.

    Args:
        frame: (N,) index of each row's frame.
        rows: The N rows (one sample of one cube each).
        shape: Number of frames, of samples that a window has room for, and of cubes.

    Returns:
        Arrays (frames, samples, cubes, …) by the names of the features.
    """
    n_frames, depth, n_cubes = shape
    # A cell is a pair of a frame and a cube. Stable sorting keeps the samples of each cell in the
    # order of recording.
    cell = frame * n_cubes + rows.cube
    order = np.argsort(cell, kind="stable")
    cell = cell[order]
    counts = np.bincount(cell, minlength=n_frames * n_cubes)
    to_end = counts.cumsum()[cell] - np.arange(len(cell))
    place = cell // n_cubes, depth - to_end, cell % n_cubes

    columns = {TACTILE: rows.components.astype(np.float32)}
    for name, kind in WINDOW_COLUMNS.items():
        columns[f"{TACTILE}.{name}"] = getattr(rows, name).astype(kind)
    windows: dict[str, AnyArray] = {}
    for key, values in columns.items():
        empty = np.nan if values.dtype == np.float32 else 0
        windows[key] = np.full(
            (*shape, *values.shape[1:]),
            empty,
            values.dtype,
        )
        windows[key][place] = values[order]
    windows[f"{TACTILE}.count"] = counts.reshape(n_frames, n_cubes)
    return windows
