# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Log of the messages of topics as they arrive, with the gaps in the numbers that DDS gives them.

A gap means that a message was sent and did not arrive here. So what this process missed can be told
from what nobody sent. Messages are taken without an executor, because only then the numbers are
available.
"""

from __future__ import annotations

from itertools import groupby
from typing import Any, Generic, NamedTuple

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile

from cube_tensor_driver.config.skin import Skin
from cube_tensor_driver.core.arrays import AnyArray
from cube_tensor_driver.core.errors import MessageError
from cube_tensor_driver.core.rows import concatenate
from cube_tensor_driver.messages.codec import AnyRows, MessageCodec

from ..checks.record import Received

MESSAGES_PER_DECODING = 500
"""Number of messages that are decoded together, which takes less time than decoding one by one."""

MAX_MESSAGES_TAKEN = 300
"""Maximum number of messages that are taken at a time, so that this process also does other
things."""


class Message(NamedTuple):
    """A serialised message, the number that DDS gave it, and the wall clock when it was sent."""

    data: bytes
    number: int
    sent_ns: int


class TopicLog(Generic[AnyRows]):
    """Collects all rows (one cube at one sampling time each) of one batch topic.

    Attributes:
        count: Number of messages so far.
    """

    def __init__(
        self,
        node: Node,
        kind: type,
        topic: str,
        quality: QoSProfile,
        codec: MessageCodec[AnyRows],
        skin: Skin,
    ) -> None:
        """Subscribe to a topic.

        Args:
            node: Node of the subscription, which has no executor.
            kind: Type of the messages.
            topic: Name of the topic.
            quality: Quality of service.
            codec: Codec of the messages.
            skin: The skin.
        """
        self.count = 0
        self._kind = kind
        self._codec: MessageCodec[AnyRows] = codec
        self._frame_id = skin.parent_frame.encode() + b"\0"
        self._subscription: Any = node.create_subscription(
            kind, topic, lambda _: None, quality, raw=True
        )
        self._decoded: list[AnyRows] = []
        self._waiting: list[Message] = []
        self._sent_ns: list[AnyArray] = []
        self._last_number = self._n_rows = self._unreadable = 0
        self._gaps: list[tuple[int, int]] = []

    def take(self) -> None:
        """Take what has arrived; to be called again and again."""
        for message in self._take_raw():
            self.count += 1
            # A publisher whose start was not noticed begins at 1 again.
            expected = self._last_number + 1 if message.number > self._last_number else 1
            self._last_number = message.number
            if message.number > expected:
                # The place of a gap is counted in rows, so all rows before it must be decoded.
                self._decode()
                self._gaps.append((self._n_rows, message.number - expected))
            self._waiting.append(message)
        if len(self._waiting) >= MESSAGES_PER_DECODING:
            self._decode()

    def _take_raw(self) -> list[Message]:
        """Return messages that have arrived since the last call, with the numbers of DDS."""
        taken: list[Message] = []
        handle = self._subscription.handle
        # The handle of the subscription must not be destroyed meanwhile.
        with handle:
            while len(taken) < MAX_MESSAGES_TAKEN:
                item = handle.take_message(self._kind, True)
                if item is None:
                    break
                data, info = item
                number, sent_ns = info["publication_sequence_number"], info["source_timestamp"]
                taken.append(Message(data, number, sent_ns))
        return taken

    def expect_new_publisher(self) -> None:
        """Expect the numbers to begin again, because the sending node makes a new publisher."""
        self.take()
        self._last_number = 0

    def count_cubes(self) -> int:
        """Return the number of cubes of which rows have arrived."""
        self._decode()
        return len({cube for rows in self._decoded for cube in rows.cube.tolist()})

    def newest_ns(self) -> int:
        """Return the stamp of the newest row, in ns since the Unix epoch; 0 before the first
        message."""
        self._decode()
        if not self._decoded:
            return 0
        return int(self._decoded[-1].stamp_ns[-1])

    def received(self) -> Received[AnyRows]:
        """Return all that arrived.

        Raises:
            MessageError: Nothing arrived.
        """
        self._decode()
        if not self._decoded:
            raise MessageError("the driver or the reconstruction published nothing: see their logs")
        sent_ns = np.concatenate(self._sent_ns)
        return Received(
            concatenate(self._decoded),
            sent_ns,
            tuple(self._gaps),
            self._unreadable,
        )

    def _decode(self) -> None:
        """Decode the waiting messages; neighbours with the same number of rows and pads
        together."""
        waiting, self._waiting = self._waiting, []
        for _, group in groupby(waiting, self._shape_of):
            messages = list(group)
            try:
                decoded = self._codec.decode(*(message.data for message in messages))
            except MessageError:
                # The checks report unreadable messages, so the run goes on.
                self._unreadable += len(messages)
                continue
            if decoded.frame_id != self._frame_id:
                self._unreadable += len(messages)
            self._n_rows += len(decoded.rows)
            self._decoded.append(decoded.rows)
            sent_ns = [message.sent_ns for message in messages]
            # Messages of one shape have the same number of rows.
            rows_per_message = len(decoded.rows) // len(messages)
            self._sent_ns.append(np.repeat(sent_ns, rows_per_message))

    def _shape_of(self, message: Message) -> tuple[int, bytes]:
        return len(message.data), self._codec.shape_bytes(message.data)
