# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Replays a bag: publishes the recorded messages on their topics at the recorded intervals.

The player publishes in a thread of its own. The main thread spins a node, which publishes the state
of the player and offers a service to pause it and to jump to another position.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from ...bags.metadata import Connection
from ...bags.read import Bag, Entry
from ...core.errors import BagError
from ...messages.codec import SECOND
from ...messages.types import COMPENSATION, FREQUENCIES, PACKAGE, STRESS, TOUCH
from ...msg import ReplayState
from ...processes.stop_signals import on_stop_signal
from ...srv import SteerReplay
from ..messages import find_message_class, to_time
from ..qos import NEWEST, make_profile
from ..session import node_session, spin_until

QUEUE_DEPTH = 2000
"""Depth of the queue of each replayed topic, in messages."""

CLOCK_PERIOD_S = 0.01
"""Maximum time, in seconds, between two messages of /clock (simulated time). One is also published
before every replayed message."""

SETTLE_S = 1.0
"""Time, in seconds, for which no further subscriber must have come before the replay begins.

It applies if the topic `frequencies` has a subscriber; otherwise `MAX_WAIT_S` does. A node
discovers each topic separately, so a node that has subscribed to `info` may not have found
`frequencies` yet and would miss its first messages.
"""

MAX_WAIT_S = 3.0
"""Time, in seconds, without a new subscriber after which the replay begins even if the topic
`frequencies` has no subscriber, because no reconstruction node runs."""

LOOK_PERIOD_S = 0.1
"""Time, in seconds, between two counts of the subscribers of the replayed topics, while the replay
waits for them."""

SHOWN_NS = 100_000_000
"""Length, in ns, of the part of the recording that is published after a jump while the player is
paused.

In this part every cube was sampled at least once, so that viewers show the stress of all cubes at
the new position.
"""

STATE_PERIOD_S = 0.1
"""Time, in seconds, between two messages on `~/state`, the state of the player."""

RECONSTRUCTED_TYPES = (
    STRESS,
    TOUCH,
    COMPENSATION,
    f"{PACKAGE}/msg/StressTensorStamped",
    "geometry_msgs/msg/WrenchStamped",
)
"""Types of messages that the node `reconstruction` publishes.

Their topics are not replayed by default, because a reconstruction node that runs during the replay
computes them anew from the replayed frequencies.
"""


