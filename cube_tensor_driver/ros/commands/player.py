"""Publishes a bag on its topics again: the recorded bytes at the recorded intervals, with /clock if
asked for."""

from __future__ import annotations

import threading
import time
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from ...bags.read import Bag, Entry
from ...core.errors import BagError
from ...messages.types import PACKAGE
from ..messages import SECOND, message_class
from .recorder import DEPTH

CLOCK_S = 0.01
"""The clock is published at least so often in real time, and before every message."""
DISCOVERY_S, NOBODY_S, LOOK_S = 1.0, 3.0, 0.1
"""The first message waits until no further subscriber has come for DISCOVERY_S, or until nobody
has subscribed to frequencies for NOBODY_S.

Each topic is discovered separately: a subscriber to `info` need not have found `frequencies` yet.
"""
SHOWN_NS = 100_000_000
"""Length of bag that is published after a jump while the player is paused: enough for a row of
every link."""
MADE = (
    f"{PACKAGE}/msg/SkinStress",
    f"{PACKAGE}/msg/StressTensorStamped",
    "geometry_msgs/msg/WrenchStamped",
)
"""Types that a reconstruction publishes. Their topics are left out unless stress is asked for."""


class Player:
    """Publishes a bag; `run` once, from one thread, the rest from any.

    rate: times the recorded speed. stress: also what a reconstruction made. clock: publish /clock.
    position and length are in s after the begin of the bag.
    BagError: the bag cannot be read, or has nothing to publish.
    """

    def __init__(self, node: Node, bag: Bag, *, rate: float, stress: bool, clock: bool) -> None:
        self.stop = threading.Event()
        self.published = 0
        self.position, self.length = 0.0, (bag.end_ns - bag.start_ns) / SECOND
        self._paused, self._steps = False, 0
        self._jump_ns: int | None = None
        self._shown_ns = 0
        self._wake = threading.Condition()
        self._node, self._bag, self._rate = node, bag, rate
        self._publishers: dict[str, Any] = {}
        self._latched: set[str] = set()
        skins = [
            topic.removesuffix("frequencies")
            for topic in bag.topics(f"{PACKAGE}/msg/SkinFrequencies")
        ]
        for connection in bag.connections:
            topic = connection.topic
            made = connection.msgtype in MADE and (
                connection.msgtype.startswith(PACKAGE)
                or any(topic.startswith(f"{skin}cubes/") for skin in skins)
            )
            if topic not in self._publishers and topic != "/clock" and (stress or not made):
                self._add(topic, connection)
        if not self._publishers:
            there = (
                "but what a reconstruction makes; --stress publishes that too"
                if bag.connections
                else "in it"
            )
            raise BagError(f"{bag.path}: nothing to publish {there}")
        best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._clock = node.create_publisher(Clock, "/clock", best_effort) if clock else None

    @property
    def paused(self) -> bool:
        return self._paused

    def pause(self, paused: bool) -> None:
        """Pause, or go on."""
        with self._wake:
            self._paused, self._steps = paused, 0
            self._wake.notify()

    def step(self) -> None:
        """While paused: publish the next message of frequencies, and what comes before it."""
        with self._wake:
            self._steps += 1
            self._wake.notify()

    def jump(self, position: float, paused: bool) -> None:
        """Go on from a position, or pause there after SHOWN_NS of the bag. BagError: it is not in
        the bag."""
        to_ns = max(self._bag.start_ns, min(self._at(position), self._bag.end_ns - SHOWN_NS))
        with self._wake:
            self._jump_ns, self._paused, self._steps = to_ns, paused, 0
            self._wake.notify()

    def end(self) -> None:
        """End `run` soon."""
        with self._wake:
            self.stop.set()
            self._wake.notify()

    def run(self, start: float, loop: bool, hold: bool = False) -> None:
        """Publish from `start` to the end of the bag, again and again with `loop`. With `hold`,
        pause at the end and wait for `jump` or `end`.

        BagError: damaged, or start is not in the bag.
        """
        begin_ns: int | None = self._at(start)
        self._await_subscribers()
        next_ns = begin_ns
        while next_ns is not None and not self.stop.is_set():
            self._once(next_ns)
            with self._wake:
                if hold and not loop and self._jump_ns is None:
                    self._paused = True
                    self._wake.wait_for(
                        lambda: self.stop.is_set() or self._jump_ns is not None or not self._paused
                    )
                next_ns, self._shown_ns = begin_ns if loop or hold else None, 0
                if self._jump_ns is not None:
                    next_ns, self._jump_ns = self._jump_ns, None
                    self._shown_ns = next_ns + SHOWN_NS

    def _await_subscribers(self) -> None:
        """Wait until subscribers have found the publishers."""
        publishers = [*self._publishers.values(), *([self._clock] if self._clock else [])]
        raw = [
            publisher
            for topic, publisher in self._publishers.items()
            if topic.endswith("frequencies")
        ]
        found, since, enough = 0, time.monotonic(), NOBODY_S
        while time.monotonic() - since < enough and not self.stop.wait(LOOK_S):
            now = sum(publisher.get_subscription_count() for publisher in publishers)
            if now != found:
                found, since = now, time.monotonic()
                heard = all(publisher.get_subscription_count() for publisher in raw or publishers)
                enough = DISCOVERY_S if heard else NOBODY_S

    def _at(self, position: float) -> int:
        if not 0 <= position <= self.length:
            raise BagError(
                f"{self._bag.path}: {position:g} s is not in the bag, which is "
                f"{self.length:.3f} s long"
            )
        return self._bag.start_ns + round(position * SECOND)

    def _add(self, topic: str, connection: Any) -> None:
        profile = QoSProfile(
            depth=DEPTH,
            durability=DurabilityPolicy.TRANSIENT_LOCAL
            if connection.is_latched
            else DurabilityPolicy.VOLATILE,
            reliability=ReliabilityPolicy.BEST_EFFORT
            if connection.is_best_effort
            else ReliabilityPolicy.RELIABLE,
        )
        self._publishers[topic] = self._node.create_publisher(
            message_class(topic, connection.msgtype), topic, profile
        )
        if connection.is_latched:
            self._latched.add(topic)

    def _once(self, start_ns: int) -> None:
        # What was latched before the start is true at the start.
        for entry in self._bag.entries(self._latched, None, start_ns):
            self._publish(entry)
        self._anchor(start_ns)
        for entry in self._bag.entries(set(self._publishers), start_ns):
            if not self._wait(entry.time_ns):
                return
            self._publish_clock(entry.time_ns)
            self._publish(entry)
            self.position = (entry.time_ns - self._bag.start_ns) / SECOND
            if self._steps and entry.topic.endswith("frequencies"):
                with self._wake:
                    self._steps -= 1

    def _anchor(self, bag_ns: int) -> None:
        """Let the time bag_ns of the bag be now."""
        self._bag_ns, self._begun = bag_ns, time.monotonic()

    def _wait(self, bag_ns: int) -> bool:
        """Wait until a message is due. False: the player shall end or jump."""
        with self._wake:
            while not self.stop.is_set() and self._jump_ns is None:
                if self._paused:
                    if self._steps or bag_ns <= self._shown_ns:
                        self._anchor(bag_ns)
                        return True
                    self._wake.wait()
                    self._anchor(bag_ns)
                    continue
                left = (
                    self._begun + (bag_ns - self._bag_ns) / SECOND / self._rate - time.monotonic()
                )
                if left <= 0:
                    return True
                if self._clock is not None:
                    self._publish_clock(bag_ns - round(left * self._rate * SECOND))
                    left = min(left, CLOCK_S)
                self._wake.wait(left)
        return False

    def _publish_clock(self, bag_ns: int) -> None:
        if self._clock is not None:
            self._clock.publish(Clock(clock=Time(sec=bag_ns // SECOND, nanosec=bag_ns % SECOND)))

    def _publish(self, entry: Entry) -> None:
        self._publishers[entry.topic].publish(entry.data)
        self.published += 1
