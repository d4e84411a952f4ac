"""What ./cube replay shows, and the keys that it obeys."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

KEYS = "space: pause, s: step, q: quit"


class ReplayBar:
    """A bar on stderr over the length of a bag, s; a context."""

    def __init__(self, length: float, keys: bool) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:.1f} / {task.total:.1f} s"),
            TextColumn(KEYS if keys else ""),
            console=Console(stderr=True),
        )
        self._task = self._progress.add_task("replaying", total=length)

    def __enter__(self) -> ReplayBar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, position: float, paused: bool) -> None:
        """position: s after the start of the bag."""
        shown = "paused" if paused else "replaying"
        self._progress.update(self._task, completed=position, description=shown)


@contextmanager
def single_keys() -> Iterator[bool]:
    """Keys come one by one and are not echoed. Yields False where stdin is no terminal."""
    if not sys.stdin.isatty():
        yield False
        return
    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    try:
        tty.setcbreak(number)
        yield True
    finally:
        termios.tcsetattr(number, termios.TCSADRAIN, before)


def pressed_key() -> str:
    """The key that was pressed, empty without one."""
    if not select.select([sys.stdin], [], [], 0)[0]:
        return ""
    return os.read(sys.stdin.fileno(), 1).decode(errors="replace")
