# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What a bag states about compensation: motion of the skin, states of creep and temperature.

A message on the topic `compensation` belongs to the message of frequencies that has the same stamp,
and to the message of stress that was computed from those frequencies.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from ..core.arrays import Array
from ..core.compensation.motion import UNKNOWN_MOTION, ForcesAtCubes, Motion
from ..core.errors import MessageError
from ..core.poses import CubePoses
from ..core.rows import FrequencyRows, concatenate
from ..messages.codec import Decoded
from ..messages.compensation import read_motion, read_states
from ..messages.types import COMPENSATION_TYPE
from .read import MAX_DISORDER_NS, Bag, read_stamp_ns

if TYPE_CHECKING:
    from ..msg import SkinCompensation


class RecordedCompensation(NamedTuple):
    """Compensation of weight, creep and temperature that applied to one message of frequencies.

    The default values apply if the bag has no messages on the topic `compensation`.

    Attributes:
        motion: Motion of the skin, which determines the effect of its weight; None: weight is not
            compensated.
        states: Name of an effect (creep, thermal) -> its state before the first sample of the
            message.
    """

    motion: Motion | None = None
    states: Mapping[str, Array] = MappingProxyType({})


class CompensationReader:
    """Reads from a bag how weight, creep and temperature were compensated during the recording.

    Calls of `find` in the order of recording are fastest. For a stamp that is more than
    `MAX_DISORDER_NS` older than that of the previous call, the bag is read again from its start.

    Attributes:
        is_recorded: Whether the bag has messages on the topic `compensation` of the skin.
    """

    def __init__(self, bag: Bag, topic: str, poses: CubePoses) -> None:
        """Prepare to read the topic `compensation` of one skin.

        Args:
            bag: Open bag.
            topic: Topic of the skin's frequencies, which has the same prefix as `compensation`.
            poses: Poses of the cubes in the SkinInfo messages.
        """
        skin = topic.removesuffix("frequencies")
        self._bag = bag
        self._topic = f"{skin}compensation"
        self.is_recorded = self._topic in bag.list_topics(COMPENSATION_TYPE)
        self._forces = ForcesAtCubes(poses)
        self._restart()

    def _restart(self) -> None:
        self._unread = self._read()
        self._known: dict[int, RecordedCompensation] = {}
        # Result for a message of frequencies without a message on the topic `compensation`.
        self._default = RecordedCompensation()
        self._newest_ns = 0
        self._wanted_ns = 0

    def find(self, wanted_ns: int) -> RecordedCompensation:
        """Return the recorded compensation of one message of frequencies.

        Args:
            wanted_ns: Stamp in the header of the message of frequencies, in ns since the Unix
                epoch.

        Returns:
            Content of the message on the topic `compensation` with the same stamp. If there is no
            such message, the motion is `UNKNOWN_MOTION` if an earlier message contains a motion;
            otherwise nothing is compensated.
        """
        if not self.is_recorded:
            return self._default
        if wanted_ns < self._wanted_ns - MAX_DISORDER_NS:
            self._restart()
        self._wanted_ns = wanted_ns
        # Messages can be out of order, so the wanted message counts as missing only after a message
        # has been read whose stamp is later by `MAX_DISORDER_NS`.
        last_ns = wanted_ns + MAX_DISORDER_NS
        while wanted_ns not in self._known and self._newest_ns < last_ns:
            item = next(self._unread, None)
            if item is None:
                break
            self._newest_ns, recorded = item
            self._known[self._newest_ns] = recorded
            if recorded.motion is not None:
                self._default = RecordedCompensation(UNKNOWN_MOTION)
            # Messages are read nearly in the order of their stamps, so the first one that is kept
            # is the oldest.
            oldest_ns = next(iter(self._known))
            if oldest_ns < wanted_ns - MAX_DISORDER_NS:
                del self._known[oldest_ns]
        return self._known.get(wanted_ns, self._default)

    def add_forces(
        self,
        messages: Decoded[FrequencyRows],
        recorded: Sequence[RecordedCompensation],
    ) -> Decoded[FrequencyRows]:
        """Return messages of frequencies with the specific force on each cube added to their rows.

        The specific force (acceleration minus gravity) determines the effect of weight.

        Args:
            messages: M messages of frequencies.
            recorded: Compensation of each message, as `find` returns it. If the first one does not
                compensate weight, the messages are returned unchanged.
        """
        if recorded[0].motion is None:
            return messages
        parts = []
        for number, compensation in enumerate(recorded):
            rows = messages.select(slice(number, number + 1)).rows
            motion = compensation.motion or UNKNOWN_MOTION
            parts.append(self._forces.add_to(rows, motion))
        return replace(messages, rows=concatenate(parts))

    def _read(self) -> Iterator[tuple[int, RecordedCompensation]]:
        """Yield the stamp, in ns since the Unix epoch, and the content of each message.

        The messages are those on the topic `compensation`, in the order of recording.
        """
        topics = {self._topic} if self.is_recorded else set()
        message: SkinCompensation
        for time_ns, message in self._bag.read_decoded(topics):
            at_ns = read_stamp_ns(message)
            try:
                motion = read_motion(message, at_ns)
                states = read_states(message)
            except MessageError as error:
                self._bag.skip(self._topic, time_ns, error)
            else:
                yield at_ns, RecordedCompensation(motion, states)
