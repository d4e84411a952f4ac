# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Quality of service (QoS) of all topics and services of the package.

The batch topics are `frequencies`, `stress` and `forces`, whose messages hold rows of all cubes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

MAX_PAUSE_S = 2.0
"""Longest pause, in seconds, that a subscriber of a batch topic may make without losing a message.
A batch topic is one whose messages hold all cubes, such as `stress`.

The depth of a queue is this time multiplied by the rate of messages, unless `MAX_QUEUE_BYTES`
limits it.
"""

MAX_QUEUE_BYTES = 64_000_000
"""Maximum size, in bytes, of the queue of a batch topic (a topic whose messages hold all cubes).

A full queue is the largest part of the memory of a process; with this limit a process stays below
200 MB. On the largest skins a queue of this size holds the messages of less than `MAX_PAUSE_S`, so
a subscriber loses messages in a shorter pause already.
"""

MIN_BATCH_DEPTH = 10
"""Minimum depth of the queue of a batch topic (a topic whose messages hold all cubes), in messages.
"""

ROW_BYTES = 78
"""Size of a row (the stress of one cube at one instant) in a message of `stress`, in bytes.

The depths of the queues of all batch topics are computed with it. A row of `frequencies` of a cube
with 8 pads is smaller, so the queue of that topic stays below `MAX_QUEUE_BYTES`.
"""

DEFAULT_RATE_HZ = 1000.0
"""Sampling rate or rate of messages, in Hz, that is assumed if the skin file does not state it."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Profile (quality of service) of the topics `info` and `driver/info`, which describe the skin. A
node that subscribes after the last message still gets that message."""

NEWEST = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Profile (quality of service) of subscribers that need only the newest messages, such as viewers.

With best effort, a slow subscriber does not make the publisher wait.
"""

SERVICES = QoSProfile(depth=1000)
"""Profile (quality of service) of services.

With the default depth of ROS, 10, DDS silently drops the oldest request when more than 10 wait. The
parameter services of rclpy have a depth of 1000, too.
"""


def make_batch_profile(
    rate_hz: float | None,
    reliability: str = "reliable",
    rows: int = 1,
) -> QoSProfile:
    """Return the profile of a batch topic: `frequencies`, `stress` or `forces`.

    Args:
        rate_hz: Rate of the messages, in Hz; None: not known, `DEFAULT_RATE_HZ` is assumed.
        reliability: reliable or best_effort.
        rows: Number of rows in each message. A row is one sample of one cube.
    """
    wanted_depth = (rate_hz or DEFAULT_RATE_HZ) * MAX_PAUSE_S
    # The messages of a large skin are so large that a queue of the wanted depth would take too much
    # memory.
    affordable_depth = MAX_QUEUE_BYTES / (rows * ROW_BYTES)
    depth = max(MIN_BATCH_DEPTH, math.ceil(min(wanted_depth, affordable_depth)))
    policy = ReliabilityPolicy.get_from_short_key(reliability)
    return QoSProfile(depth=depth, reliability=policy)


def count_scans_per_message(publish_period_s: float, rate_hz: float | None) -> int:
    """Return the number of scans (samples of all cubes) that one message holds, at least one.

    Args:
        publish_period_s: Time, in seconds, between two messages. A message holds the scans of this
            time.
        rate_hz: Rate of scans, in Hz; None: not known, `DEFAULT_RATE_HZ` is assumed.
    """
    return max(1, round(publish_period_s * (rate_hz or DEFAULT_RATE_HZ)))


def make_profile(
    depth: int,
    *,
    is_latched: bool,
    is_best_effort: bool,
) -> QoSProfile:
    """Return the profile of a topic.

    Args:
        depth: Depth of the queue, in messages.
        is_latched: Whether a late subscriber still gets the last message (transient local).
        is_best_effort: Whether lost messages are not sent again (best effort).
    """
    profile = QoSProfile(depth=depth)
    if is_latched:
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    if is_best_effort:
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    return profile


def match_offered_profile(
    offers: Sequence[TopicEndpointInfo],
    depth: int,
) -> QoSProfile:
    """Return the profile of a subscription that matches all publishers of a topic.

    The subscription is latched (transient local) only if all publishers are, and it is best effort
    if at least one publisher is. Otherwise DDS would not connect it to some of the publishers.

    Args:
        offers: The publishers of the topic, as `get_publishers_info_by_topic` returns them.
        depth: Depth of the queue, in messages.
    """
    profiles = [offer.qos_profile for offer in offers]
    # DDS does not connect a transient-local subscription with a volatile publisher.
    are_latched = [one.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in profiles]
    # DDS does not connect a reliable subscription with a best-effort publisher.
    are_reliable = [one.reliability == ReliabilityPolicy.RELIABLE for one in profiles]
    return make_profile(
        depth,
        is_latched=bool(profiles) and all(are_latched),
        is_best_effort=not all(are_reliable),
    )
