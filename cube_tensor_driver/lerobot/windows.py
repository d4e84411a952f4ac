# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Arrangement of stress in windows: all samples of every cube in one frame of a data set."""

from __future__ import annotations

from collections.abc import Iterator

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

MAX_BLOCK_BYTES = 32 << 20
"""Largest size, in bytes, of the stress of those frames (time steps) that are written together.

At least one frame is written, even if it is larger.
"""

MAX_BLOCK_FRAMES = 128
"""Largest number of frames (time steps of the data set) that are written together. The images of
all these frames are in memory at the same time."""


class Windows:
    """The windows (samples of all cubes in one frame, a time step of the data set) of one episode.

    Rows of stress (one sample of one cube each) may be added in any order of frames; the windows
    are made in the order of the frames. Within a window the samples of a cube are in the order of
    recording, the newest at the end. If a frame has fewer samples than a window has room for, the
    first entries are NaN (0 in columns of integers).

    Attributes:
        done: Number of frames whose windows have been made.
    """

    def __init__(self, counts: AnyArray, depth: int) -> None:
        """Prepare the windows (samples of all cubes in one frame) of an episode.

        Args:
            counts: (frames, cubes) number of samples of each cube in each frame.
            depth: Number of samples of a cube that a window has room for.
        """
        self.done = 0
        self._counts, self._depth = counts, depth
        columns = len(COMPONENTS) + len(WINDOW_COLUMNS)
        frame_bytes = 4 * columns * depth * counts.shape[1]
        fitting = max(1, MAX_BLOCK_BYTES // frame_bytes)
        self._block = min(MAX_BLOCK_FRAMES, fitting)
        self._waiting: list[tuple[Index, StressRows]] = []

    def add(self, frame: Index, rows: StressRows) -> None:
        """Add N rows of stress (one sample of one cube each).

        Args:
            frame: (N,) number of the frame in the episode to which each row belongs.
            rows: The N rows.
        """
        self._waiting.append((frame, rows))

    def complete(self) -> Iterator[dict[str, AnyArray]]:
        """Yield the windows (samples of all cubes in one frame) that have become complete.

        Frames come in order, each once. A window is complete when all of its rows have been added.

        Yields:
            For n successive frames: arrays (n, depth, cubes, …) by the names of the features, where
            depth is the number of samples that a window has room for.
        """
        while self.done < len(self._counts):
            block = self._counts[self.done : self.done + self._block]
            end = self.done + len(block)
            # The first pass over the bag has counted the rows of every frame. A block of frames is
            # complete only when all of them are there, including those of hubs that deliver late.
            expected = int(block.sum(dtype=np.int64))
            frames = [frame for frame, _ in self._waiting]
            ready = sum(np.count_nonzero(frame < end) for frame in frames)
            if ready < expected:
                return
            frame = np.concatenate(frames)
            rows = concatenate([rows for _, rows in self._waiting])
            inside = frame < end
            windows = arrange_windows(
                block,
                self._depth,
                frame[inside] - self.done,
                rows.select(inside),
            )
            later = ~inside
            late_rows = rows.select(later)
            self._waiting = [(frame[later], late_rows)]
            self.done = end
            yield windows


def arrange_windows(
    counts: AnyArray,
    depth: int,
    frame: Index,
    rows: StressRows,
) -> dict[str, AnyArray]:
    """Arrange all rows of n successive frames in windows (samples of all cubes in one frame).

    Args:
        counts: (n, cubes) number of samples of each cube in each frame.
        depth: Number of samples of a cube that a window has room for.
        frame: (N,) index of each row's frame, 0 for the first of the n frames.
        rows: The N rows (one sample of one cube each).

    Returns:
        Arrays (n, depth, cubes, …) by the names of the features.
    """
    n_frames, n_cubes = counts.shape
    # A cell is a pair of a frame and a cube. Stable sorting keeps the samples of each cell in the
    # order of recording.
    cell = frame * n_cubes + rows.cube
    order = np.argsort(cell, kind="stable")
    cell = cell[order]
    # The last row of each cell gets the last entry of the window, so that the newest sample is
    # always there. The rows before the last one get the entries before it.
    ends = np.cumsum(counts, dtype=np.intp)
    to_end = ends[cell] - np.arange(len(cell))
    place = (
        cell // n_cubes,
        depth - to_end,
        cell % n_cubes,
    )

    shape = (n_frames, depth, n_cubes)
    tactile_shape = (*shape, len(COMPONENTS))
    tactile = np.full(tactile_shape, np.nan, np.float32)
    tactile[place] = rows.components[order]
    windows: dict[str, AnyArray] = {TACTILE: tactile}
    for name, kind in WINDOW_COLUMNS.items():
        empty = np.nan if kind is np.float32 else 0
        column: AnyArray = np.full(shape, empty, kind)
        column[place] = getattr(rows, name)[order]
        windows[f"{TACTILE}.{name}"] = column
    windows[f"{TACTILE}.count"] = counts.astype(np.int64)
    return windows
