"""Bags to one data set: plan all bags, then reconstruct each and write its frames."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from ..bags.read import Bag
from ..bags.reprocess.job import reconstruct, settings_with
from ..bags.source import open_bag
from ..config.skin import Skin
from ..core.errors import BagError
from ..core.rows import StressRows
from .choices import Choices
from .data_set import DataSet
from .episode_writer import EpisodeWriter
from .others import Others, Topic, find_topics
from .plan import BagPlan, plan_bag

Report = Callable[[float, float, str], None]
"""Called with what is done, the total, and what is being done."""


class Exported(NamedTuple):
    """What was written, and what was not.

    rows: samples of cubes; features: of the other topics
    depth: samples in a window; usual: samples in most windows
    outside, unknown, empty: as in `BagPlan`, of all bags
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
    bags: Sequence[Path], folder: Path, choices: Choices, report: Report
) -> Exported:
    """Write a data set into a folder that is empty or not there yet. It appears when it is
    complete.

    BagError: what is wrong with a bag, the choices or the folder.
    """
    check_empty(folder)
    plans = [_plan(path, choices, report) for path in bags]
    skin = _one_skin(plans)
    episodes = [episode for plan in plans for episode in plan.episodes]
    if not episodes:
        raise BagError(f"{bags[0]}: no sample lies between the marks; nothing to export")
    topics = find_topics(bags, choices)
    depth = max(int(episode.counts.max()) for episode in episodes)
    rows = sum(int(episode.counts.sum()) for episode in episodes)
    partial = folder.absolute().parent / f"{folder.absolute().name}.partial"
    try:
        shutil.rmtree(partial, ignore_errors=True)
        data_set = DataSet(partial, skin, list(topics.values()), choices.fps, depth, rows)
        with data_set.files:
            for plan in plans:
                _add_bag(data_set, plan, topics, choices, report)
        data_set.write_meta()
        partial.replace(folder)
    except OSError as error:
        raise BagError(
            f"{folder}: {error.strerror or error}; name a folder on a disk with room"
        ) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return Exported(
        len(episodes),
        data_set.frames,
        rows,
        depth,
        math.ceil(max(plan.rate for plan in plans) / choices.fps),
        [topic.key for topic in topics.values()],
        sum(plan.outside for plan in plans),
        sum(plan.unknown for plan in plans),
        sum(plan.empty for plan in plans),
    )


def check_empty(folder: Path) -> None:
    """BagError: there is something in a folder for results."""
    if folder.is_dir() and any(folder.iterdir()):
        raise BagError(f"{folder} is not empty; name another folder, or remove what is in it")


def _plan(path: Path, choices: Choices, report: Report) -> BagPlan:
    def counted(done: int, total: int) -> None:
        report(done, total, f"counting {path}")

    return plan_bag(path, choices.fps, choices.frequencies, choices.task, choices.marks, counted)


def _one_skin(plans: list[BagPlan]) -> Skin:
    """BagError: the bags were recorded with different cubes, or in other places."""
    first = plans[0]
    for plan in plans[1:]:
        for cube, other in zip(first.skin.cubes, plan.skin.cubes, strict=False):
            if (cube.name, cube.xyz, cube.rpy) != (other.name, other.xyz, other.rpy):
                raise BagError(
                    f"{plan.path}: cube {other.name} at {other.xyz}, in {first.path} {cube.name} "
                    f"at {cube.xyz}; export them into two folders"
                )
        if len(first.skin.cubes) != len(plan.skin.cubes):
            raise BagError(
                f"{plan.path} has {len(plan.skin.cubes)} cubes, {first.path} "
                f"{len(first.skin.cubes)}; export them into two folders"
            )
    return first.skin


def _add_bag(
    data_set: DataSet, plan: BagPlan, topics: dict[str, Topic], choices: Choices, report: Report
) -> None:
    """All episodes of a bag. BagError: damaged, or the overrides do not fit."""
    with ExitStack() as stack:
        others = Others(stack.enter_context(Bag(plan.path)), topics)
        writers = [EpisodeWriter(data_set, plan, one, others) for one in plan.episodes]
        waiting = iter(writers)
        now = next(waiting, None)
        total = sum(int(one.counts.sum()) for one in plan.episodes)
        done = 0
        for rows in _rows(data_set, plan, choices):
            for writer in writers:
                done += writer.add(rows)
            while now is not None and now.write():
                now = next(waiting, None)
            report(done, total, f"exporting {plan.path}")


def _rows(data_set: DataSet, plan: BagPlan, choices: Choices) -> Iterator[StressRows]:
    """The stress of all rows of cubes that the skin has."""
    with open_bag(plan.path, choices.frequencies) as source:
        settings = settings_with(source, choices.overrides)
        for segment, rows in reconstruct(source, choices.overrides):
            known = rows.cube < len(source.skin.cubes)
            if not known.all():
                rows = rows.select(known)
            if len(rows):
                ids = [one.id for one in settings[segment.number].calibrations]
                data_set.note_calibrations(plan.path.name, int(rows.stamp_ns.min()), ids)
                yield rows
