# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The health of the pads that the reconstruction found while a bag was recorded, row by row.

The health is which pads were left out as faulty, and why. It cannot be computed again exactly from
a bag, because it also depends on samples before the recording began and on where the statistics
windows began. Therefore it is read from the recorded stress when that stress is reprocessed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..core.arrays import Integers, PadMasks, StatusBits, Times
from ..core.matching import NO_MATCH, match_rows
from ..core.reconstructor import RecordedHealth
from ..core.rows import FrequencyRows
from ..core.status import WORDS
from ..messages.codec import stress_codec
from ..messages.types import STRESS_TYPE
from .read import MAX_DISORDER_NS, Bag

HEALTH_BITS = np.uint16(sum(WORDS))
"""Status bits in a row of stress that state conditions of the cube's pads (open, short, noisy, …).

Only these are taken from the recorded stress; the other status bits are computed again.
"""


class _StressBatch(NamedTuple):
    """The columns of N recorded rows of stress that state the health of pads, read together.

    Attributes:
        cube: (N,) index of the cube in the skin.
        sequence: (N,) sequence number of the sample.
        stamp_ns: (N,) stamp of the sample, in ns since the Unix epoch.
        left_out: (N,) bit masks of pads; bit p is set if pad p of the cube was not used.
        status: (N,) status bits, restricted to `HEALTH_BITS`.
        first_ns: Earliest of the stamps, in ns since the Unix epoch.
        last_ns: Latest of the stamps, in ns since the Unix epoch.
    """

    cube: Integers
    sequence: Integers
    stamp_ns: Times
    left_out: PadMasks
    status: StatusBits
    first_ns: int
    last_ns: int


class RecordedHealthReader:
    """Reads the health of pads for rows of frequencies from the recorded stress of the same skin.

    Calls of `find` in the order of recording are fastest. For rows that are more than
    `MAX_DISORDER_NS` older than those of the previous call, the bag is read again from its start.
    """

    def __init__(self, bag: Bag, topic: str) -> None:
        """Prepare to read the recorded stress.

        Args:
            bag: Open bag.
            topic: Topic of the frequencies.
        """
        self._bag = bag
        self._topic = f"{topic.removesuffix('frequencies')}stress"
        self._restart()

    def _restart(self) -> None:
        self._unread = self._read()
        self._batches: list[_StressBatch] = []
        self._newest_ns = 0
        self._last_wanted_ns = 0

    def find(self, rows: FrequencyRows) -> RecordedHealth:
        """Return the recorded health (which pads were left out, and why) for rows of frequencies.

        The row of stress that belongs to a row of frequencies has the same cube, sequence number
        and stamp. If it was not recorded, `known` is false for this row in the result.
        """
        count = len(rows)
        health = RecordedHealth(
            known=np.zeros(count, bool),
            left_out=np.zeros(count, np.uint32),
            status=np.zeros(count, np.uint16),
        )
        if not count:
            return health
        begin_ns = int(rows.stamp_ns.min())
        end_ns = int(rows.stamp_ns.max())
        for batch in self._read_between(begin_ns, end_ns):
            # Usually a batch of stress has exactly the rows of the batch of frequencies, so that no
            # search is needed.
            has_same_stamps = np.array_equal(batch.stamp_ns, rows.stamp_ns)
            if has_same_stamps and np.array_equal(batch.cube, rows.cube):
                known = np.ones(count, bool)
                return RecordedHealth(known, batch.left_out, batch.status)
            match = match_rows(batch, rows)
            # A hub counts from 0 again after a restart, so an equal sequence number with another
            # stamp is a different sample.
            is_same = (match != NO_MATCH) & (batch.stamp_ns[match] == rows.stamp_ns)
            source = match[is_same]
            health.known[is_same] = True
            health.left_out[is_same] = batch.left_out[source]
            health.status[is_same] = batch.status[source]
            if health.known.all():
                break
        return health

    def _read_between(self, begin_ns: int, end_ns: int) -> Iterator[_StressBatch]:
        """Yield the batches of recorded stress that can contain rows with stamps in a span of time.

        Batches already in memory come first. The bag is read further only while the caller takes
        more batches, and at most `MAX_DISORDER_NS` beyond the span.

        Args:
            begin_ns: Start of the span, in ns since the Unix epoch.
            end_ns: End of the span, in ns since the Unix epoch.
        """
        if end_ns < self._last_wanted_ns - MAX_DISORDER_NS:
            self._restart()
        self._last_wanted_ns = end_ns
        oldest_ns = begin_ns - MAX_DISORDER_NS
        self._batches = [batch for batch in self._batches if batch.last_ns >= oldest_ns]
        # A list can grow while it is iterated, here by the batches that are read further.
        for batch in self._batches or self._read_next(end_ns):
            if batch.first_ns <= end_ns and batch.last_ns >= begin_ns:
                yield batch
            if batch is self._batches[-1]:
                self._read_next(end_ns)

    def _read_next(self, end_ns: int) -> list[_StressBatch]:
        """Read one more batch of recorded stress if it may contain rows up to a stamp.

        Args:
            end_ns: The stamp, in ns since the Unix epoch.

        Returns:
            All batches in memory.
        """
        if self._newest_ns < end_ns + MAX_DISORDER_NS:
            for batch in self._unread:
                self._newest_ns = max(self._newest_ns, batch.last_ns)
                self._batches.append(batch)
                break
        return self._batches

    def _read(self) -> Iterator[_StressBatch]:
        """Yield the recorded columns of stress that state the health of the pads, batch by batch.

        The bag is read from its beginning.
        """
        if self._topic not in self._bag.list_topics(STRESS_TYPE):
            return
        names = ("cube", "sequence", "left_out", "status")
        for columns in self._bag.read_columns(self._topic, stress_codec, names):
            stamp_ns, cube, sequence, left_out, status = columns
            if len(cube):
                yield _StressBatch(
                    cube,
                    sequence,
                    stamp_ns.astype(np.int64, copy=False),
                    left_out.astype(np.uint32, copy=False),
                    status=status & HEALTH_BITS,
                    first_ns=int(stamp_ns.min()),
                    last_ns=int(stamp_ns.max()),
                )
