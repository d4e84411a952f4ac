"""Counts the messages of a topic that were sent and did not come, of one
subscription after the other.

DDS numbers the messages of each publisher. A number that is left out is a message that is gone for
good: the network lost it, or it was dropped because this process was away longer than its queue
holds, which DDS itself tells nobody. Where rclpy does not give the numbers, only what DDS reports
as lost is counted.
"""

from __future__ import annotations

from collections import deque
from typing import Any

from ..compat import SubscriptionEventCallbacks


class LostMessages:
    """count: so far. Messages of several publishers that send in turn cannot be told apart: of them
    only what DDS reports is counted."""

    def __init__(self) -> None:
        self._before = self._left_out = self._reported = 0
        self._newest: int | None = None  # number
        self._gap = 0  # just before the newest; counted when its publisher goes on
        self._others: deque[int] = deque(maxlen=8)  # newest numbers of publishers before
        self._several = False

    @property
    def count(self) -> int:
        return self._before + max(self._left_out, self._reported)

    def new_subscription(self) -> SubscriptionEventCallbacks:
        """Begin to count of a new subscription: its events. What was lost before stays counted."""
        self._before, self._left_out, self._reported = self.count, 0, 0
        self._newest, self._gap, self._several = None, 0, False
        self._others.clear()
        return SubscriptionEventCallbacks(message_lost=self._on_lost)

    def came(self, number: int | None) -> None:
        """A message came, and this is its number; None: not known."""
        newest, self._newest = self._newest, number
        if number is None or newest is None:
            return
        is_next = number == newest + 1
        goes_on = not is_next and number - 1 in self._others
        if goes_on or number <= newest:
            # Of another publisher: one of several, or a new one, which begins at 1.
            self._several |= goes_on
            self._others.append(newest)
            self._gap = 0
        elif not self._several:
            self._left_out += self._gap
            self._gap = number - newest - 1

    def _on_lost(self, event: Any) -> None:
        self._reported = event.total_count
