# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Starts and ends rclpy, and spins executors; nodes and commands share these functions."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import rclpy
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ..core.errors import ConfigError
from ..processes.domain import VARIABLE, check_domain
from .compat import make_executor

STEP_S = 0.05
"""Default of the maximum duration, in seconds, of one step of `spin_until`."""


def start_ros() -> None:
    """Start rclpy in this process without its signal handlers.

    The program handles SIGINT and SIGTERM itself, see `processes/stop_signals.py`.

    Raises:
        ConfigError: rclpy does not start, for example because of a wrong environment variable.
    """
    check_domain()
    try:
        # The signal handlers of rclpy would shut down the context while a thread still publishes.
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    # rclpy raises RCLError, a RuntimeError, for a wrong environment variable or ROS argument.
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"ROS 2 does not start: {reason}; correct ROS_* and RMW_*") from None


class NodeSession(NamedTuple):
    """The node of a command, and the executor to which it was added.

    The main thread must spin the executor.
    """

    node: Node
    executor: Executor


@contextmanager
def run_node_session(name: str) -> Iterator[NodeSession]:
    """Start rclpy with a node for a `with` block, and shut rclpy down at its end.

    Args:
        name: Name of the node.

    Raises:
        ConfigError: rclpy does not start.
    """
    start_ros()
    try:
        node = rclpy.create_node(name)
        executor = make_executor()
        executor.add_node(node)
        try:
            yield NodeSession(node, executor)
        finally:
            executor.remove_node(node)
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def spin_until(
    executor: Executor,
    is_done: Callable[[], object],
    seconds: float = float("inf"),
    *,
    step_s: float = STEP_S,
    on_step: Callable[[], None] | None = None,
) -> bool:
    """Spin an executor in this thread until a condition is true.

    The loop calls `spin_once` for short steps. `EventsExecutor.spin` is not used, because it can
    occupy a whole CPU core and does not return on a signal.

    Args:
        executor: The executor.
        is_done: Called before each step; a true value ends the loop.
        seconds: Maximum duration of the loop, in seconds.
        step_s: Maximum duration of a step, in seconds.
        on_step: Called after each step.

    Returns:
        True if `is_done` ended the loop, False if `seconds` have passed.
    """
    until = time.monotonic() + seconds
    while not is_done():
        # The time is taken from the monotonic clock, because somebody may set the system clock
        # during the loop.
        left = until - time.monotonic()
        if left <= 0:
            return False
        executor.spin_once(timeout_sec=min(left, step_s))
        if on_step is not None:
            on_step()
    return True


def describe_domain() -> str:
    """Return a text such as "DDS domain 0" with the domain of this process, for messages."""
    return f"DDS domain {os.environ.get(VARIABLE) or 0}"
