"""What a bag holds, as tables."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ...bags.read import Bag
from ...bags.recording import skin_infos
from ...bags.summary import cube_summaries, last_diagnostics
from ...core.errors import BagError
from ...messages.types import FREQUENCIES


def show_bag(path: Path) -> None:
    """Print topics, skins, cubes, calibrations, rates, gaps and the last diagnostics.

    BagError: the bag cannot be read.
    """
    console = Console(highlight=False)
    with Bag(path) as bag:
        seconds = 0.0
        # A bag without messages has no time either.
        if any(connection.msgcount for connection in bag.connections):
            seconds = (bag.end_ns - bag.start_ns) * 1e-9
            start = np.datetime64(bag.start_ns, "ns").astype("datetime64[ms]")
            console.print(f"{path}: {seconds:.3f} s from {start} UTC")
        else:
            console.print(f"{path}: no messages")
        console.print(_topics(bag, seconds))
        for topic in bag.topics(FREQUENCIES):
            _show_skin(bag, topic, console)
        for status in last_diagnostics(bag):
            console.print(_diagnostics(status), markup=False)


def _topics(bag: Bag, seconds: float) -> Table:
    table = Table("topic")
    table.add_column("type", overflow="fold")
    for name in ("messages", "Hz"):
        table.add_column(name, justify="right")
    for connection in sorted(bag.connections, key=lambda connection: connection.topic):
        count = connection.msgcount
        rate = f"{count / seconds:.1f}" if seconds and count > 1 else ""
        table.add_row(connection.topic, connection.msgtype, str(count), rate)
    return table


def _cubes(count: int) -> str:
    return f"{count} {'cube' if count == 1 else 'cubes'}"


def _show_skin(bag: Bag, topic: str, console: Console) -> None:
    try:
        info = skin_infos(bag, topic)[-1]
    except BagError as error:
        console.print(str(error), style="red", markup=False)
        return
    console.print(
        f"skin {info.name!r}: {_cubes(len(info.cubes))} in {info.header.frame_id}, "
        f"info version {info.version}",
        markup=False,
    )
    for name, count in Counter(cube.calibration_id for cube in info.cubes).items():
        layouts = {cube.layout for cube in info.cubes if cube.calibration_id == name}
        console.print(f"  calibration {name}, layout {', '.join(sorted(layouts))}: {_cubes(count)}")
    table = Table("cube", "uid")
    for name in ("samples", "Hz", "lost", "gaps", "longest gap / ms"):
        table.add_column(name, justify="right")
    for cube in cube_summaries(bag, topic, info):
        cells = ["", "", "", ""]
        if cube.rate is not None and cube.longest_gap is not None:
            gap_ms = f"{1e3 * cube.longest_gap:.1f}"
            cells = [f"{cube.rate:.1f}", str(cube.lost), str(cube.gaps), gap_ms]
        table.add_row(cube.name, f"{cube.uid:#x}", str(cube.samples), *cells)
    console.print(table)


def _diagnostics(status: Any) -> str:
    """The message and the values that are not zero."""
    values = [
        f"{pair.key} {pair.value}" for pair in status.values if pair.value not in ("0", "0.0", "")
    ]
    return f"{status.name}: {status.message or 'nothing wrong'}; {', '.join(values)}"
