# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Division of a bag into the episodes and frames of a data set.

A frame is one time step. Frame k of an episode contains the samples with stamps t::

    begin + k / fps <= t < begin + (k + 1) / fps

where ``begin`` is the first stamp in the episode. All frames of a data set have room for the same
number of samples, which must be known before the first frame is written.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..bags.read import MAX_TIME_NS, Bag
from ..bags.reprocess.job import AS_RECORDED, Overrides
from ..bags.source import BagSource, open_bag
from ..config.skin import Skin
from ..core.arrays import AnyArray, Index, Times
from ..core.errors import BagError
from ..messages.codec import SECOND, frequency_codec

if TYPE_CHECKING:
    from std_msgs.msg import String

MARK_TYPE = "std_msgs/msg/String"
"""Message type of marks: recorded texts that divide a bag into episodes (executions of a task)."""

MAX_STAMP_RATIO = 10
"""Largest allowed ratio of the time between the first and the last stamp of an episode to the
duration of the recording. A larger ratio means that a clock was set, and is an error.

The ratio can be above 1, because a bag may be recorded from a replay at several times its speed.
"""

MAX_DEPTH_RATIO = 10
"""Largest allowed ratio of the number of a cube's samples in one frame to the number that follows
from the sample rate.

Every frame of a data set has room for as many samples as the fullest frame. If wrong stamps put
many samples into one frame, the size of the whole data set would be multiplied.
"""

ALWAYS_ALLOWED_COUNT = 100
"""Number that is added to two limits: to the number of frames in an episode that
`MAX_STAMP_RATIO` allows, and to the number of samples in a frame that `MAX_DEPTH_RATIO` allows.

Without this addition, a recording of a few frames would be rejected for a few samples with late
stamps, although nothing is wrong.
"""


class Choices(NamedTuple):
    """Options that the user chooses for a data set.

    Attributes:
        fps: Frames per second.
        task: Text of the task of each bag that has no marks.
        marks: Topic of the marks (texts that begin episodes); None: each bag is one episode.
        frequencies: Topic of the frequencies; None: that of the only skin in a bag.
        topics: Topics to add beside the stress; None: all with images or stamped numbers.
        state: Topic that becomes the feature (column) observation.state; None: the topic of joint
            states, if there is only one.
        action: Topic that becomes the feature action (commands to the robot); None: the data set
            has no actions.
        overrides: Calibrations and tare (frequencies without load) that replace the recorded ones.
    """

    fps: int
    task: str
    marks: str | None = None
    frequencies: str | None = None
    topics: Sequence[str] | None = None
    state: str | None = None
    action: str | None = None
    overrides: Overrides = AS_RECORDED


class Episode(NamedTuple):
    """An episode of a bag: one execution of a task.

    Attributes:
        task: Text of the task, such as "pick up the cup".
        begin_ns: Time at which its first frame begins, in ns since the Unix epoch.
        blocks: Numbers of its frames among the intervals of the bag (`BagPlan.find_frames`), in
            blocks that are written together and last 1 s each (the last one at most 1 s).
    """

    task: str
    begin_ns: int
    blocks: list[range]


class BagPlan(NamedTuple):
    """Episodes and frames of a bag.

    Attributes:
        path: Folder or file of the bag.
        skin: The skin (cubes and their poses) as the bag describes it.
        episodes: Episodes of the bag that have samples.
        edges_ns: (E,) times, in ns since the Unix epoch, that divide the bag into intervals. An
            interval is a frame, or the time between two episodes. Interval i ends at edge i.
        counts: (E + 1, cubes) number of samples of each cube in each frame; 0 between episodes.
        left_out: Number of samples in no episode, such as those before the first mark
            (`MARK_TYPE`).
    """

    path: Path
    skin: Skin
    episodes: list[Episode]
    edges_ns: Times
    counts: AnyArray
    left_out: int

    @property
    def blocks(self) -> list[range]:
        """The blocks of frames of all episodes."""
        return [block for episode in self.episodes for block in episode.blocks]

    def find_frames(self, stamp_ns: Times) -> Index:
        """Return the number (N,) of the interval (of `edges_ns`) in which each of N stamps lies."""
        return np.searchsorted(self.edges_ns, stamp_ns, side="right")


