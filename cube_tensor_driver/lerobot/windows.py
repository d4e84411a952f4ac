# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Arrangement of stress in windows: all samples of every cube in one frame of a data set."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain

import numpy as np

from ..core.arrays import AnyArray, Index
from ..core.modes import COMPONENTS
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
        blocks: Ranges of frame numbers, in rising order. Rows of other frames are left out.
        counts: (frames, cubes) number of rows of each cube in each frame.
        depth: Number of samples of each cube that a window has room for.

    Yields:
        Features of the frames of each block, as `arrange_windows` returns them.
    """
    waiting: list[tuple[Index, StressRows]] = []
    unread = iter(parts)
    for block in blocks:
        begin, end = block.start, block.stop
        missing = int(counts[begin:end].sum())
        frames, rows = [], []
        for frame, part in chain(waiting, unread):
            frames.append(frame)
            rows.append(part)
            missing -= np.count_nonzero((begin <= frame) & (frame < end))
            if missing <= 0:
                break
        frame, part = np.concatenate(frames), concatenate(rows)
        inside = (begin <= frame) & (frame < end)
        yield arrange_windows(
            frame[inside] - begin,
            part.select(inside),
            (len(block), depth, counts.shape[1]),
        )
        later = frame >= end
        waiting = [(frame[later], part.select(later))]


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

    tactile: AnyArray = np.full(
        (*shape, len(COMPONENTS)),
        np.nan,
        np.float32,
    )
    tactile[place] = rows.components[order]
    windows = {TACTILE: tactile}
    for name, kind in WINDOW_COLUMNS.items():
        empty = np.nan if kind is np.float32 else 0
        column: AnyArray = np.full(shape, empty, kind)
        column[place] = getattr(rows, name)[order]
        windows[f"{TACTILE}.{name}"] = column
    windows[f"{TACTILE}.count"] = counts.reshape(n_frames, n_cubes)
    return windows
