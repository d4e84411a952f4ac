"""Quality of service of all topics and services of the package."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from ..core.errors import ConfigError

MAX_PAUSE_S = 2.0
"""Time, in seconds, for which a subscriber may pause without losing messages of a batch topic.

The depth of a queue is this time multiplied by the rate of messages.
"""

MAX_QUEUE_BYTES = 64_000_000
"""Maximum size of a queue, in bytes, so that no process grows beyond 200 MB.

The queues of the largest skins hold less than `MAX_PAUSE_S`.
"""

MIN_BATCH_DEPTH = 10
"""Minimum depth of the queue of a batch topic, in messages."""

ROW_BYTES = 78
"""Size of a row of `stress` in a message, in bytes. A row of `frequencies` of 8 pads is smaller."""

DEFAULT_RATE_HZ = 1000.0
"""Rate of messages, in Hz, that is assumed where it is not known."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""For `info` topics: whoever subscribes late still gets the last message."""

NEWEST = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
"""For viewers, which want the newest messages and not all: a slow viewer holds up nobody."""

SERVICES = QoSProfile(depth=1000)
"""For services. ROS's own depth is 10: with more calls at once DDS silently drops the oldest.

Parameter services have a depth of 1000 anyway.
"""

_RELIABILITIES = {
    "reliable": ReliabilityPolicy.RELIABLE,
    "best_effort": ReliabilityPolicy.BEST_EFFORT,
}


def batch_profile(
    rate_hz: float | None, reliability: str = "reliable", rows: int = 1
) -> QoSProfile:
    """Return the profile of a batch topic, `frequencies` or `stress`.

    Args:
        rate_hz: Messages per second; None: not known.
        reliability: reliable or best_effort.
        rows: Number of rows of each message.

    Raises:
        ConfigError: There is no such reliability.
    """
    if reliability not in _RELIABILITIES:
        allowed = ", ".join(_RELIABILITIES)
        raise ConfigError(f"parameter qos_reliability is {reliability!r}, allowed: {allowed}")
    wanted_depth = (rate_hz or DEFAULT_RATE_HZ) * MAX_PAUSE_S
    # A large skin with a deep queue would fill the memory of a robot.
    affordable_depth = MAX_QUEUE_BYTES / (rows * ROW_BYTES)
    depth = max(MIN_BATCH_DEPTH, math.ceil(min(wanted_depth, affordable_depth)))
    return QoSProfile(depth=depth, reliability=_RELIABILITIES[reliability])


def scans_per_message(publish_period_s: float, rate_hz: float | None) -> int:
    """Return how many scans a message holds that covers a publish period, at least one.

    Args:
        publish_period_s: Time that a message covers, in seconds.
        rate_hz: Samples per second; None: not known.
    """
    return max(1, round(publish_period_s * (rate_hz or DEFAULT_RATE_HZ)))


def make_profile(
    depth: int,
    *,
    is_latched: bool,
    is_best_effort: bool,
) -> QoSProfile:
    """Return the profile of a topic with a queue of `depth` messages."""
    profile = QoSProfile(depth=depth)
    if is_latched:
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    if is_best_effort:
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    return profile


def offered_profile(offers: Sequence[TopicEndpointInfo], depth: int) -> QoSProfile:
    """Return the profile of a subscription that fits all publishers of a topic.

    It is latched only if all publishers are, and best effort as soon as one of them is: a stricter
    subscription would get nothing from that publisher.

    Args:
        offers: The publishers.
        depth: Depth of the queue, in messages.
    """
    profiles = [offer.qos_profile for offer in offers]
    # A latched subscription does not match a publisher that is not.
    are_latched = [one.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in profiles]
    # A reliable subscription does not match a publisher of best effort.
    are_reliable = [one.reliability == ReliabilityPolicy.RELIABLE for one in profiles]
    return make_profile(
        depth,
        is_latched=bool(profiles) and all(are_latched),
        is_best_effort=not all(are_reliable),
    )
