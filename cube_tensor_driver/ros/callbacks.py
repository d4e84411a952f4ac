"""Callbacks of a node, run so that no error in them ends the process.

Whatever a callback raises is caught here and nowhere else: it is logged from time to time, counted,
and shown in diagnostics. A service whose callback raised still answers, with the response as it was
made, whose `success` is false.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from rclpy.node import Node

LOG_PERIOD_S = 5.0
"""Minimum time, in seconds, between two lines of the log about errors that repeat."""


class CallbackErrors:
    """Catches and counts the errors of a node's callbacks.

    Attributes:
        count: Number of calls that have raised.
    """

    def __init__(self, node: Node) -> None:
        self.count = 0
        self._node = node

    def catch(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return the callback of a subscription or a timer, with its errors caught."""

        @wraps(callback)
        def call(*arguments: Any) -> Any:
            try:
                return callback(*arguments)
            except Exception as error:  # noqa: BLE001  (see the head of this file)
                self._note(error)
                return None

        return call

    def catch_in_service(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return the callback of a service, which after an error sends the response as it is."""

        @wraps(callback)
        def call(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Exception as error:  # noqa: BLE001  (see the head of this file)
                self._note(error)
                return response

        return call

    def _note(self, error: Exception) -> None:
        self.count += 1
        self._node.get_logger().error(
            f"a callback failed, the node goes on ({self.count} so far): {error!r}",
            throttle_duration_sec=LOG_PERIOD_S,
        )


def refuse_on_error(callback: Callable[..., Any], errors: type[Exception]) -> Callable[..., Any]:
    """Return the callback of a service in which such an error refuses the request."""

    @wraps(callback)
    def call(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except errors:
            response.success = False
            return response

    return call
