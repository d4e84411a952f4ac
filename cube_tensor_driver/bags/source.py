# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A bag as a source: the recorded frequencies of one skin, delivered like those of a device."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..config.skin import Skin
from ..core.arrays import AnyArray, Array, Index, Mask, Times
from ..core.errors import BagError
from ..core.reconstructor import RecordedHealth
from ..core.rows import FrequencyRows
from ..messages.codec import Decoded
from ..messages.types import FREQUENCIES_TYPE
from .read import Bag
from .recorded_compensation import RecordedCompensation
from .recording import Recording


class Segment(NamedTuple):
    """Consecutive messages of frequencies with the same cubes, reconstructed with one SkinInfo.

    Attributes:
        messages: M messages of frequencies.
        recorded_ns: (M,) time at which each message was recorded, in ns since the Unix epoch.
        number: Index in `Recording.infos` of the SkinInfo message (calibrations and rest
            frequencies) with which these frequencies were reconstructed.
        states: States of creep and temperature, by name, that the reconstruction had before the
            first of these messages; empty: it continued with its states after the message before.
        health: Recorded health of the pads for the rows; None: it was not asked for.
    """

    messages: Decoded[FrequencyRows]
    recorded_ns: Times
    number: int
    states: Mapping[str, Array]
    health: RecordedHealth | None


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

        Successive messages are delivered together if their reconstruction then gives the same
        stress as that of one message after the other. This is faster.

        Raises:
            BagError: The bag is damaged.
        """
        for segment in self.read_segments():
            yield segment.messages.rows

    def statistics(self) -> dict[str, object]:
        """Return the numbers of messages and rows delivered so far, and of damaged messages."""
        return {
            "messages": self.messages,
            "rows": self.rows,
            "skipped": self.bag.skipped[self.topic],
        }

    def skip(self, segment: Segment, error: Exception) -> None:
        """Count the messages of a segment as left out instead of delivered.

        Args:
            segment: Messages of frequencies that the reconstruction refused.
            error: Why it refused them.
        """
        count = len(segment.messages)
        self.messages -= count
        self.rows -= len(segment.messages.rows)
        self.bag.skip(
            self.topic,
            int(segment.recorded_ns[0]),
            error,
            count,
        )

    def read_segments(
        self,
        *,
        use_health: bool = False,
        join: bool = True,
    ) -> Iterator[Segment]:
        """Yield all messages in the order of recording, with their rows (samples of cubes).

        Each segment has successive messages with the same cubes, SkinInfo (calibrations and rest
        frequencies) and compensation (removal of weight, creep and temperature).

        Args:
            use_health: Whether to read the recorded health of the pads, too.
            join: Whether a segment may have several messages.

        Raises:
            BagError: The bag is damaged.
        """
        for messages, recorded_ns in self.bag.read_frequencies(self.topic):
            # The health is read before messages are divided, because the recorded stress was
            # decoded in the same groups.
            health = self.recording.health.find(messages.rows) if use_health else None
            yield from self._divide(messages, recorded_ns, health, join)

    def _divide(
        self,
        messages: Decoded[FrequencyRows],
        recorded_ns: Times,
        health: RecordedHealth | None,
        join: bool,
    ) -> Iterator[Segment]:
        """Divide successive messages of frequencies into segments.

        Args:
            messages: M messages of frequencies.
            recorded_ns: (M,) time at which each was recorded, in ns since the Unix epoch.
            health: Recorded health of the pads for their rows, or None.
            join: Whether a segment may have several messages.
        """
        n_rows = len(messages.rows) // len(messages)
        cube = messages.group_by_message(messages.rows.cube)
        info_index = self._find_infos(messages)
        compensation = self.recording.compensation
        recorded = [compensation.find(stamp_ns) for stamp_ns in messages.stamp_ns.tolist()]

        begins = np.flatnonzero(_begins_segment(cube, info_index, recorded)) + 1
        bounds = [0, *begins.tolist(), len(messages)]
        for begin, end in pairwise(bounds):
            # Rows with rising cube indices count as one scan, and the health depends on the scans.
            # So messages are joined only if the index does not rise from the last row of a message
            # to the first row of the next one: otherwise two scans would become one.
            order = cube[begin]
            can_join = join and len(order) and order[0] <= order[-1]
            step = end - begin if can_join else 1
            for first in range(begin, end, step):
                chosen = slice(first, first + step)
                part = compensation.add_forces(messages.select(chosen), recorded[chosen])
                self.messages += len(part)
                self.rows += len(part.rows)
                rows = slice(first * n_rows, (first + step) * n_rows)
                yield Segment(
                    messages=part,
                    recorded_ns=recorded_ns[chosen],
                    number=int(info_index[first]),
                    states=recorded[first].states,
                    health=health.select(rows) if health else None,
                )

    def _find_infos(self, messages: Decoded[FrequencyRows]) -> Index:
        """Return the indices (M,) in `Recording.infos` of the SkinInfo for each of M messages."""
        times_ns = messages.group_by_message(messages.rows.stamp_ns)
        # A message without rows has no newest row, so the stamp in its header is used.
        newest_ns: Times = times_ns.max(axis=1) if times_ns.size else messages.stamp_ns
        return self.recording.find_info_index(newest_ns)


def _begins_segment(
    cube: AnyArray,
    info_index: AnyArray,
    recorded: Sequence[RecordedCompensation],
) -> Mask:
    """Return whether a new segment begins at each message, so that it is reconstructed separately.

    Args:
        cube: (M, N) cube index of each of N rows in M messages.
        info_index: (M,) index of the SkinInfo (calibrations and rest frequencies) that applies.
        recorded: Compensation of each message.

    Returns:
        (M - 1,) for all messages except the first: whether its cubes, its SkinInfo or the use of
        weight compensation change, or it begins with recorded states of creep and temperature.
    """
    has_motion: Mask = np.array([one.motion is not None for one in recorded])
    has_states: Mask = np.array([bool(one.states) for one in recorded])
    has_other_cubes = (cube[1:] != cube[:-1]).any(axis=1)
    has_other_info = info_index[1:] != info_index[:-1]
    has_other_effects = has_motion[1:] != has_motion[:-1]
    begins: Mask = has_other_cubes | has_other_info | has_other_effects | has_states[1:]
    return begins


def open_bag(path: Path | str, topic: str | None = None) -> BagSource:
    """Open the recorded frequencies of one skin in a bag.

    Args:
        path: Folder or file of the bag.
        topic: Topic of the frequencies; None: the topic of the only skin in the bag.

    Raises:
        BagError: There is no bag, no such topic, no SkinInfo message for it, or no topic was given
            although the bag has several skins.
    """
    # The returned source closes the bag. If an error occurs before, the bag is closed here.
    bag = Bag(Path(path))
    try:
        topics = bag.list_topics(FREQUENCIES_TYPE)
        if topic is None:
            topic = f"{bag.find_skin_prefix()}frequencies"
        elif topic not in topics:
            found = ", ".join(topics) or "none"
            raise BagError(f"{path}: no frequencies on {topic}; there are {found}")
        return BagSource(bag, topic)
    except BaseException:
        bag.close()
        raise
