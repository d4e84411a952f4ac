# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""First pass over a bag: it finds the episodes and counts the samples of each cube in every frame.

A frame is one time step of a data set. Frame k of an episode contains the samples with stamps t::

    begin + k / fps <= t < begin + (k + 1) / fps

All frames of a data set have room for the same number of samples (the size of the window), which
must therefore be known before the first frame is written.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..bags.read import MAX_TIME_NS, Bag
from ..bags.reprocess.job import AS_RECORDED, Overrides
from ..bags.source import BagSource, open_bag
from ..config.skin import Skin
from ..core.arrays import AnyArray, Index, Mask, Times
from ..core.errors import BagError
from ..messages.codec import SECOND

MARK_TYPE = "std_msgs/msg/String"
"""Message type of marks: recorded texts that divide a bag into episodes (executions of a task). The
text of a mark is the task of the episode that begins with it."""

MIN_NS = -(1 << 63)
"""Smallest time in 64 bits, in ns. A bag without marks (texts that begin an episode) has a single
episode that begins at this time."""

MAX_STAMP_RATIO = 10
"""Largest allowed ratio of the time between the first and the last stamp of an episode (execution
of a task) to the duration of the recording. A larger ratio means that a clock was set, and is an
error.

The ratio can be above 1, because a bag may be recorded from a replay at several times its speed.
"""

MAX_DEPTH_RATIO = 10
"""Largest allowed ratio of the number of a cube's samples in one frame (time step) to the number
that follows from the sample rate.

Every frame of a data set has room for as many samples as the fullest frame. If wrong stamps put
many samples into one frame, the size of the whole data set would be multiplied.
"""

ALWAYS_ALLOWED_COUNT = 100
"""Number that is added to two limits: to the largest allowed number of frames (time steps) of an
episode, and to the largest allowed number of samples of a cube in one frame.

The limits are multiples (`MAX_STAMP_RATIO`, `MAX_DEPTH_RATIO`) of the numbers that are expected
from the duration of the recording and the sample rate. Without this addition, a few samples that
were stamped late would exceed the limits in a recording of a few frames, although nothing is wrong.
"""

Report = Callable[[float, float, str], None]
"""Function that displays progress. Its arguments are the amount done, the total amount (in the same
unit, messages or samples), and a text that names the current step."""


@dataclass(frozen=True)
class Choices:
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


class Episode:
    """An episode of a bag (one execution of a task), and its numbers of samples.

    Attributes:
        bag: Folder or file of the bag.
        task: Text of the task, such as "pick up the cup".
        begin_ns: Time at which frame 0 begins, in ns since the Unix epoch: the earliest stamp among
            the first samples that are counted.
        rows: Number of samples of all cubes.
        counts: (frames, cubes) number of samples of each cube in each frame (time step of the data
            set).
    """

    def __init__(
        self,
        bag: Path,
        span: tuple[int, int, str],
        *,
        fps: int,
        n_cubes: int,
        max_frames: float,
    ) -> None:
        """Make an episode without samples.

        Args:
            bag: Folder or file of the bag.
            span: Smallest stamp that belongs to the episode, the stamp from which on nothing
                belongs to it (both in ns since the Unix epoch), and the text of its task.
            fps: Frames per second.
            n_cubes: Number of cubes of the skin.
            max_frames: Largest plausible number of frames for the duration of the recording.
        """
        self.bag = bag
        self._since_ns, self._until_ns, self.task = span
        self._fps, self._max_frames = fps, max_frames
        self.begin_ns = self.rows = 0
        shape = (0, n_cubes)
        self.counts: AnyArray = np.zeros(shape, np.uint32)

    def contains(self, stamp_ns: Times) -> Mask:
        """Return whether each stamp (N,), in ns since the Unix epoch, lies in the episode."""
        return (stamp_ns >= self._since_ns) & (stamp_ns < self._until_ns)

    def frame_of(self, stamp_ns: Times) -> Index:
        """Return the number of the frame (time step of the data set) in which each stamp lies.

        Args:
            stamp_ns: (N,) stamps, in ns since the Unix epoch.

        Returns:
            (N,) numbers of frames; they are negative for stamps before `begin_ns`.
        """
        # Whole seconds are multiplied separately, because the product of a time in ns and the frame
        # rate may exceed 64 bits if a clock was never set.
        seconds, rest_ns = np.divmod(stamp_ns - self.begin_ns, SECOND)
        frames: Index = seconds * self._fps + rest_ns * self._fps // SECOND
        return frames

    def sample_frame_of(self, stamp_ns: Times) -> Index:
        """Return the number of the frame (time step) to which the sample with each stamp belongs.

        Samples before `begin_ns` belong to frame 0: the samples of some hubs arrive later than the
        first counted sample, but were taken a little earlier.

        Args:
            stamp_ns: (N,) stamps, in ns since the Unix epoch.
        """
        return np.maximum(self.frame_of(stamp_ns), 0)

    def count(self, cube: Index, stamp_ns: Times) -> None:
        """Count those samples whose stamps lie in the episode.

        Args:
            cube: (N,) index of the cube of each sample.
            stamp_ns: (N,) stamps, in ns since the Unix epoch.

        Raises:
            BagError: A stamp is so late that the episode would have more frames than is plausible
                for the duration of the recording.
        """
        inside = self.contains(stamp_ns)
        cube = cube[inside]
        stamp_ns = stamp_ns[inside]
        if not len(cube):
            return
        # The first samples determine the begin of frame 0 (the first time step). Samples that are
        # read later but have earlier stamps are put into frame 0, too.
        if not self.rows:
            self.begin_ns = int(stamp_ns.min())
        frame = self.sample_frame_of(stamp_ns)
        n_frames = int(frame.max()) + 1
        if n_frames > self._max_frames:
            late_ns = int(stamp_ns.max()) - self.begin_ns
            late_s = late_ns / SECOND
            raise BagError(
                f"{self.bag}: a sample is stamped {late_s:.0f} s after the first of its episode, "
                "which is longer than was recorded: a clock was set; leave it out with --marks"
            )
        if n_frames > len(self.counts):
            # The number of frames is not known before the end, so the table of counts grows by half
            # each time it is full. If it grew by single frames, it would be copied too often.
            room = 3 * n_frames // 2
            n_cubes = self.counts.shape[1]
            self.counts.resize((room, n_cubes), refcheck=False)
        self.rows += len(cube)
        np.add.at(self.counts, (frame, cube), 1)

    def finish(self) -> None:
        """Remove the empty frames (time steps) after the last sample.

        It is called once, when all samples of the bag have been counted.
        """
        has_samples = self.counts.any(axis=1)
        last = np.flatnonzero(has_samples)[-1]
        self.counts = self.counts[: last + 1]


