"""Log lines about one link, bounded: a hub can say something new a thousand times a second."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

BURST = 20
"""Lines that may come at once: those of a link that opens, or is lost, and what does not fit."""
REFILL_S = 1.0
"""After a burst, one line in this time."""


class Log(Protocol):
    """What is needed of a logger, that of Python or of ROS."""

    def info(self, message: str, /) -> object: ...

    def warning(self, message: str, /) -> object: ...

    def error(self, message: str, /) -> object: ...


class LinkLog:
    """A `Log` of lines about one link. Lines beyond the bound are left out and counted; the next
    one says how many.

    left_out: lines so far.
    """

    def __init__(self, name: str, log: Log, clock: Callable[[], float] = time.monotonic) -> None:
        self.left_out = 0
        self._name = name
        self._log = log
        self._clock = clock
        self._allowed = float(BURST)
        self._at = clock()
        self._told = 0

    # Each severity has its own line here, because the loggers of ROS go by the place of the call.

    def info(self, message: str, /) -> None:
        if self._may():
            self._log.info(self._line(message))

    def warning(self, message: str, /) -> None:
        if self._may():
            self._log.warning(self._line(message))

    def error(self, message: str, /) -> None:
        if self._may():
            self._log.error(self._line(message))

    def _may(self) -> bool:
        now = self._clock()
        self._allowed = min(BURST, self._allowed + (now - self._at) / REFILL_S)
        self._at = now
        if self._allowed < 1.0:
            self.left_out += 1
            return False
        self._allowed -= 1.0
        return True

    def _line(self, message: str) -> str:
        omitted, self._told = self.left_out - self._told, self.left_out
        after = f" ({omitted} lines about this link were left out before)" if omitted else ""
        return f"link {self._name}: {message}{after}"
