# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Export of bags to one data set: all bags are planned, then each is reconstructed and written."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from ..bags.read import Bag
from ..bags.reprocess.job import choose_settings, reconstruct
from ..bags.source import BagSource, open_bag
from ..bags.tables import complete_output
from ..core.arrays import AnyArray, Index
from ..core.errors import BagError
from ..core.rows import StressRows
from .data_set import Columns, DataSet
from .plan import BagPlan, Choices, plan_bag
from .topics import Topic, find_topics
from .windows import TACTILE, stream_windows

Report = Callable[[float, float, str], None]
"""Function that displays progress. Its arguments are the amount done, the total amount in the same
unit, and a text that names the current step."""


class Exported(NamedTuple):
    """Size of an exported data set, and of what was left out of it.

    Attributes:
        episodes: Number of exported episodes (executions of a task).
        frames: Number of exported frames (time steps).
        rows: Number of exported samples of cubes.
        depth: Number of samples of each cube that a frame has room for.
        features: Names of the features (columns) that come from topics other than stress.
        left_out: Number of samples in no episode, which are not exported.
    """

    episodes: int
    frames: int
    rows: int
    depth: int
    features: list[str]
    left_out: int


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
    cubes = [[(cube.name, cube.xyz, cube.rpy) for cube in plan.skin.cubes] for plan in plans]
    for path, found in zip(bags, cubes, strict=True):
        if found != cubes[0]:
            raise BagError(
                f"{path}: its cubes, or their poses, are not those of {bags[0]}: export them into "
                "two folders"
            )
    depth = max(int(plan.counts.max()) for plan in plans)
    if not depth:
        raise BagError(f"{bags[0]}: no sample lies in an episode; record longer, or set marks")
    topics = find_topics(bags, choices)
    names = {key: list(topic.names) for key, topic in topics.items()}
    skin = plans[0].skin
    names[f"{TACTILE}.count"] = list(skin.names)
    frames = sum(len(block) for plan in plans for block in plan.blocks)
    calibrations: list[dict[str, object]] = []
    with complete_output(folder) as partial:
        data_set = DataSet(partial, choices.fps, names, frames)
        for plan in plans:
            with open_bag(plan.path, choices.frequencies) as source:
                rows = _read_stress(plan, source, choices, calibrations)
                windows = stream_windows(
                    rows,
                    plan.blocks,
                    plan.counts,
                    depth,
                )
                columns = _add_topics(
                    plan,
                    windows,
                    source.bag,
                    topics,
                    report,
                )
                data_set.write_bag(plan, columns)
        data_set.write_meta(skin, calibrations)
    return Exported(
        episodes=sum(len(plan.episodes) for plan in plans),
        frames=frames,
        rows=sum(int(plan.counts.sum()) for plan in plans),
        depth=depth,
        features=list(topics),
        left_out=sum(plan.left_out for plan in plans),
    )


def check_empty(folder: Path) -> None:
    """Check that a folder for results is empty or does not exist.

    Raises:
        BagError: The folder is not empty.
    """
    if folder.is_dir() and any(folder.iterdir()):
        raise BagError(f"{folder} is not empty; name another folder, or remove what is in it")


def _add_topics(
    plan: BagPlan,
    windows: Iterator[dict[str, AnyArray]],
    bag: Bag,
    topics: dict[str, Topic],
    report: Report,
) -> Iterator[Columns]:
    """Yield the values of all features (columns) in each block of frames.

    Args:
        plan: Episodes and frames of the bag.
        windows: Features of the stress in each block.
        bag: The open bag.
        topics: Topics other than stress by the names of their features.
        report: Function that displays progress.
    """
    ends_ns = [plan.edges_ns[block.start : block.stop] for block in plan.blocks]
    others = {key: topic.sample(bag, ends_ns) for key, topic in topics.items()}
    for block, window in zip(plan.blocks, windows, strict=True):
        yield {**window, **{key: next(values) for key, values in others.items()}}
        report(block.stop, len(plan.counts), f"exporting {plan.path}")


def _read_stress(
    plan: BagPlan,
    source: BagSource,
    choices: Choices,
    calibrations: list[dict[str, object]],
) -> Iterator[tuple[Index, StressRows]]:
    """Yield the number of the frame of each row, and the rows with the reconstructed stress.

    Args:
        plan: Episodes and frames of the bag.
        source: The recorded frequencies.
        choices: Calibrations and tare that replace the recorded ones.
        calibrations: List to which each change of calibrations is added.
    """
    settings = choose_settings(source, choices.overrides)
    for segment, rows in reconstruct(source, settings):
        rows = rows.select(rows.cube < len(plan.skin.cubes))
        if not len(rows):
            continue
        ids = [one.id for one in settings[segment.number].calibrations]
        if not calibrations or calibrations[-1]["ids"] != ids:
            since_ns = int(rows.stamp_ns.min())
            calibrations.append({"bag": plan.path.name, "since_ns": since_ns, "ids": ids})
        frame = plan.find_frames(rows.stamp_ns)
        is_used = plan.counts[frame, rows.cube].astype(bool)
        yield frame[is_used], rows.select(is_used)
