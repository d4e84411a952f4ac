# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The signals that ask a process to end."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable

INTERRUPTED = 130
"""Exit code after Ctrl-C: by the convention of shells, 128 plus the number of the signal SIGINT."""

STOP_SIGNALS = [one for one in signal.Signals if one.name in ("SIGINT", "SIGTERM", "SIGHUP")]
"""Signals that ask this process to end: SIGINT comes from Ctrl-C, SIGTERM from another process, and
SIGHUP, which Windows does not have, when the terminal is closed."""


def on_stop_signal(stop: Callable[[], None]) -> None:
    """Register `stop` as handler of the signals that ask this process to end (`STOP_SIGNALS`).

    After that, such a signal only calls `stop`, and the process must end by itself. This function
    must be called in the main thread, as Python requires for handlers of signals.
    """
    for number in STOP_SIGNALS:
        # A command started with nohup ignores SIGHUP; a handler here would undo that.
        if number.name != "SIGHUP" or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda *_: stop())


def stop_event() -> threading.Event:
    """Return an event that is set when the process gets SIGINT, SIGTERM or SIGHUP."""
    event = threading.Event()
    on_stop_signal(event.set)
    return event