class Player:
    """Publishes the messages of a bag (recording) at the intervals at which they were recorded.

    `run` must be called only once; the other methods may be called from any thread meanwhile.

    Attributes:
        position: Time of the message published last, in s from the start of the bag.
        length: Duration of the bag, in s.
        published: Number of messages published so far.
        stop: Event that ends the method `run`; the method `end` sets it.
    """

    def __init__(
        self,
        node: Node,
        bag: Bag,
        *,
        rate: float,
        stress: bool,
        clock: bool,
    ) -> None:
        """Make the publishers for the topics of the bag.

        Args:
            node: The node that publishes.
            bag: The bag.
            rate: Speed of the replay, divided by the speed of the recording.
            stress: Whether to publish the recorded topics of a reconstruction (stress and wrenches)
                as well.
            clock: Whether to publish /clock (simulated time).

        Raises:
            BagError: A type of messages is not installed, or the bag has no topic to publish.
        """
        self.stop = threading.Event()
        self.published = 0
        self.position = 0.0
        self.length = (bag.end_ns - bag.start_ns) / SECOND
        self._paused = False
        self._steps = 0
        self._jump_ns: int | None = None
        self._shown_until_ns = 0
        # This condition variable guards the variables for pausing, stepping and jumping, which
        # other threads change. It wakes the thread of `run` after a change.
        self._wake = threading.Condition()
        self._node = node
        self._bag = bag
        self._rate = rate
        self._publishers: dict[str, Publisher] = {}
        self._latched: set[str] = set()
        # A bag may contain several skins in different namespaces; each has a topic `frequencies`.
        skins = [topic.removesuffix("frequencies") for topic in bag.topics(FREQUENCIES)]
        for connection in bag.connections:
            topic = connection.topic
            is_chosen = stress or not _is_reconstructed(connection, skins)
            if topic not in self._publishers and topic != "/clock" and is_chosen:
                self._announce(topic, connection)
        if not self._publishers:
            there = "in it"
            if bag.connections:
                there = "but what a reconstruction makes; --stress publishes that too"
            raise BagError(f"{bag.path}: nothing to publish {there}")
        self._clock = node.create_publisher(Clock, "/clock", NEWEST) if clock else None

    @property
    def paused(self) -> bool:
        """Whether the replay is paused, by `pause`, by `jump` or at the end of the bag."""
        return self._paused

    def pause(self, paused: bool) -> None:
        """Pause the replay, or continue it if `paused` is false."""
        with self._wake:
            self._paused = paused
            self._steps = 0
            self._wake.notify()

    def step(self) -> None:
        """Publish all messages up to the next one of `frequencies`, and stay paused.

        It has an effect only while the replay is paused.
        """
        with self._wake:
            self._steps += 1
            self._wake.notify()

    def jump(self, position: float, paused: bool) -> None:
        """Continue the replay at another position.

        Args:
            position: The position, in s from the start of the bag.
            paused: Whether the replay pauses there. It does so after it has published `SHOWN_NS` of
                the recording, so that viewers show the position.

        Raises:
            BagError: The position is negative or after the end of the bag.
        """
        # A jump to the end of the bag goes back by SHOWN_NS, so that there are messages to show.
        latest_ns = self._bag.end_ns - SHOWN_NS
        to_ns = min(self._to_ns(position), latest_ns)
        to_ns = max(self._bag.start_ns, to_ns)
        with self._wake:
            self._jump_ns = to_ns
            self._paused = paused
            self._steps = 0
            self._wake.notify()

    def end(self) -> None:
        """Make `run` return after the message that it publishes now."""
        with self._wake:
            self.stop.set()
            self._wake.notify()

    def run(
        self,
        start: float,
        loop: bool,
        hold: bool = False,
    ) -> None:
        """Publish the bag to its end.

        Args:
            start: Position at which the replay begins, in s from the start of the bag.
            loop: Whether the replay begins at `start` again after the end of the bag.
            hold: Whether the replay pauses at the end of the bag and waits for `jump`, `pause` or
                `end`, instead of returning.

        Raises:
            BagError: The bag is damaged, or `start` is negative or after the end of the bag.
        """
        begin_ns: int | None = self._to_ns(start)
        self._await_subscribers()
        next_ns = begin_ns
        while next_ns is not None and not self.stop.is_set():
            self._publish_from(next_ns)
            with self._wake:
                if hold and not loop and self._jump_ns is None:
                    self._paused = True
                    self._wake.wait_for(self._has_request)
                next_ns = begin_ns if loop or hold else None
                self._shown_until_ns = 0
                if self._jump_ns is not None:
                    next_ns = self._jump_ns
                    self._jump_ns = None
                    self._shown_until_ns = next_ns + SHOWN_NS

    def _has_request(self) -> bool:
        """Return whether `end`, `jump` or `pause` ended the pause at the end of the bag."""
        has_jump = self._jump_ns is not None
        return self.stop.is_set() or has_jump or not self._paused

    def _announce(self, topic: str, connection: Connection) -> None:
        """Make the publisher of a topic, with the quality of service of the recorded publisher.

        Args:
            topic: Name of the topic.
            connection: Description of the topic in the bag.
        """
        profile = make_profile(
            QUEUE_DEPTH,
            is_latched=connection.is_latched,
            is_best_effort=connection.is_best_effort,
        )
        kind = find_message_class(topic, connection.msgtype)
        self._publishers[topic] = self._node.create_publisher(kind, topic, profile)
        if connection.is_latched:
            self._latched.add(topic)

    def _await_subscribers(self) -> None:
        """Wait until the topics have their subscribers, before the replay begins.

        The wait ends if `frequencies` has subscribers and no new one has come for `SETTLE_S`, or if
        no new one has come for `MAX_WAIT_S`.
        """
        publishers = list(self._publishers.values())
        if self._clock is not None:
            publishers.append(self._clock)
        # Each topic `frequencies` is to have a subscriber, the reconstruction node. If no such node
        # runs, the replay begins after MAX_WAIT_S.
        needed = [one for topic, one in self._publishers.items() if _is_frequencies(topic)]
        count = 0
        changed_s = time.monotonic()
        wait_s = MAX_WAIT_S
        while time.monotonic() - changed_s < wait_s and not self.stop.wait(LOOK_PERIOD_S):
            count_before = count
            count = sum(publisher.get_subscription_count() for publisher in publishers)
            if count != count_before:
                changed_s = time.monotonic()
                all_heard = all(one.get_subscription_count() for one in needed or publishers)
                wait_s = SETTLE_S if all_heard else MAX_WAIT_S

    def _to_ns(self, position: float) -> int:
        """Convert a position in the bag to the time of recording, in ns since the Unix epoch.

        Args:
            position: The position, in s from the start of the bag.

        Raises:
            BagError: The position is negative or after the end of the bag.
        """
        if not 0 <= position <= self.length:
            raise BagError(
                f"{self._bag.path}: {position:g} s is not in the bag, which is "
                f"{self.length:.3f} s long"
            )
        return self._bag.start_ns + round(position * SECOND)

    def _publish_from(self, start_ns: int) -> None:
        """Publish messages until the end of the bag, a call of `jump`, or a call of `end`.

        Args:
            start_ns: Time of recording of the first message, in ns since the Unix epoch.
        """
        # Latched messages (such as `info`) from before the start are still valid at the start.
        for entry in self._bag.entries(self._latched, stop_ns=start_ns):
            self._publish(entry)
        self._set_time(start_ns)
        for entry in self._bag.entries(set(self._publishers), start_ns):
            if not self._wait_until_due(entry.time_ns):
                return
            # Nodes with simulated time must get the time of a message before the message itself,
            # because otherwise its stamp would lie in the future.
            self._publish_clock(entry.time_ns)
            self._publish(entry)
            # Other threads read the position. Assigning one attribute is atomic and needs no lock.
            self.position = (entry.time_ns - self._bag.start_ns) / SECOND
            # A step, requested by `step`, ends with the first message of `frequencies`.
            if self._steps and _is_frequencies(entry.topic):
                with self._wake:
                    self._steps -= 1

    def _set_time(self, bag_ns: int) -> None:
        """Set the pair of corresponding times from which the due time of each message is computed.

        Args:
            bag_ns: Time of recording, in ns since the Unix epoch, that corresponds to the present
                time of the monotonic clock.
        """
        self._anchor_ns = bag_ns
        self._anchor_s = time.monotonic()

    def _wait_until_due(self, bag_ns: int) -> bool:
        """Wait until a message is due.

        While the replay is paused, a message is due only if it belongs to a step (see `step`) or to
        the time that is shown after a jump (see `SHOWN_NS`).

        Args:
            bag_ns: Time of recording of the message, in ns since the Unix epoch.

        Returns:
            Whether the message is to be published. False means that `end` or `jump` was called.
        """
        with self._wake:
            while not self.stop.is_set() and self._jump_ns is None:
                if self._paused:
                    if self._steps or bag_ns <= self._shown_until_ns:
                        self._set_time(bag_ns)
                        return True
                    self._wake.wait()
                    self._set_time(bag_ns)
                    continue
                since_anchor_s = (bag_ns - self._anchor_ns) / SECOND / self._rate
                due_s = self._anchor_s + since_anchor_s
                left_s = due_s - time.monotonic()
                if left_s <= 0:
                    return True
                if self._clock is not None:
                    left_in_bag_ns = round(left_s * self._rate * SECOND)
                    self._publish_clock(bag_ns - left_in_bag_ns)
                    left_s = min(left_s, CLOCK_PERIOD_S)
                self._wake.wait(left_s)
        return False

    def _publish_clock(self, bag_ns: int) -> None:
        if self._clock is not None:
            self._clock.publish(Clock(clock=to_time(bag_ns)))

    def _publish(self, entry: Entry) -> None:
        self._publishers[entry.topic].publish(entry.data)
        self.published += 1


