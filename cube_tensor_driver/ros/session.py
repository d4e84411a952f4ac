"""rclpy started and ended, and the one loop that spins an executor."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ..core.errors import ConfigError
from ..processes.domain import VARIABLE, check_domain
from .compat import make_executor

STEP_S = 0.05
"""Maximum time, in seconds, that a spinning loop waits before it looks whether it is done."""


def start_ros() -> None:
    """Start rclpy in this process and leave signals to us.

    Raises:
        ConfigError: rclpy does not start, for example because of a wrong environment variable.
    """
    check_domain()
    try:
        # rclpy's own handlers would end the context under a thread that publishes.
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # RCLError, from a wrong variable or argument of ROS
        reason = " ".join(str(error).split())
        raise ConfigError(f"ROS 2 does not start: {reason}; correct ROS_* and RMW_*") from None


@contextmanager
def node_session(name: str) -> Iterator[tuple[Node, Any]]:
    """Give a node, and the executor that it is in, for the length of a block.

    The executor is to be spun in the main thread.

    Raises:
        ConfigError: rclpy does not start.
    """
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


def spin_until(
    executor: Any,
    is_done: Callable[[], object],
    seconds: float = float("inf"),
    *,
    step_s: float = STEP_S,
    on_step: Callable[[], None] | None = None,
) -> bool:
    """Spin an executor in this thread until something is done.

    `EventsExecutor.spin` can burn a core and does not return on a signal. Many short `spin_once` in
    the main thread do neither.

    Args:
        executor: The executor.
        is_done: Called before each step; a true value ends the loop.
        seconds: Maximum duration, in seconds.
        step_s: Maximum duration of a step, in seconds.
        on_step: Called after each step.

    Returns:
        Whether it is done. False means that the time is over.
    """
    until = time.monotonic() + seconds
    while not is_done():
        # Monotonic, because the clock of the system may be set meanwhile.
        left = until - time.monotonic()
        if left <= 0:
            return False
        executor.spin_once(timeout_sec=min(left, step_s))
        if on_step is not None:
            on_step()
    return True


def domain_text() -> str:
    """Return the DDS domain of this process in words."""
    return f"DDS domain {os.environ.get(VARIABLE) or 0}"
