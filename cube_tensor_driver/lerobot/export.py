# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Export of bags to one data set: all bags are planned, then each is reconstructed and written."""

from __future__ import annotations

import math
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..bags.read import Bag
from ..bags.reprocess.job import choose_settings, reconstruct
from ..bags.source import open_bag
from ..bags.tables import report_write_errors
from ..config.skin import Skin
from ..core.arrays import AnyArray
from ..core.errors import BagError
from ..core.modes import COMPONENTS
from ..core.rows import StressRows
from .data_set import RESIDUAL, DataSet
from .images import ImageStream, decode_image
from .plan import BagPlan, Choices, Episode, Report, plan_bag
from .topics import Signal, Topic, find_topics
from .windows import TACTILE, Windows

MAX_SAMPLED_IMAGES = 20
"""Largest number of images per episode and topic whose pixels enter the statistics of colours."""

PIXEL_STRIDE = 4
"""Step, in pixels, along height and width between the pixels that enter the statistics of colours.
With 4, one pixel in 16 is used."""


@dataclass(frozen=True)
class Exported:
    """Size of an exported data set, and of what was left out of it.

    Attributes:
        episodes: Number of exported episodes (executions of a task).
        frames: Number of exported frames (time steps).
        rows: Number of exported samples of cubes.
        depth: Number of samples of each cube that a frame has room for.
        usual: Number of samples of each cube in most frames.
        features: Names of the features (columns) that come from topics other than stress.
        left_out: Numbers of samples and episodes that were not exported, by a text with the reason.
    """

    episodes: int
    frames: int
    rows: int
    depth: int
    usual: int
    features: list[str]
    left_out: Counter[str]


