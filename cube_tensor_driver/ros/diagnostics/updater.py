"""Diagnostics at 1 Hz, by diagnostic_updater if it is installed, otherwise by a substitute."""

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
        """The part of diagnostic_updater's class that is used here."""

        def __init__(self, node: Node, period: float = 1.0) -> None:
            self.node, self.node_name = node, node.get_name()
            self.publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
            self.timer = node.create_timer(period, self.update)

        def update(self) -> None:
            """Publish the statuses. Called by the timer."""

        def publish(self, statuses: list[DiagnosticStatus]) -> None:
            """Publish these statuses under the name of the node."""
            message = DiagnosticArray(status=statuses)
            message.header.stamp = self.node.get_clock().now().to_msg()
            for status in statuses:
                status.name = f"{self.node_name}: {status.name}"
            self.publisher.publish(message)


class Diagnostics(Updater):  # type: ignore[misc]
    """Publishes statuses of a node once a second, for as long as the node lives."""

    def __init__(
        self,
        node: Node,
        statuses: Callable[[], list[DiagnosticStatus]],
        count_errors: Callable[[], int],
    ) -> None:
        """Begin to publish.

        Args:
            node: The node.
            statuses: Returns what to publish; nothing is published where it returns none.
            count_errors: Returns how many callbacks of the node have failed so far, which the
                first status also says.
        """
        super().__init__(node)
        self._statuses, self._count_errors = statuses, count_errors
        self._errors_before = 0
        # With the namespace, because a skin may run in several. Left to itself, the updater uses
        # the bare name or doubles the slash.
        self.node_name = node.get_fully_qualified_name()

    def update(self) -> None:
        """Publish the statuses. Called by the timer."""
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
    """Return the status of one part of a node."""
    pairs = [_make_pair(name, key, str(value)) for key, value in values.items()]
    return DiagnosticStatus(
        name=name, hardware_id=hardware_id, level=level, message=text, values=pairs
    )


_newest_pairs: dict[tuple[str, str], KeyValue] = {}


def _make_pair(name: str, key: str, value: str) -> KeyValue:
    """Return a key with its value.

    The last pair is used again if the value has not changed, because rclpy takes 2 µs to make one.
    """
    pair = _newest_pairs.get((name, key))
    if pair is None or pair.value != value:
        pair = _newest_pairs[name, key] = KeyValue(key=key, value=value)
    return pair
