"""Comparison of what simulated hubs sent with what arrived.

Demo and bench collect what arrives in `Arrivals`, and `compare` it with the sample log at the end.
Counts are rows: one cube, one sample. Torture checks more, see `workshop/checks/`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..config.skin import Skin
from ..core.arrays import AnyArray, Array, Index, Mask
from ..core.matching import NO_MATCH, SampleKeys
from ..core.rows import FrequencyRows, StressRows
from ..simulation.cubes import hub_cubes
from ..simulation.sample_log import SampleTable

NS_TO_MS = 1e-6


class Arrivals:
    """Collects which rows arrive and when.

    Attributes:
        row_count: (cubes,) number of rows that a kept row of each cube stands for; rows of cubes
            with 0 are not kept.
        rows: Number of rows that arrived, kept or not.
    """

    def __init__(self, skin: Skin, *, one_per_hub: bool = False) -> None:
        """Start with nothing.

        Args:
            skin: The skin whose rows arrive.
            one_per_hub: Keep only rows of the first cube of each hub. It saves memory and time
                where whole samples of a hub arrive or are lost.
        """
        self.row_count = np.ones(len(skin.cubes), np.int64)
        if one_per_hub:
            self.row_count[:] = 0
            for hub in hub_cubes(skin):
                members = hub.skin_cubes
                self.row_count[members[0]] = len(members)
        self.rows = 0
        self._keeps_all = not one_per_hub
        self._parts: list[tuple[Index, ...]] = []

    def keeps(self, cube: AnyArray) -> Mask:
        """Return, for each of these cubes (N,), whether its rows are kept."""
        return np.asarray(self.row_count[cube] > 0)

    def add(self, rows: FrequencyRows | StressRows, received_ns: int = 0) -> None:
        """Add rows that arrived at `received_ns` of the wall clock.

        Args:
            rows: The rows of one message.
            received_ns: Time of arrival; 0 where the latency is not asked for.
        """
        # All rows count, kept or not, because callers ask whether anything has arrived.
        self.rows += len(rows)
        cube, sequence, stamp_ns = rows.cube, rows.sequence, rows.stamp_ns
        if not self._keeps_all:
            kept = self.keeps(cube)
            cube, sequence, stamp_ns = cube[kept], sequence[kept], stamp_ns[kept]
        # `astype` copies: the rows may be views of a message whose memory is used again.
        part = (cube.astype(np.int64), sequence.astype(np.int64), stamp_ns.astype(np.int64))
        self._parts.append((*part, np.full(len(cube), received_ns)))

    def columns(self) -> tuple[Index, ...]:
        """Return cube, sequence, stamp_ns and received_ns (N,) of the rows kept, in order."""
        if not self._parts:
            return tuple(np.empty((4, 0), np.int64))
        # The joined parts are stored, so that the next call does not join them again.
        self._parts = [tuple(np.concatenate(column) for column in zip(*self._parts, strict=True))]
        return self._parts[0]


@dataclass(frozen=True)
class Comparison:
    """What was sent and received of the samples that were taken in a span of time.

    Attributes:
        sent: Number of rows of the samples that the hubs took.
        received: Number of these rows that arrived; repeated ones count once.
        first: (K,) indices into the rows kept in `Arrivals` of the first arrival of each row.
        taken_ns: (K,) wall clock at which these rows were taken, in ns.
        latency_ms: (K,) time from the sample to its arrival, in ms.
        stamp_error_ms: (K,) absolute difference between the sample's time and its stamp, in ms.
    """

    sent: int
    received: int
    first: Index
    taken_ns: Index
    latency_ms: Array
    stamp_error_ms: Array

    @property
    def missing(self) -> int:
        """Number of rows that were sent and did not arrive."""
        return self.sent - self.received


def compare(
    taken: SampleTable,
    arrivals: Arrivals,
    start_ns: int,
    end_ns: int,
) -> Comparison:
    """Compare what arrived with what was taken from `start_ns` to before `end_ns` (wall clock)."""
    cube, sequence, stamp_ns, received_ns = arrivals.columns()
    sample = taken.match(SampleKeys(cube, sequence, stamp_ns))
    taken_ns = taken.time_ns[sample] if len(taken) else np.zeros(len(sample), np.int64)
    in_span = (sample != NO_MATCH) & (taken_ns >= start_ns) & (taken_ns < end_ns)
    rows = np.flatnonzero(in_span)

    row_id = sample[rows] * len(arrivals.row_count) + cube[rows]
    first = rows[np.sort(np.unique(row_id, return_index=True)[1])]
    return Comparison(
        sent=taken.rows_taken(start_ns, end_ns),
        received=int(arrivals.row_count[cube[first]].sum()),
        first=first,
        taken_ns=taken_ns[first],
        latency_ms=NS_TO_MS * (received_ns[first] - taken_ns[first]),
        stamp_error_ms=NS_TO_MS * np.abs(stamp_ns[first] - taken_ns[first]),
    )


def percentile(values: Array, percent: float) -> float:
    """Return a percentile, rounded to 1e-3; NaN if there are no values."""
    return round(float(np.percentile(values, percent)), 3) if len(values) else float("nan")
