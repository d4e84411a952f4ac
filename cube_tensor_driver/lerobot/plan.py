"""The first pass over a bag: its episodes, and how many samples of each cube every frame holds.

A window has one size in the whole data set, so it must be known before the first is written.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bags.read import Bag
from ..bags.source import BagSource, open_bag
from ..config.skin import Skin
from ..core.errors import BagError
from .frames import SECOND, Frames

MARK = "std_msgs/msg/String"
FIRST_NS, LAST_NS = -(1 << 63), (1 << 63) - 1
LONGEST = 10
"""How many times as long as the recording the stamps may last: replayed bags may be faster."""
DEEPEST = 10
"""How many times as many samples as usual a frame may hold."""
SLACK = 100
"""Frames, or samples, that short recordings may have more than these bounds."""
BLOCK = 256
"""Frames that are counted in one array."""


@dataclass(frozen=True)
class Span:
    """When an episode was recorded, since_ns <= t < until_ns, and what was done in it."""

    since_ns: int
    until_ns: int
    task: str


@dataclass(frozen=True, eq=False)
class Episode:
    """An episode of a bag. counts: (frames, cubes) samples of each cube in each frame."""

    span: Span
    frames: Frames
    counts: NDArray[np.uint32]

    def rows_in(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(N,) which samples belong to it."""
        return (stamp_ns >= self.span.since_ns) & (stamp_ns < self.span.until_ns)

    def frame_of(self, stamp_ns: NDArray[np.int64]) -> NDArray[Any]:
        """(N,) the frame of each sample. Some links sample a little before the first row."""
        return np.maximum(self.frames.number_of(stamp_ns), 0)


