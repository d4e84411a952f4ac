"""One episode: rows of stress in, frames with all features out."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.rows import StressRows
from .data_set import DataSet
from .images import Encoded
from .others import Others
from .plan import BagPlan, Episode
from .statistics import Statistics
from .windows import TACTILE, Windows

LOOKED_AT = 20
"""Images of an episode that statistics are taken from."""
PIXELS = 4
"""Every how many pixels of them, along height and width."""


class EpisodeWriter:
    """Writes an episode into a data set; others: the other topics of its bag."""

    def __init__(self, data_set: DataSet, plan: BagPlan, episode: Episode, others: Others) -> None:
        self._data_set, self._plan, self._episode, self._others = data_set, plan, episode, others
        self._windows: Windows | None = None
        self._place: dict[str, int] | None = None
        self._task = 0
        frames, samples = len(episode.counts), int(episode.counts.sum())
        rows = dict.fromkeys(data_set.widths, frames)
        rows |= {TACTILE: samples, f"{TACTILE}.residual": samples}
        self._stats = {key: Statistics(data_set.widths[key], rows[key]) for key in rows}

    def add(self, rows: StressRows) -> int:
        """Take what belongs to the episode; how many rows did."""
        inside = self._episode.rows_in(rows.stamp_ns)
        if not inside.any():
            return 0
        if not inside.all():
            rows = rows.select(inside)
        if self._windows is None:
            self._windows = Windows(self._episode.counts, self._data_set.depth)
        self._windows.add(self._episode.frame_of(rows.stamp_ns), rows)
        self._stats[TACTILE].add(np.hstack([rows.stress, rows.gradient]))
        self._stats[f"{TACTILE}.residual"].add(rows.residual[:, None])
        return len(rows)

    def write(self) -> bool:
        """Write the frames that are complete; whether all are. Call it for the first episode that
        is not yet complete only."""
        windows = self._windows
        if windows is None:
            return False
        if self._place is None:
            self._place, self._task = self._data_set.begin_episode(self._episode.span.task)
        columns = windows.take()
        while len(columns[TACTILE]):
            self._write(columns)
            columns = windows.take()
        if windows.taken < windows.frames:
            return False
        self._windows = None
        self._data_set.end_episode(self._plan, self._episode, self._place, self._stats)
        return True

    def _write(self, columns: dict[str, Any]) -> None:
        """Frames that `Windows` has just handed on."""
        data_set, frames = self._data_set, len(columns[TACTILE])
        last = self._windows.taken if self._windows else frames
        first = last - frames
        others = self._others.at(self._episode.frames, first, last)
        number = np.arange(first, last)
        counted: dict[str, Any] = {
            "timestamp": (number / data_set.fps).astype(np.float32),
            "frame_index": number,
            "episode_index": np.full(frames, len(data_set.episodes)),
            "index": np.arange(data_set.frames, data_set.frames + frames),
            "task_index": np.full(frames, self._task),
        }
        counted = {key: values[:, None] for key, values in counted.items()}
        data_set.write(columns | others | counted)
        for key, values in (others | counted).items():
            if isinstance(values, list):
                self._look_at(key, first, values)
            else:
                self._stats[key].add(values)

    def _look_at(self, key: str, first: int, images: list[Encoded]) -> None:
        """Statistics of some pixels of some images."""
        every = -(-len(self._episode.counts) // LOOKED_AT)
        for number, image in enumerate(images, first):
            if number % every == 0:
                pixels = image.pixels()[::PIXELS, ::PIXELS]
                self._stats[key].add(pixels.reshape(-1, pixels.shape[2]))
