# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Record of a torture: both batch topics, and the counters of the nodes.

Messages are recorded with the gaps in the numbers that DDS gives them. A gap means that a message
was sent and did not arrive here. So what this process missed can be told from what nobody sent.
Messages are taken without an executor, because only then the numbers are available.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import groupby
from threading import Event
from typing import Any, Generic, NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import QoSProfile

from cube_tensor_driver.config.skin import Skin
from cube_tensor_driver.core.errors import MessageError
from cube_tensor_driver.core.rows import concatenate
from cube_tensor_driver.demo.running import Observer, observe_skin
from cube_tensor_driver.messages.codec import (
    AnyRows,
    MessageCodec,
    frequency_codec,
    stress_codec,
)
from cube_tensor_driver.msg import SkinFrequencies, SkinStress
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.ros.messages import to_ns
from cube_tensor_driver.ros.qos import make_batch_profile

from ..checks.record import NodeAction, Received, Record, Span
from .memory import MemoryMonitor
from .mix import RATE

MESSAGES_PER_DECODING = 500
"""Number of messages that are decoded together, which takes less time than decoding one by one."""

MAX_MESSAGES_TAKEN = 300
"""Maximum number of messages that are taken at a time, so that this process also does other
things."""

QUIET_S = 1.0
"""Time, in seconds, without a new message after which everything has arrived."""

QUEUE_DEPTH = 20_000
"""Number of messages that the queues of this process hold.

It is larger than in all other processes. If this process is delayed, its queues must lose nothing,
because the loss would be taken for an error of the driver.
"""

LINK_COUNTERS = ("lost_on_the_way", "dropped_in_hub", "taken", "delivered", "duplicate", "resets")
"""Names of those counters of the driver for each link that are shown or checked."""


class Message(NamedTuple):
    """A serialised message, the number that DDS gave it, and the wall clock when it was sent."""

    data: bytes
    number: int
    sent_ns: int


