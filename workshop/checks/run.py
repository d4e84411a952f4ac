# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""One torture, prepared for the checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cube_tensor_driver.core.arrays import Index, Integers, Mask, Real, Records
from cube_tensor_driver.core.matching import NO_MATCH
from cube_tensor_driver.simulation.sample_log import SampleLog

from .record import NS_PER_S, Record, Samples
from .sent_readings import SentReadings

EXAMPLES = 3
"""Maximum number of lines that describe examples of one kind of finding."""


def count(mask: Mask) -> int:
    """Return the number of entries that are True."""
    return int(np.count_nonzero(mask))


def find_matched(index: Index) -> Index:
    """Return the places at which indices (N,) are not `NO_MATCH` (no sample was found)."""
    return np.flatnonzero(index != NO_MATCH)


def agree(
    found: Real,
    wanted: Real,
    allowed: Real | float = 0.0,
) -> Mask:
    """Return where two arrays differ by at most a tolerance; NaN (unknown) agrees only with NaN."""
    near = np.abs(found - wanted) <= allowed
    return near | (np.isnan(found) & np.isnan(wanted))


class Run:
    """What the hubs of a torture (run of a simulated skin under faults) sent, and what arrived.

    Attributes:
        record: What arrived and what was done.
        samples: All samples that the hubs took, S in number.
        sent: Finds what the hubs sent in these samples.
        sample: Index of the sample of each row of frequencies (N,), or `NO_MATCH`.
    """

    def __init__(
        self,
        record: Record,
        log: SampleLog,
        readings: Records,
    ) -> None:
        self.record, self.samples = record, Samples(log)
        self.sent = SentReadings(self.samples, readings)
        self.sample = self.sent.find_samples(record.frequencies.rows)
        self._start_ns = log.start_time_ns

    def describe(self, finding: str, time_ns: int) -> str:
        """Return a line about a finding, with its simulated time in seconds."""
        seconds = (int(time_ns) - self._start_ns) / NS_PER_S
        return f"{finding}, {seconds:.3f} s"

    def describe_examples(
        self,
        finding: str,
        number: Integers,
        time_ns: Index,
        is_found: Mask,
    ) -> list[str]:
        """Return lines that describe the first findings.

        Args:
            finding: Text of the finding.
            number: Number that each line shows, such as the index of the cube (N,).
            time_ns: Times (N,), in ns since the Unix epoch.
            is_found: Which of the N rows or samples are findings (N,).
        """
        rows = np.flatnonzero(is_found)[:EXAMPLES]
        return [self.describe(f"{finding} {number[row]}", time_ns[row]) for row in rows]


@dataclass(frozen=True)
class Findings:
    """Result of one check.

    Attributes:
        figures: Counts by the name that torture prints; those of several checks are added.
        examples: Lines about the first findings.
    """

    figures: Mapping[str, int]
    examples: list[str]
