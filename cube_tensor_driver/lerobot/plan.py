"""The first pass over a bag: its episodes, and how many samples of each cube every frame has.

A frame is one step of a data set. Frame k of an episode contains what was measured in a period::

    begin + k / fps <= t < begin + (k + 1) / fps

The window of samples has one size in the whole data set, so this size must be known before the
first frame is written.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..bags.read import Bag
from ..bags.reprocess.job import AS_RECORDED, Overrides
from ..bags.source import BagSource, open_bag
from ..config.skin import Skin
from ..core.arrays import AnyArray, Index, Mask, Times
from ..core.errors import BagError
from ..messages.codec import SECOND

MARK = "std_msgs/msg/String"
"""Message type of marks: texts that divide a bag into episodes and name their tasks."""

MIN_NS, MAX_NS = -(1 << 63), (1 << 63) - 1
"""Smallest and largest time in 64 bits, in ns: the bounds of an episode without marks."""

MAX_TIME_NS = 1 << 62
"""Largest allowed product of a time, in ns, and the frame rate, so that it fits 64 bits. Times of
clocks that were never set are reduced to it."""

MAX_STAMP_RATIO = 10
"""Largest ratio of the time that the stamps of an episode cover to the duration of the recording.

It can be above 1, because a bag may be replayed at several times its speed and recorded again.
"""

MAX_DEPTH_RATIO = 10
"""Largest ratio of the number of samples in one frame to the usual number.

Every window of a data set is as long as the fullest frame, so a frame in which wrong stamps collect
samples would multiply the size of the data set.
"""

ALWAYS_ALLOWED = 100
"""Number of frames (or samples in a frame) that is always allowed, in addition to the two ratios:
in a short recording a few late samples already exceed a ratio."""

Report = Callable[[float, float, str], None]
"""Function that displays progress: it gets the amount done, the total amount, and a text that names
the current step."""


@dataclass(frozen=True)
class Choices:
    """What a person chooses for a data set.

    Attributes:
        fps: Frames per second.
        task: Task of every episode without a mark.
        marks: Topic of the marks; None: each bag is one episode.
        frequencies: Topic of the frequencies, where a bag has those of several skins.
        topics: Other topics to add; None: all that can be added.
        state: Topic that becomes observation.state; None: the only topic of joint states.
        action: Topic that becomes action; None: there is none.
        overrides: What differs from the recording, as for `reprocess`.
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
    """An episode of a bag, and how many samples it has.

    Attributes:
        task: What was done in it.
        begin_ns: Stamp of its first sample, in ns, at which frame 0 begins.
        rows: Number of samples of cubes.
        counts: (frames, cubes) number of samples of each cube in each frame.
    """

    def __init__(
        self,
        since_ns: int,
        until_ns: int,
        task: str,
        fps: int,
    ) -> None:
        """Make an episode without samples, of the time since_ns <= t < until_ns."""
        self.task = task
        self.begin_ns = self.rows = 0
        self.counts: AnyArray = np.zeros((0, 1), np.uint32)
        self._since_ns = since_ns
        self._until_ns = until_ns
        self._fps = fps

    def contains(self, stamp_ns: Times) -> Mask:
        """Return which samples (N,) belong to the episode."""
        return (stamp_ns >= self._since_ns) & (stamp_ns < self._until_ns)

    def frame_of(self, stamp_ns: Times) -> Index:
        """Return the frame of each instant (N,); it is below 0 before the episode."""
        limit = MAX_TIME_NS // self._fps
        since_ns = np.clip(stamp_ns - self.begin_ns, -limit, limit)
        frames: Index = since_ns * self._fps // SECOND
        return frames

    def sample_frame_of(self, stamp_ns: Times) -> Index:
        """Return the frame of each sample (N,); some links sample a little before the first row."""
        return np.maximum(self.frame_of(stamp_ns), 0)

    def count(
        self,
        cube: Index,
        stamp_ns: Times,
        n_cubes: int,
        max_frames: float,
    ) -> None:
        """Count samples.

        Args:
            cube: (N,) index of the cube of each sample.
            stamp_ns: (N,) stamps, in ns.
            n_cubes: Number of cubes of the skin.
            max_frames: Number of frames that the recording can have.

        Raises:
            BagError: A stamp is too far from the first one.
        """
        inside = self.contains(stamp_ns)
        cube = cube[inside]
        stamp_ns = stamp_ns[inside]
        if not len(cube):
            return
        # The first rows decide where frame 0 begins; rows that come late are put into it.
        if not self.rows:
            self.begin_ns = int(stamp_ns.min())
        frame = self.sample_frame_of(stamp_ns)
        n_frames = int(frame.max()) + 1
        if n_frames > max_frames:
            late_s = (int(stamp_ns.max()) - self.begin_ns) / SECOND
            raise BagError(
                f"a sample is stamped {late_s:.0f} s after the first of its episode, "
                "which is longer than was recorded: a clock was set; leave it out with --marks"
            )
        if n_frames > len(self.counts):
            # The number of frames is known only at the end: the table grows by half each time.
            room = 3 * n_frames // 2
            larger = np.zeros((room, n_cubes), np.uint32)
            larger[: len(self.counts)] = self.counts
            self.counts = larger
        self.rows += len(cube)
        np.add.at(self.counts, (frame, cube), 1)

    def finish(self) -> None:
        """Remove the empty frames behind the last sample, once all samples are counted."""
        has_samples = self.counts.any(axis=1)
        last = np.flatnonzero(has_samples)[-1]
        self.counts = self.counts[: last + 1]


