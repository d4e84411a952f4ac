"""The topics that nodes publish here, with what comes on them within a second."""

from __future__ import annotations

import time
from dataclasses import dataclass

from rclpy.node import Node

from ..core.errors import BagError, CubeError
from .asking import SETTLE_S, discover_all, domain_text, spin
from .listening import profile_of
from .recorder import message_class
from .session import node_session

COUNT_S = 1.0
OWN = ("/rosout", "/parameter_events")
"""Every node has these, ours too."""


@dataclass
class Topic:
    """count: messages within COUNT_S; None where a topic's messages are not installed here."""

    name: str
    kinds: list[str]
    publishers: int
    count: int | None = 0

    @property
    def rate(self) -> float | None:
        """Messages per second."""
        return None if self.count is None else self.count / COUNT_S


def list_topics() -> list[Topic]:
    """Topics that somebody publishes, by name. CubeError: there is none."""
    with node_session("topic_list") as (node, executor):
        discover_all(executor, lambda: _published(node))
        topics = _published(node)
        if not topics:
            raise CubeError(f"nobody publishes in {domain_text()}; start ./cube demo or a skin")
        for topic in topics:
            _listen(node, topic)
        # Latched messages of before are no rate, and subscriptions take a moment to be matched.
        spin(executor, SETTLE_S)
        before = {topic.name: topic.count or 0 for topic in topics}
        begin = time.monotonic()
        spin(executor, COUNT_S)
        seconds = time.monotonic() - begin
        for topic in topics:
            if topic.count is not None:
                topic.count = round((topic.count - before[topic.name]) * COUNT_S / seconds)
        return topics


def _published(node: Node) -> list[Topic]:
    return [
        Topic(name, kinds, publishers)
        for name, kinds in sorted(node.get_topic_names_and_types())
        if name not in OWN and (publishers := node.count_publishers(name))
    ]


def _listen(node: Node, topic: Topic) -> None:
    try:
        kind = message_class(topic.name, topic.kinds[0])
    except BagError:
        topic.count = None
        return

    def receive(_: bytes) -> None:
        topic.count = (topic.count or 0) + 1

    offers = node.get_publishers_info_by_topic(topic.name)
    node.create_subscription(kind, topic.name, receive, profile_of(offers), raw=True)
