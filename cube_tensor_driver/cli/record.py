"""./cube record: topics of a running skin into a bag."""

from __future__ import annotations

import signal
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import rclpy
from rclpy.signals import SignalHandlerOptions
from rich.console import Console

from ..bags.repair import repair
from ..bags.write import BagWriter
from ..core.errors import BagError
from ..ros.node import make_executor
from ..ros.recorder import Recorder

TOPICS = ("frequencies", "stress", "info", "/diagnostics")
FIND_S, SPIN_S, SAY_S = 0.2, 0.05, 1.0


@dataclass(frozen=True)
class Options:
    """As on the command line. duration and split in s, None: without end; size in bytes, 0: one
    file."""

    output: Path
    topics: list[str]
    duration: float | None
    storage: str
    split_bytes: int
    split_s: float


def run_record(options: Options) -> int:
    """Record until the duration is over or asked to end. BagError: cannot be written; what was is
    made valid."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stop.set())
    console = Console(stderr=True, highlight=False)
    bag = BagWriter(options.output, options.storage, options.split_bytes, options.split_s)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node("recorder")
        executor = make_executor()
        executor.add_node(node)
        recorder = Recorder(node, options.topics or TOPICS, bag)
        try:
            _record(recorder, executor, options, stop, console)
        finally:
            _close(recorder, options, console)
        executor.remove_node(node)
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
    return 1 if recorder.dropped else 0


def _record(
    recorder: Recorder, executor, options: Options, stop: threading.Event, console: Console
) -> None:  # type: ignore[no-untyped-def]
    begun = time.monotonic()
    until = float("inf") if options.duration is None else begun + options.duration
    find_at = say_at = begun
    dropped = 0
    refused: set[str] = set()
    with console.status("") as status:
        while not stop.is_set() and recorder.error is None and (now := time.monotonic()) < until:
            executor.spin_once(timeout_sec=min(SPIN_S, until - now))
            if now >= find_at:
                recorder.find_topics()
                find_at = now + FIND_S
            if now >= say_at:
                say_at = now + SAY_S
                waiting = f"; waiting for {', '.join(recorder.missing)}" if recorder.missing else ""
                status.update(
                    f"{options.output}: {now - begun:.0f} s, {recorder.received} messages{waiting}"
                )
                for topic in set(recorder.refused) - refused:
                    refused.add(topic)
                    console.print(f"not recorded: {recorder.refused[topic]}", style="red")
                if recorder.dropped > dropped:
                    dropped = recorder.dropped
                    console.print(
                        f"the disk is too slow: {dropped} messages dropped so far", style="red"
                    )


def _close(recorder: Recorder, options: Options, console: Console) -> None:
    try:
        recorder.close()
    except BagError as error:
        # Most likely the disk is full: cutting off the last, incomplete chunk makes room for the
        # summary.
        try:
            done = repair(options.output, keep_rest=False)
        except BagError as worse:
            raise BagError(f"{error}\n{worse}") from None
        raise BagError(f"{error}. The {done.messages} messages written before are valid") from None
    console.print(f"{options.output}: {recorder.received - recorder.dropped} messages")
    for topic, count in sorted(recorder.counts.items()):
        console.print(f"  {count:8} {topic}")
    for topic in recorder.missing:
        console.print(f"         0 {topic}: nobody offers it", style="yellow")
    if recorder.dropped:
        console.print(f"{recorder.dropped} messages dropped: the disk is too slow", style="red")
