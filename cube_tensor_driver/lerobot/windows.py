"""Rows of stress arranged in windows: for each frame, all samples of each cube in it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ..core.arrays import AnyArray, Index
from ..core.modes import COMPONENTS
from ..core.rows import StressRows, concatenate

TACTILE = "observation.tactile"
"""Name of the feature with the stress of all cubes."""

COLUMNS: dict[str, Any] = {
    "stamp_ns": np.int64,
    "sequence": np.uint32,
    "residual": np.float32,
    "status": np.uint16,
    "observed": np.uint16,
    "left_out": np.uint32,
}
"""Columns of `StressRows` that a window has beside the stress, with their types."""

MAX_BLOCK_BYTES = 32 << 20
"""Largest size, in bytes, of the block of windows that is built and written at a time."""
MAX_BLOCK_FRAMES = 128
"""Largest number of frames in such a block. Their images are in memory at the same time."""


class Windows:
    """The windows of one episode: rows are added in any order, windows come in that of the frames.

    The samples of a cube stand in the order of recording, the newest at the end. Where a frame has
    fewer samples than the window, the places in front are NaN, and 0 where numbers are whole.

    Attributes:
        done: Number of frames whose windows have been made.
    """

    def __init__(self, counts: AnyArray, depth: int) -> None:
        """Prepare the windows of an episode.

        Args:
            counts: (frames, cubes) number of samples to come.
            depth: Number of samples in a window.
        """
        self.done = 0
        self._counts, self._depth = counts, depth
        columns = len(COMPONENTS) + len(COLUMNS)
        frame_bytes = 4 * columns * depth * counts.shape[1]
        fitting = max(1, MAX_BLOCK_BYTES // frame_bytes)
        self._block = min(MAX_BLOCK_FRAMES, fitting)
        self._waiting: list[tuple[Index, StressRows]] = []

    def add(self, frame: Index, rows: StressRows) -> None:
        """Add rows, each with the frame it belongs to."""
        self._waiting.append((frame, rows))

    def complete(self) -> Iterator[dict[str, AnyArray]]:
        """Yield blocks of windows (n, depth, cubes, ...) by name, as far as rows are there."""
        while self.done < len(self._counts):
            block = self._counts[self.done : self.done + self._block]
            end = self.done + len(block)
            # Late links are waited for: the first pass has counted how many rows there are.
            expected = int(block.sum(dtype=np.int64))
            ready = sum(np.count_nonzero(frame < end) for frame, _ in self._waiting)
            if ready < expected:
                return
            frame = np.concatenate([one for one, _ in self._waiting])
            rows = concatenate([one for _, one in self._waiting])
            inside = frame < end
            windows = self._arrange(
                block,
                frame[inside] - self.done,
                rows.select(inside),
            )
            later = ~inside
            self._waiting = [(frame[later], rows.select(later))]
            self.done = end
            yield windows

    def _arrange(
        self,
        counts: AnyArray,
        frame: Index,
        rows: StressRows,
    ) -> dict[str, AnyArray]:
        """Arrange all rows of some frames.

        Args:
            counts: (n, cubes) number of samples in each frame.
            frame: (N,) frame of each row, counted from the first of these frames.
            rows: N rows.
        """
        n_frames, n_cubes = counts.shape
        # A cell is one cube in one frame. The stable order keeps its samples as they came.
        cell = frame * n_cubes + rows.cube
        order = np.argsort(cell, kind="stable")
        cell = cell[order]
        # Rows of one cell stand together now: a row's rank in it is its distance from the first.
        first_of_cell = np.searchsorted(cell, cell)
        rank = np.arange(len(cell)) - first_of_cell
        # The newest sample stands at the end of the window.
        in_cell = counts.reshape(-1).astype(np.intp)[cell]
        slot = self._depth - in_cell + rank
        place = cell // n_cubes, slot, cell % n_cubes

        shape = (n_frames, self._depth, n_cubes)
        components = np.hstack([rows.stress, rows.gradient])
        tactile = np.empty((*shape, len(COMPONENTS)), np.float32)
        tactile[:] = np.nan
        tactile[place] = components[order]
        windows: dict[str, AnyArray] = {TACTILE: tactile}
        for name, kind in COLUMNS.items():
            empty = np.nan if kind is np.float32 else 0
            column = np.full(shape, empty, kind)
            column[place] = getattr(rows, name)[order]
            windows[f"{TACTILE}.{name}"] = column
        windows[f"{TACTILE}.count"] = counts.astype(np.int64)
        return windows