def export_lerobot(
    bags: Sequence[Path],
    folder: Path,
    choices: Choices,
    report: Report,
) -> Exported:
    """Write a LeRobot data set of some bags (recordings).

    The folder gets its final name only when the data set is complete.

    Args:
        bags: Folders or files of bags.
        folder: Folder of the data set; it must be empty or not exist.
        choices: Options that the user chose, such as frame rate, tasks and topics.
        report: Function that displays progress (see `plan.Report`).

    Raises:
        BagError: A bag is damaged, the choices do not fit, or the folder cannot be written.
    """
    # The folder is checked before the bags are read, because reading them takes long.
    check_empty(folder)
    plans = [plan_bag(path, choices, report) for path in bags]
    skin = _check_same_skin(plans)
    counts = [episode.counts for plan in plans for episode in plan.episodes]
    if not counts:
        raise BagError(f"{bags[0]}: no sample lies between the marks; nothing to export")
    topics = find_topics(bags, choices)
    frames = sum(len(each) for each in counts)
    depth = max(int(each.max()) for each in counts)
    # The incomplete data set lies beside the final folder, so that it can be renamed. That works
    # only within one file system.
    partial = folder.absolute()
    partial = partial.with_name(f"{partial.name}.partial")
    try:
        # An export that was killed may have left an incomplete data set here. It cannot be
        # continued, so it is removed.
        shutil.rmtree(partial, ignore_errors=True)
        with report_write_errors(folder):
            data_set = DataSet(
                partial,
                skin,
                topics,
                fps=choices.fps,
                depth=depth,
                frames=frames,
            )
            with data_set:
                for plan in plans:
                    _write_bag(
                        data_set,
                        plan,
                        topics,
                        choices,
                        report,
                    )
            data_set.write_meta()
            partial.replace(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    rate = max(plan.rate for plan in plans)
    return Exported(
        episodes=len(counts),
        frames=data_set.frames,
        rows=sum(int(each.sum()) for each in counts),
        depth=data_set.depth,
        usual=math.ceil(rate / choices.fps),
        features=[topic.key for topic in topics],
        left_out=sum((plan.left_out for plan in plans), Counter()),
    )


def check_empty(folder: Path) -> None:
    """Check that a folder for results is empty or does not exist.

    Raises:
        BagError: The folder is not empty.
    """
    if folder.is_dir() and any(folder.iterdir()):
        raise BagError(f"{folder} is not empty; name another folder, or remove what is in it")


class EpisodeWriter:
    """Writes one episode (execution of a task) of a data set.

    It collects rows of stress (one sample of one cube each) and writes frames (time steps of the
    data set) when they are complete.
    """

    def __init__(
        self,
        data_set: DataSet,
        episode: Episode,
        topics: dict[str, Signal | ImageStream],
    ) -> None:
        """Prepare to write an episode.

        Args:
            data_set: The data set to write into.
            episode: The episode, with its numbers of samples.
            topics: Numbers and images on the topics other than stress, by the names of the features
                (columns of the data set) that they become.
        """
        self._data_set = data_set
        self._episode = episode
        self._topics = topics
        self._windows = Windows(episode.counts, data_set.depth)
        self._statistics = data_set.new_statistics()

    def add(self, rows: StressRows) -> int:
        """Add those rows of stress (one sample of one cube each) whose stamps lie in the episode.

        Args:
            rows: Rows of one or several episodes of the bag.

        Returns:
            The number of rows that lie in the episode.
        """
        is_inside = self._episode.contains(rows.stamp_ns)
        inside = rows.select(is_inside)
        if len(inside):
            frame = self._episode.sample_frame_of(inside.stamp_ns)
            self._windows.add(frame, inside)
        return len(inside)

    def write(self) -> bool:
        """Write the frames (time steps of the data set) of which all rows of stress were added.

        The frames of a data set lie episode by episode in its files, so this may only be called for
        the first episode that is not complete.

        Returns:
            Whether all frames of the episode have been written.
        """
        for windows in self._windows.complete():
            self._write_frames(windows)
        is_complete = self._windows.done == len(self._episode.counts)
        if is_complete:
            self._data_set.end_episode(self._episode, self._statistics)
        return is_complete

    def _write_frames(self, windows: dict[str, AnyArray]) -> None:
        """Write successive frames with all of their features, and add them to the statistics.

        Args:
            windows: Arrays of the stress in these frames, as `Windows.complete` has just returned
                them, by the names of the features (columns of the data set).
        """
        data_set, last = self._data_set, self._windows.done
        frames = len(windows[TACTILE])
        first = last - frames
        columns: dict[str, Any] = {
            key: source.at(self._episode, first, last) for key, source in self._topics.items()
        }

        frame = np.arange(first, last)
        task = data_set.task_index(self._episode.task)
        counted: dict[str, AnyArray] = {
            "timestamp": (frame / data_set.fps).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.full(frames, len(data_set.episodes)),
            "index": data_set.frames + np.arange(frames),
            "task_index": np.full(frames, task),
        }
        for key, numbers in counted.items():
            columns[key] = numbers[:, np.newaxis]
        data_set.write(windows | columns)

        # The arrays `windows` have room for more samples than most frames have. The free entries
        # are NaN, which the statistics leave out.
        components = windows[TACTILE].reshape(-1, len(COMPONENTS))
        residual = windows[RESIDUAL].reshape(-1, 1)
        self._statistics[TACTILE].add(components)
        self._statistics[RESIDUAL].add(residual)
        # A few pixels of a few images suffice for the statistics of colours. Decoding every image
        # would be slow.
        stride = -(-len(self._episode.counts) // MAX_SAMPLED_IMAGES)
        for key, values in columns.items():
            if isinstance(values, np.ndarray):
                self._statistics[key].add(values)
                continue
            # Every stride-th frame of the episode is chosen. `values` begins with frame `first`, so
            # its first chosen frame has the index -first % stride in it.
            for image in values[-first % stride :: stride]:
                pixels = decode_image(image)[::PIXEL_STRIDE, ::PIXEL_STRIDE]
                # LeRobot normalises images of the shape (bands, height, width), to which statistics
                # of the shape (bands, 1, 1) are broadcast.
                bands = pixels.shape[2]
                colours = pixels.reshape(-1, bands, 1, 1)
                self._statistics[key].add(colours)


def _check_same_skin(plans: list[BagPlan]) -> Skin:
    """Check that all bags have the same cubes at the same poses, and return their skin.

    Args:
        plans: The bags, at least one.

    Raises:
        BagError: The cubes of two bags differ in their names or poses.
    """

    def places(plan: BagPlan) -> list[object]:
        """Return name and pose of each cube of a bag."""
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
    topics: list[Topic],
    choices: Choices,
    report: Report,
) -> None:
    """Reconstruct the stress of a bag and write its episodes into a data set.

    Args:
        data_set: The data set to write into.
        plan: The bag and its episodes (executions of a task).
        topics: Topics other than stress that become features (columns) of the data set.
        choices: Options that the user chose, such as the frame rate.
        report: Function that displays progress.
    """
    with Bag(plan.path) as bag:
        sources = {topic.key: topic.open(bag) for topic in topics}
        waiting = [EpisodeWriter(data_set, episode, sources) for episode in plan.episodes]
        total = sum(episode.rows for episode in plan.episodes)
        done = 0
        for rows in _find_stress_rows(data_set, plan, choices):
            # All unfinished episodes are offered the rows, because rows of a hub whose connection
            # is slow can belong to an earlier episode than those of the other hubs.
            done += sum(writer.add(rows) for writer in waiting)
            # The frames of a data set lie episode after episode. So only the first unfinished
            # episode may be written.
            while waiting and waiting[0].write():
                waiting.pop(0)
            report(done, total, f"exporting {plan.path}")
    data_set.close_file()


def _find_stress_rows(
    data_set: DataSet,
    plan: BagPlan,
    choices: Choices,
) -> Iterator[StressRows]:
    """Yield the stress that is reconstructed from the frequencies in a bag.

    Rows (samples of one cube) of cubes that the skin does not have are left out.

    Args:
        data_set: The data set, in which the calibrations are noted.
        plan: The bag.
        choices: Topic of the frequencies, and calibrations and tare that replace the recorded ones.
    """
    noted = data_set.calibrations
    with open_bag(plan.path, choices.frequencies) as source:
        settings = choose_settings(source, choices.overrides)
        for segment, rows in reconstruct(source, settings):
            is_known = rows.cube < len(source.skin.cubes)
            known = rows.select(is_known)
            if not len(known):
                continue
            calibrations = settings[segment.number].calibrations
            ids = [one.id for one in calibrations]
            # The calibrations are noted only when they change, because in most data sets they are
            # the same throughout.
            if not noted or noted[-1]["ids"] != ids:
                since_ns = int(known.stamp_ns.min())
                noted.append(
                    {
                        "bag": plan.path.name,
                        "since_ns": since_ns,
                        "ids": ids,
                    }
                )
            yield known
