"""The executor of nodes and commands."""

from __future__ import annotations

from typing import Any


def make_executor() -> Any:
    """The EventsExecutor, which costs a third of the default one, if this rclpy has it."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor()
    return EventsExecutor()
