# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube bag info, ./cube bag repair: show what a bag holds, make a damaged bag readable."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from .parser import Parser

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticStatus

    from ..bags.read import Bag


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    info = parser.add_subcommand(
        "info",
        "print skin, cubes, calibrations, rates, gaps and counters",
    )
    repair = parser.add_subcommand(
        "repair",
        "make a bag readable that was cut off: killed, disk full, power lost",
    )
    for command in (info, repair):
        command.add_bag()


def run(options: argparse.Namespace) -> int:
    """Show what a bag holds, or repair one."""
    if options.what == "info":
        show_bag(options.bag)
    else:
        repair_bag(options.bag)
    return 0


def repair_bag(path: Path) -> None:
    """Make a damaged bag (recording) readable, and print how many messages are left and what was
    lost.

    Args:
        path: Folder or file of the bag.
    """
    from ..bags.repair import REST_SUFFIX, repair
    from ..views.terminal.output import format_count, say

    done = repair(path)
    print(f"{path}: {done.messages} messages can be read")
    if done.cut:
        print(
            f"moved {done.cut} bytes behind the last complete chunk to files ending in "
            f"{REST_SUFFIX}"
        )
    if done.damaged:
        say(f"left out {format_count(done.damaged, 'damaged record')}", "red")


def show_bag(path: Path) -> None:
    """Print what a bag contains: topics, skins with their cubes and gaps, and last diagnostics.

    Args:
        path: Folder or file of the bag.

    Raises:
        BagError: The bag cannot be read.
    """
    import numpy as np

    from ..bags.read import Bag
    from ..bags.summary import find_last_diagnostics
    from ..messages.types import FREQUENCIES_TYPE
    from ..views.terminal.output import say

    with Bag(path) as bag:
        duration_s = 0.0
        # A bag without messages has no start and end time.
        if any(connection.msgcount for connection in bag.connections):
            duration_s = (bag.end_ns - bag.start_ns) * 1e-9
            # The start is printed with a resolution of 1 ms.
            start = np.datetime64(bag.start_ns, "ns").astype("datetime64[ms]")
            say(f"{path}: {duration_s:.3f} s from {start} UTC")
        else:
            say(f"{path}: no messages")

        show_topics(bag, duration_s)
        for topic in bag.list_topics(FREQUENCIES_TYPE):
            show_skin(bag, topic)
        for status in find_last_diagnostics(bag):
            say(format_diagnostics(status))


def show_topics(bag: Bag, duration_s: float) -> None:
    """Print a table of the topics of a bag with their types, message counts and mean rates.

    Args:
        bag: The bag.
        duration_s: Time from the first to the last message, in s.
    """
    from ..views.terminal.output import print_table

    rows = []
    connections = sorted(bag.connections, key=lambda connection: connection.topic)
    for connection in connections:
        count = connection.msgcount
        # A rate needs at least two messages.
        rate = f"{count / duration_s:.1f}" if duration_s and count > 1 else ""
        rows.append((connection.topic, connection.msgtype, str(count), rate))
    print_table(("topic", "type"), ("messages", "Hz"), rows)


def show_skin(bag: Bag, topic: str) -> None:
    """Print a recorded skin with its calibrations, and for each cube its rate, losses and gaps.

    Args:
        bag: The bag.
        topic: Topic with the frequencies of the skin's pads.
    """
    from ..bags.recording import find_skin_infos
    from ..bags.summary import summarise_cubes
    from ..core.errors import BagError
    from ..views.terminal.output import format_count, print_table, say

    try:
        info = find_skin_infos(bag, topic)[-1]
    except BagError as error:
        # A skin that cannot be shown must not keep the other skins of the bag from being shown.
        say(str(error), "red")
        return
    frame, version = info.header.frame_id, info.version
    cubes = format_count(len(info.cubes), "cube")
    say(f"skin {info.name!r}: {cubes} in {frame}, info version {version}")
    counts = Counter(cube.calibration_id for cube in info.cubes)
    for name, count in counts.items():
        # One calibration has one layout. A bag with several, which is damaged, shows all of them.
        layouts = {cube.layout for cube in info.cubes if cube.calibration_id == name}
        layout = ", ".join(sorted(layouts))
        cubes = format_count(count, "cube")
        say(f"  calibration {name}, layout {layout}: {cubes}")

    rows = []
    summaries = summarise_cubes(bag, topic, len(info.cubes))
    for cube, summary in zip(info.cubes, summaries, strict=True):
        # Rate, losses and gaps are unknown for a cube with fewer than two samples.
        cells = ["", "", "", ""]
        if summary.rate is not None and summary.longest_gap is not None:
            gap_ms = f"{1e3 * summary.longest_gap:.1f}"
            cells = [f"{summary.rate:.1f}", str(summary.lost), str(summary.gaps), gap_ms]
        rows.append((cube.name, f"{cube.uid:#x}", str(summary.samples), *cells))
    print_table(
        ("cube", "uid"),
        ("samples", "Hz", "lost", "gaps", "longest gap / ms"),
        rows,
    )


def format_diagnostics(status: DiagnosticStatus) -> str:
    """Return one line for a diagnostic status: its name, its message, and all values except zeros.

    Args:
        status: A message diagnostic_msgs/DiagnosticStatus.
    """
    empty = ("0", "0.0", "")
    values = [f"{pair.key} {pair.value}" for pair in status.values if pair.value not in empty]
    message = status.message or "nothing wrong"
    return f"{status.name}: {message}; {', '.join(values)}"
