"""What simulated hubs sent, compared with what arrived.

Demo and bench collect what arrives in `Arrivals` and `compare` it with the sample log at the end.
Counts are in rows: one cube, one sample. Torture checks more: `workshop/judge/`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..config.skin import Skin
from ..core.rows import FrequencyRows, StressRows
from ..simulation.cubes import hub_cubes
from ..simulation.sample_log import NEVER


class Taken(Protocol):
    """Which samples hubs took and when: a `SampleLog`, or what other hubs wrote."""

    @property
    def start_time_ns(self) -> int: ...

    def rows_taken(self, start_ns: int, end_ns: int) -> int: ...

    def taken_ns(
        self, cube: NDArray[Any], sequence: NDArray[Any], stamp_ns: NDArray[Any]
    ) -> NDArray[np.int64]: ...


class Arrivals:
    """Collects which rows arrive and when.

    row_count: (cubes of the skin,) rows that a kept row of each cube stands for; rows of cubes with
        0 are not kept. `one_per_hub` keeps rows of the first cube of each hub, where whole samples
        arrive or are lost and memory or time counts; else all rows are kept.
    rows: that arrived, kept or not
    """

    def __init__(self, skin: Skin, *, one_per_hub: bool = False) -> None:
        self.row_count = np.ones(len(skin.cubes), np.int64)
        if one_per_hub:
            self.row_count[:] = 0
            for hub in hub_cubes(skin):
                members = hub.skin_cubes
                self.row_count[members[0]] = len(members)
        self.rows = 0
        self._all_kept = not one_per_hub
        self._parts: list[tuple[NDArray[np.int64], ...]] = []

    def keeps(self, cube: NDArray[np.uint16]) -> NDArray[np.bool_]:
        """(N,) whether a row of each of these cubes is kept."""
        return self.row_count[cube] > 0

    def add(self, rows: FrequencyRows | StressRows, received_ns: int = 0) -> None:
        """Rows that arrived at received_ns of the wall clock; 0 where latency is not asked for."""
        self.rows += len(rows)
        cube, sequence, stamp_ns = rows.cube, rows.sequence, rows.stamp_ns
        if not self._all_kept:
            kept = self.keeps(cube)
            cube, sequence, stamp_ns = cube[kept], sequence[kept], stamp_ns[kept]
        # Copies, because rows may be views of a whole message.
        part = (cube.astype(np.int64), sequence.astype(np.int64), stamp_ns.astype(np.int64))
        self._parts.append((*part, np.full(len(cube), received_ns)))

    def columns(self) -> tuple[NDArray[np.int64], ...]:
        """cube, sequence, stamp_ns and received_ns (N,) of all rows that were kept, in order."""
        if not self._parts:
            return tuple(np.empty((4, 0), np.int64))
        # Joined parts stay joined: whoever asks again does not pay again.
        self._parts = [tuple(np.concatenate(column) for column in zip(*self._parts, strict=True))]
        return self._parts[0]


@dataclass(frozen=True)
class Comparison:
    """What was sent and received of the samples taken in a span of time.

    sent: rows of samples that the hubs took
    received: rows of them that arrived, each counted once
    taken_ns: (N,) of each row kept in `Arrivals`, as `SampleLog.taken_ns`
    first: (K,) which of those arrived first of each row of the span
    latency_ms, stamp_error_ms: (K,) of these rows, from the sample to its arrival, and between the
        sample and its stamp
    """

    sent: int
    received: int
    taken_ns: NDArray[np.int64]
    first: NDArray[np.int64]
    latency_ms: NDArray[np.float64]
    stamp_error_ms: NDArray[np.float64]

    @property
    def missing(self) -> int:
        """Rows sent that did not arrive."""
        return self.sent - self.received


def compare(log: Taken, arrivals: Arrivals, start_ns: int, end_ns: int) -> Comparison:
    """Compare what arrived with what was taken from start_ns to before end_ns of the wall clock."""
    cube, sequence, stamp_ns, received_ns = arrivals.columns()
    taken_ns = log.taken_ns(cube, sequence, stamp_ns)
    rows = np.flatnonzero((taken_ns != NEVER) & (taken_ns >= start_ns) & (taken_ns < end_ns))
    # Cube and time in one number: sequence numbers are given again after a restart.
    since_us = (taken_ns[rows] - log.start_time_ns) // 1000
    key = since_us * len(arrivals.row_count) + cube[rows]
    first = rows[np.sort(np.unique(key, return_index=True)[1])]
    return Comparison(
        sent=log.rows_taken(start_ns, end_ns),
        received=int(arrivals.row_count[cube[first]].sum()),
        taken_ns=taken_ns,
        first=first,
        latency_ms=1e-6 * (received_ns[first] - taken_ns[first]),
        stamp_error_ms=1e-6 * np.abs(stamp_ns[first] - taken_ns[first]),
    )


def percentile(values: NDArray[np.float64], percent: float) -> float:
    """Rounded to 1e-3; NaN of no values."""
    return round(float(np.percentile(values, percent)), 3) if len(values) else float("nan")