@dataclass(frozen=True, eq=False)
class BagPlan:
    """Episodes of a bag that are exported, and numbers of the samples that are not.

    Attributes:
        path: Folder or file of the bag.
        skin: The skin (cubes and their poses) as the bag describes it.
        episodes: Episodes of the bag that have samples.
        rate: Sample rate of a cube, in Hz: the median of all cubes.
        left_out: Numbers of samples and episodes that are not exported, by a text with the reason.
    """

    path: Path
    skin: Skin
    episodes: list[Episode]
    rate: float
    left_out: Counter[str]


def plan_bag(
    path: Path,
    choices: Choices,
    report: Report,
) -> BagPlan:
    """Find the episodes (executions of a task) in a bag and count their samples.

    Args:
        path: Folder or file of the bag.
        choices: Frame rate, tasks and topics that the user chose.
        report: Function that displays progress.

    Raises:
        BagError: The bag has no frequencies or no marks, its stamps are implausible, or the frame
            rate is above the sample rate, so that frames would have no sample.
    """
    with open_bag(path, choices.frequencies) as source:
        # The progress that is displayed is the fraction of the messages that have been read.
        counts = {one.topic: one.msgcount for one in source.bag.connections}
        total = counts[source.topic]
        spans = [(MIN_NS, MAX_TIME_NS, choices.task)]
        if choices.marks is not None:
            spans = _find_marked_spans(source.bag, choices.marks)
        n_cubes = len(source.skin.cubes)
        recorded_s = (source.bag.end_ns - source.bag.start_ns) / SECOND
        max_frames = MAX_STAMP_RATIO * recorded_s * choices.fps + ALWAYS_ALLOWED_COUNT
        episodes = [
            Episode(
                path,
                span,
                fps=choices.fps,
                n_cubes=n_cubes,
                max_frames=max_frames,
            )
            for span in spans
        ]

        samples = np.zeros(n_cubes, np.int64)
        first_ns, last_ns = MAX_TIME_NS, MIN_NS
        for rows in source:
            is_known = rows.cube < n_cubes
            cube = rows.cube[is_known].astype(np.intp)
            stamp_ns = rows.stamp_ns[is_known]
            if len(cube):
                samples += np.bincount(cube, minlength=n_cubes)
                first_ns = min(first_ns, int(stamp_ns.min()))
                last_ns = max(last_ns, int(stamp_ns.max()))
                for episode in episodes:
                    episode.count(cube, stamp_ns)
            report(source.messages, total, f"counting {path}")

    covered_s = (last_ns - first_ns) / SECOND
    rate = _check_rate(source, samples, covered_s, choices.fps)
    # Episodes without samples are left out. Often the last one begins just before the end of the
    # recording.
    used = [episode for episode in episodes if episode.rows]
    for episode in used:
        episode.finish()
        _check_depth(source, episode, math.ceil(rate / choices.fps))
    known_rows = int(samples.sum())
    used_rows = sum(episode.rows for episode in used)
    left_out = {
        "samples outside of the marks": known_rows - used_rows,
        "samples of cubes that the skin does not have": source.rows - known_rows,
        "marks without a sample": len(episodes) - len(used),
    }
    return BagPlan(
        path,
        source.skin,
        used,
        rate,
        Counter(left_out),
    )


