"""Bags exported to one data set: plan all bags, then reconstruct each and write its frames."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..bags.read import Bag
from ..bags.reprocess.job import reconstruct, settings_with
from ..bags.source import open_bag
from ..config.skin import Skin
from ..core.arrays import AnyArray
from ..core.errors import BagError
from ..core.rows import StressRows
from .data_set import DataSet
from .plan import BagPlan, Choices, Episode, Report, plan_bag
from .statistics import Statistics
from .topics import Topic, TopicReader, find_topics
from .windows import TACTILE, Windows

MAX_SAMPLED_IMAGES = 20
"""Largest number of images of an episode whose pixels are used for statistics."""
PIXEL_STRIDE = 4
"""Distance, in pixels along height and width, of the pixels that are used for statistics."""


@dataclass(frozen=True)
class Exported:
    """What was exported, and what was left out.

    Attributes:
        episodes: Number of episodes.
        frames: Number of frames.
        rows: Number of samples of cubes.
        depth: Number of samples in a window.
        usual: Number of samples in most windows.
        features: Names of the features of other topics.
        outside, unknown, empty: As in `BagPlan`, summed over all bags.
    """

    episodes: int
    frames: int
    rows: int
    depth: int
    usual: int
    features: list[str]
    outside: int
    unknown: int
    empty: int


def export_lerobot(
    bags: Sequence[Path],
    folder: Path,
    choices: Choices,
    report: Report,
) -> Exported:
    """Write a data set, which appears when it is complete.

    Args:
        bags: Folders or files of bags.
        folder: Folder of the data set, empty or not there yet.
        choices: What goes into it, and how.
        report: Function that is told about progress.

    Raises:
        BagError: A bag is damaged, the choices do not fit, or the folder cannot be written.
    """
    # Before the bags are read, which takes long.
    check_empty(folder)
    plans = [plan_bag(path, choices, report) for path in bags]
    skin = _check_same_skin(plans)
    episodes = [episode for plan in plans for episode in plan.episodes]
    if not episodes:
        raise BagError(f"{bags[0]}: no sample lies between the marks; nothing to export")
    topics = find_topics(bags, choices)
    depths = [int(episode.counts.max()) for episode in episodes]
    depth = max(depths)
    samples = sum(episode.rows for episode in episodes)
    # Beside the folder, so that it can be renamed when it is complete.
    partial = folder.absolute()
    partial = partial.with_name(f"{partial.name}.partial")
    try:
        # What an export that was killed left behind is of no use.
        shutil.rmtree(partial, ignore_errors=True)
        data_set = DataSet(
            partial,
            skin,
            list(topics.values()),
            fps=choices.fps,
            depth=depth,
            samples=samples,
        )
        with data_set:
            for plan in plans:
                _write_bag(data_set, plan, topics, choices, report)
        data_set.write_meta()
        partial.replace(folder)
    except OSError as error:
        raise BagError(
            f"{folder}: {error.strerror or error}; name a folder on a disk with room"
        ) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    rate = max(plan.rate for plan in plans)
    return Exported(
        episodes=len(episodes),
        frames=data_set.frames,
        rows=samples,
        depth=depth,
        usual=math.ceil(rate / choices.fps),
        features=[topic.key for topic in topics.values()],
        outside=sum(plan.outside for plan in plans),
        unknown=sum(plan.unknown for plan in plans),
        empty=sum(plan.empty for plan in plans),
    )


def check_empty(folder: Path) -> None:
    """Check that a folder for results has no content.

    Raises:
        BagError: It has.
    """
    if folder.is_dir() and any(folder.iterdir()):
        raise BagError(f"{folder} is not empty; name another folder, or remove what is in it")


class EpisodeWriter:
    """Writes one episode: rows of stress go in, frames with all features come out."""

    def __init__(
        self,
        data_set: DataSet,
        plan: BagPlan,
        episode: Episode,
        topics: TopicReader,
    ) -> None:
        """Prepare an episode of a bag, whose other topics `topics` reads."""
        self._data_set = data_set
        self._plan = plan
        self._episode = episode
        self._topics = topics
        self._windows = Windows(episode.counts, data_set.depth)
        self._place: dict[str, int] = {}
        self._task = 0
        self._statistics = {}
        for key, width in data_set.widths.items():
            # Stress is counted by samples, everything else by frames.
            is_stress = key.startswith(TACTILE)
            rows = episode.rows if is_stress else len(episode.counts)
            self._statistics[key] = Statistics(width, rows)

    def add(self, rows: StressRows) -> int:
        """Take the rows that belong to the episode, and return their number."""
        inside = self._episode.contains(rows.stamp_ns)
        if not inside.any():
            return 0
        rows = rows.select(inside)
        frame = self._episode.sample_frame_of(rows.stamp_ns)
        self._windows.add(frame, rows)
        components = np.hstack([rows.stress, rows.gradient])
        self._count(TACTILE, components)
        self._count(f"{TACTILE}.residual", rows.residual[:, np.newaxis])
        return len(rows)

    def write(self) -> bool:
        """Write the frames that are complete, and return whether all are.

        Only one episode can be written at a time: the first one that is not complete.
        """
        for windows in self._windows.complete():
            if not self._place:
                task = self._episode.task
                self._place, self._task = self._data_set.begin_episode(task)
            self._write_frames(windows)
        is_complete = self._windows.done == len(self._episode.counts)
        if is_complete:
            self._data_set.end_episode(
                self._plan,
                self._episode,
                self._place,
                self._statistics,
            )
        return is_complete

    def _write_frames(self, windows: dict[str, AnyArray]) -> None:
        """Write the frames of windows that have just been made."""
        data_set, last = self._data_set, self._windows.done
        frames = len(windows[TACTILE])
        first = last - frames
        frame = np.arange(first, last)
        counted: dict[str, Any] = {
            "timestamp": (frame / data_set.fps).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.full(frames, len(data_set.episodes)),
            "index": data_set.frames + np.arange(frames),
            "task_index": np.full(frames, self._task),
        }
        columns = self._topics.at(self._episode, first, last)
        for key, values in counted.items():
            columns[key] = values[:, np.newaxis]
        data_set.write(windows | columns)

        # Some pixels of some images describe the colours well enough; decoding all would be slow.
        stride = -(-len(self._episode.counts) // MAX_SAMPLED_IMAGES)
        for key, values in columns.items():
            if isinstance(values, np.ndarray):
                self._count(key, values)
                continue
            # The chosen frames are multiples of the stride within the episode, not in this block.
            for image in values[-first % stride :: stride]:
                pixels = image.pixels()[::PIXEL_STRIDE, ::PIXEL_STRIDE]
                bands = pixels.shape[2]
                self._count(key, pixels.reshape(-1, bands))

    def _count(self, key: str, rows: AnyArray) -> None:
        self._data_set.count(key, rows, self._statistics)


def _check_same_skin(plans: list[BagPlan]) -> Skin:
    """Return the skin of all bags, which must have the same cubes in the same places."""

    def places(plan: BagPlan) -> list[Any]:
        cubes = plan.skin.cubes
        return [(cube.name, cube.xyz, cube.rpy) for cube in cubes]

    first = plans[0]
    expected = places(first)
    for plan in plans[1:]:
        found = places(plan)
        if found != expected:
            new = [place for place in found if place not in expected]
            raise BagError(
                f"{plan.path}: its {len(found)} cubes are not those of {first.path}, which has "
                f"{len(expected)}; different are {new[:1] or 'missing cubes'}: export them into "
                "two folders"
            )
    return first.skin


def _write_bag(
    data_set: DataSet,
    plan: BagPlan,
    topics: dict[str, Topic],
    choices: Choices,
    report: Report,
) -> None:
    """Write all episodes of a bag."""
    with Bag(plan.path) as bag:
        reader = TopicReader(bag, topics)
        waiting = []
        for episode in plan.episodes:
            writer = EpisodeWriter(data_set, plan, episode, reader)
            waiting.append(writer)
        total = sum(episode.rows for episode in plan.episodes)
        done = 0
        for rows in _stress_rows(data_set, plan, choices):
            # Rows of links that are late may belong to the episode before.
            done += sum(writer.add(rows) for writer in waiting)
            # A data set has its episodes one after the other.
            while waiting and waiting[0].write():
                waiting.pop(0)
            report(done, total, f"exporting {plan.path}")


def _stress_rows(
    data_set: DataSet,
    plan: BagPlan,
    choices: Choices,
) -> Iterator[StressRows]:
    """Yield the stress of all rows of cubes that the skin has."""
    with open_bag(plan.path, choices.frequencies) as source:
        settings = settings_with(source, choices.overrides)
        for segment, rows in reconstruct(source, choices.overrides):
            is_known = rows.cube < len(source.skin.cubes)
            rows = rows.select(is_known)
            if len(rows):
                calibrations = settings[segment.number].calibrations
                since_ns = int(rows.stamp_ns.min())
                data_set.note_calibrations(
                    plan.path.name,
                    since_ns,
                    [one.id for one in calibrations],
                )
                yield rows
