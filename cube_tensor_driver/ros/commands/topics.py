# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Lists the topics that nodes publish, with the rate of their messages, for `./cube topics`."""

from __future__ import annotations

import contextlib
import re
import time
from dataclasses import dataclass

from rclpy.node import Node
from rclpy.subscription import Subscription

from ...core.errors import BagError, CubeError
from ..messages import find_message_class
from ..qos import match_offered_profile
from ..session import NodeSession, describe_domain, run_node_session, spin_until
from .echo import QUEUE_DEPTH
from .services import SETTLE_S, discover

COUNT_S = 1.0
"""Time, in seconds, for which the messages of each topic are counted."""

MAX_TRIES = 3
"""Maximum number of times that the messages of all topics are counted. They are counted again if
the number of topics has changed during the count."""

HIDDEN_TOPICS = ("/rosout", "/parameter_events")
"""Topics that are not listed, because every ROS node has them, also the node that lists."""

ANY_CUBE = "<name>"
"""Text that replaces the name of the cube in a listed topic, as in cubes/<name>/stress."""

_CUBE_TOPIC = re.compile(r"(?P<before>.*/cubes/)(?P<cube>[^/]+)(?P<after>/(stress|wrench))")
"""Pattern of the name of a topic of one cube, to list the topics of all cubes as one line."""


@dataclass
class ListedTopic:
    """A line of the list: one topic, or all topics whose names differ only in the name of a cube.

    Attributes:
        name: Full name of the topic. For topics of cubes it contains `<name>` in place of the name
            of the cube.
        kinds: Types of the messages.
        cubes: Names of the cubes that have the topic; empty for other topics.
        rate: Rate of the messages on the topic `counted_topic`, in Hz; None: the type of the
            messages is not installed.
    """

    name: str
    kinds: list[str]
    cubes: list[str]
    rate: float | None = None

    @property
    def counted_topic(self) -> str:
        """Full name of the topic whose messages are counted; for topics of cubes, the topic of the
        first cube."""
        if not self.cubes:
            return self.name
        return self.name.replace(ANY_CUBE, self.cubes[0])


def list_topics() -> list[ListedTopic]:
    """Return the topics in the DDS domain that have a publisher, sorted by name.

    Raises:
        CubeError: No topic was found.
    """
    with run_node_session("topic_list") as session:
        node, executor = session
        if not discover(executor, lambda: _find_topics(node)):
            raise CubeError(f"nobody publishes in {describe_domain()}; start ./cube demo or a skin")
        for _ in range(MAX_TRIES):
            topics = _find_topics(node)
            _measure_rates(session, topics)
            if len(topics) == len(_find_topics(node)):
                break
        return topics


def _find_topics(node: Node) -> list[ListedTopic]:
    topics: dict[str, ListedTopic] = {}
    for name, kinds in sorted(node.get_topic_names_and_types()):
        if name in HIDDEN_TOPICS or not node.count_publishers(name):
            continue
        # The topics of all cubes share one line, because 1000 cubes would give 2000 lines.
        found = _CUBE_TOPIC.fullmatch(name)
        common = f"{found['before']}{ANY_CUBE}{found['after']}" if found else name
        topic = topics.setdefault(common, ListedTopic(common, kinds, []))
        if found:
            topic.cubes.append(found["cube"])
    return list(topics.values())


def _measure_rates(session: NodeSession, topics: list[ListedTopic]) -> None:
    """Count the messages of topics for `COUNT_S`, and store the rate in each `ListedTopic`.

    Args:
        session: The node that subscribes to the topics.
        topics: The topics, whose `rate` is set.
    """
    node, executor = session
    counts: dict[str, int] = {}
    subscriptions = []
    for topic in topics:
        # Messages of a type that is not installed cannot be counted.
        with contextlib.suppress(BagError):
            subscriptions.append(_subscribe(node, topic, counts))
    # Counting begins after a pause: DDS needs time to connect the subscriptions, and latched
    # messages, which were published earlier, arrive in this time and are not counted.
    spin_until(executor, lambda: False, SETTLE_S)
    before = dict(counts)
    begin = time.monotonic()
    spin_until(executor, lambda: False, COUNT_S)
    # On a busy machine the time that has really passed is longer than COUNT_S.
    seconds = time.monotonic() - begin
    for topic in topics:
        if topic.name in counts:
            topic.rate = (counts[topic.name] - before[topic.name]) / seconds
    for subscription in subscriptions:
        node.destroy_subscription(subscription)


def _subscribe(
    node: Node,
    topic: ListedTopic,
    counts: dict[str, int],
) -> Subscription:
    """Return a subscription that counts messages.

    Args:
        node: The node that subscribes.
        topic: The topic.
        counts: Name of a topic -> number of its messages. It gets an entry for this topic.

    Raises:
        BagError: The type of the messages is not installed.
    """
    kind = find_message_class(topic.counted_topic, topic.kinds[0])
    counts[topic.name] = 0

    def receive(_: bytes) -> None:
        counts[topic.name] += 1

    offers = node.get_publishers_info_by_topic(topic.counted_topic)
    profile = match_offered_profile(offers, QUEUE_DEPTH)
    return node.create_subscription(
        kind,
        topic.counted_topic,
        receive,
        profile,
        raw=True,
    )
