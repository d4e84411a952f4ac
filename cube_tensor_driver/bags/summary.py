"""Summary of a bag for people: rates, losses and gaps of each cube, and the last diagnostics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.arrays import AnyArray, Times
from .read import Bag

DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

MIN_GAP_PERIODS = 1.5
"""Time between two samples of a cube, in median periods, from which on it counts as a gap."""

SEQUENCE_RANGE = 1 << 32
"""Number of different sequence numbers (32 bits); the largest one is followed by 0."""


@dataclass(frozen=True)
class CubeSummary:
    """How completely one cube was recorded.

    Attributes:
        name: Name of the cube.
        uid: Number of its hub.
        samples: Number of samples.
        lost: Number of samples missing in the sequence.
        gaps: Number of gaps in time.
        rate: Samples per second, from the median period; None with fewer than two samples.
        longest_gap: Longest time between two samples, in s; None with fewer than two samples.
    """

    name: str
    uid: int
    samples: int
    lost: int = 0
    gaps: int = 0
    rate: float | None = None
    longest_gap: float | None = None


def cube_summaries(
    bag: Bag,
    topic: str,
    info: Any,
) -> Iterator[CubeSummary]:
    """Summarise every cube of a SkinInfo from the frequencies on a topic."""
    cube, sequence, stamp_ns = _columns(bag, topic)
    for number, one in enumerate(info.cubes):
        rows = cube == number
        yield _summarise(
            one.name,
            one.uid,
            sequence[rows],
            stamp_ns[rows],
        )


def last_diagnostics(bag: Bag) -> list[Any]:
    """Return the last DiagnosticStatus of each name, sorted by name."""
    # Later messages replace earlier ones of the same name.
    last = {}
    topics = set(bag.topics(DIAGNOSTICS))
    for entry in bag.entries(topics) if topics else ():
        for status in bag.decode(entry).status:
            last[status.name] = status
    return [last[name] for name in sorted(last)]


def _summarise(
    name: str,
    uid: int,
    sequence: AnyArray,
    stamp_ns: Times,
) -> CubeSummary:
    """Summarise the samples of one cube."""
    if len(sequence) < 2:
        return CubeSummary(name, uid, len(sequence))
    differences = np.diff(sequence.astype(np.int64))
    steps = np.mod(differences, SEQUENCE_RANGE)
    # A step of half the range or more is a hub that restarted, not loss.
    is_forward = (steps > 0) & (steps < SEQUENCE_RANGE // 2)
    lost = (steps[is_forward] - 1).sum()
    periods_ns = np.diff(stamp_ns)
    # The median is not moved by a pause, as the mean would be.
    median_ns = float(np.median(periods_ns))
    return CubeSummary(
        name,
        uid,
        samples=len(sequence),
        lost=int(lost),
        gaps=int(np.count_nonzero(periods_ns > MIN_GAP_PERIODS * median_ns)),
        rate=1e9 / median_ns if median_ns > 0 else np.nan,
        longest_gap=1e-9 * float(periods_ns.max()),
    )


def _columns(bag: Bag, topic: str) -> tuple[AnyArray, AnyArray, Times]:
    """Return cube, sequence number and stamp of all rows."""
    # An empty part keeps the type where there is no message.
    cube = [np.empty(0, np.uint16)]
    sequence = [np.empty(0, np.uint32)]
    stamp_ns = [np.empty(0, np.int64)]
    for messages, _ in bag.frequencies(topic):
        cube.append(messages.rows.cube)
        sequence.append(messages.rows.sequence)
        stamp_ns.append(messages.rows.stamp_ns)
    return np.concatenate(cube), np.concatenate(sequence), np.concatenate(stamp_ns)
