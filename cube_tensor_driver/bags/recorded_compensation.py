# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What a bag states about compensation: motion of the skin, states of creep and temperature.

The messages of `compensation` have the stamps of the messages of stress, and so those of the
frequencies, to which they belong.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

from ..core.arrays import Array
from ..core.compensation.motion import UNKNOWN_MOTION, ForcesAtCubes, Motion
from ..core.errors import MessageError
from ..core.poses import CubePoses
from ..core.rows import FrequencyRows, concatenate
from ..messages.codec import SECOND, Decoded
from ..messages.compensation import read_motion, read_states
from ..messages.types import COMPENSATION
from .read import Bag, stamp_ns

MAX_DISORDER_NS = SECOND
"""Largest time, in ns, by which messages in a bag may be out of the order of their stamps."""


class RecordedCompensation(NamedTuple):
    """What one message of `compensation` states; the defaults are for a bag without any.

    Attributes:
        motion: Motion of the skin; None: weight is not compensated.
        states: States of effects before the first row of the message of frequencies, by name.
    """

    motion: Motion | None = None
    states: Mapping[str, Array] = MappingProxyType({})


class CompensationReader:
    """Reads what a bag states about compensation for messages of frequencies.

    Calls in the order of recording are fastest. For messages that are more than `MAX_DISORDER_NS`
    older than those of the call before, the bag is read again from its beginning.

    Attributes:
        is_recorded: Whether the bag has messages of `compensation`.
    """

    def __init__(self, bag: Bag, topic: str, poses: CubePoses) -> None:
        """Prepare to read the messages of `compensation` that were recorded with frequencies.

        Args:
            bag: Open bag.
            topic: Topic of the frequencies. The name of the topic of compensation follows from it.
            poses: Poses of the cubes in the SkinInfo messages.
        """
        self._bag, self._topic = bag, topic.removesuffix("frequencies") + "compensation"
        self.is_recorded = self._topic in bag.topics(COMPENSATION)
        self._forces = ForcesAtCubes(poses)
        self._restart()

    def _restart(self) -> None:
        self._unread = self._read()
        self._known: dict[int, RecordedCompensation] = {}
        # What holds for a message of frequencies whose message of compensation is missing.
        self._missing = RecordedCompensation()
        self._newest_ns = 0
        self._wanted_ns = 0

    def at(self, wanted_ns: int) -> RecordedCompensation:
        """Return the compensation that the bag has recorded for one message of frequencies.

        Args:
            wanted_ns: Stamp in the header of the message of frequencies, in ns since the Unix
                epoch.

        Returns:
            Motion of the skin and states of effects (creep, temperature) from the message of
            `compensation` with this stamp. If the bag has none: unknown motion if an earlier
            message has one, else no compensation.
        """
        if wanted_ns < self._wanted_ns - MAX_DISORDER_NS:
            self._restart()
        self._wanted_ns = wanted_ns
        # Without a message of compensation there is nothing to read, and the loop ends at once.
        while wanted_ns not in self._known and self._newest_ns < wanted_ns + MAX_DISORDER_NS:
            item = next(self._unread, None)
            if item is None:
                break
            self._newest_ns, recorded = item
            self._known[self._newest_ns] = recorded
            if recorded.motion is not None:
                self._missing = RecordedCompensation(UNKNOWN_MOTION)
            # Messages come nearly in the order of their stamps, so the first is the oldest.
            oldest_ns = next(iter(self._known))
            if oldest_ns < wanted_ns - MAX_DISORDER_NS:
                del self._known[oldest_ns]
        return self._known.get(wanted_ns, self._missing)

    def add_forces(
        self, messages: Decoded[FrequencyRows], recorded: Sequence[RecordedCompensation]
    ) -> Decoded[FrequencyRows]:
        """Return messages whose rows have specific forces.

        Args:
            messages: M messages of frequencies.
            recorded: What is stated for each of them. If weight is not compensated in the first,
                the messages are returned as they are.
        """
        if recorded[0].motion is None:
            return messages
        parts = []
        for k, one in enumerate(recorded):
            rows = messages.select(slice(k, k + 1)).rows
            motion = one.motion or UNKNOWN_MOTION
            parts.append(self._forces.add_to(rows, motion))
        return replace(messages, rows=concatenate(parts))

    def _read(self) -> Iterator[tuple[int, RecordedCompensation]]:
        """Yield stamp and content of the messages in the order of recording."""
        topics = {self._topic} if self.is_recorded else set()
        for time_ns, message in self._bag.decoded(topics):
            try:
                motion = read_motion(message, stamp_ns(message))
                yield stamp_ns(message), RecordedCompensation(motion, read_states(message))
            except MessageError as error:
                self._bag.skip(self._topic, time_ns, error)
