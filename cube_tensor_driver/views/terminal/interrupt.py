"""Ctrl-C while the main thread runs C code.

Python raises KeyboardInterrupt between two of its own instructions, and a matrix factorisation is
one instruction that can take many seconds. The signal itself arrives at once and can wake another
thread, which then ends the process.
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
"""Time, in seconds, that the main thread has to end by KeyboardInterrupt after Ctrl-C.

Outside of C code it does so at once, and runs its `finally` blocks.
"""

INTERRUPTED = 130
"""Exit code after Ctrl-C: 128 plus the number of SIGINT, as shells count."""

_SHOW_CURSOR = b"\x1b[?25h"


@contextmanager
def ends_at_once() -> Iterator[None]:
    """Make Ctrl-C end the process after at most `GRACE_S`, even in the middle of C code.

    It is meant for work that only computes, because no `finally` runs when the process ends this
    way. The C code must release Python's lock. Use it in the main thread only.
    """
    watched, written = os.pipe()
    os.set_blocking(written, False)
    before = signal.set_wakeup_fd(written, warn_on_full_buffer=False)
    watcher = threading.Thread(
        target=_end_on_interrupt,
        args=(watched,),
        daemon=True,
    )
    watcher.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        os.close(written)
        watcher.join()
        os.close(watched)


def _end_on_interrupt(watched: int) -> None:
    """Read signal numbers from a pipe until its other end is closed, and act on SIGINT."""
    while number := os.read(watched, 1):
        if number[0] != signal.SIGINT:
            continue
        # The pipe becomes readable, here by its end, when the main thread leaves the block itself.
        has_ended, _, _ = select.select([watched], [], [], GRACE_S)
        if not has_ended:
            # A progress bar hides the cursor, and nothing else gives it back now.
            if sys.stderr.isatty():
                os.write(sys.stderr.fileno(), _SHOW_CURSOR)
            os._exit(INTERRUPTED)
