# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of the samples that simulated hubs sent with the rows of messages that arrived.

`./cube demo` and `./cube bench` collect the rows in `Arrivals`, and `compare` them with the log of
the simulator at the end. A row is one cube at one sampling time. `./cube torture` checks more, see
`workshop/checks/`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..config.skin import Skin
from ..core.arrays import Array, Index
from ..core.matching import NO_MATCH, SampleKeys
from ..core.rows import FrequencyRows, StressRows
from ..simulation.sample_log import SampleTable

NS_TO_MS = 1e-6
"""Number of milliseconds in a nanosecond."""


class Arrivals:
    """Stores which rows (one cube at one sampling time) have arrived, and when.

    Attributes:
        row_count: (cubes,) number of rows for which one stored row of each cube stands; here 1. A
            subclass may store the rows of only one cube of each hub. Then a row of this cube stands
            for the rows of all cubes of the hub. The value is 0 for cubes whose rows are not
            stored.
        rows: Number of rows that have arrived, stored or not.
    """

    def __init__(self, skin: Skin) -> None:
        self.row_count = np.ones(len(skin.cubes), np.int64)
        self.rows = 0
        no_rows = np.empty((4, 0), np.int64)
        self._parts: list[Index] = [no_rows]

    def add(self, rows: FrequencyRows | StressRows, received_ns: int = 0) -> None:
        """Add the rows of one message.

        Args:
            rows: The rows.
            received_ns: Time of arrival, in ns since the Unix epoch; 0 if the caller does not use
                the latency.
        """
        # Rows that are not stored count as well, because callers test whether any row has arrived.
        self.rows += len(rows)
        kept = self.row_count[rows.cube] > 0
        # The columns are copied, because the rows may be views of a message whose memory is reused
        # for the next message.
        received = np.full(len(rows), received_ns)
        columns = [rows.cube, rows.sequence, rows.stamp_ns, received]
        table = np.array(columns, np.int64)
        self._parts.append(table[:, kept])

    def collect_columns(self) -> Index:
        """Return four columns (4, N) of the stored rows, in the order of their arrival.

        Returns:
            Index of the cube; sequence number; stamp and time of arrival, in ns since the Unix
            epoch.
        """
        # The joined array replaces the parts of all messages, so that the next call does not have
        # to join them again.
        joined = np.hstack(self._parts)
        self._parts = [joined]
        return joined


@dataclass(frozen=True)
class Comparison:
    """The samples that the hubs took in a period, and the rows that arrived for these samples.

    A row is one cube at one sampling time; a sample of a hub has one row for each of its cubes.

    Attributes:
        sent: Number of rows of the samples that the hubs took.
        received: Number of these rows that arrived; a row that arrived twice counts once.
        first: (K,) indices into the rows stored in `Arrivals`: the first arrival of each row.
        taken_ns: (K,) sampling times of these rows, in ns since the Unix epoch.
        latency_ms: (K,) time from sampling to arrival, in ms.
        stamp_error_ms: (K,) absolute difference between sampling time and stamp, in ms.
    """

    sent: int
    received: int
    first: Index
    taken_ns: Index
    latency_ms: Array
    stamp_error_ms: Array

    @property
    def missing(self) -> int:
        """Number of rows that were sent in the period but did not arrive."""
        return self.sent - self.received


def compare(
    taken: SampleTable,
    arrivals: Arrivals,
    start_ns: int,
    end_ns: int,
) -> Comparison:
    """Compare the rows (one cube at one sampling time) that arrived with the samples that the
    simulated hubs took in a period.

    Args:
        taken: All samples in the log of the simulator.
        arrivals: The rows that arrived.
        start_ns: Beginning of the period, in ns since the Unix epoch.
        end_ns: End of the period; samples taken at this time or later do not count.
    """
    cube, sequence, stamp_ns, received_ns = arrivals.collect_columns()
    sample = taken.match(SampleKeys(cube, sequence, stamp_ns))
    matched = np.flatnonzero(sample != NO_MATCH)
    matched_ns = taken.time_ns[sample[matched]]
    in_span = (matched_ns >= start_ns) & (matched_ns < end_ns)
    rows = matched[in_span]

    row_id = sample[rows] * len(arrivals.row_count) + cube[rows]
    _, indices = np.unique(row_id, return_index=True)
    first = rows[np.sort(indices)]
    represented = arrivals.row_count[cube[first]]
    taken_ns = taken.time_ns[sample[first]]
    latency_ns = received_ns[first] - taken_ns
    stamp_error_ns = stamp_ns[first] - taken_ns
    return Comparison(
        sent=taken.count_rows_taken(start_ns, end_ns),
        received=int(represented.sum()),
        first=first,
        taken_ns=taken_ns,
        latency_ms=NS_TO_MS * latency_ns,
        stamp_error_ms=NS_TO_MS * np.abs(stamp_error_ns),
    )


def compute_percentile(values: Array, percent: float) -> float:
    """Return a percentile of some values, rounded to three decimals; NaN if there are no values.

    Args:
        values: (N,) the values.
        percent: The percentile, from 0 to 100.
    """
    if not len(values):
        return float("nan")
    return round(float(np.percentile(values, percent)), 3)
