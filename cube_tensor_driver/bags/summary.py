# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Summary of a bag: sample rates, losses and gaps of each cube, and the last diagnostics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..core.arrays import Integers
from ..core.rows import COUNTER_RANGE
from ..messages.codec import frequency_codec
from .read import Bag

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

DIAGNOSTICS_TYPE = "diagnostic_msgs/msg/DiagnosticArray"
"""Message type of the diagnostics, which state the condition of each node and cube."""

MIN_GAP_PERIODS = 1.5
"""Time between two successive samples of a cube above which it counts as a gap, divided by the
cube's median sampling period."""


@dataclass(frozen=True)
class CubeSummary:
    """Completeness of the recorded samples of one cube.

    Attributes:
        samples: Number of recorded samples.
        lost: Number of samples whose sequence numbers are missing.
        gaps: Number of gaps: times between two successive samples above `MIN_GAP_PERIODS` times the
            median sampling period.
        rate: Samples per second, from the median period; None with fewer than two samples.
        longest_gap: Longest time between two samples, in s; None with fewer than two samples.
    """

    samples: int
    lost: int = 0
    gaps: int = 0
    rate: float | None = None
    longest_gap: float | None = None


def summarise_cubes(bag: Bag, topic: str, n_cubes: int) -> Iterator[CubeSummary]:
    """Summarise the recorded samples of every cube of a skin.

    Args:
        bag: Open bag.
        topic: Topic of the skin's frequencies.
        n_cubes: Number of cubes of the skin.
    """
    # The empty first part makes the concatenation below possible for a topic without messages.
    parts: list[list[Integers]] = [[np.empty(0, np.int64)] * 3]
    parts += bag.read_columns(topic, frequency_codec, ("cube", "sequence"))
    columns = zip(*parts, strict=True)
    stamp_ns, cube, sequence = map(np.concatenate, columns)
    for number in range(n_cubes):
        rows = cube == number
        n_samples = int(np.count_nonzero(rows))
        if n_samples < 2:
            yield CubeSummary(n_samples)
            continue
        steps = np.mod(np.diff(sequence[rows]), COUNTER_RANGE)
        # A step of at least half the range of the sequence numbers is in fact a step back: the hub
        # was restarted and counts from 0 again, so no samples were lost.
        is_forward = (steps > 0) & (steps < COUNTER_RANGE // 2)
        periods_ns = np.diff(stamp_ns[rows])
        # The median is used because a pause of the recording would lengthen the mean period.
        median_ns = float(np.median(periods_ns))
        yield CubeSummary(
            n_samples,
            lost=int((steps[is_forward] - 1).sum()),
            gaps=int(np.count_nonzero(periods_ns > MIN_GAP_PERIODS * median_ns)),
            rate=1e9 / median_ns if median_ns > 0 else np.nan,
            longest_gap=1e-9 * float(periods_ns.max()),
        )


def find_last_diagnostics(bag: Bag) -> list[DiagnosticStatus]:
    """Return the last recorded DiagnosticStatus of each name, sorted by name."""
    # Entries come in the order of recording, so a later status replaces an earlier one.
    last = {}
    topics = set(bag.list_topics(DIAGNOSTICS_TYPE))
    message: DiagnosticArray
    for _, message in bag.read_decoded(topics):
        for status in message.status:
            last[status.name] = status
    return [last[name] for name in sorted(last)]
