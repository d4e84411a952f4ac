"""Log lines about one link, limited in rate, because a hub can cause a thousand of them per
second."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

MAX_BURST = 20
"""Number of lines that may be logged at once. A link that opens, is lost, or does not fit the skin
logs a few lines together."""
LINE_PERIOD_S = 1.0
"""Period of the lines after a burst, in s."""


class Log(Protocol):
    """The methods used of a logger, which may be that of Python or of ROS."""

    def info(self, message: str, /) -> object: ...

    def warning(self, message: str, /) -> object: ...

    def error(self, message: str, /) -> object: ...


class LinkLogger:
    """Logs lines about one link at a limited rate.

    Lines beyond the limit are left out and counted, and the next line states their number.

    Args:
        name: Name of the link.
        log: Logger to write to.
        clock: Monotonic clock, in s.

    Attributes:
        left_out: Number of lines left out so far.
    """

    def __init__(
        self,
        name: str,
        log: Log,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.left_out = 0
        self._name = name
        self._log = log
        self._clock = clock
        self._allowed = float(MAX_BURST)
        self._updated_at = clock()
        self._reported_left_out = 0

    # Each severity has its own call here, because a logger of ROS accepts only one severity for
    # each place of the call.

    def info(self, message: str, /) -> None:
        """Log news."""
        if self._is_allowed():
            self._log.info(self._line(message))

    def warning(self, message: str, /) -> None:
        """Log a problem that may pass by itself."""
        if self._is_allowed():
            self._log.warning(self._line(message))

    def error(self, message: str, /) -> None:
        """Log a problem that somebody must solve."""
        if self._is_allowed():
            self._log.error(self._line(message))

    def _is_allowed(self) -> bool:
        """Return whether a line may be logged now, and count it."""
        now = self._clock()
        earned = (now - self._updated_at) / LINE_PERIOD_S
        self._allowed = min(MAX_BURST, self._allowed + earned)
        self._updated_at = now
        if self._allowed < 1.0:
            self.left_out += 1
            return False
        self._allowed -= 1.0
        return True

    def _line(self, message: str) -> str:
        """Return the line for a message."""
        omitted = self.left_out - self._reported_left_out
        self._reported_left_out = self.left_out
        note = f" ({omitted} lines about this link were left out before)" if omitted else ""
        return f"link {self._name}: {message}{note}"