def _is_reconstructed(connection: Connection, skins: list[str]) -> bool:
    """Return whether the node `reconstruction` published a recorded topic.

    Other nodes publish messages of type WrenchStamped, too, so a topic of this type counts only if
    its name is that of the topic of a single cube, `cubes/<name>/wrench`.

    Args:
        connection: Description of the topic in the bag.
        skins: Namespaces of the skins in the bag, each with a closing slash.
    """
    if connection.msgtype not in RECONSTRUCTED_TYPES:
        return False
    is_own_type = connection.msgtype.startswith(PACKAGE)
    return is_own_type or any(connection.topic.startswith(f"{skin}cubes/") for skin in skins)


def _is_frequencies(topic: str) -> bool:
    return topic.endswith("frequencies")


class ReplayControl:
    """Publishes the state of a player on `~/state`, and offers `~/steer` to control the player."""

    def __init__(self, node: Node, player: Player) -> None:
        self._player = player
        self._state = node.create_publisher(ReplayState, "~/state", 1)
        node.create_service(SteerReplay, "~/steer", self._steer)
        node.create_timer(STATE_PERIOD_S, self._publish_state)

    def _publish_state(self) -> None:
        player = self._player
        self._state.publish(
            ReplayState(
                position=player.position,
                length=player.length,
                paused=player.paused,
            )
        )

    def _steer(
        self, request: SteerReplay.Request, answer: SteerReplay.Response
    ) -> SteerReplay.Response:
        try:
            if math.isnan(request.position):
                self._player.pause(request.paused)
            else:
                self._player.jump(request.position, request.paused)
        except BagError as error:
            answer.message = str(error)
            return answer
        answer.success = True
        answer.message = "holds" if request.paused else "goes on"
        return answer


