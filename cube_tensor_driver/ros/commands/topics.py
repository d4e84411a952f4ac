"""The topics that nodes publish, with the number of messages that come within a second."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node

from ...core.errors import BagError, CubeError
from ..messages import message_class
from ..qos import offered_profile
from ..session import domain_text, node_session, spin_until
from .echo import QUEUE_DEPTH
from .services import SETTLE_S, discover_all

COUNT_S = 1.0
"""Time, in seconds, for which messages are counted."""

MAX_TRIES = 3
"""Maximum number of attempts to count messages.

They are counted again if topics came or went meanwhile.
"""

HIDDEN_TOPICS = ("/rosout", "/parameter_events")
"""Topics that every node has, ours too."""

ANY_CUBE = "<name>"
_CUBE_TOPIC = re.compile(r"(?P<before>.*/cubes/)(?P<cube>[^/]+)(?P<after>/(stress|wrench))")


@dataclass
class ListedTopic:
    """One topic, or one kind of topic of all cubes, of which the first cube's is listened to.

    Attributes:
        name: Full name, in which `<name>` stands for each of `cubes`, if there are any.
        kinds: Types of its messages.
        cubes: Names of the cubes.
        count: Number of messages within `COUNT_S`; None: its messages are not installed here.
    """

    name: str
    kinds: list[str]
    cubes: list[str]
    count: int | None = 0

    @property
    def rate(self) -> float | None:
        """Messages per second."""
        return None if self.count is None else self.count / COUNT_S

    @property
    def listened(self) -> str:
        """The topic that is listened to."""
        return self.name.replace(ANY_CUBE, self.cubes[0]) if self.cubes else self.name


def list_topics() -> list[ListedTopic]:
    """Return the topics that somebody publishes, by name. CubeError: there is none."""
    with node_session("topic_list") as (node, executor):
        if not discover_all(executor, lambda: _find_topics(node)):
            raise CubeError(f"nobody publishes in {domain_text()}; start ./cube demo or a skin")
        for _ in range(MAX_TRIES):
            topics = _find_topics(node)
            _count_messages(node, executor, topics)
            if len(topics) == len(_find_topics(node)):
                break
        return topics


def _find_topics(node: Node) -> list[ListedTopic]:
    topics: dict[str, ListedTopic] = {}
    for name, kinds in sorted(node.get_topic_names_and_types()):
        if name in HIDDEN_TOPICS or not node.count_publishers(name):
            continue
        # A skin of 1000 cubes would give 2000 lines.
        found = _CUBE_TOPIC.fullmatch(name)
        common = f"{found['before']}{ANY_CUBE}{found['after']}" if found else name
        topic = topics.setdefault(common, ListedTopic(common, kinds, []))
        if found:
            topic.cubes.append(found["cube"])
    return list(topics.values())


def _count_messages(
    node: Node,
    executor: Any,
    topics: list[ListedTopic],
) -> None:
    """Count the messages of these topics."""
    subscriptions = [_subscribe(node, topic) for topic in topics]
    # Latched messages of before are no rate, and subscriptions take a moment to be matched.
    spin_until(executor, lambda: False, SETTLE_S)
    before = {topic.name: topic.count or 0 for topic in topics}
    begin = time.monotonic()
    spin_until(executor, lambda: False, COUNT_S)
    # A busy machine spins for longer than it was asked to.
    seconds = time.monotonic() - begin
    for topic in topics:
        if topic.count is not None:
            topic.count = round((topic.count - before[topic.name]) * COUNT_S / seconds)
    for subscription in filter(None, subscriptions):
        node.destroy_subscription(subscription)


def _subscribe(node: Node, topic: ListedTopic) -> Any:
    """Return a subscription that counts, or None if the messages are not installed."""
    try:
        kind = message_class(topic.listened, topic.kinds[0])
    except BagError:
        topic.count = None
        return None

    def receive(_: bytes) -> None:
        topic.count = (topic.count or 0) + 1

    offers = node.get_publishers_info_by_topic(topic.listened)
    profile = offered_profile(offers, QUEUE_DEPTH)
    return node.create_subscription(
        kind,
        topic.listened,
        receive,
        profile,
        raw=True,
    )
