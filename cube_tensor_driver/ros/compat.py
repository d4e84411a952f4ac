# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Features of rclpy that some releases of ROS 2 lack, with a replacement for each.

The code tests for the feature and not for the name of the release, so that a feature which was
added to an older release is used. ROS 2 Humble lacks all of them: the EventsExecutor, the sequence
numbers of messages, and the module `event_handler`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.subscription import Subscription

try:
    from rclpy.event_handler import SubscriptionEventCallbacks
except ImportError:
    from rclpy.qos_event import (  # type: ignore[no-redef, unused-ignore]
        SubscriptionEventCallbacks,
    )

__all__ = [
    "SubscriptionEventCallbacks",
    "has_message_numbers",
    "make_executor",
    "wrap_with_number",
]


def make_executor(warn: Callable[[str], object] = lambda text: None) -> Executor:
    """Return a new executor: an EventsExecutor if this rclpy has it, else a SingleThreadedExecutor.

    The EventsExecutor takes a third of the CPU time of the other one. ROS 2 Jazzy (rclpy 7.1.4),
    Kilted and Lyrical (rclpy 10) have it in the same module.

    Args:
        warn: Called with one line of text if this rclpy has no EventsExecutor.
    """
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        warn(
            "this rclpy has no EventsExecutor: the nodes take about three times the CPU time; "
            "install rclpy 7.1.4 (ROS 2 Jazzy) or newer"
        )
        return SingleThreadedExecutor()
    return EventsExecutor()


def has_message_numbers() -> bool:
    """Return whether this rclpy passes the sequence numbers of messages to callbacks."""
    return hasattr(Subscription, "CallbackType")


def wrap_with_number(callback: Callable[[Any, int | None], None]) -> Callable[..., None]:
    """Wrap a function that takes a message and its sequence number, as callback of a subscription.

    Args:
        callback: Called with each message and its sequence number. DDS numbers the messages of each
            publisher consecutively. The number is None if this rclpy or DDS does not report it.

    Returns:
        The argument `callback` of `create_subscription`.
    """
    if not has_message_numbers():
        # This release of rclpy passes only the message and no sequence number to callbacks.
        return lambda message: callback(message, None)

    def call(*arguments: Any) -> None:
        # The EventsExecutor of ROS 2 Jazzy passes message and MessageInfo as one tuple.
        message, info = arguments if len(arguments) == 2 else arguments[0]
        callback(message, info.get("publication_sequence_number"))

    # rclpy passes the MessageInfo, which contains the sequence number, only to callbacks whose
    # signature has two parameters.
    call.__signature__ = inspect.signature(lambda message, info: None)  # type: ignore[attr-defined]
    return call
