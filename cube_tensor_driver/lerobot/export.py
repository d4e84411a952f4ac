# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Export of bags to one data set: all bags are planned, then each is reconstructed and written."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..bags.reprocess.job import choose_settings, reconstruct
from ..bags.source import BagSource, open_bag
from ..bags.tables import report_write_errors
from ..config.skin import Skin
from ..core.arrays import Index
from ..core.errors import BagError
from ..core.rows import StressRows
from .data_set import DataSet
from .plan import BagPlan, Choices, plan_bag
from .topics import Topic, find_topics
from .windows import stream_windows

Report = Callable[[float, float, str], None]
"""Function that displays progress. Its arguments are the amount done, the total amount in the same
unit, and a text that names the current step."""


@dataclass(frozen=True)
class Exported:
    """Size of an exported data set, and of what was left out of it.

    Attributes:
        episodes: Number of exported episodes (executions of a task).
        frames: Number of exported frames (time steps).
        rows: Number of exported samples of cubes.
        depth: Number of samples of each cube that a frame has room for.
        usual: Median number of samples of a cube in the frames of a bag; the largest of all bags.
        features: Names of the features (columns) that come from topics other than stress.
        left_out: Numbers of samples and episodes that were not exported, by a text with the reason.
    """

    episodes: int
    frames: int
    rows: int
    depth: int
    usual: float
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
        report: Function that displays progress.

    Raises:
        BagError: A bag is damaged, the choices do not fit the bags, or the folder is not empty or
            cannot be written.
    """
    # The folder is checked before the bags are read, because reading them takes long.
    check_empty(folder)
    plans = []
    for number, path in enumerate(bags):
        report(number, len(bags), f"counting {path}")
        plans.append(plan_bag(path, choices))
    skin = _check_same_skin(plans)
    depth = max(int(plan.counts.max()) for plan in plans)
    if not depth:
        raise BagError(f"{bags[0]}: no sample lies between the marks; nothing to export")
    topics = find_topics(bags, choices)
    episodes = [episode for plan in plans for episode in plan.episodes]
    frames = sum(len(episode.frames) for episode in episodes)
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
                choices.fps,
                frames,
            )
            for plan in plans:
                _write_bag(
                    data_set,
                    plan,
                    topics,
                    depth,
                    choices,
                    report,
                )
            data_set.write_meta()
            partial.replace(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return Exported(
        episodes=len(episodes),
        frames=frames,
        rows=sum(int(plan.counts.sum()) for plan in plans),
        depth=depth,
        usual=max(plan.usual for plan in plans),
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


def _check_same_skin(plans: list[BagPlan]) -> Skin:
    """Check that all bags have the same cubes at the same poses, and return their skin.

    Args:
        plans: The bags, at least one.

    Raises:
        BagError: The cubes of two bags differ in their names or poses.
    """
    first, *others = plans
    expected = [(cube.name, cube.xyz, cube.rpy) for cube in first.skin.cubes]
    for plan in others:
        found = [(cube.name, cube.xyz, cube.rpy) for cube in plan.skin.cubes]
        if found != expected:
            new = [cube for cube in found if cube not in expected]
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
    depth: int,
    choices: Choices,
    report: Report,
) -> None:
    """Reconstruct the stress of a bag and write its episodes into a data set.

    Args:
        data_set: The data set to write into.
        plan: Episodes and frames of the bag.
        topics: Topics other than stress that become features (columns) of the data set.
        depth: Number of samples of each cube that a frame has room for.
        choices: Options that the user chose, such as the frame rate.
        report: Function that displays progress.
    """
    with open_bag(plan.path, choices.frequencies) as source:
        streams = {topic.key: topic.open(source.bag) for topic in topics}
        blocks = [
            block for episode in plan.episodes for block in episode.divide_into_blocks(choices.fps)
        ]
        rows = _find_stress(data_set, plan, source, choices)
        windows = stream_windows(rows, blocks, plan.counts, depth)
        for episode in plan.episodes:
            for block in episode.divide_into_blocks(choices.fps):
                ends_ns = plan.edges_ns[block.start : block.stop]
                columns = {key: stream.at(ends_ns) for key, stream in streams.items()}
                data_set.write({**next(windows), **columns}, episode.task)
                report(
                    block.stop,
                    len(plan.counts),
                    f"exporting {plan.path}",
                )
            data_set.end_episode(episode, plan.path.name)
    data_set.close_file()


def _find_stress(
    data_set: DataSet,
    plan: BagPlan,
    source: BagSource,
    choices: Choices,
) -> Iterator[tuple[Index, StressRows]]:
    """Yield the number of the frame of each row, and the rows with the reconstructed stress.

    Args:
        data_set: The data set, in which the calibrations are noted.
        plan: Episodes and frames of the bag.
        source: The recorded frequencies.
        choices: Calibrations and tare that replace the recorded ones.
    """
    noted = data_set.calibrations
    settings = choose_settings(source, choices.overrides)
    for segment, rows in reconstruct(source, settings):
        known = rows.select(rows.cube < len(plan.skin.cubes))
        if not len(known):
            continue
        ids = [one.id for one in settings[segment.number].calibrations]
        # An entry is added only when the calibrations change, which is rare.
        if not noted or noted[-1]["ids"] != ids:
            since_ns = int(known.stamp_ns.min())
            noted.append(
                {
                    "bag": plan.path.name,
                    "since_ns": since_ns,
                    "ids": ids,
                }
            )
        yield plan.find_frames(known.stamp_ns), known
