# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Publishes diagnostics of a node at 1 Hz.

The package diagnostic_updater of ROS is used if it is installed, otherwise a replacement.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import (
    DiagnosticArray,
    DiagnosticStatus,
    KeyValue,
)
from rclpy.node import Node

try:
    from diagnostic_updater import Updater
except ModuleNotFoundError:

    class Updater:  # type: ignore[no-redef]
        """Replacement of diagnostic_updater's class, with the methods that are used here."""

        def __init__(self, node: Node, period: float = 1.0) -> None:
            self.node, self.node_name = node, node.get_name()
            self.publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
            self.timer = node.create_timer(period, self.update)

        def update(self) -> None:
            """Publish the statuses of the node; subclasses override it. The timer calls it."""

        def publish(self, statuses: list[DiagnosticStatus]) -> None:
            """Publish statuses, with the name of the node in front of their names."""
            message = DiagnosticArray(status=statuses)
            message.header.stamp = self.node.get_clock().now().to_msg()
            for status in statuses:
                status.name = f"{self.node_name}: {status.name}"
            self.publisher.publish(message)


class Diagnostics(Updater):  # type: ignore[misc]
    """Publishes the diagnostic statuses of a node once a second, until the node is destroyed."""

    def __init__(
        self,
        node: Node,
        statuses: Callable[[], list[DiagnosticStatus]],
        count_errors: Callable[[], int],
    ) -> None:
        """Begin to publish.

        Args:
            node: The node.
            statuses: Returns the statuses to publish. If the list is empty, nothing is published.
            count_errors: Returns the number of calls of the node's callbacks that have raised an
                exception so far. It is added to the first status.
        """
        super().__init__(node)
        self._statuses, self._count_errors = statuses, count_errors
        self._errors_before = 0
        # The name contains the namespace, because several skins may run in different namespaces.
        # By itself diagnostic_updater uses the name without namespace, or writes two slashes.
        self.node_name = node.get_fully_qualified_name()

    def update(self) -> None:
        """Publish the statuses of the node. A timer of the base class calls this once a second."""
        statuses = self._statuses()
        if statuses:
            self._add_errors(statuses[0])
            self.publish(statuses)

    def _add_errors(self, status: DiagnosticStatus) -> None:
        errors = self._count_errors()
        status.values = [*status.values, KeyValue(key="callback errors", value=str(errors))]
        if errors > self._errors_before:
            status.level = DiagnosticStatus.ERROR
            text = f"{errors - self._errors_before} callbacks failed: see the log of the node"
            status.message = "; ".join(filter(None, [status.message, text]))
        self._errors_before = errors


def make_status(
    name: str,
    hardware_id: str,
    level: bytes,
    text: str,
    values: Mapping[str, Any],
) -> DiagnosticStatus:
    """Return the diagnostic status of one part of a node.

    Args:
        name: Name of the part, such as "link hub0".
        hardware_id: Identifies the device, as a uid in hexadecimal; empty: it is not known.
        level: Level of the status, a constant of DiagnosticStatus.
        text: Message of the status.
        values: Key -> value, shown as text.
    """
    pairs = [_make_pair(name, key, str(value)) for key, value in values.items()]
    return DiagnosticStatus(
        name=name, hardware_id=hardware_id, level=level, message=text, values=pairs
    )


_newest_pairs: dict[tuple[str, str], KeyValue] = {}
"""(name of a status, key) -> the pair of key and value that was published last."""


def _make_pair(name: str, key: str, value: str) -> KeyValue:
    """Return a pair of key and value for the status with this name.

    The previous pair is returned if the value has not changed, because rclpy takes 2 µs to make a
    new one.

    Args:
        name: Name of the diagnostic status.
        key: Key within this status.
        value: Value as text.
    """
    pair = _newest_pairs.get((name, key))
    if pair is None or pair.value != value:
        pair = _newest_pairs[name, key] = KeyValue(key=key, value=value)
    return pair
