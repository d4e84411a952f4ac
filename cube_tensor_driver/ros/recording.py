"""Recording from the first message to a complete bag."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from ..bags.repair import repair
from ..bags.write import BagWriter
from ..core.errors import BagError
from .recorder import Recorder
from .session import node_session, on_stop_signal

FIND_S, SPIN_S, SHOW_S = 0.2, 0.05, 1.0
"""How often topics are looked for, how long a spin lasts, how often `show` is called."""


def record(
    folder: Path,
    topics: Sequence[str],
    *,
    storage: str,
    max_bytes: int,
    max_seconds: float,
    duration: float | None,
    show: Callable[[Recorder, float], None],
) -> Recorder:
    """Record for `duration` s (None: until a signal) into a new bag; `BagWriter` says of what kind.

    show: called once a second with the recorder and the seconds since the start.
    BagError: cannot be written; what was written before is made readable.
    """
    stop = threading.Event()
    on_stop_signal(stop.set)
    bag = BagWriter(folder, storage, max_bytes, max_seconds)
    with node_session("recorder") as (node, executor):
        recorder = Recorder(node, topics, bag)
        begin = find_at = show_at = time.monotonic()
        until = float("inf") if duration is None else begin + duration
        try:
            while not stop.is_set() and recorder.error is None:
                now = time.monotonic()
                if now >= until:
                    break
                executor.spin_once(timeout_sec=min(SPIN_S, until - now))
                if now >= find_at:
                    find_at = now + FIND_S
                    recorder.find_topics()
                if now >= show_at:
                    show_at = now + SHOW_S
                    show(recorder, now - begin)
        finally:
            _close(recorder, folder)
    return recorder


def _close(recorder: Recorder, folder: Path) -> None:
    try:
        recorder.close()
    except BagError as error:
        # Most likely the disk is full: without the last, incomplete chunk there is room for the
        # summary.
        try:
            done = repair(folder, keep_rest=False)
        except BagError as worse:
            raise BagError(f"{error}\n{worse}") from None
        raise BagError(f"{error}. The {done.messages} messages written before are valid") from None
