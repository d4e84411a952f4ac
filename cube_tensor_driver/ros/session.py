"""A node for the time of a command: rclpy started and ended, signals left to the command."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ..core.errors import ConfigError
from ..processes.domain import check_domain
from .compat import make_executor


def start_ros() -> None:
    """Start rclpy in this process and leave signals to us. CubeError: it does not start."""
    check_domain()
    try:
        # rclpy's own handlers would end the context under a thread that publishes.
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # RCLError, from a wrong variable or argument of ROS
        reason = " ".join(str(error).split())
        raise ConfigError(f"ROS 2 does not start: {reason}; correct ROS_* and RMW_*") from None


@contextmanager
def node_session(name: str) -> Iterator[tuple[Node, Any]]:
    """A node and the executor that it is in, to be spun in the main thread. CubeError: ROS does not
    start."""
    start_ros()
    try:
        node, executor = rclpy.create_node(name), make_executor()
        executor.add_node(node)
        try:
            yield node, executor
        finally:
            executor.remove_node(node)
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
