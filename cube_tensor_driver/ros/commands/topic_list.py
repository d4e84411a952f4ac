"""The topics that nodes publish here, with what comes on them within a second."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node

from ...core.errors import BagError, CubeError
from ..messages import message_class
from ..session import node_session
from .asking import SETTLE_S, discover_all, domain_text, spin
from .listening import profile_of

COUNT_S = 1.0
TRIES = 3
"""It is counted again where topics came or went meanwhile."""
OWN = ("/rosout", "/parameter_events")
"""Every node has these, ours too."""
ANY = "<name>"
_OF_A_CUBE = re.compile(r"(?P<before>.*/cubes/)(?P<cube>[^/]+)(?P<after>/(stress|wrench))")


@dataclass
class Topic:
    """One topic, or one kind of topic of all cubes, of which the first cube's is listened to.

    name: `<name>` in it stands for each of `cubes`, if there are any
    count: messages within COUNT_S; None where a topic's messages are not installed here
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
        return self.name.replace(ANY, self.cubes[0]) if self.cubes else self.name


def list_topics() -> list[Topic]:
    """Topics that somebody publishes, by name. CubeError: there is none."""
    with node_session("topic_list") as (node, executor):
        if not discover_all(executor, lambda: _published(node)):
            raise CubeError(f"nobody publishes in {domain_text()}; start ./cube demo or a skin")
        for _ in range(TRIES):
            topics = _published(node)
            _count(node, executor, topics)
            if len(topics) == len(_published(node)):
                break
        return topics


def _count(node: Node, executor: Any, topics: list[Topic]) -> None:
    """Count what comes on these topics within COUNT_S."""
    listeners = [_listen(node, topic) for topic in topics]
    # Latched messages of before are no rate, and subscriptions take a moment to be matched.
    spin(executor, SETTLE_S)
    before = {topic.name: topic.count or 0 for topic in topics}
    begin = time.monotonic()
    spin(executor, COUNT_S)
    seconds = time.monotonic() - begin
    for topic in topics:
        if topic.count is not None:
            topic.count = round((topic.count - before[topic.name]) * COUNT_S / seconds)
    for listener in filter(None, listeners):
        node.destroy_subscription(listener)


def _published(node: Node) -> list[Topic]:
    topics: dict[str, Topic] = {}
    for name, kinds in sorted(node.get_topic_names_and_types()):
        if name in OWN or not node.count_publishers(name):
            continue
        found = _OF_A_CUBE.fullmatch(name)
        common = f"{found['before']}{ANY}{found['after']}" if found else name
        topic = topics.setdefault(common, Topic(common, kinds, []))
        if found:
            topic.cubes.append(found["cube"])
    return list(topics.values())


def _listen(node: Node, topic: Topic) -> Any:
    """The subscription; None if the messages are not installed."""
    try:
        kind = message_class(topic.listened, topic.kinds[0])
    except BagError:
        topic.count = None
        return None

    def receive(_: bytes) -> None:
        topic.count = (topic.count or 0) + 1

    offers = node.get_publishers_info_by_topic(topic.listened)
    return node.create_subscription(kind, topic.listened, receive, profile_of(offers), raw=True)