@dataclass(frozen=True, eq=False)
class BagPlan:
    """What is exported of a bag.

    Attributes:
        path: The bag.
        skin: Its skin.
        episodes: Its episodes that have samples.
        rate: Samples of a cube per second, the median of all cubes.
        outside: Number of rows outside of all episodes.
        unknown: Number of rows of cubes that the skin does not have.
        empty: Number of marks without a sample.
    """

    path: Path
    skin: Skin
    episodes: list[Episode]
    rate: float
    outside: int
    unknown: int
    empty: int


def plan_bag(
    path: Path,
    choices: Choices,
    report: Report,
) -> BagPlan:
    """Count the samples of a bag.

    Raises:
        BagError: There are no frequencies or no marks, the stamps do not follow time, or there are
            more frames than samples.
    """
    with open_bag(path, choices.frequencies) as source:
        # Number of messages, for the report.
        counts = {one.topic: one.msgcount for one in source.bag.connections}
        total = counts[source.topic]
        spans = [(MIN_NS, MAX_NS, choices.task)]
        if choices.marks is not None:
            spans = _marked_spans(source.bag, choices.marks)
        episodes = [Episode(*span, choices.fps) for span in spans]
        n_cubes = len(source.skin.cubes)
        recorded_s = (source.bag.end_ns - source.bag.start_ns) / SECOND
        max_frames = MAX_STAMP_RATIO * recorded_s * choices.fps + ALWAYS_ALLOWED

        samples = np.zeros(n_cubes, np.int64)
        first_ns, last_ns = MAX_NS, MIN_NS
        for rows in source:
            is_known = rows.cube < n_cubes
            cube = rows.cube[is_known].astype(np.intp)
            stamp_ns = rows.stamp_ns[is_known]
            if len(cube):
                samples += np.bincount(cube, minlength=n_cubes)
                first_ns = min(first_ns, int(stamp_ns.min()))
                last_ns = max(last_ns, int(stamp_ns.max()))
                for episode in episodes:
                    try:
                        episode.count(cube, stamp_ns, n_cubes, max_frames)
                    except BagError as error:
                        raise BagError(f"{path}: {error}") from None
            report(source.messages, total, f"counting {path}")

    covered_s = (last_ns - first_ns) / SECOND
    rate = _check_rate(
        source,
        samples,
        covered_s,
        choices.fps,
    )
    # A mark at the end of a recording often has no sample behind it.
    used = [episode for episode in episodes if episode.rows]
    for episode in used:
        episode.finish()
        _check_depth(source, episode, math.ceil(rate / choices.fps))
    known_rows = int(samples.sum())
    return BagPlan(
        path=path,
        skin=source.skin,
        episodes=used,
        rate=rate,
        outside=known_rows - sum(episode.rows for episode in used),
        unknown=source.rows - known_rows,
        empty=len(episodes) - len(used),
    )


def _check_rate(
    source: BagSource,
    samples: Index,
    seconds: float,
    fps: int,
) -> float:
    """Return the sample rate of a bag, in Hz, if every frame can have a sample.

    Args:
        source: The bag.
        samples: (cubes,) number of samples.
        seconds: Time that the stamps cover, in s.
        fps: Frames per second.
    """
    path = source.bag.path
    # One sample tells no rate, and a hub that was unplugged would lower it.
    several = samples[samples > 1]
    if not len(several) or seconds <= 0:
        raise BagError(
            f"{path}: {samples.sum()} samples on {source.topic}, and no two of one cube; "
            "record longer"
        )
    rate = float(np.median(several - 1)) / seconds
    # n samples bound n - 1 periods.
    fewest = int(several.min())
    max_fps = math.floor(rate * (1 + 1 / fewest))
    if max_fps < 1:
        raise BagError(
            f"{path}: the cubes were sampled {rate:.2g} times per second; LeRobot counts "
            "whole frames per second, and needed is at least one sample in each"
        )
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
    """Check that no frame has far more samples than usual, which would lengthen every window."""
    depth = int(episode.counts.max())
    if depth > MAX_DEPTH_RATIO * usual + ALWAYS_ALLOWED:
        deepest = episode.counts.argmax()
        frame, cube = np.unravel_index(deepest, episode.counts.shape)
        raise BagError(
            f"{source.bag.path}: {depth} samples of cube {source.skin.names[cube]} in frame "
            f"{frame}, usual are {usual}: stamps do not follow time; leave that time out with "
            "--marks"
        )


def _marked_spans(bag: Bag, topic: str) -> list[tuple[int, int, str]]:
    """Return begin, end and task of the episodes that marks bound.

    A mark is a text at the time when it was recorded: it begins an episode with this task, and ends
    the one before. An empty text only ends one.
    """
    if topic not in bag.topics(MARK):
        names = ", ".join(bag.topics(MARK)) or "none"
        raise BagError(f"{bag.path}: no marks ({MARK}) on {topic}; topics of that type: {names}")
    marks = []
    for entry in bag.entries({topic}):
        text = bag.decode(entry).data.strip()
        marks.append((entry.time_ns, text))
    marks.append((MAX_NS, ""))
    spans = []
    for (since_ns, task), (until_ns, _) in pairwise(marks):
        if task:
            spans.append((since_ns, until_ns, task))
    if not spans:
        raise BagError(f"{bag.path}: no mark on {topic} begins an episode; publish its task there")
    return spans
