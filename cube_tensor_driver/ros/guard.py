"""Callbacks of a node, run so that nothing that comes from outside ends the process.

Whatever a callback raises is caught here and nowhere else: it is logged now and then, counted, and
shown in diagnostics. A service whose callback raised still answers, with the response as it was
made, whose `success` is false.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from rclpy.node import Node

LOGGED_EVERY_S = 5.0


class CallbackGuard:
    """errors: how many callbacks of the node have raised."""

    def __init__(self, node: Node) -> None:
        self.errors = 0
        self._node = node

    def wrap(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """The callback of a subscription or a timer."""

        @wraps(callback)
        def guarded(*arguments: Any) -> Any:
            try:
                return callback(*arguments)
            except Exception as error:  # noqa: BLE001  (see the head of this file)
                self.count(error)
                return None

        return guarded

    def wrap_service(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """The callback of a service: after an error the response is sent as it is."""

        @wraps(callback)
        def guarded(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Exception as error:  # noqa: BLE001  (see the head of this file)
                self.count(error)
                return response

        return guarded

    def count(self, error: Exception) -> None:
        """An error that was caught."""
        self.errors += 1
        self._node.get_logger().error(
            f"a callback failed, the node goes on ({self.errors} so far): {error!r}",
            throttle_duration_sec=LOGGED_EVERY_S,
        )


def refuse_errors(callback: Callable[..., Any], errors: type[Exception]) -> Callable[..., Any]:
    """The callback of a service for which such an error means that the request cannot be done."""

    @wraps(callback)
    def refusing(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except errors:
            response.success = False
            return response

    return refusing
