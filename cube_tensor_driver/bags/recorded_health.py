"""The health of pads that the reconstruction found while a bag was recorded, row by row.

`Health` remembers more than a bag contains: what it saw before the recording began, and where its
statistics windows begin. Therefore its results are taken from the recorded stress when the same
stress is computed again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..core.arrays import AnyArray, PadMasks, StatusBits, Times
from ..core.matching import NO_MATCH, match_rows
from ..core.reconstructor import RecordedHealth
from ..core.rows import FrequencyRows
from ..core.status import WORDS
from ..messages.codec import SECOND
from ..messages.types import STRESS
from .read import Bag

MAX_DISORDER_NS = SECOND
"""Largest difference, in ns, between the order of messages in a bag and that of their samples.

Stress is read this much further than the frequencies for which it is wanted.
"""

HEALTH_BITS = np.uint16(sum(WORDS))
"""The status bits of a row that state the health of its pads. The others are computed again."""


class _StressBatch(NamedTuple):
    """Columns of N rows of stress that were read together."""

    cube: AnyArray
    sequence: AnyArray
    stamp_ns: Times
    left_out: PadMasks
    status: StatusBits

    def overlaps(self, begin_ns: int, end_ns: int) -> bool:
        """Return whether a row can lie between two times."""
        first_ns, last_ns = self.stamp_ns.min(), self.stamp_ns.max()
        return bool(first_ns <= end_ns and last_ns >= begin_ns)


class RecordedHealthReader:
    """Reads the stress beside the frequencies on a topic of a bag.

    It is fastest when rows are asked for in the order of recording. When time jumps back, it starts
    again from the beginning of the bag.
    """

    def __init__(self, bag: Bag, topic: str) -> None:
        """Prepare to read.

        Args:
            bag: Open bag.
            topic: Topic of the frequencies.
        """
        self._bag = bag
        self._topic = topic.removesuffix("frequencies") + "stress"
        self._has_stress = self._topic in bag.topics(STRESS)
        self._last_wanted_ns = 0
        self._newest_ns = 0
        self._batches: deque[_StressBatch] = deque()
        self._unread = self._read()

    def health_at(self, rows: FrequencyRows) -> RecordedHealth:
        """Return the recorded health for rows, which are found by cube, number and stamp."""
        health = RecordedHealth(
            known=np.zeros(len(rows), bool),
            left_out=np.zeros(len(rows), np.uint32),
            status=np.zeros(len(rows), np.uint16),
        )
        if not self._has_stress or not len(rows):
            return health
        begin_ns, end_ns = int(rows.stamp_ns.min()), int(rows.stamp_ns.max())
        for batch in self._batches_between(begin_ns, end_ns):
            # Usually frequencies and stress were recorded alike: then nothing must be searched.
            has_same_stamps = np.array_equal(batch.stamp_ns, rows.stamp_ns)
            if has_same_stamps and np.array_equal(batch.cube, rows.cube):
                everything = np.ones(len(rows), bool)
                return RecordedHealth(everything, batch.left_out, batch.status)
            _copy_matching(batch, rows, health)
            if health.known.all():
                break
        return health

    def _batches_between(self, begin_ns: int, end_ns: int) -> Iterator[_StressBatch]:
        """Yield the stress of a span of time.

        The bag is read on only as far as the caller asks for more.
        """
        if end_ns < self._last_wanted_ns - MAX_DISORDER_NS:
            self._newest_ns = 0
            self._batches.clear()
            self._unread = self._read()
        self._last_wanted_ns = end_ns
        oldest_ns = begin_ns - MAX_DISORDER_NS
        while self._batches and self._batches[0].stamp_ns.max() < oldest_ns:
            self._batches.popleft()

        for kept in tuple(self._batches):
            if kept.overlaps(begin_ns, end_ns):
                yield kept
        while self._newest_ns < end_ns + MAX_DISORDER_NS:
            batch = next(self._unread, None)
            if batch is None:
                return
            newest_ns = int(batch.stamp_ns.max())
            self._newest_ns = max(self._newest_ns, newest_ns)
            self._batches.append(batch)
            if batch.overlaps(begin_ns, end_ns):
                yield batch

    def _read(self) -> Iterator[_StressBatch]:
        names = ("cube", "sequence", "left_out", "status")
        for columns in self._bag.stress_columns(self._topic, names):
            stamp_ns, cube, sequence, left_out, status = columns
            if len(cube):
                yield _StressBatch(cube, sequence, stamp_ns, left_out, status & HEALTH_BITS)


def _copy_matching(
    batch: _StressBatch,
    rows: FrequencyRows,
    health: RecordedHealth,
) -> None:
    """Copy the health of the rows that a batch contains."""
    match = match_rows(batch, rows)
    # The same number with another stamp is a sample from before a restart of the hub.
    has_match = match != NO_MATCH
    is_same = has_match & (batch.stamp_ns[match] == rows.stamp_ns)
    source = match[is_same]
    health.known[is_same] = True
    health.left_out[is_same] = batch.left_out[source]
    health.status[is_same] = batch.status[source]
