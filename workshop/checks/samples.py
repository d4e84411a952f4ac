"""All samples that the hubs took, from the sample log, and which of them a row is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.simulation.sample_log import SEQUENCE_RANGE, SampleLog

if TYPE_CHECKING:
    from .expected import Expected

NONE = -1
"""Number of a sample that no hub took."""
HALF = 0.5
"""Of a row's pads at least must read what they should, or another sample of this number is looked
for."""
CHUNK = 100_000
"""Rows looked at together."""


class Samples:
    """One entry for each sample, hub after hub, in the order of time.

    link: (S,) index in the log; boot, number: (S,) as in the log
    time_us: (S,) simulated time; time_ns: (S,) wall clock; period_us: (S,)
    damaged: (S,) bool, harmed on purpose, or it found no room on the line
    """

    def __init__(self, log: SampleLog) -> None:
        parts, damaged = [], []
        self._begin: list[int] = []
        count = 0
        for number, link in enumerate(log.links):
            for run in link.runs:
                self._begin.append(count)
                count += len(run)
                n = np.arange(len(run))
                time_us = run.start_us + run.period_us * n
                same = [np.full(len(run), value) for value in (number, run.boot, run.period_us)]
                parts.append((*same, run.first + n, time_us))
            harmed = set(link.damaged)
            damaged += [
                (run.boot, sample) in harmed
                for run in link.runs
                for sample in range(run.first, run.last + 1)
            ]
        columns = zip(*parts, strict=True) if parts else [[np.empty(0, int)]] * 5
        self.link, self.boot, self.period_us, self.number, self.time_us = (
            np.concatenate(column).astype(np.int64) for column in columns
        )
        self.time_ns = log.start_time_ns + 1000 * self.time_us
        self.damaged = np.array(damaged, bool)
        self._log = log

    def __len__(self) -> int:
        return len(self.link)

    def match(self, rows: FrequencyRows, expected: Expected) -> NDArray[np.int64]:
        """(N,) which sample each row is, NONE for what no hub took.

        A hub that restarts gives its numbers again. Then the sample is meant whose readings the row
        has; of several, or none, the one that was taken nearest to the row's stamp.
        """
        parts = [
            self._match(rows.select(slice(at, at + CHUNK)), expected)
            for at in range(0, len(rows), CHUNK)
        ]
        return np.concatenate([np.empty(0, np.int64), *parts])

    def _match(self, rows: FrequencyRows, expected: Expected) -> NDArray[np.int64]:
        sample = self._nearest(rows)
        known = np.flatnonzero(sample != NONE)
        unlike = known[~_alike(rows.select(known), sample[known], expected)]
        other = self._nearest(rows.select(unlike), expected)
        sample[unlike[other != NONE]] = other[other != NONE]
        return sample

    def _nearest(self, rows: FrequencyRows, expected: Expected | None = None) -> NDArray[np.int64]:
        """(N,) of all samples with a row's number the nearest to its stamp; if `expected` is given,
        of those that it is alike."""
        found = np.full(len(rows), NONE, np.int64)
        best = np.full(len(rows), np.iinfo(np.int64).max)
        runs = ((link, run) for link in self._log.links for run in link.runs)
        for begin, (link, run) in zip(self._begin, runs, strict=True):
            ahead = (rows.sequence.astype(np.int64) - run.first) % SEQUENCE_RANGE
            chosen = np.flatnonzero((ahead < len(run)) & np.isin(rows.cube, link.members))
            sample = begin + ahead[chosen]
            if expected is not None:
                alike = _alike(rows.select(chosen), sample, expected)
                chosen, sample = chosen[alike], sample[alike]
            distance = np.abs(self.time_ns[sample] - rows.stamp_ns[chosen])
            nearer = distance < best[chosen]
            found[chosen[nearer]], best[chosen[nearer]] = sample[nearer], distance[nearer]
        return found


def _alike(rows: FrequencyRows, sample: NDArray[np.int64], expected: Expected) -> NDArray[np.bool_]:
    """(N,) whether rows read what their cubes did in these samples, mostly."""
    readings = expected.of(rows.cube, sample)
    same = (readings.frequency == rows.frequency) | np.isnan(readings.frequency)
    alike: NDArray[np.bool_] = same.mean(axis=1) >= HALF
    return alike
