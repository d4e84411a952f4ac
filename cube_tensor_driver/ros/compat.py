# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Features of rclpy that some releases of ROS 2 lack, with a replacement for each.

The code tests for the feature and not for the name of the release, so that a feature which was
added to an older release is used. ROS 2 Humble lacks all of them: the EventsExecutor, the event
that a subscriber was matched, the callback after parameters were set, the sequence numbers of
messages, and the module `event_handler`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.subscription import Subscription

try:
    from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
except ImportError:
    from rclpy.qos_event import (  # type: ignore[no-redef, unused-ignore]
        PublisherEventCallbacks,
        SubscriptionEventCallbacks,
    )

__all__ = [
    "SubscriptionEventCallbacks",
    "after_parameters_are_set",
    "make_executor",
    "on_matched",
    "with_number",
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


def on_matched(callback: Callable[[int], None]) -> PublisherEventCallbacks | None:
    """Return event callbacks for a publisher that report each change of its subscribers.

    Args:
        callback: Called with the number of subscribers after each change of this number.

    Returns:
        The argument `event_callbacks` of `create_publisher`, or None if this rclpy has no such
        event. The caller must then poll `get_subscription_count`.
    """
    if "matched" not in inspect.signature(PublisherEventCallbacks).parameters:
        return None

    def on_event(event: Any) -> None:
        callback(event.current_count)

    return PublisherEventCallbacks(matched=on_event)


def with_number(callback: Callable[[Any, int | None], None]) -> Callable[..., None]:
    """Wrap a function of a message and its sequence number so that a subscription can call it.

    Args:
        callback: Called with each message and its sequence number. DDS numbers the messages of each
            publisher consecutively. The number is None if this rclpy or DDS does not report it.

    Returns:
        The argument `callback` of `create_subscription`.
    """
    if not hasattr(Subscription, "CallbackType"):
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


def after_parameters_are_set(node: Node, callback: Callable[[list[Parameter]], None]) -> None:
    """Register a callback that is called after parameters of a node have been set.

    This function must be called before callbacks that may refuse a change are added to the node.
    ROS 2 Humble calls callbacks only before parameters are set, the one that was added last first.
    There this callback must be the last one, so that it is called only after all others have
    accepted the change.

    Args:
        node: The node.
        callback: Called with the list of the parameters that were set.
    """
    if hasattr(node, "add_post_set_parameters_callback"):
        node.add_post_set_parameters_callback(callback)
        return

    def before_change(parameters: list[Parameter]) -> SetParametersResult:
        # rclpy also calls this function when a parameter is declared. That is not a change of a
        # value, so parameters that the node does not have yet are left out.
        known = [parameter for parameter in parameters if node.has_parameter(parameter.name)]

        def after_change() -> None:
            node.destroy_timer(timer)
            callback(known)

        if known:
            # The timer calls `callback` in the next step of the executor. By then the parameters
            # have their new values.
            timer = node.create_timer(0.0, after_change)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(before_change)