def replay(
    bag: Bag,
    *,
    rate: float,
    loop: bool,
    start: float,
    clock: bool,
    stress: bool,
    hold: bool,
    on_step: Callable[[Player], None],
) -> None:
    """Publish a bag until its end, or until a signal asks the process to end.

    Args:
        bag: The bag.
        rate: Speed of the replay, divided by the speed of the recording.
        loop: Whether the replay begins at `start` again after the end of the bag.
        start: Position at which the replay begins, in s from the start of the bag.
        clock: Whether to publish /clock (simulated time).
        stress: Whether to publish the recorded topics of a reconstruction (stress and wrenches) as
            well.
        hold: Whether the replay pauses at the end of the bag and waits for the service `~/steer`.
        on_step: Called in the main thread with the player after each step of the executor, which
            lasts 0.05 s at most, and at the end.

    Raises:
        BagError: The bag cannot be read, or has no topic to publish.
    """
    errors: list[BagError] = []
    with node_session("player") as (node, executor):
        player = Player(
            node,
            bag,
            rate=rate,
            stress=stress,
            clock=clock,
        )
        ReplayControl(node, player)
        on_stop_signal(player.end)

        def play() -> None:
            try:
                player.run(start, loop, hold=hold)
            except BagError as error:
                errors.append(error)

        thread = threading.Thread(target=play, name="player")
        thread.start()
        try:
            spin_until(
                executor,
                lambda: not thread.is_alive(),
                on_step=lambda: on_step(player),
            )
        finally:
            player.end()
            thread.join()
        on_step(player)
    if errors:
        raise errors[0]
