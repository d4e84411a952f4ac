"""Service calls whose answers are awaited without blocking."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

from rclpy.client import Client
from rclpy.task import Future

WAIT_S = 10.0
"""How long a service may take to answer."""


class _Call(NamedTuple):
    what: str
    future: Future
    asked_at: float


class ServiceCalls:
    """Asks services. What becomes of it is one line of text for the page."""

    def __init__(self) -> None:
        self._open: list[_Call] = []

    def ask(self, what: str, client: Client, request: Any) -> str:
        """Ask, unless nobody offers the service; returns what to tell the user."""
        if not client.service_is_ready():
            return f"{what}: no reconstruction node that can is running"
        self._open.append(_Call(what, client.call_async(request), time.monotonic()))
        return f"{what}: asked …"

    def news(self) -> list[str]:
        """What to tell the user about the calls that have been answered, or not in time."""
        lines, still_open = [], []
        for call in self._open:
            if call.future.done():
                answer = call.future.result()
                outcome = "done" if answer.success else "refused"
                lines.append(f"{call.what} {outcome}: {answer.message}")
            elif time.monotonic() - call.asked_at > WAIT_S:
                lines.append(f"{call.what}: no answer within {WAIT_S:g} s")
                call.future.cancel()
            else:
                still_open.append(call)
        self._open = still_open
        return lines
