"""Diagnostics at 1 Hz: by diagnostic_updater where it is installed, else by what stands in for it
here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

try:
    from diagnostic_updater import Updater
except ModuleNotFoundError:

    class Updater:  # type: ignore[no-redef]
        """What is used of the real one; it has a parameter for the period besides."""

        def __init__(self, node: Node, period: float = 1.0) -> None:
            self.node, self.node_name = node, node.get_name()
            self.publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
            self.timer = node.create_timer(period, self.update)

        def update(self) -> None:
            """Called by the timer."""

        def publish(self, statuses: list[DiagnosticStatus]) -> None:
            message = DiagnosticArray(status=statuses)
            message.header.stamp = self.node.get_clock().now().to_msg()
            for status in statuses:
                status.name = f"{self.node_name}: {status.name}"
            self.publisher.publish(message)


class Diagnostics(Updater):  # type: ignore[misc]
    """Publishes what `statuses` says, if anything, under the node's full name; for as long as the
    node lives."""

    def __init__(self, node: Node, statuses: Callable[[], list[DiagnosticStatus]]) -> None:
        super().__init__(node)
        self._statuses = statuses
        # The updater knows the bare name only, or doubles the slash; one skin may run in several
        # namespaces.
        self.node_name = node.get_fully_qualified_name()

    def update(self) -> None:
        """Called by the timer."""
        statuses = self._statuses()
        if statuses:
            self.publish(statuses)


def make_status(
    name: str, hardware_id: str, level: bytes, text: str, values: Mapping[str, Any]
) -> DiagnosticStatus:
    """A status of a part of the node."""
    pairs = [_pair(name, key, str(value)) for key, value in values.items()]
    return DiagnosticStatus(
        name=name, hardware_id=hardware_id, level=level, message=text, values=pairs
    )


_newest: dict[tuple[str, str], KeyValue] = {}


def _pair(name: str, key: str, value: str) -> KeyValue:
    """Most values stay as they are from one second to the next, and rclpy takes 2 us to make a
    pair."""
    pair = _newest.get((name, key))
    if pair is None or pair.value != value:
        pair = _newest[name, key] = KeyValue(key=key, value=value)
    return pair
