# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube record: record topics of a running skin into a bag."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from .parser import Parser, positive

if TYPE_CHECKING:
    from ..ros.commands.record import Recorder


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    from ..processes.skin_processes import RECORDED

    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder of the bag, which must not exist yet",
    )
    parser.add_value(
        "--topics",
        "T",
        f"topics to record (default: {' '.join(RECORDED)})",
        nargs="+",
        default=RECORDED,
    )
    parser.add_value(
        "--duration",
        "S",
        "end S seconds after the first message (default: Ctrl-C)",
        positive,
    )
    parser.add_argument(
        "--storage",
        choices=["mcap", "sqlite3"],
        default="mcap",
        help="format of the files (default: %(default)s)",
    )
    parser.add_value(
        "--split-size",
        "MB",
        "begin a new file after MB megabytes",
        positive,
    )
    parser.add_value(
        "--split-time",
        "S",
        "begin a new file after S seconds",
        positive,
    )


def run(options: argparse.Namespace) -> int:
    """Record a bag, and return the exit code: 1 if messages were dropped, otherwise 0."""
    from ..ros.commands.record import record

    status = RecordingStatus(options.output)
    with status.line:
        recorder = record(
            options.output,
            options.topics,
            storage=options.storage,
            # With the value 0, size or duration of a file of the bag has no limit.
            max_bytes=round((options.split_size or 0) * 1e6),
            max_seconds=options.split_time or 0.0,
            duration=options.duration,
            show=status.show,
        )
    status.print_summary(recorder)
    return 1 if recorder.dropped else 0


class RecordingStatus:
    """Shows the progress of a recording on stderr.

    One line with duration and number of messages is updated. A red line is added for each topic
    that cannot be recorded, and each time more messages were dropped.

    Attributes:
        line: Context manager that shows the line while it is active.
    """

    def __init__(self, path: Path) -> None:
        """Prepare the line; `path` is the folder of the bag, whose name the line contains."""
        from rich.console import Console

        self._path = path
        self._console = Console(stderr=True, highlight=False)
        self.line = self._console.status("")
        self._refused: set[str] = set()
        self._dropped = 0

    def show(self, recorder: Recorder, seconds: float) -> None:
        """Update the line, and print topics that were refused and messages that were dropped.

        Args:
            recorder: The recorder, which counts the messages.
            seconds: Time since the start of the command, in s.
        """
        missing, refused = recorder.missing, recorder.refused
        waiting = f"; waiting for {', '.join(missing)}" if missing else ""
        self.line.update(f"{self._path}: {seconds:.0f} s, {recorder.received} messages{waiting}")
        # A topic that cannot be recorded is reported once, not with every update.
        for topic in refused.keys() - self._refused:
            self._console.print(f"not recorded: {refused[topic]}", style="red")
        self._refused |= refused.keys()
        if recorder.dropped > self._dropped:
            self._dropped = recorder.dropped
            self._console.print(
                f"the disk is too slow: {self._dropped} messages dropped so far",
                style="red",
            )

    def print_summary(self, recorder: Recorder) -> None:
        """Print the number of messages of each topic, topics without a publisher, and drops.

        Args:
            recorder: The recorder, whose recording has ended.
        """
        counts, dropped = recorder.counts, recorder.dropped
        self._console.print(f"{self._path}: {sum(counts.values()) - dropped} messages")
        for topic, count in sorted(counts.items()):
            self._console.print(f"  {count:8} {topic}")
        for topic, seconds in recorder.late.items():
            self._console.print(
                f"{topic} came {seconds:.1f} s later than the other topics",
                style="yellow",
            )
        for topic in recorder.missing:
            self._console.print(f"         0 {topic}: nobody offers it", style="yellow")
        if dropped:
            self._console.print(f"{dropped} messages dropped: the disk is too slow", style="red")
