# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Replays a bag: publishes the recorded messages on their topics at the recorded intervals.

The node of the player also publishes its state, and offers a service to pause it and to jump to
another position.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from ...bags.metadata import Connection
from ...bags.read import Bag, Entry
from ...core.errors import BagError
from ...messages.codec import SECOND
from ...messages.types import COMPENSATION_TYPE, FREQUENCIES_TYPE, PACKAGE, STRESS_TYPE, TOUCH_TYPE
from ...msg import ReplayState
from ...processes.stop_signals import on_stop_signal
from ...srv import SteerReplay
from ..messages import find_message_class, to_time
from ..qos import NEWEST, make_profile
from ..session import run_node_session, spin_until

QUEUE_DEPTH = 2000
"""Depth of the queue of each replayed topic, in messages."""

CLOCK_PERIOD_S = 0.01
"""Maximum time, in seconds, between two messages of /clock (simulated time). One is also published
before every replayed message."""

SETTLE_S = 1.0
"""Time, in seconds, for which no further subscriber must have come before the replay begins.

It applies if the topic `frequencies` has a subscriber; otherwise `MAX_WAIT_S` applies. A node
discovers each of its topics separately, so when its first subscription appears, it may not have
found its other topics yet and would miss their first messages.
"""

MAX_WAIT_S = 3.0
"""Time, in seconds, without a new subscriber after which the replay begins although the topic
`frequencies` has no subscriber. The topic stays without one if no reconstruction node runs."""

LOOK_PERIOD_S = 0.1
"""Time, in seconds, between two counts of the subscribers of the replayed topics, while the replay
waits for them."""

SHOWN_NS = 100_000_000
"""Length, in ns, of the part of the recording that is published after a jump while the player is
paused.

In this part every cube was sampled at least once, so that viewers show the stress of all cubes at
the new position.
"""

MAX_STEP_S = 0.05
"""Maximum time, in seconds, between two checks for requests and signals, while messages are
published or the next message is awaited."""

STATE_PERIOD_S = 0.1
"""Time, in seconds, between two messages on `~/state`, the state of the player."""

RECONSTRUCTED_TYPES = (
    STRESS_TYPE,
    TOUCH_TYPE,
    COMPENSATION_TYPE,
    f"{PACKAGE}/msg/StressTensorStamped",
    "geometry_msgs/msg/WrenchStamped",
)
"""Types of messages that the node `reconstruction` publishes.

Their topics are not replayed by default, because a reconstruction node that runs during the replay
computes them anew from the replayed frequencies.
"""


