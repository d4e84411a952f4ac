"""What rclpy has in one ROS 2 and lacks in another, and what is done without it.

A feature is looked for, never the name of a distribution: so a backport is used, and later releases
work. Humble lacks all of these: the EventsExecutor, the event that a subscriber came or went, the
callback after parameters were set, the sequence numbers of messages, and the module
`event_handler`.
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


def make_executor() -> Any:
    """Return an EventsExecutor, which costs a third of the default one, if this rclpy has it."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor()
    return EventsExecutor()


def on_matched(callback: Callable[[int], None]) -> PublisherEventCallbacks | None:
    """Return events of a publisher that tell the number of its subscribers when that changes.

    None means that this rclpy has no such event; then call `get_subscription_count` from time to
    time.
    """
    if "matched" not in inspect.signature(PublisherEventCallbacks).parameters:
        return None

    def on_event(event: Any) -> None:
        callback(event.current_count)

    return PublisherEventCallbacks(matched=on_event)


def with_number(callback: Callable[[Any, int | None], None]) -> Callable[..., None]:
    """Return the callback of a subscription that also takes the sequence number of each message.

    DDS numbers the messages of each publisher. The number is None where this rclpy, or this DDS,
    does not tell it.
    """
    if not hasattr(Subscription, "CallbackType"):
        # Without the info of a message there is no number.
        return lambda message: callback(message, None)

    def call(*arguments: Any) -> None:
        # The EventsExecutor of Jazzy gives both as one tuple.
        message, info = arguments if len(arguments) == 2 else arguments[0]
        callback(message, info.get("publication_sequence_number"))

    # rclpy looks at the number of parameters to see that the callback takes the info, too.
    call.__signature__ = inspect.signature(lambda message, info: None)  # type: ignore[attr-defined]
    return call


def after_parameters_are_set(node: Node, callback: Callable[[list[Any]], None]) -> None:
    """Call back with the parameters of a node that have been set, after each change.

    Call this before adding callbacks that may refuse a change: rclpy asks the newest one first.
    """
    if hasattr(node, "add_post_set_parameters_callback"):
        node.add_post_set_parameters_callback(callback)
        return

    def before_change(parameters: list[Any]) -> SetParametersResult:
        # A parameter that the node does not have yet is being declared, not changed.
        known = [parameter for parameter in parameters if node.has_parameter(parameter.name)]

        def after_change() -> None:
            node.destroy_timer(timer)
            callback(known)

        if known:
            # The executor comes to the timer when this change is done.
            timer = node.create_timer(0.0, after_change)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(before_change)
