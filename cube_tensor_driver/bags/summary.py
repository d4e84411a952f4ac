"""What a bag says about its cubes: rates, losses, gaps, and the last diagnostics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .read import Bag

DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
GAP = 1.5
"""A step between two samples of a cube that is so many times the usual one counts as a gap."""


@dataclass(frozen=True)
class CubeSummary:
    """lost: samples missing in the sequence. rate (Hz) and longest_gap (s) of the time between
    samples; None with fewer than two samples."""

    name: str
    uid: int
    samples: int
    lost: int = 0
    gaps: int = 0
    rate: float | None = None
    longest_gap: float | None = None


def cube_summaries(bag: Bag, topic: str, info: Any) -> Iterator[CubeSummary]:
    """Of every cube of a SkinInfo, from the frequencies of `topic`."""
    cube, sequence, stamp_ns = _columns(bag, topic)
    for number, one in enumerate(info.cubes):
        rows = cube == number
        yield _summary(one.name, one.uid, sequence[rows], stamp_ns[rows])


def last_diagnostics(bag: Bag) -> list[Any]:
    """The last DiagnosticStatus of each name, by name."""
    last = {}
    topics = set(bag.topics(DIAGNOSTICS))
    for entry in bag.entries(topics) if topics else ():
        for status in bag.decode(entry).status:
            last[status.name] = status
    return [last[name] for name in sorted(last)]


def _summary(
    name: str, uid: int, sequence: NDArray[np.uint32], stamp_ns: NDArray[np.int64]
) -> CubeSummary:
    if len(sequence) < 2:
        return CubeSummary(name, uid, len(sequence))
    steps = np.diff(sequence).astype(np.uint32).astype(np.int64)
    # A step of half the range is a hub that restarted, not loss.
    lost = (steps[(steps > 0) & (steps < 1 << 31)] - 1).sum()
    times_ns = np.diff(stamp_ns)
    usual_ns = float(np.median(times_ns))
    return CubeSummary(
        name,
        uid,
        len(sequence),
        lost=int(lost),
        gaps=int(np.count_nonzero(times_ns > GAP * usual_ns)),
        rate=1e9 / usual_ns if usual_ns > 0 else np.nan,
        longest_gap=1e-9 * float(times_ns.max()),
    )


def _columns(
    bag: Bag, topic: str
) -> tuple[NDArray[np.uint16], NDArray[np.uint32], NDArray[np.int64]]:
    """cube, sequence and stamp_ns of all rows."""
    cube = [np.empty(0, np.uint16)]
    sequence = [np.empty(0, np.uint32)]
    stamp_ns = [np.empty(0, np.int64)]
    for messages, _ in bag.frequencies(topic):
        cube.append(messages.rows.cube)
        sequence.append(messages.rows.sequence)
        stamp_ns.append(messages.rows.stamp_ns)
    return np.concatenate(cube), np.concatenate(sequence), np.concatenate(stamp_ns)