@dataclass(frozen=True, eq=False)
class BagPlan:
    """What is exported of a bag.

    rate: samples of a cube per second, the median of all cubes
    outside: rows outside of all episodes; unknown: rows of cubes that the skin does not have
    empty: marks without a sample
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
    fps: int,
    topic: str | None,
    task: str,
    marks: str | None,
    report: Callable[[int, int], None],
) -> BagPlan:
    """Count the samples of a bag.

    topic: of the frequencies; marks: topic of the marks, None: the bag is one episode
    BagError: no frequencies, no marks, stamps that do not follow time, fps above the sample rate.
    """
    with open_bag(path, topic) as source:
        total = sum(c.msgcount for c in source.bag.connections if c.topic == source.topic)
        spans = [Span(FIRST_NS, LAST_NS, task)] if marks is None else marked(source.bag, marks)
        cubes = len(source.skin.cubes)
        seconds = (source.bag.end_ns - source.bag.start_ns) / SECOND
        counters = [_Counter(span, fps, cubes, seconds, path) for span in spans]
        unknown = 0
        samples = np.zeros(cubes, np.int64)
        first_ns, last_ns = LAST_NS, FIRST_NS
        for rows in source:
            known = rows.cube < cubes
            unknown += int(len(rows) - known.sum())
            cube, stamp_ns = rows.cube[known], rows.stamp_ns[known]
            if len(cube):
                samples += np.bincount(cube, minlength=cubes)
                first_ns = min(first_ns, int(stamp_ns.min()))
                last_ns = max(last_ns, int(stamp_ns.max()))
                for counter in counters:
                    counter.add(cube, stamp_ns)
            report(source.messages, total)
        return _plan(source, counters, samples, (first_ns, last_ns), unknown, fps)


def _plan(
    source: BagSource,
    counters: list[_Counter],
    samples: NDArray[np.int64],
    covered_ns: tuple[int, int],
    unknown: int,
    fps: int,
) -> BagPlan:
    """BagError: as `plan_bag`."""
    path = source.bag.path
    seconds = (covered_ns[1] - covered_ns[0]) / SECOND
    there = samples[samples > 1]
    if not len(there) or seconds <= 0:
        raise BagError(
            f"{path}: {samples.sum()} samples on {source.topic}, and no two of one cube; "
            "record longer"
        )
    rate = float(np.median(there - 1)) / seconds
    most = math.floor(rate * (1 + 1 / min(there)))
    if fps > most:
        raise BagError(
            f"{path}: --fps {fps}: the cubes were sampled {rate:.4g} times per second, so that "
            f"frames would be without a sample; give at most {most}"
            if most
            else f"{path}: the cubes were sampled {rate:.2g} times per second; LeRobot counts "
            "whole frames per second, and needed is at least one sample in each"
        )
    episodes = [counter.episode() for counter in counters if counter.rows]
    usual = math.ceil(rate / fps)
    for episode in episodes:
        deepest = int(episode.counts.max())
        if deepest > DEEPEST * usual + SLACK:
            frame, cube = np.unravel_index(episode.counts.argmax(), episode.counts.shape)
            raise BagError(
                f"{path}: {deepest} samples of cube {source.skin.names[cube]} in frame {frame}, "
                f"usual are {usual}: stamps do not follow time; leave that time out with --marks"
            )
    inside = sum(counter.rows for counter in counters)
    return BagPlan(
        path,
        source.skin,
        episodes,
        rate,
        int(samples.sum()) - inside,
        unknown,
        len(counters) - len(episodes),
    )


class _Counter:
    """Counts the samples of one episode while its number of frames is not known yet."""

    def __init__(self, span: Span, fps: int, cubes: int, seconds: float, path: Path) -> None:
        """seconds: how long the recording lasts."""
        self.rows = 0
        self._span, self._fps, self._cubes, self._path = span, fps, cubes, path
        self._most = LONGEST * seconds * fps + SLACK
        self._blocks: dict[int, NDArray[np.uint32]] = {}
        self._frames: Frames | None = None
        self._last = 0

    def add(self, cube: NDArray[np.uint16], stamp_ns: NDArray[np.int64]) -> None:
        """BagError: a stamp is too far from the first."""
        inside = (stamp_ns >= self._span.since_ns) & (stamp_ns < self._span.until_ns)
        if not inside.all():
            cube, stamp_ns = cube[inside], stamp_ns[inside]
        if not len(cube):
            return
        if self._frames is None:
            self._frames = Frames(int(stamp_ns.min()), self._fps)
        number = np.maximum(self._frames.number_of(stamp_ns), 0)
        self._last = max(self._last, int(number.max()))
        if self._last > self._most:
            late = (int(stamp_ns.max()) - self._frames.begin_ns) / SECOND
            raise BagError(
                f"{self._path}: a sample is stamped {late:.0f} s after the first of its episode, "
                "which is longer than was recorded: a clock was set; leave it out with --marks"
            )
        self.rows += len(cube)
        for block in np.unique(number // BLOCK).tolist():
            counts = self._blocks.setdefault(block, np.zeros((BLOCK, self._cubes), np.uint32))
            mine = number // BLOCK == block
            places = (number[mine] - block * BLOCK) * self._cubes + cube[mine]
            np.add.at(counts.reshape(-1), places, 1)

    def episode(self) -> Episode:
        """Once all rows were added; some were."""
        counts = np.zeros((self._last + 1, self._cubes), np.uint32)
        for block, part in self._blocks.items():
            some = counts[block * BLOCK : (block + 1) * BLOCK]
            some[:] = part[: len(some)]
        return Episode(self._span, self._frames or Frames(0, self._fps), counts)


def marked(bag: Bag, topic: str) -> list[Span]:
    """The episodes that marks bound. BagError: there are none.

    A mark is a text at the time when it was recorded: it begins an episode with this task, and
    ends the one before. An empty text only ends one.
    """
    if topic not in bag.topics(MARK):
        names = ", ".join(bag.topics(MARK)) or "none"
        raise BagError(f"{bag.path}: no marks ({MARK}) on {topic}; topics of that type: {names}")
    marks = [(entry.time_ns, bag.decode(entry).data.strip()) for entry in bag.entries({topic})]
    spans = list(_spans([*marks, (LAST_NS, "")]))
    if not spans:
        raise BagError(f"{bag.path}: no mark on {topic} begins an episode; publish its task there")
    return spans


def _spans(marks: list[tuple[int, str]]) -> Iterator[Span]:
    for (since_ns, task), (until_ns, _) in pairwise(marks):
        if task:
            yield Span(since_ns, until_ns, task)
