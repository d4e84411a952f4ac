# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Record of a torture: both batch topics, and the counters of the nodes."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from cube_tensor_driver.config.skin import Skin
from cube_tensor_driver.demo.running import Observer, observing
from cube_tensor_driver.messages.codec import frequency_codec, stress_codec
from cube_tensor_driver.msg import SkinFrequencies, SkinStress
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.ros.messages import to_ns
from cube_tensor_driver.ros.qos import batch_profile

from ..checks.record import NodeAction, Record, Span
from .memory import MemoryMonitor
from .message_log import TopicLog
from .mix import RATE

INSTANTS = 1000
"""Number of instants of the load that the simulated hubs repeat."""

QUIET_S = 1.0
"""Time, in seconds, without a new message after which everything has arrived."""

QUEUE_DEPTH = 20_000
"""Number of messages that the queues of this process hold, more than those of all other processes.
So nothing is lost here, for which the driver would be blamed, when this process is delayed."""

LINK_COUNTERS = ("lost_on_the_way", "dropped_in_hub", "taken", "delivered", "duplicate", "resets")
"""Names of those counters of the driver for each link that are shown or checked."""


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
            node: Node of the subscriptions, which has no executor, see `message_log`.
            skin: The skin.
        """
        self.observer, self._skin = observer, skin
        quality = batch_profile(RATE)
        quality.depth = QUEUE_DEPTH
        self._frequencies = TopicLog(
            node, SkinFrequencies, "frequencies", quality, frequency_codec, skin
        )
        self.stress = TopicLog(node, SkinStress, "stress", quality, stress_codec, skin)

        self._links: dict[str, dict[str, str]] = {}
        self._totals: dict[str, str] = {}
        self._earlier_counts: Counter[str] = Counter()  # Of the drivers that were killed.
        self._counted_ns = 0
        self._messages_lost = [0]  # By the reconstruction, in each of its lives.
        self._n_messages, self._last_message_s = 0, time.monotonic()
        observer.node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, 1000
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
            instants=INSTANTS,
            frequencies=self._frequencies.received(),
            stress=self.stress.received(),
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
def recording(
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

    with observing("torture", children, interrupted=interrupted, on_step=on_step) as observer:
        node = rclpy.create_node("checker")
        try:
            recorder = TortureRecorder(observer, node, skin)
            steps.append(recorder.take)
            yield recorder
        finally:
            node.destroy_node()  # type: ignore[no-untyped-call]
