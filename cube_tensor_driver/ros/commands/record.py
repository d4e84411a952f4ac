# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Records topics into a bag (file of messages). Messages are stored as the bytes that arrive.

The main thread receives the messages, and a separate thread writes them to the disk.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from ...bags.metadata import describe_quality
from ...bags.repair import repair
from ...bags.write import BagWriter
from ...core.errors import BagError
from ...processes.stop_signals import stop_event
from ..messages import find_message_class
from ..qos import match_offered_profile
from ..session import describe_domain, run_node_session, spin_until
from .echo import resolve_topics

QUEUE_DEPTH = 2000
"""Depth of the queue of each recorded topic, in messages."""

WRITE_PERIOD_S = 0.05
"""Time, in seconds, for which the writing thread sleeps before it writes the messages that have
arrived meanwhile.

With a shorter time the thread would compete with the receiving thread for Python's global
interpreter lock more often.
"""

FLUSH_PERIOD_S = 0.25
"""Time, in seconds, after which written data are passed to the operating system (flushed).

If the process is killed (SIGKILL), the messages that were not yet flushed are lost. Because writing
takes time, too, these may be the messages of up to twice this period.
"""

MAX_WAITING_BYTES = 256 << 20
"""Maximum size, in bytes, of all messages that wait to be written. Messages that exceed it are
dropped and counted."""

FIND_PERIOD_S = 0.2
"""Time, in seconds, between two searches for publishers of the topics to record."""

MAX_CONNECT_S = 3.0
"""Longest time, in seconds, from the connection to the first publisher until recording begins.

Recording begins as soon as every topic to record is connected to a publisher, so that the bag does
not contain messages of stress without the frequencies from which they were computed. After this
time it begins without the topics that are not connected yet.
"""

SHOW_PERIOD_S = 1.0
"""Time, in seconds, between two calls of the function `show`, which reports the progress."""


class Recorder:
    """Records topics into a bag, until `close`.

    The caller calls `find_topics` regularly, which subscribes to topics that are published by now.
    Recording begins when all topics are connected (see `MAX_CONNECT_S`), and messages that came
    before are dropped. Only messages of latched topics are kept from their connection on.

    Attributes:
        has_begun: Whether recording has begun, so that messages are kept.
        late: Topic that was connected after recording began -> how much later, in seconds.
        dropped: Number of messages that were not recorded, because the disk is too slow or writing
            has failed.
        counts: Topic that is recorded -> number of its messages that have arrived.
        refused: Topic -> reason why it is not recorded.
        error: Error that ended the writing thread; None: no error has occurred.
    """

    def __init__(
        self,
        node: Node,
        topics: Sequence[str],
        bag: BagWriter,
    ) -> None:
        """Start the writing thread.

        Args:
            node: The node that subscribes.
            topics: Full names of the topics.
            bag: The bag, which is empty.
        """
        self.has_begun = False
        self.late: dict[str, float] = {}
        self.dropped = 0
        self.counts: dict[str, int] = {}
        self.refused: dict[str, str] = {}
        self.error: BagError | None = None
        self._node = node
        self._bag = bag
        self._wanted = list(topics)
        self._subscriptions: list[Subscription] = []
        self._unconnected: dict[str, Subscription] = {}
        self._latched: set[str] = set()
        self._connected_s = self._begin_s = 0.0
        # Each message is stored as its topic, time of arrival in ns, and bytes. `_waiting` holds
        # the messages that the writing thread is to write. `_early` holds messages that came before
        # recording began; they are dropped when it begins.
        self._waiting: deque[tuple[str, int, bytes]] = deque()
        self._early: list[tuple[str, int, bytes]] = []
        # Only the receiving thread changes the number of received bytes, and only the writing
        # thread that of written bytes, so they need no lock.
        self._received_bytes = self._written_bytes = 0
        self._lock = threading.Lock()
        self._closing = threading.Event()
        # The thread is a daemon, so that it does not keep the process alive if an error ends the
        # main thread before it calls `close`.
        self._thread = threading.Thread(
            target=self._write,
            name="bag writer",
            daemon=True,
        )
        self._thread.start()

    @property
    def received(self) -> int:
        """Number of messages that have arrived."""
        return sum(self.counts.values())

    @property
    def missing(self) -> list[str]:
        """Topics that are to be recorded but have had no publisher so far."""
        known = self.counts.keys() | self.refused.keys()
        return [topic for topic in self._wanted if topic not in known]

    def find_topics(self) -> None:
        """Subscribe to the topics that have a publisher by now. Call it in the main thread only."""
        for topic in self.missing:
            offers = self._node.get_publishers_info_by_topic(topic)
            if offers:
                try:
                    self._subscribe(topic, offers)
                except BagError as error:
                    self.refused[topic] = str(error)
        now = time.monotonic()
        for topic, subscription in list(self._unconnected.items()):
            if subscription.get_publisher_count():
                del self._unconnected[topic]
                self._connected_s = self._connected_s or now
                if self.has_begun:
                    self.late[topic] = now - self._begin_s
        is_complete = not (self.missing or self._unconnected)
        has_connection = self._connected_s > 0
        has_waited = has_connection and now - self._connected_s > MAX_CONNECT_S
        if not self.has_begun and (is_complete or has_waited):
            self._begin(now)

    def _begin(self, now: float) -> None:
        """Drop the messages that have come so far, and write those that come from now on.

        Messages of latched topics come only once, so they are kept.

        Args:
            now: Time of the monotonic clock, in seconds.
        """
        self._received_bytes -= sum(len(data) for _, _, data in self._early)
        self._early.clear()
        for topic in self.counts.keys() - self._latched:
            self.counts[topic] = 0
        self.has_begun = True
        self._begin_s = now

    def close(self) -> None:
        """Write the messages that wait, and close the bag.

        Raises:
            BagError: Writing has failed, now or earlier.
        """
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()
        # If recording ends while topics are still awaited, the messages that have arrived until
        # then are written nevertheless.
        self._waiting.extend(self._early)
        self._closing.set()
        self._thread.join()
        if self.error is not None:
            raise self.error

    def _subscribe(self, topic: str, offers: list[TopicEndpointInfo]) -> None:
        type_name = offers[0].topic_type
        profile = match_offered_profile(offers, QUEUE_DEPTH)
        is_latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        recorded_profile = describe_quality(
            latched=is_latched,
            reliable=profile.reliability == ReliabilityPolicy.RELIABLE,
            depth=QUEUE_DEPTH,
        )
        with self._lock:
            self._bag.add_topic(topic, type_name, [recorded_profile])
        clock = self._node.get_clock()
        self.counts[topic] = 0
        if is_latched:
            self._latched.add(topic)

        def receive(data: bytes) -> None:
            self.counts[topic] += 1
            # Appending to a deque needs no lock. The deque has no limit of its size in bytes, so
            # the bytes that wait are counted here.
            waiting_bytes = self._received_bytes - self._written_bytes
            is_full = waiting_bytes + len(data) > MAX_WAITING_BYTES
            if is_full or self.error is not None:
                self.dropped += 1
                return
            self._received_bytes += len(data)
            is_kept = self.has_begun or is_latched
            messages = self._waiting if is_kept else self._early
            messages.append((topic, clock.now().nanoseconds, data))

        kind = find_message_class(topic, type_name)
        subscription = self._node.create_subscription(
            kind,
            topic,
            receive,
            profile,
            raw=True,
        )
        self._subscriptions.append(subscription)
        self._unconnected[topic] = subscription

    def _write(self) -> None:
        try:
            flushed = time.monotonic()
            is_last = False
            while not is_last:
                is_last = self._closing.wait(WRITE_PERIOD_S)
                with self._lock:
                    while self._waiting:
                        topic, time_ns, data = self._waiting.popleft()
                        self._bag.write(topic, time_ns, data)
                        self._written_bytes += len(data)
                    if time.monotonic() - flushed >= FLUSH_PERIOD_S:
                        self._bag.flush()
                        flushed = time.monotonic()
            self._bag.close()
        except BagError as error:
            self.error = error


