# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Wrappers of a node's callbacks that catch all exceptions, so that none ends the process.

An exception in a callback is logged at most every `LOG_PERIOD_S`, counted, and shown in the
diagnostics of the node. A service whose callback raised an exception still sends its response, in
which `success` is false by default.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node

from ..core.errors import CubeError

Callback = Callable[..., Any]
"""Function that rclpy calls for a message, timer or service request, with arguments that depend on
which of these it is."""

MAX_CHARACTERS = 1000
"""Maximum number of characters of a text that a service returns and logs. A longer text is cut,
because it may quote the request of a client, which can have megabytes."""

LOG_PERIOD_S = 5.0
"""Minimum time, in seconds, between two log messages about errors that occur repeatedly."""


def guard(
    callback: Callback,
    on_error: Callback,
    errors: type[Exception] = Exception,
) -> Callback:
    """Wrap a callback so that no exception of a class leaves it.

    Args:
        callback: Callback of a subscription, a timer or a service.
        on_error: Called with the exception and with the arguments of the callback. The result of
            `on_error` is returned in place of that of the callback.
        errors: Class of the exceptions; others are not caught.
    """

    @wraps(callback)
    def call(*arguments: Any) -> Any:
        try:
            return callback(*arguments)
        except errors as error:
            return on_error(error, *arguments)

    return call


class CallbackErrors:
    """Catches, logs and counts the exceptions of a node's callbacks.

    Attributes:
        count: Number of calls of callbacks that have raised an exception.
    """

    def __init__(self, node: Node) -> None:
        self.count = 0
        self._node = node

    def catch(self, callback: Callback) -> Callback:
        """Wrap the callback of a subscription or a timer so that its exceptions are caught."""
        return guard(callback, self._note)

    def catch_in_service(self, callback: Callback) -> Callback:
        """Wrap the callback of a service so that its exceptions are logged, counted and reported.

        The client still gets a response after an exception: `explain_failure` writes the text of
        the exception into it, and the fields that the callback has not set keep their defaults. A
        CubeError means that the request is refused; it is not counted.
        """

        def explain(error: Exception, request: Any, response: Any) -> Any:
            if isinstance(error, CubeError):
                self._node.get_logger().warning(f"refused: {shorten(str(error))}")
                return explain_failure(request, response, shorten(str(error)))
            self._note(error)
            return explain_failure(request, response, repr(error))

        return guard(callback, explain)

    def _note(self, error: Exception, *_: Any) -> None:
        self.count += 1
        self._node.get_logger().error(
            f"a callback failed, the node goes on ({self.count} so far): {error!r}",
            throttle_duration_sec=LOG_PERIOD_S,
        )


def explain_failure(request: Any, response: Any, reason: str) -> Any:
    """Write into the response of a service why it failed, if its type has a field for that.

    Args:
        request: Request of the client.
        response: Response to the client, which is changed.
        reason: Reason of the failure.

    Returns:
        The changed response.
    """
    if hasattr(response, "message"):
        response.message = reason
    # The service SetParameters has a list of results, which needs an entry for each parameter.
    if hasattr(response, "results"):
        done: list[Any] = list(response.results)
        missing = len(request.parameters) - len(done)
        response.results = done + [SetParametersResult(reason=reason)] * missing
    return response


def shorten(text: str) -> str:
    """Return a text, cut to `MAX_CHARACTERS`; a text that was cut ends with its full length."""
    if len(text) <= MAX_CHARACTERS:
        return text
    return f"{text[:MAX_CHARACTERS]}… ({len(text)} characters)"
