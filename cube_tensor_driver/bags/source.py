# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A bag as a source: the recorded frequencies of one skin, delivered like those of a device."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..config.skin import Skin
from ..core.arrays import Array, Times
from ..core.errors import BagError
from ..core.rows import FrequencyRows
from ..messages.codec import Decoded
from ..messages.types import FREQUENCIES
from .read import Bag
from .recording import Recording


class Segment(NamedTuple):
    """Consecutive messages of frequencies with the same cubes, reconstructed with one SkinInfo.

    Attributes:
        messages: M messages of frequencies.
        recorded_ns: (M,) time at which each was recorded, in ns since the Unix epoch.
        number: Index in `Recording.infos` of the SkinInfo message (calibrations and rest
            frequencies) with which these frequencies were reconstructed.
        states: States of creep and temperature, by name, that the reconstruction had before the
            first of these messages; empty: it went on from the message before.
    """

    messages: Decoded[FrequencyRows]
    recorded_ns: Times
    number: int
    states: Mapping[str, Array]


class BagSource:
    """The frequencies on one topic of a bag; a context manager that closes the bag.

    Attributes:
        bag: The open bag.
        topic: Topic of the frequencies.
        recording: Calibrations, rest frequencies and health of the pads at the time of each row.
        skin: The skin (cubes, their poses and calibrations) as the bag describes it.
        is_live: Always false, because a bag delivers its rows faster than they were measured.
        messages: Number of messages delivered so far.
        rows: Number of rows (samples of cubes) delivered so far.
    """

    is_live = False

    def __init__(self, bag: Bag, topic: str) -> None:
        """Prepare to read a topic.

        Args:
            bag: Open bag.
            topic: Topic of the frequencies.

        Raises:
            BagError: The bag has no SkinInfo message for the topic, or one that is invalid.
        """
        self.bag, self.topic = bag, topic
        self.recording = Recording(bag, topic)
        self.skin: Skin = self.recording.skin
        self.messages = self.rows = 0

    def __repr__(self) -> str:
        seconds = (self.bag.end_ns - self.bag.start_ns) * 1e-9
        return f"BagSource({str(self.bag.path)!r}, {self.topic}: {self.skin!r}, {seconds:.1f} s)"

    def __enter__(self) -> BagSource:
        return self

    def __exit__(self, *error: object) -> None:
        self.bag.close()

    def __iter__(self) -> Iterator[FrequencyRows]:
        """Yield all rows (samples of cubes) in the order of recording.

        The rows of several messages are delivered together, which is faster, where reconstructing
        them together gives the same stress as one message after the other.

        Raises:
            BagError: The bag is damaged.
        """
        for segment in self.segments():
            yield segment.messages.rows

    def statistics(self) -> dict[str, object]:
        """Return the numbers of messages and rows delivered so far, and of damaged messages."""
        skipped = self.bag.skipped[self.topic]
        return {"messages": self.messages, "rows": self.rows, "skipped": skipped}

    def skip(self, segment: Segment, error: Exception) -> None:
        """Count the messages of a segment as left out instead of delivered.

        Args:
            segment: Messages of frequencies that the reconstruction refused.
            error: Why it refused them.
        """
        count = len(segment.messages)
        self.messages -= count
        self.rows -= len(segment.messages.rows)
        self.bag.skip(self.topic, int(segment.recorded_ns[0]), error, count)

    def segments(self) -> Iterator[Segment]:
        """Yield all messages in the order of recording, with their rows (samples of cubes).

        Each segment has successive messages of the same cubes to which one SkinInfo (calibrations
        and rest frequencies) applies.

        Raises:
            BagError: The bag is damaged.
        """
        for messages, recorded_ns in self.bag.frequencies(self.topic):
            cube = messages.by_message(messages.rows.cube)
            times_ns = messages.by_message(messages.rows.stamp_ns)
            # A message without rows has no newest row, so its own stamp is used.
            newest_ns = times_ns.max(axis=1) if times_ns.size else messages.stamp_ns
            number = self.recording.number_at(newest_ns)
            compensation = self.recording.compensation
            recorded = [compensation.at(stamp_ns) for stamp_ns in messages.stamp_ns.tolist()]

            # A segment (messages reconstructed together) ends where the next message has other
            # cubes, a newer SkinInfo message (calibrations, rest frequencies) applies, or the next
            # message states what is compensated, or from which state on.
            has_other_cubes = (cube[1:] != cube[:-1]).any(axis=1)
            has_other_info = number[1:] != number[:-1]
            has_motion = np.array([one.motion is not None for one in recorded])
            has_other_effects = has_motion[1:] != has_motion[:-1]
            has_states = np.array([bool(one.states) for one in recorded[1:]], bool)
            is_end = has_other_cubes | has_other_info | has_other_effects | has_states
            ends = np.flatnonzero(is_end) + 1
            for begin, end in pairwise([0, *ends.tolist(), len(messages)]):
                # A scan ends where the cube number does not rise. Messages are reconstructed
                # together only if their scans stay apart, so that the health finds the same scans.
                are_apart = len(cube[begin]) and cube[begin, 0] <= cube[begin, -1]
                step = end - begin if are_apart else 1
                for first in range(begin, end, step):
                    chosen = slice(first, first + step)
                    part = compensation.add_forces(messages.select(chosen), recorded[chosen])
                    self.messages += len(part)
                    self.rows += len(part.rows)
                    yield Segment(
                        messages=part,
                        recorded_ns=recorded_ns[chosen],
                        number=int(number[first]),
                        states=recorded[first].states,
                    )


def open_bag(path: Path | str, topic: str | None = None) -> BagSource:
    """Open the recorded frequencies of one skin in a bag.

    Args:
        path: Folder or file of the bag.
        topic: Topic of the frequencies; None: that of the only skin in the bag.

    Raises:
        BagError: There is no bag, no such topic, no SkinInfo message for it, or no topic was given
            although the bag has several skins.
    """
    # The returned source closes the bag. If an error occurs before, the bag is closed here.
    bag = Bag(Path(path))
    bag.open()
    try:
        topics = bag.topics(FREQUENCIES)
        if topic is None:
            topic = f"{bag.skin()}frequencies"
        elif topic not in topics:
            raise BagError(
                f"{path}: no frequencies on {topic}; there are {', '.join(topics) or 'none'}"
            )
        return BagSource(bag, topic)
    except BaseException:
        bag.close()
        raise