def plan_bag(path: Path, choices: Choices) -> BagPlan:
    """Find the episodes and frames of a bag and count the samples in them.

    Args:
        path: Folder or file of the bag.
        choices: Frame rate, tasks and topics that the user chose.

    Raises:
        BagError: The bag has no frequencies or no marks, its stamps are implausible, or the frame
            rate is above the sample rate, so that frames would have no sample.
    """
    fps = choices.fps
    with open_bag(path, choices.frequencies) as source:
        marks_ns, tasks = _read_marks(source.bag, choices)
        first_ns = np.full(len(tasks), MAX_TIME_NS)
        last_ns = -first_ns
        for stamp_ns, _ in _read_samples(source):
            mark = np.searchsorted(marks_ns, stamp_ns, side="right")
            np.minimum.at(first_ns, mark, stamp_ns)
            np.maximum.at(last_ns, mark, stamp_ns)

        recorded_s = (source.bag.end_ns - source.bag.start_ns) / SECOND
        max_frames = MAX_STAMP_RATIO * recorded_s * fps + ALWAYS_ALLOWED_COUNT
        episodes: list[Episode] = []
        edges_ns = np.empty(0, np.int64)
        between = [0]
        limits_ns = [*marks_ns, MAX_TIME_NS]
        parts = zip(
            tasks,
            first_ns.tolist(),
            last_ns.tolist(),
            limits_ns,
            strict=True,
        )
        for task, begin_ns, end_ns, limit_ns in parts:
            if not task or begin_ns > end_ns:
                continue
            n_frames = (end_ns - begin_ns) * fps // SECOND + 1
            if n_frames > max_frames:
                raise BagError(
                    f"{path}: a sample is stamped {n_frames / fps:.0f} s after the first of its "
                    "episode, which is longer than was recorded: a clock was set; leave it out "
                    "with --marks"
                )
            # Interval 0 is the time before the first episode. Each episode adds one interval per
            # frame, and one for the time from its last frame to the next episode. Each interval
            # but the first has one edge, its start. So after n edges, interval n + 1 is the next.
            first = len(edges_ns) + 1
            frames = range(first, first + n_frames)
            blocks = [frames[k : k + fps] for k in range(0, n_frames, fps)]
            episodes.append(Episode(task, begin_ns, blocks))
            between.append(frames.stop)
            # Rounding up gives the first whole ns of each frame. The next mark ends the last frame
            # of an episode.
            steps_ns = -(-np.arange(n_frames + 1) * SECOND // fps)
            edges = np.minimum(begin_ns + steps_ns, limit_ns)
            edges_ns = np.append(edges_ns, edges)

        counts = np.zeros((len(edges_ns) + 1, len(source.skin.cubes)), np.uint32)
        for stamp_ns, cube in _read_samples(source):
            frame = np.searchsorted(edges_ns, stamp_ns, side="right")
            np.add.at(counts, (frame, cube), 1)
    left_out = int(counts[between].sum())
    counts[between] = 0
    plan = BagPlan(path, source.skin, episodes, edges_ns, counts, left_out)
    if episodes:
        _check_counts(plan, fps)
    return plan


def _read_samples(source: BagSource) -> Iterator[tuple[Times, Index]]:
    """Yield the stamps and cube indices of all samples of cubes that the skin has."""
    for stamp_ns, cube in source.bag.read_columns(source.topic, frequency_codec, ("cube",)):
        is_known = cube < len(source.skin.cubes)
        yield stamp_ns[is_known].astype(np.int64, copy=False), cube[is_known].astype(np.intp)


def _check_counts(plan: BagPlan, fps: int) -> None:
    """Check that every frame can have a sample, and that no frame has far too many samples.

    Args:
        plan: Episodes and frames of the bag; at least one of each.
        fps: Frames per second.

    Raises:
        BagError: The frame rate is above the sample rate, or a frame has more samples than
            `MAX_DEPTH_RATIO` and `ALWAYS_ALLOWED_COUNT` allow.
    """
    n_frames = sum(map(len, plan.blocks))
    samples = plan.counts.sum(axis=0)
    # A hub that was not connected must not lower the median of all cubes.
    per_frame = float(np.median(samples[samples > 0])) / n_frames
    if per_frame < 1:
        rate = per_frame * fps
        raise BagError(
            f"{plan.path}: --fps {fps}: the cubes were sampled {rate:.3g} times per second, so "
            f"that frames would be without a sample; give at most {math.floor(rate)}"
        )
    depth = plan.counts.max()
    if depth > MAX_DEPTH_RATIO * per_frame + ALWAYS_ALLOWED_COUNT:
        raise BagError(
            f"{plan.path}: {depth} samples of a cube in one frame, usual are {per_frame:.3g}: "
            "stamps do not follow time; leave that time out with --marks"
        )


def _read_marks(bag: Bag, choices: Choices) -> tuple[list[int], list[str]]:
    """Read the marks that divide a bag.

    A mark is a recorded text. At the time of its recording it ends the episode before and begins a
    new one, whose task is the text. An empty text only ends the episode before.

    Args:
        bag: Open bag.
        choices: Topic of the marks, and the task of a bag without marks.

    Returns:
        Time of recording of each of M marks, in ns since the Unix epoch. M + 1 texts: the task
        before the first mark, which is empty if there are marks, and the text of each mark.

    Raises:
        BagError: The topic does not exist.
    """
    if choices.marks is None:
        return [], [choices.task]
    topics = bag.list_topics(MARK_TYPE)
    if choices.marks not in topics:
        names = ", ".join(topics) or "none"
        raise BagError(
            f"{bag.path}: no marks ({MARK_TYPE}) on {choices.marks}; topics of that type: {names}"
        )
    marks: list[tuple[int, String]] = list(bag.read_decoded({choices.marks}))
    return [time_ns for time_ns, _ in marks], ["", *(mark.data.strip() for _, mark in marks)]
