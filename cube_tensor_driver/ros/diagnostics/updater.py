# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Publishes diagnostics of a node once a second.

The package diagnostic_updater of ROS is not used: it publishes on /diagnostics only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import (
    DiagnosticArray,
    DiagnosticStatus,
    KeyValue,
)

from ..node import CubeNode

TOPICS = ("/diagnostics", "diagnostics")
"""Topics on which each node publishes its diagnostics.

All nodes of a robot share the first one, which tools of ROS read. The second one lies in the
namespace of the node, so that the recording of a skin contains only what concerns this skin.
"""

PERIOD_S = 1.0
"""Time, in seconds, between two messages of diagnostics of a node."""

QUEUE_DEPTH = 10
"""Depth of the queue of each topic of diagnostics, in messages. It holds the messages of several
nodes of a robot that publish at the same time."""


class Diagnostics:
    """Publishes the diagnostic statuses of a node once a second, until the node is destroyed."""

    def __init__(
        self,
        node: CubeNode,
        statuses: Callable[[], list[DiagnosticStatus]],
    ) -> None:
        """Begin to publish.

        Args:
            node: The node. The number of its callbacks' errors is added to the first status.
            statuses: Returns the statuses to publish. If the list is empty, nothing is published.
        """
        self._node = node
        self._make_statuses = statuses
        self._errors_before = 0
        # In a node without a namespace both names resolve to the same topic, which then gets only
        # one publisher.
        topics = {node.resolve_topic_name(topic) for topic in TOPICS}
        self._publishers = [
            node.create_publisher(DiagnosticArray, topic, QUEUE_DEPTH) for topic in topics
        ]
        node.create_timer(PERIOD_S, self._publish)

    def _publish(self) -> None:
        statuses = self._make_statuses()
        if not statuses:
            return
        self._add_errors(statuses[0])
        # The name contains the namespace, because several skins may run in different namespaces.
        node_name = self._node.get_fully_qualified_name()
        for status in statuses:
            status.name = f"{node_name}: {status.name}"
        message = DiagnosticArray(status=statuses)
        now = self._node.get_clock().now()
        message.header.stamp = now.to_msg()
        for publisher in self._publishers:
            publisher.publish(message)

    def _add_errors(self, status: DiagnosticStatus) -> None:
        errors = self._node.count_errors()
        pair = KeyValue(key="callback errors", value=str(errors))
        status.values = [*status.values, pair]
        if errors > self._errors_before:
            status.level = DiagnosticStatus.ERROR
            new_errors = errors - self._errors_before
            text = f"{new_errors} callbacks failed: see the log of the node"
            texts = filter(None, [status.message, text])
            status.message = "; ".join(texts)
        self._errors_before = errors


def make_status(
    name: str,
    hardware_id: str,
    level: bytes,
    text: str,
    values: Mapping[str, object],
) -> DiagnosticStatus:
    """Return the diagnostic status of one part of a node.

    Args:
        name: Name of the part, such as "link hub0".
        hardware_id: Identifies the device, as a uid in hexadecimal; empty: it is not known.
        level: Level of the status, a constant of DiagnosticStatus.
        text: Message of the status.
        values: Key -> value, shown as text.
    """
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(
        name=name,
        hardware_id=hardware_id,
        level=level,
        message=text,
        values=pairs,
    )
