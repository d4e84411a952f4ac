"""./cube record: topics of a running skin into a bag."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parser import Parser, positive


def arguments(parser: Parser) -> None:
    from ..processes.skin_processes import RECORDED

    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder of the bag, which must not exist yet",
    )
    parser.add_argument(
        "--topics",
        nargs="+",
        default=RECORDED,
        metavar="T",
        help=f"topics to record (default: {' '.join(RECORDED)})",
    )
    parser.add_argument(
        "--duration",
        type=positive,
        metavar="S",
        help="end S seconds after the first message (default: Ctrl-C)",
    )
    parser.add_argument(
        "--storage",
        choices=["mcap", "sqlite3"],
        default="mcap",
        help="format of the files (default: %(default)s)",
    )
    parser.add_argument(
        "--split-size", type=positive, metavar="MB", help="begin a new file after so many megabytes"
    )
    parser.add_argument(
        "--split-time", type=positive, metavar="S", help="begin a new file after so many seconds"
    )


def run(options: argparse.Namespace) -> int:
    """1 if messages were dropped, else 0."""
    from ..ros.commands.recorder import Recorder
    from ..ros.commands.recording import record
    from ..views.terminal.recording import RecordingStatus

    status = RecordingStatus(options.output)

    def show(recorder: Recorder, seconds: float) -> None:
        status.show(
            seconds,
            received=recorder.received,
            dropped=recorder.dropped,
            missing=recorder.missing,
            refused=recorder.refused,
        )

    with status:
        recorder = record(
            options.output,
            options.topics,
            storage=options.storage,
            max_bytes=round((options.split_size or 0) * 1e6),
            max_seconds=options.split_time or 0.0,
            duration=options.duration,
            show=show,
        )
    status.summary(recorder.counts, dropped=recorder.dropped, missing=recorder.missing)
    return 1 if recorder.dropped else 0
