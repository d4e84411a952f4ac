"""Records topics into a bag, in the bytes in which messages arrive. The main thread receives them,
a separate thread writes them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from ...bags.metadata import quality
from ...bags.write import BagWriter
from ...core.errors import BagError
from ..messages import message_class

DEPTH = 2000
WRITE_S = 0.05
"""How often the writing thread looks for messages: seldom, so that it does not contend for the
interpreter."""
FLUSH_S = 0.25
"""How often written data is handed to the system. A kill -9 costs at most twice this time."""
WAITING_BYTES = 256 << 20
"""Messages that wait for the disk; those beyond it are dropped and counted."""


class Recorder:
    """Records `topics`, whole names, of a node's graph into a bag from now until `close`.

    Call `find_topics` now and then: it subscribes to topics that have appeared. received, dropped:
    messages. counts: messages of each topic. refused: why a topic is not recorded.
    """

    def __init__(self, node: Node, topics: Sequence[str], bag: BagWriter) -> None:
        self.received = self.dropped = 0
        self.counts: dict[str, int] = {}
        self.refused: dict[str, str] = {}
        self.error: BagError | None = None
        self._node, self._bag = node, bag
        self._wanted = list(topics)
        self._subscriptions: list[Any] = []
        self._waiting: deque[tuple[str, int, bytes]] = deque()
        self._taken_bytes = self._written_bytes = 0
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._write, name="bag writer")
        self._thread.start()

    @property
    def missing(self) -> list[str]:
        """Topics that nobody offers yet."""
        return [
            topic
            for topic in self._wanted
            if topic not in self.counts and topic not in self.refused
        ]

    def find_topics(self) -> None:
        """Subscribe to the wanted topics that have a publisher by now. Main thread only."""
        for topic in self.missing:
            offers = self._node.get_publishers_info_by_topic(topic)
            if offers:
                try:
                    self._subscribe(topic, offers)
                except BagError as error:
                    self.refused[topic] = str(error)

    def close(self) -> None:
        """Write what waits and complete the bag. BagError: why it could not be."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()
        self._closing.set()
        self._thread.join()
        if self.error is not None:
            raise self.error

    def _subscribe(self, topic: str, offers: list[TopicEndpointInfo]) -> None:
        msgtype = offers[0].topic_type
        profiles = [offer.qos_profile for offer in offers]
        latched = all(
            profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in profiles
        )
        reliable = all(profile.reliability == ReliabilityPolicy.RELIABLE for profile in profiles)
        with self._lock:
            self._bag.add_topic(
                topic, msgtype, [quality(latched=latched, reliable=reliable, depth=DEPTH)]
            )
        clock = self._node.get_clock()
        self.counts[topic] = 0

        def receive(data: bytes) -> None:
            self.received += 1
            self.counts[topic] += 1
            if (
                self._taken_bytes - self._written_bytes + len(data) > WAITING_BYTES
                or self.error is not None
            ):
                self.dropped += 1
                return
            # Each of the two counts has one thread that changes it; the deque is safe for both.
            self._taken_bytes += len(data)
            self._waiting.append((topic, clock.now().nanoseconds, data))

        profile = QoSProfile(
            depth=DEPTH,
            history=HistoryPolicy.KEEP_LAST,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        self._subscriptions.append(
            self._node.create_subscription(
                message_class(topic, msgtype), topic, receive, profile, raw=True
            )
        )

    def _write(self) -> None:
        try:
            flushed = time.monotonic()
            while True:
                last = self._closing.wait(WRITE_S)
                with self._lock:
                    self._write_waiting()
                    if time.monotonic() - flushed >= FLUSH_S:
                        self._bag.flush()
                        flushed = time.monotonic()
                if last:
                    break
            self._bag.close()
        except BagError as error:
            self.error = error

    def _write_waiting(self) -> None:
        while self._waiting:
            topic, time_ns, data = self._waiting.popleft()
            self._bag.write(topic, time_ns, data)
            self._written_bytes += len(data)
