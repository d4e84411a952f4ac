# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Logging of lines about one link at a limited rate.

A faulty hub can cause a thousand lines per second.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Protocol

from ...core.errors import LinkError
from .link import LinkState

MAX_BURST = 20
"""Number of lines about one link that may be logged without a pause between them. For example, a
link that is opened and whose cubes do not fit the skin file logs a few lines together."""
SILENCE_PERIOD_S = 60.0
"""Minimum time, in s, between two lines about the silence of one link (no sample comes).

A simulator on a busy machine, for example, may pause many times a minute.
"""
LINE_PERIOD_S = 1.0
"""Period, in s, at which lines about one link may be logged after `MAX_BURST` lines together."""


class Log(Protocol):
    """Methods of a logger that this package calls; the loggers of Python and of ROS have them."""

    def info(self, message: str, /) -> object:
        """Log a normal event."""

    def warning(self, message: str, /) -> object:
        """Log something that a person should look at."""

    def error(self, message: str, /) -> object:
        """Log a failure."""


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
        # Time of `clock` until which further silences (no samples come) are left out of the log,
        # and whether the last silence was left out.
        self._silences_until = -math.inf
        self._left_out_silence = False

    def change(self, state: LinkState, error: LinkError | None) -> None:
        """Log a change of the state of the link.

        A silence is logged at most once in `SILENCE_PERIOD_S`. Further silences are left out and
        counted, and so is the return to the open state after each of them.

        Args:
            state: The new state.
            error: Reason of the state; None if there is none.
        """
        is_end = self._left_out_silence and state is LinkState.OPEN
        self._left_out_silence = False
        if error is not None and error.kind == "silent":
            now = self._clock()
            self._left_out_silence = now < self._silences_until
            if not self._left_out_silence:
                self._silences_until = now + SILENCE_PERIOD_S
        if is_end or self._left_out_silence:
            self.left_out += 1
        elif error is None:
            self.info(state.value)
        else:
            self.warning(f"{state.value}: {error}")

    # There is one method for each severity, because a logger of ROS raises an error if the same
    # line of code logs with different severities.

    def info(self, message: str, /) -> None:
        """Log an event of the link that is no problem, for example that it was opened."""
        if self._is_allowed():
            self._log.info(self._format_line(message))

    def warning(self, message: str, /) -> None:
        """Log a problem that may pass without help, for example a lost connection."""
        if self._is_allowed():
            self._log.warning(self._format_line(message))

    def error(self, message: str, /) -> None:
        """Log a problem that a person must solve, for example a cube missing in the skin file."""
        if self._is_allowed():
            self._log.error(self._format_line(message))

    def _is_allowed(self) -> bool:
        """Return whether a line may be logged now, and count it as logged or left out."""
        now = self._clock()
        earned = (now - self._updated_at) / LINE_PERIOD_S
        self._allowed = min(MAX_BURST, self._allowed + earned)
        self._updated_at = now
        if self._allowed < 1.0:
            self.left_out += 1
            return False
        self._allowed -= 1.0
        return True

    def _format_line(self, message: str) -> str:
        """Return the log line for a message: link, message, number of lines left out before."""
        omitted = self.left_out - self._reported_left_out
        self._reported_left_out = self.left_out
        note = f" ({omitted} lines about this link were left out before)" if omitted else ""
        return f"link {self._name}: {message}{note}"
