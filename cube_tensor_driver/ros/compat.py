"""What rclpy has in one ROS 2 and lacks in another, and what is done without it.

A feature is looked for, never the name of a distribution: so a backport is used, and a release that
nobody has seen yet works. Humble lacks all of these: the EventsExecutor, the event that a
subscriber came or went, the callback after parameters were set, the numbers of messages, and the
module `event_handler`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.subscription import Subscription

try:
    from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
except ImportError:
    from rclpy.qos_event import (  # type: ignore[import-not-found, no-redef]
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


def make_executor() -> Any:
    """The EventsExecutor, which costs a third of the default one, if this rclpy has it."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor()
    return EventsExecutor()


def on_matched(callback: Callable[[int], None]) -> PublisherEventCallbacks | None:
    """Events of a publisher that call back with the number of its subscribers when that changes.

    None: this rclpy has no such event; ask `get_subscription_count` now and then.
    """
    if "matched" not in inspect.signature(PublisherEventCallbacks).parameters:
        return None

    def matched(event: Any) -> None:
        callback(event.current_count)

    return PublisherEventCallbacks(matched=matched)


def with_number(callback: Callable[[Any, int | None], None]) -> Callable[..., None]:
    """Of a subscription: call back with each message and the number that DDS gave it among those
    of its publisher. None: this rclpy, or this DDS, does not say it."""
    if not hasattr(Subscription, "CallbackType"):
        return lambda message: callback(message, None)

    def with_info(*arguments: Any) -> None:
        # The EventsExecutor of Jazzy gives both as one tuple.
        message, info = arguments if len(arguments) == 2 else arguments[0]
        callback(message, info.get("publication_sequence_number"))

    # By this rclpy sees that the callback takes both.
    with_info.__signature__ = inspect.signature(lambda message, info: None)  # type: ignore[attr-defined]
    return with_info


def after_parameters_are_set(node: Node, callback: Callable[[list[Any]], None]) -> None:
    """Call back with the parameters of a node that have been set, after each change.

    Add it before the callbacks that may refuse a change: rclpy asks the newest first.
    """
    if hasattr(node, "add_post_set_parameters_callback"):
        node.add_post_set_parameters_callback(callback)
        return

    def about_to_be_set(parameters: list[Any]) -> SetParametersResult:
        known = [parameter for parameter in parameters if node.has_parameter(parameter.name)]

        def are_set() -> None:
            node.destroy_timer(timer)
            callback(known)

        if known:  # otherwise they are only declared
            # The executor comes to the timer when this change is done.
            timer = node.create_timer(0.0, are_set)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(about_to_be_set)
