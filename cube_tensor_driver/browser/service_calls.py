"""Service calls whose answers are awaited without blocking."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from rclpy.client import Client
from rclpy.task import Future

from .markup import NoteColour

WAIT_S = 10.0
"""How long a service may take to answer."""


class _Call(NamedTuple):
    what: str
    future: Future
    asked_at: float


class ServiceCalls:
    """Asks services. What becomes of it is said on the page."""

    def __init__(self, say: Callable[[str, str, NoteColour], None]) -> None:
        """say: told title, text and colour of what the user should know."""
        self._say = say
        self._open: list[_Call] = []

    def ask(self, what: str, client: Client, request: Any) -> None:
        """Ask, unless nobody offers the service."""
        if not client.service_is_ready():
            self._say(
                f"{what} is not possible", f"{what}: no node that can do it is running", "red"
            )
            return
        self._open.append(_Call(what, client.call_async(request), time.monotonic()))

    def update(self) -> None:
        """Tell about the calls that have been answered, or not in time."""
        still_open = []
        for call in self._open:
            if call.future.done():
                answer = call.future.result()
                if answer.success:
                    self._say(
                        f"{call.what} is done", f"{call.what} done: {answer.message}", "green"
                    )
                else:
                    text = f"{call.what} refused, nothing was changed: {answer.message}"
                    self._say(f"{call.what} was refused", text, "red")
            elif time.monotonic() - call.asked_at > WAIT_S:
                text = f"{call.what}: no answer within {WAIT_S:g} s"
                self._say(f"{call.what} had no answer", text, "red")
                call.future.cancel()
            else:
                still_open.append(call)
        self._open = still_open
