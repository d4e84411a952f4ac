"""Rows of stress to windows: for each frame, all samples of each cube since the frame before."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.modes import COMPONENTS, STRESS
from ..core.rows import StressRows

TACTILE = "observation.tactile"
COLUMNS: dict[str, Any] = {
    "stamp_ns": np.int64,
    "sequence": np.uint32,
    "residual": np.float32,
    "status": np.uint16,
    "observed": np.uint16,
    "left_out": np.uint32,
}
"""What a window has beside the tensors, as in `StressRows`."""
TOGETHER_BYTES, TOGETHER = 32 << 20, 128
"""Windows that are handed on at a time, and how many at most: images may go with them."""


class Windows:
    """The windows of one episode, filled in any order, taken in the order of the frames.

    The samples of a cube are in the order of recording, the newest at the end. Where a frame holds
    fewer than the window, those in front are NaN, and 0 where numbers are whole.
    """

    def __init__(self, counts: NDArray[np.uint32], depth: int) -> None:
        """counts: (frames, cubes) samples to come; depth: samples in a window."""
        self.frames, cubes = counts.shape
        self.taken = 0
        self._counts, self._depth, self._cubes = counts, depth, cubes
        self._due = counts.sum(axis=1, dtype=np.int64)
        values = depth * cubes * (len(COMPONENTS) + 6)
        most = max(1, TOGETHER_BYTES // (4 * values))
        self._together = min(self.frames, most, TOGETHER)
        self._arrays: dict[str, NDArray[Any]] = {}
        self._filled = np.zeros((0, cubes), np.int64)
        self._make(2 * self._together)

    def add(self, frame: NDArray[Any], rows: StressRows) -> None:
        """Place rows, each in its frame."""
        needed = int(frame.max()) + 1 - self.taken
        if needed > len(self._filled):
            self._make(2 * needed)
        at = (frame - self.taken) * self._cubes + rows.cube
        order = np.argsort(at, kind="stable")
        cells, begins, sizes = np.unique(at[order], return_index=True, return_counts=True)
        rank = np.arange(len(at)) - np.repeat(begins, sizes)
        filled = self._filled.reshape(-1)
        before = filled[cells] - self._counts[self.taken :].reshape(-1)[cells].astype(np.int64)
        slot = self._depth + np.repeat(before, sizes) + rank
        frame, cube = np.divmod(at[order], self._cubes)
        place = (frame * self._depth + slot) * self._cubes + cube
        filled[cells] += sizes
        rows = rows.select(order)
        tactile = self._arrays[TACTILE].reshape(-1, len(COMPONENTS))
        tactile[place, : len(STRESS)] = rows.stress
        tactile[place, len(STRESS) :] = rows.gradient
        for name in COLUMNS:
            self._arrays[f"{TACTILE}.{name}"].reshape(-1)[place] = getattr(rows, name)

    def take(self) -> dict[str, NDArray[Any]]:
        """Windows (n, depth, cubes, ...) by their names, of the next frames that are complete: none
        while there are few, until the last."""
        due = self._due[self.taken : self.taken + len(self._filled)]
        complete = self._filled.sum(axis=1)[: len(due)] == due
        ready = len(due) if complete.all() else int(complete.argmin())
        if ready < min(self._together, self.frames - self.taken):
            ready = 0
        ready = min(ready, self._together)
        windows = {name: array[:ready].copy() for name, array in self._arrays.items()}
        counts = self._counts[self.taken : self.taken + ready]
        windows[f"{TACTILE}.count"] = counts.astype(np.int64)
        if ready:
            self.taken += ready
            self._make(len(self._filled), ready)
        return windows

    def _make(self, frames: int, drop: int = 0) -> None:
        """Room for more frames, without the first ones."""
        shape = (frames, self._depth, self._cubes)
        made: dict[str, NDArray[Any]] = {
            TACTILE: np.full((*shape, len(COMPONENTS)), np.nan, np.float32)
        }
        for name, kind in COLUMNS.items():
            empty = np.nan if kind is np.float32 else 0
            made[f"{TACTILE}.{name}"] = np.full(shape, empty, kind)
        filled = np.zeros((frames, self._cubes), np.int64)
        kept = len(self._filled) - drop
        for name, array in self._arrays.items():
            made[name][:kept] = array[drop:]
        filled[:kept] = self._filled[drop:]
        self._arrays, self._filled = made, filled