def _check_rate(
    source: BagSource,
    samples: Index,
    seconds: float,
    fps: int,
) -> float:
    """Return the sample rate of a bag and check that every frame can have a sample.

    Args:
        source: Source of the recorded frequencies.
        samples: (cubes,) number of samples of each cube.
        seconds: Time between the first and the last stamp, in s.
        fps: Frames per second.

    Returns:
        The sample rate of a cube, in Hz: the median of all cubes.

    Raises:
        BagError: No cube has two samples, or the frame rate is above the sample rate.
    """
    path = source.bag.path
    # Cubes with fewer than two samples are left out: they have no rate, and a hub that was not
    # connected would lower the median of all cubes.
    several = samples[samples > 1]
    if not len(several) or seconds <= 0:
        raise BagError(
            f"{path}: {samples.sum()} samples on {source.topic}, and no two of one cube; "
            "record longer"
        )
    rate = float(np.median(several - 1)) / seconds
    # n samples enclose only n - 1 sampling periods, so n frames can have one sample each even if
    # the frame rate is higher than the sample rate by the factor 1 + 1/n.
    fewest = int(several.min())
    max_fps = math.floor(rate * (1 + 1 / fewest))
    if fps > max_fps:
        raise BagError(
            f"{path}: --fps {fps}: the cubes were sampled {rate:.4g} times per second, so that "
            f"frames would be without a sample; give at most {max_fps}"
        )
    return rate


def _check_depth(
    source: BagSource,
    episode: Episode,
    usual: int,
) -> None:
    """Check that no frame (time step of the data set) has far more samples than usual.

    Every frame of the data set gets room for as many samples as the fullest frame has, so such a
    frame would multiply the size of the data set.

    Args:
        source: Source of the recorded frequencies.
        episode: Episode of the bag, with its numbers of samples.
        usual: Number of samples of a cube in a frame that follows from the sample rate.

    Raises:
        BagError: A frame has more samples than `MAX_DEPTH_RATIO` and `ALWAYS_ALLOWED_COUNT` allow.
    """
    depth = int(episode.counts.max())
    if depth > MAX_DEPTH_RATIO * usual + ALWAYS_ALLOWED_COUNT:
        deepest = episode.counts.argmax()
        frame, cube = np.unravel_index(deepest, episode.counts.shape)
        raise BagError(
            f"{source.bag.path}: {depth} samples of cube {source.skin.names[cube]} in frame "
            f"{frame}, usual are {usual}: stamps do not follow time; leave that time out with "
            "--marks"
        )


def _find_marked_spans(
    bag: Bag,
    topic: str,
) -> list[tuple[int, int, str]]:
    """Return the episodes (executions of a task) into which marks divide a bag.

    A mark is a recorded text. At the time of its recording it ends the episode before and begins a
    new one, whose task is the text. An empty text only ends the episode before.

    Args:
        bag: Open bag.
        topic: Topic of the marks.

    Returns:
        Begin (ns since the Unix epoch), end (ns) and task of each episode.

    Raises:
        BagError: The topic does not exist, or none of its marks has a text.
    """
    if topic not in bag.topics(MARK_TYPE):
        names = ", ".join(bag.topics(MARK_TYPE)) or "none"
        raise BagError(
            f"{bag.path}: no marks ({MARK_TYPE}) on {topic}; topics of that type: {names}"
        )
    marks = []
    for time_ns, mark in bag.decoded({topic}):
        marks.append((time_ns, mark.data.strip()))
    end = (MAX_TIME_NS, "")
    spans = []
    for (since_ns, task), (until_ns, _) in pairwise([*marks, end]):
        if task:
            spans.append((since_ns, until_ns, task))
    if not spans:
        raise BagError(f"{bag.path}: no mark on {topic} begins an episode; publish its task there")
    return spans