def record(
    folder: Path,
    topics: Sequence[str],
    *,
    storage: str,
    max_bytes: int,
    max_seconds: float,
    duration: float | None,
    show: Callable[[Recorder, float], None],
) -> Recorder:
    """Record topics into a new bag, until a signal asks the process to end or the duration is over.

    Args:
        folder: Folder of the bag, which must not exist.
        topics: Names of the topics.
        storage: Format of the files of the bag: mcap or sqlite3.
        max_bytes: Maximum size of one file of the bag, in bytes; 0: no limit.
        max_seconds: Maximum duration of one file of the bag, in seconds; 0: no limit.
        duration: Time, in s, from the first message on, after which recording ends; None: it ends
            only at a signal. If no message arrives, it ends after this time from the start.
        show: Called once a second with the recorder and the time since the start, in s.

    Raises:
        BagError: Writing the bag has failed; the messages written before are readable. Or no
            message arrived, and the bag was removed.
        ConfigError: ROS does not allow the name of a topic, or rclpy does not start.
    """
    stop = stop_event()
    with run_node_session("recorder") as session:
        names = resolve_topics(session.node, topics)
        bag = BagWriter(
            folder,
            storage,
            max_bytes,
            max_seconds,
        )
        recorder = Recorder(session.node, names, bag)
        begin = time.monotonic()
        until = float("inf") if duration is None else begin + duration
        has_come = False

        def is_done() -> bool:
            nonlocal has_come, until
            now = time.monotonic()
            if not has_come and recorder.has_begun and any(recorder.counts.values()):
                # The duration is counted from the first message on and not from the start, because
                # finding the topics may take seconds on a busy machine.
                has_come = True
                until += now - begin
            return stop.is_set() or recorder.error is not None or now >= until

        node = session.node
        recorder.find_topics()
        node.create_timer(FIND_PERIOD_S, recorder.find_topics)
        node.create_timer(SHOW_PERIOD_S, lambda: show(recorder, time.monotonic() - begin))
        try:
            spin_until(session.executor, is_done)
        finally:
            _close(recorder, bag.folder)
        if not bag.messages:
            # An empty bag is removed, so that the next recording can use the same name.
            shutil.rmtree(bag.folder, ignore_errors=True)
            raise BagError(f"nothing recorded, no bag made: {_explain_nothing(recorder)}")
        return recorder


def _explain_nothing(recorder: Recorder) -> str:
    if recorder.refused:
        return "; ".join(recorder.refused.values())
    if recorder.counts:
        return f"no message came on {', '.join(sorted(recorder.counts))}"
    missing = ", ".join(recorder.missing)
    return f"nobody offers {missing} in {describe_domain()}; start the skin, or correct --topics"


def _close(recorder: Recorder, folder: Path) -> None:
    """Close a bag, and repair it if closing fails.

    Args:
        recorder: The recorder of the bag.
        folder: Folder of the bag.

    Raises:
        BagError: Writing has failed. The message states how many messages are readable.
    """
    try:
        recorder.close()
    except BagError as error:
        # Most likely the disk is full. Removing the last, incomplete chunk of messages makes room
        # for the summary at the end of the file.
        try:
            done = repair(folder, keep_rest=False)
        except BagError as worse:
            raise BagError(f"{error}\n{worse}") from None
        raise BagError(f"{error}. The {done.messages} messages written before are valid") from None