class Player:
    """Publishes the messages of a bag (recording) at the intervals at which they were recorded.

    Attributes:
        position: Time of the message published last, in s from the start of the bag.
        length: Duration of the bag, in s.
        paused: Whether the replay is paused, by `pause`, by `jump` or at the end of the bag.
        has_begun: Whether the replay has begun, by `begin` or by `jump`.
        has_ended: Whether the replay is over.
    """

    def __init__(
        self,
        node: Node,
        bag: Bag,
        *,
        rate: float,
        start: float,
        loop: bool,
        hold: bool,
        stress: bool,
        clock: bool,
    ) -> None:
        """Make the publishers for the topics of the bag.

        Args:
            node: The node that publishes.
            bag: The bag.
            rate: Speed of the replay, divided by the speed of the recording.
            start: Position at which the replay begins, in s from the start of the bag.
            loop: Whether the replay begins at `start` again after the end of the bag.
            hold: Whether the replay pauses at the end of the bag, instead of ending there.
            stress: Whether to publish the recorded topics of a reconstruction (stress and wrenches)
                as well.
            clock: Whether to publish /clock (simulated time).

        Raises:
            BagError: A type of messages is not installed, the bag has no topic to publish, or
                `start` is negative or after the end of the bag.
        """
        self.position = 0.0
        self.length = (bag.end_ns - bag.start_ns) / SECOND
        self.paused = self.has_begun = self.has_ended = False
        self._steps = 0
        self._node = node
        self._bag = bag
        self._rate = rate
        self._begin_ns = self._to_ns(start)
        self._loop = loop
        self._hold = hold
        self._publishers: dict[str, Publisher] = {}
        self._latched: set[str] = set()
        # A bag may contain several skins in different namespaces; each has a topic `frequencies`.
        skins = [topic.removesuffix("frequencies") for topic in bag.list_topics(FREQUENCIES_TYPE)]
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
        # Number of subscribers that `has_subscribers` has counted, and the time of its last change.
        self._n_subscribers = 0
        self._changed_s = time.monotonic()

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
        self._publishers[topic] = self._node.create_publisher(
            kind,
            topic,
            profile,
        )
        if connection.is_latched:
            self._latched.add(topic)

    def has_subscribers(self) -> bool:
        """Return whether the topics have their subscribers, so that the replay can begin.

        That is so if `frequencies` has subscribers and the number of subscribers of all topics has
        not changed for `SETTLE_S`, or if it has not changed for `MAX_WAIT_S`. The method is to be
        called repeatedly.
        """
        publishers = list(self._publishers.values())
        if self._clock is not None:
            publishers.append(self._clock)
        count = sum(publisher.get_subscription_count() for publisher in publishers)
        if count != self._n_subscribers:
            self._n_subscribers = count
            self._changed_s = time.monotonic()
        # Each topic `frequencies` is to have a subscriber, the reconstruction node. If no such node
        # runs, the replay begins after MAX_WAIT_S.
        needed = [one for topic, one in self._publishers.items() if _is_frequencies(topic)]
        all_heard = all(one.get_subscription_count() for one in needed or publishers)
        wait_s = SETTLE_S if all_heard else MAX_WAIT_S
        has_waited = time.monotonic() - self._changed_s >= wait_s
        return has_waited or self.has_begun or self.has_ended

    def begin(self) -> None:
        """Begin the replay at its start.

        Raises:
            BagError: The bag is damaged.
        """
        self._go_to(self._begin_ns)

    def pause(self, paused: bool) -> None:
        """Pause the replay, or continue it if `paused` is false."""
        self.paused = paused
        self._steps = 0

    def step(self) -> None:
        """Publish all messages up to the next one of `frequencies`, and stay paused.

        It has an effect only while the replay is paused.
        """
        self._steps += 1

    def jump(self, position: float, paused: bool) -> None:
        """Continue the replay at another position.

        Args:
            position: The position, in s from the start of the bag.
            paused: Whether the replay pauses there. It does so after it has published `SHOWN_NS` of
                the recording, so that viewers show the position.

        Raises:
            BagError: The position is negative or after the end of the bag, or the bag is damaged.
        """
        # A jump to the end of the bag goes back by SHOWN_NS, so that there are messages to show.
        latest_ns = self._bag.end_ns - SHOWN_NS
        to_ns = min(self._to_ns(position), latest_ns)
        to_ns = max(self._bag.start_ns, to_ns)
        self.pause(paused)
        self._go_to(to_ns)
        self._shown_until_ns = to_ns + SHOWN_NS

    def end(self) -> None:
        """End the replay."""
        self.has_ended = True

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

    def _go_to(self, start_ns: int) -> None:
        """Continue the replay with the first message that was recorded at or after a time.

        Latched messages (such as `info`) that were recorded before this time are still valid, so
        they are published at once.

        Args:
            start_ns: The time, in ns since the Unix epoch.
        """
        for entry in self._bag.read_entries(self._latched, stop_ns=start_ns):
            self._publishers[entry.topic].publish(entry.data)
        self.has_begun = True
        self._set_time(start_ns)
        self._entries: Iterator[Entry] = iter(
            self._bag.read_entries(set(self._publishers), start_ns)
        )
        self._next = next(self._entries, None)
        self._shown_until_ns = 0
        self._is_held = False

    def _set_time(self, bag_ns: int) -> None:
        """Let a time of recording correspond to now; later messages become due relative to it.

        Args:
            bag_ns: The time of recording, in ns since the Unix epoch.
        """
        self._anchor_ns = bag_ns
        self._anchor_s = time.monotonic()

    def advance(self) -> float:
        """Publish the messages that are due.

        Returns:
            Time, in s, after which to call the method again, at most `MAX_STEP_S`.

        Raises:
            BagError: The bag is damaged.
        """
        until_s = time.monotonic() + MAX_STEP_S
        while not self.has_ended and time.monotonic() < until_s:
            entry = self._next
            left_s = self._leave_end() if entry is None else self._find_left_s(entry.time_ns)
            if left_s > 0:
                return min(left_s, MAX_STEP_S)
            if entry is None:
                continue
            # Nodes with simulated time must get the time of a message before the message itself,
            # because otherwise its stamp would lie in the future.
            self._publish_clock(entry.time_ns)
            self._publishers[entry.topic].publish(entry.data)
            self.position = (entry.time_ns - self._bag.start_ns) / SECOND
            # A step, requested by `step`, ends with the first message of `frequencies`.
            if self._steps and _is_frequencies(entry.topic):
                self._steps -= 1
            self._next = next(self._entries, None)
        return 0.0

    def _leave_end(self) -> float:
        """At the end of the bag, begin again, end, or wait for a request.

        Returns:
            Time, in s, after which to call the method again; 0 if the end was left.
        """
        if self._hold and not self._loop and not self._is_held:
            self._is_held = self.paused = True
        if self._is_held and self.paused:
            return MAX_STEP_S
        if self._hold or self._loop:
            self.begin()
        else:
            self.end()
        return 0.0

    def _find_left_s(self, bag_ns: int) -> float:
        """Return the time, in s, to wait before the next call; at most 0 if the message is due.

        While a replay that is not paused waits, it publishes /clock. In a paused replay, a message
        is due only if it belongs to a step (see `step`) or to the time that is shown after a jump
        (see `SHOWN_NS`).

        Args:
            bag_ns: Time of recording of the message, in ns since the Unix epoch.
        """
        if self.paused:
            self._set_time(bag_ns)
            return 0.0 if self._steps or bag_ns <= self._shown_until_ns else MAX_STEP_S
        since_anchor_s = (bag_ns - self._anchor_ns) / SECOND / self._rate
        left_s = self._anchor_s + since_anchor_s - time.monotonic()
        if self._clock is not None and left_s > 0:
            left_in_bag_ns = round(left_s * self._rate * SECOND)
            self._publish_clock(bag_ns - left_in_bag_ns)
            left_s = min(left_s, CLOCK_PERIOD_S)
        return left_s

    def _publish_clock(self, bag_ns: int) -> None:
        if self._clock is not None:
            self._clock.publish(Clock(clock=to_time(bag_ns)))


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
        self,
        request: SteerReplay.Request,
        answer: SteerReplay.Response,
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
        on_step: Called with the player about every `MAX_STEP_S`, and at the end.

    Raises:
        BagError: The bag cannot be read, or has no topic to publish.
    """
    with run_node_session("player") as (node, executor):
        player = Player(
            node,
            bag,
            rate=rate,
            start=start,
            loop=loop,
            hold=hold,
            stress=stress,
            clock=clock,
        )
        ReplayControl(node, player)
        on_stop_signal(player.end)
        # `on_step` may raise errors, so it is called here and not by a timer of rclpy, which would
        # print a traceback of each error.
        spin_until(
            executor,
            player.has_subscribers,
            step_s=LOOK_PERIOD_S,
            on_step=lambda: on_step(player),
        )
        if not player.has_begun:
            player.begin()
        next_step_s = time.monotonic()
        while not player.has_ended:
            executor.spin_once(timeout_sec=player.advance())
            if time.monotonic() >= next_step_s:
                on_step(player)
                next_step_s = time.monotonic() + MAX_STEP_S
        on_step(player)