class TopicLog(Generic[AnyRows]):
    """Collects the messages of one batch topic, and decodes them when all have arrived."""

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
        self._kind = kind
        self._codec: MessageCodec[AnyRows] = codec
        self._frame_id = skin.parent_frame.encode() + b"\0"
        self._n_cubes = len(skin.cubes)
        self._subscription: Any = node.create_subscription(
            kind,
            topic,
            lambda _: None,
            quality,
            raw=True,
        )
        self._messages: list[Message] = []
        self._last_number = 0
        # For each gap: number of messages before it, and number of messages that are missing.
        self._gaps: list[tuple[int, int]] = []

    @property
    def count(self) -> int:
        """Number of messages so far."""
        return len(self._messages)

    def take(self) -> None:
        """Take what has arrived; to be called again and again."""
        for message in self._take_raw():
            # If the number is not larger than the last one, a new publisher has started at 1.
            expected = self._last_number + 1 if message.number > self._last_number else 1
            self._last_number = message.number
            if message.number > expected:
                self._gaps.append((self.count, message.number - expected))
            self._messages.append(message)

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

    def decode_newest_rows(self) -> AnyRows:
        """Return the rows of the newest message; there must be one."""
        return self._codec.decode(self._messages[-1].data).rows

    def has_every_cube(self) -> bool:
        """Return whether the newest message has rows of every cube.

        The number of rows does not tell: a message can hold several scans of a few hubs.
        """
        if not self._messages:
            return False
        cubes = np.unique(self.decode_newest_rows().cube)
        return len(cubes) == self._n_cubes

    def collect_received(self) -> Received[AnyRows]:
        """Return the rows (one cube at one sampling time each) of all messages.

        Raises:
            MessageError: Nothing arrived.
        """
        decoded: list[AnyRows] = []
        # Wall clock of sending, and number of rows, of each message.
        sent_ns = np.array([message.sent_ns for message in self._messages])
        n_rows: list[int] = []
        unreadable = 0
        for _, group in groupby(enumerate(self._messages), self._find_batch):
            messages = [message.data for _, message in group]
            data = np.frombuffer(b"".join(messages), np.uint8)
            try:
                batch = self._codec.decode(data.reshape(len(messages), -1))
            except MessageError:
                # The checks report unreadable messages, so the run goes on.
                unreadable += len(messages)
                n_rows += [0] * len(messages)
                continue
            if batch.frame_id != self._frame_id:
                unreadable += len(messages)
            decoded.append(batch.rows)
            # Messages of one shape have the same number of rows.
            n_rows += [len(batch.rows) // len(messages)] * len(messages)
        if not decoded:
            raise MessageError("the driver or the reconstruction published nothing: see their logs")
        first_row = np.cumsum([0, *n_rows]).tolist()
        gaps = tuple((first_row[before], missing) for before, missing in self._gaps)
        return Received(
            concatenate(decoded),
            np.repeat(sent_ns, n_rows),
            gaps,
            unreadable,
        )

    def _find_batch(self, item: tuple[int, Message]) -> tuple[int, int, bytes]:
        """Return what successive messages that are decoded together have in common."""
        number, message = item
        shape = self._codec.read_shape_bytes(message.data)
        return number // MESSAGES_PER_DECODING, len(message.data), shape


class TortureRecorder:
    """Records what a skin publishes.

    Attributes:
        observer: Node that observes the skin.
        stress: Log of the topic `stress`.
    """

    def __init__(
        self,
        observer: Observer,
        node: Node,
        skin: Skin,
    ) -> None:
        """Subscribe to the topics of a skin.

        Args:
            observer: Node that observes the skin.
            node: Node of the subscriptions, which has no executor.
            skin: The skin.
        """
        self.observer, self._skin = observer, skin
        quality = make_batch_profile(RATE)
        quality.depth = QUEUE_DEPTH
        self._frequencies = TopicLog(
            node,
            SkinFrequencies,
            "frequencies",
            quality,
            frequency_codec,
            skin,
        )
        self.stress = TopicLog(
            node,
            SkinStress,
            "stress",
            quality,
            stress_codec,
            skin,
        )

        self._links: dict[str, dict[str, str]] = {}
        self._totals: dict[str, str] = {}
        # Sum of the counters of all drivers that were killed.
        self._earlier_counts: Counter[str] = Counter()
        self._counted_ns = 0
        # Messages that each process of the reconstruction reported to have lost.
        self._messages_lost = [0]
        self._n_messages, self._last_message_s = 0, time.monotonic()
        observer.node.create_subscription(
            DiagnosticArray,
            "/diagnostics",
            self._on_diagnostics,
            1000,
        )

    def take(self) -> None:
        """Take what has arrived; to be called again and again."""
        self._frequencies.take()
        self.stress.take()
        n_messages = self._frequencies.count + self.stress.count
        if n_messages != self._n_messages:
            self._n_messages, self._last_message_s = n_messages, time.monotonic()

    def is_complete(self, stopped_ns: int) -> bool:
        """Return whether everything has arrived that was sent before a time.

        Then the driver has reported its counters once more, and no message came for a while.
        """
        is_quiet = time.monotonic() - self._last_message_s > QUIET_S
        return is_quiet and self._counted_ns > stopped_ns

    def on_driver_killed(self) -> None:
        """Add up the counters of the driver that was killed: the next one counts from 0."""
        self._frequencies.expect_new_publisher()
        self._earlier_counts.update(self._count())
        self._links.clear()
        self._totals.clear()

    def _count(self) -> dict[str, int]:
        """Return the counters of the driver that runs."""
        counts = {name: int(value) for name, value in self._totals.items()}
        # A link that has not been connected yet has no counters.
        for name in LINK_COUNTERS:
            values = [int(link.get(name, 0)) for link in self._links.values()]
            counts[name] = sum(values)
        return counts

    def finish(self, checked: Span, actions: list[NodeAction]) -> Record:
        """Return everything that was recorded.

        Args:
            checked: Span in which samples are checked.
            actions: What was done to the nodes.

        Raises:
            MessageError: Nothing arrived.
        """
        self.take()
        counters = Counter(self._count())
        counters.update(self._earlier_counts)
        return Record(
            begin_ns=checked.begin_ns,
            end_ns=checked.end_ns,
            skin=self._skin,
            frequencies=self._frequencies.collect_received(),
            stress=self.stress.collect_received(),
            actions=tuple(actions),
            counters=counters,
            messages_lost=sum(self._messages_lost),
        )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if status.name.startswith("/driver: link "):
                self._links[status.name] = values
            elif status.name == "/driver: rows":
                self._totals, self._counted_ns = values, to_ns(message.header.stamp)
            elif status.name == "/reconstruction: rows":
                lost = int(values["messages lost on the way"])
                # A counter that became smaller belongs to a node that was started again.
                if lost < self._messages_lost[-1]:
                    self._messages_lost.append(0)
                self._messages_lost[-1] = lost


@contextmanager
def record_torture(
    skin: Skin,
    children: Children,
    interrupted: Event,
    memory: MemoryMonitor,
) -> Iterator[TortureRecorder]:
    """Make a recorder for the length of a block, and measure the memory while it spins."""
    steps: list[Callable[[], None]] = [memory.measure]

    def on_step() -> None:
        for step in steps:
            step()

    with observe_skin("torture", children, interrupted=interrupted, on_step=on_step) as observer:
        node = rclpy.create_node("checker")
        try:
            recorder = TortureRecorder(observer, node, skin)
            steps.append(recorder.take)
            yield recorder
        finally:
            node.destroy_node()  # type: ignore[no-untyped-call]
