# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""End of a process by Ctrl-C while its main thread runs C code.

Python raises KeyboardInterrupt only between two of its own instructions, and a matrix factorisation
is one instruction that can take many seconds. The signal itself arrives at once and can wake
another thread, which then ends the process.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from cube_tensor_driver.processes.stop_signals import INTERRUPTED

_SHOW_CURSOR = b"\n\x1b[?25h"
"""End of the line of a progress bar, and the escape sequence that makes a terminal show its cursor
again."""


@contextmanager
def end_at_once() -> Iterator[None]:
    """Let Ctrl-C end the process, even in the middle of C code.

    Use it only in the main thread, and for work that only computes, because no `finally` block
    runs. The C code must release Python's global interpreter lock.
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
    """Wait for SIGINT and end the process.

    Args:
        watched: File descriptor of a pipe into which Python writes the number of each signal. The
            function returns when the other end of the pipe is closed.
    """
    while number := os.read(watched, 1):
        if number[0] == signal.SIGINT:
            # A progress bar hides the cursor, and the code that would show it again does not run.
            if sys.stderr.isatty():
                os.write(sys.stderr.fileno(), _SHOW_CURSOR)
            os._exit(INTERRUPTED)
