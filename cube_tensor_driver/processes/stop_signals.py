"""The signals that ask a process to end."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, the request of another process, and the end of the terminal."""


def on_stop_signal(stop: Callable[[], None]) -> None:
    """Call `stop` for each signal that asks this process to end, instead of ending at once."""
    for number in STOP_SIGNALS:
        # nohup has the end of the terminal ignored, and that stays.
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda *_: stop())


def stop_event() -> threading.Event:
    """Return an event that is set by the signals that ask this process to end."""
    event = threading.Event()
    on_stop_signal(event.set)
    return event
