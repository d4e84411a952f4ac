"""./cube bag: what is in a bag, and bags made readable again."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from ..bags.read import FREQUENCIES, Bag
from ..bags.repair import REST, repair
from ..core.errors import BagError

DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
GAP = 1.5
"""Times the usual step between two samples of a cube that count as a gap."""


def run_info(path: Path) -> int:
    """Print topics, skins, cubes, calibrations, rates, gaps and the last counters. BagError: cannot
    be read."""
    console = Console(highlight=False)
    with Bag(path) as bag:
        # A bag without messages has no time either.
        empty = not any(one.msgcount for one in bag.connections)
        seconds = 0.0 if empty else (bag.end_ns - bag.start_ns) * 1e-9
        start = np.datetime64(bag.start_ns, "ns").astype("datetime64[ms]")
        console.print(
            f"{path}: no messages" if empty else f"{path}: {seconds:.3f} s from {start} UTC"
        )
        table = Table("topic", "type")
        for name in ("messages", "Hz"):
            table.add_column(name, justify="right")
        for one in sorted(bag.connections, key=lambda connection: connection.topic):
            rate = f"{one.msgcount / seconds:.1f}" if seconds and one.msgcount > 1 else ""
            table.add_row(one.topic, one.msgtype, str(one.msgcount), rate)
        console.print(table)
        for topic in bag.topics(FREQUENCIES):
            _skin(bag, topic, console)
        _counters(bag, console)
    return 0


def _skin(bag: Bag, topic: str, console: Console) -> None:
    try:
        info = bag.infos(topic.removesuffix("frequencies") + "info")[-1]
    except BagError as error:
        console.print(str(error), style="red", markup=False)
        return
    used = Counter(cube.calibration_id for cube in info.cubes)
    console.print(
        f"skin {info.name}: {len(info.cubes)} cubes in {info.header.frame_id}, info version {info.version}"
    )
    for name, count in used.items():
        layouts = ", ".join(
            sorted({cube.layout for cube in info.cubes if cube.calibration_id == name})
        )
        console.print(f"  calibration {name}, layout {layouts}: {count} cubes")
    cube, sequence, times = _rows(bag, topic)
    table = Table("cube", "uid")
    for name in ("samples", "Hz", "lost", "gaps", "longest gap / ms"):
        table.add_column(name, justify="right")
    for number, one in enumerate(info.cubes):
        chosen = cube == number
        if chosen.sum() < 2:
            table.add_row(one.name, f"{one.uid:#x}", str(chosen.sum()), "", "", "", "")
            continue
        steps = np.diff(sequence[chosen]).astype(np.uint32).astype(np.int64)
        # A step of half the range is a hub that began anew, no loss.
        lost = (steps[(steps > 0) & (steps < 1 << 31)] - 1).sum()
        waits = np.diff(times[chosen])
        gaps = np.count_nonzero(waits > GAP * np.median(waits))
        rate = 1e9 / np.median(waits) if np.median(waits) > 0 else np.nan
        table.add_row(
            one.name,
            f"{one.uid:#x}",
            str(chosen.sum()),
            f"{rate:.1f}",
            str(lost),
            str(gaps),
            f"{waits.max() * 1e-6:.1f}",
        )
    console.print(table)


def _rows(bag: Bag, topic: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """cube, sequence and time in ns of all rows."""
    columns: list[tuple[np.ndarray, ...]] = [
        (np.empty(0, np.uint16), np.empty(0, np.uint32), np.empty(0, np.int64))
    ]
    for messages, _ in bag.frequencies(topic):
        rows = messages.rows
        columns.append((rows.cube, rows.sequence, rows.stamp_ns))
    cube, sequence, times = (np.concatenate(column) for column in zip(*columns, strict=True))
    return cube, sequence, times


def _counters(bag: Bag, console: Console) -> None:
    """The last that diagnostics said of each part, where it is not zero."""
    last = {}
    topics = set(bag.topics(DIAGNOSTICS))
    for entry in bag.entries(topics) if topics else ():
        for status in bag.decode(entry).status:
            last[status.name] = status
    for name, status in sorted(last.items()):
        said = [
            f"{pair.key} {pair.value}"
            for pair in status.values
            if pair.value not in ("0", "0.0", "")
        ]
        console.print(
            f"{name}: {status.message or 'nothing wrong'}; {', '.join(said)}", markup=False
        )


def run_repair(folder: Path) -> int:
    """Make a bag's folder readable and say what was lost."""
    done = repair(folder)
    console = Console(highlight=False)
    console.print(f"{folder}: {done.messages} messages can be read")
    if done.cut:
        console.print(
            f"{done.cut} bytes behind the last complete chunk were moved to files ending in {REST}"
        )
    if done.damaged:
        console.print(f"{done.damaged} damaged chunks were left out", style="red")
    return 0
