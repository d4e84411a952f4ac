"""Ctrl-C while the main thread is in C code and does not hear it.

Python raises KeyboardInterrupt between two of its own instructions, and a factorisation is one
instruction of many seconds. The signal itself is there at once: it wakes another thread.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

GRACE_S = 0.3
"""For the main thread to end by KeyboardInterrupt, as it does outside of C code."""
_SHOW_CURSOR = "\x1b[?25h"


@contextmanager
def ends_at_once() -> Iterator[None]:
    """Ctrl-C within it ends the process after GRACE_S at the latest, with exit code 130.

    For work that only computes: a process that does not hear runs no `finally`. The C code must
    give up Python's lock. From the main thread only.
    """
    heard, signalled = os.pipe()
    os.set_blocking(signalled, False)
    before = signal.set_wakeup_fd(signalled, warn_on_full_buffer=False)
    watcher = threading.Thread(target=_watch, args=(heard,), daemon=True)
    watcher.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        os.close(signalled)
        watcher.join()
        os.close(heard)


def _watch(heard: int) -> None:
    """Reads the numbers of signals until the other end is closed."""
    while number := os.read(heard, 1):
        if number[0] != signal.SIGINT:
            continue
        ended, _, _ = select.select([heard], [], [], GRACE_S)
        if not ended:
            if sys.stderr.isatty():  # the progress bar hides it
                os.write(sys.stderr.fileno(), _SHOW_CURSOR.encode())
            os._exit(130)
