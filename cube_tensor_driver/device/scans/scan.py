"""Gathers the samples of all links into scans, and makes rows of them.

A scan holds one sample of each link that delivers. Nothing here looks at a value.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.rows import FrequencyRows
from ..wire.native import wire
from ..wire.protocol import NOT_MEASURED, TEMPERATURE_UNKNOWN, Sample, join
from .cube_table import CubeAddress, CubeTable

# °C of each of the 65536 bit patterns of a temperature.
_CELSIUS = np.arange(1 << 16, dtype=np.uint16).view(np.int16) * np.float32(0.01)
_CELSIUS[TEMPERATURE_UNKNOWN] = np.nan

MOST_AHEAD = 4
"""Scans that one link may be ahead of another before all are built as they are."""
MAX_SPAN_NS = 2_000_000_000
"""Rows that are built together lie within it: a message holds 2.1 s after its stamp."""

SHAPES_KEPT = 4
"""Of rows, whose memory is kept."""

CLEARLY_BEFORE = 0.75
"""Of a period: hubs sample at different phases, and stamps jitter."""

MakeRows = Callable[[int, int], FrequencyRows]
"""Makes rows to fill: so many rows, of so many pads."""


def empty_rows(n_rows: int, n_pads: int) -> FrequencyRows:
    """New rows to fill."""
    return FrequencyRows(
        cube=np.empty(n_rows, np.uint16),
        sequence=np.empty(n_rows, np.uint32),
        stamp_ns=np.empty(n_rows, np.int64),
        frequency=np.empty((n_rows, n_pads), np.float32),
        temperature=np.empty(n_rows, np.float32),
        pad_fault=np.empty(n_rows, np.uint32),
        status=np.empty(n_rows, np.uint16),
    )


class _Part(NamedTuple):
    """The rows of one sample: index in the skin of each cube, the sample, when it was taken, and
    the status bits of the rows."""

    cubes: NDArray[np.uint16]
    sample: Sample
    stamp_ns: int
    status: int


class ScanBuilder:
    """Gathers samples of all links until a scan is complete, and builds its rows.

    cubes: `CubeTable`, which knows the cube of each row.
    """

    def __init__(self, n_links: int, addresses: Sequence[CubeAddress]) -> None:
        self.cubes = CubeTable(n_links, addresses)
        self._live: set[int] = set()
        # Scans not built yet: of each link its first sample, with time and status; then its second
        self._pending: list[dict[int, tuple[Sample, int, int]]] = []
        self._too_late: list[_Part] = []  # to be built next: beyond MAX_SPAN_NS of the last
        self._pending_ns: list[int] = []  # when the first sample of each pending scan was taken
        self._n_pending = [0] * n_links  # how many pending scans each link has reached
        self._held_back = False  # what is pending waits for the next samples
        self._built_ns = [0] * n_links  # when the newest sample that was built was taken
        # The same few shapes come again and again, and new memory costs more than it.
        self._columns_of = lru_cache(maxsize=SHAPES_KEPT)(_Columns)

    def set_live(self, link: int, live: bool) -> None:
        """Whether a link delivers samples now, so that a scan waits for it."""
        self._held_back = False
        if live:
            self._live.add(link)
        else:
            self._live.discard(link)
            self.cubes.forget(link)

    def add(
        self, link: int, samples: Sequence[Sample], stamps_ns: Sequence[int], status: int = 0
    ) -> None:
        """Samples of one link in order, and when they were taken, ns, in the clock of the rows.

        status: bits of status.py that all their rows get
        """
        self._live.add(link)
        self._held_back = False
        for sample, stamp_ns in zip(samples, stamps_ns, strict=True):
            # What a link has not sent, because it began later or lost it, leaves a gap. Its samples
            # counted one by one would stay behind the others for as long as it delivers.
            scan = self._n_pending[link]
            if len(self._pending) > 1:
                scan = max(scan, self._first_scan_at(stamp_ns))
            if scan == len(self._pending):
                self._pending.append({})
                self._pending_ns.append(stamp_ns)
            self._pending[scan][link] = sample, stamp_ns, status
            self._n_pending[link] = scan + 1

    def is_complete(self, n_scans: int = 1) -> bool:
        """Whether it is time to build rows of so many scans.

        It is when every live link has given its samples, or when one link has given one more. A
        single scan is also complete if it only holds samples that came late to the last one.
        """
        if self._too_late:
            return True
        if not self._pending or self._held_back:
            return False
        if len(self._pending) > n_scans or not self._live:
            return True
        if len(self._pending) < n_scans:
            return False
        missing = self._live - self._pending[-1].keys()
        if not missing:
            return True
        return n_scans == 1 and self._holds_late_sample(missing)

    def build(
        self, make_rows: MakeRows = empty_rows, max_scans: int | None = None
    ) -> FrequencyRows | None:
        """The rows of the oldest scans, of at most so many; None if the skin has none of them.

        There may be more: `is_complete` says so. Rows are written into what make_rows gives: a
        message's own memory, where there is one.
        """
        parts, self._too_late = _split(self._too_late or self._take(max_scans))
        if not parts:
            return None
        rows = make_rows(sum(len(part.cubes) for part in parts), self.cubes.n_pads)
        # Mostly all cubes have as many pads; then there is nothing to select.
        if len({part.sample.shape[1] for part in parts}) == 1:
            _fill(rows, parts, self._columns_of)
            return rows
        start = 0
        for _, group in groupby(parts, key=lambda part: part.sample.shape[1]):
            same_width = list(group)
            end = start + sum(len(part.cubes) for part in same_width)
            _fill(rows.select(slice(start, end)), same_width, self._columns_of)
            start = end
        return rows

    def rows_waiting(self) -> int:
        """How many rows came in and were neither built nor left out yet."""
        gathered = sum(sample.n_cubes for scan in self._pending for sample, _, _ in scan.values())
        return gathered + sum(len(part.cubes) for part in self._too_late)

    def _take(self, max_scans: int | None) -> list[_Part]:
        """Take the oldest scans out, and find the skin's cubes in them."""
        if len(self._pending) - self._reached() > 1:
            self._line_up()
            self._held_back = True
        n_scans = self._n_scans_to_build()
        if max_scans is not None and n_scans > max_scans:
            n_scans, self._held_back = max_scans, False
        # Out before anything can fail: what is looked at is never looked at again.
        scans = self._pending[:n_scans]
        del self._pending[:n_scans], self._pending_ns[:n_scans]
        self._n_pending = [max(0, count - n_scans) for count in self._n_pending]
        parts: list[_Part] = []
        for scan in scans:
            for link in sorted(scan):
                sample, stamp_ns, status = scan[link]
                self._built_ns[link] = stamp_ns
                found = self.cubes.find(link, sample)
                if found is not None:
                    parts.append(_Part(*found, stamp_ns, status))
        return parts

    def _holds_late_sample(self, missing: set[int]) -> bool:
        """Whether the pending scan holds a sample that belongs to the scan built last.

        A link that comes late must not wait for the next samples of the others: it would stay one
        sample behind from then on. Its sample is late if all links that have given nothing since
        have a built sample nearer to it in time than its own last one is.
        """
        middles = []
        for link, (_, stamp_ns, _) in self._pending[0].items():
            last_ns = self._built_ns[link]
            # A further frame of the sample that was built last is late, too.
            middles.append((stamp_ns + last_ns) / 2 if stamp_ns > last_ns else 0.0)
        return min(self._built_ns[link] for link in missing) > min(middles)

    def _n_scans_to_build(self) -> int:
        """Scans that every live link has reached; all, if a live link has given nothing, or if one
        has given far more than another.

        The other scans wait: a link that was late once would else stay a sample behind.
        """
        reached = self._reached()
        if not reached or len(self._pending) - reached > MOST_AHEAD:
            return len(self._pending)
        return reached

    def _reached(self) -> int:
        """Scans that every live link has reached."""
        return min((self._n_pending[link] for link in self._live), default=0)

    def _line_up(self) -> None:
        """The first pending samples of all links make a scan, whenever they were taken, and so on.

        That is for links that are late by more than a scan, and not alike, as they are where this
        process cannot keep up. Parts of scans, in more messages than scans, would cost it even more
        time: so it keeps up with 1260 cubes at 1 kHz, where it lost a third of them before.
        """
        queues: dict[int, list[tuple[Sample, int, int]]] = {}
        for scan in self._pending:
            for link, sample in scan.items():
                queues.setdefault(link, []).append(sample)
        self._pending = [
            {link: queue[at] for link, queue in queues.items() if at < len(queue)}
            for at in range(max(map(len, queues.values())))
        ]
        self._pending_ns = [min(at for _, at, _ in scan.values()) for scan in self._pending]
        self._n_pending = [len(queues.get(link, ())) for link in range(len(self._n_pending))]

    def _first_scan_at(self, stamp_ns: int) -> int:
        """The first of several pending scans that was not taken clearly before this time, as far
        as it is known."""
        times = self._pending_ns
        period = (times[-1] - times[0]) / (len(times) - 1)
        return bisect_left(times, stamp_ns - CLEARLY_BEFORE * period)


def _split(parts: list[_Part]) -> tuple[list[_Part], list[_Part]]:
    """Those within MAX_SPAN_NS of the earliest, and the others."""
    stamps_ns = [part.stamp_ns for part in parts]
    if not parts or max(stamps_ns) - min(stamps_ns) <= MAX_SPAN_NS:
        return parts, []
    end_ns = min(stamps_ns) + MAX_SPAN_NS
    within = [part for part in parts if part.stamp_ns <= end_ns]
    return within, [part for part in parts if part.stamp_ns > end_ns]


def _fill(
    rows: FrequencyRows, parts: Sequence[_Part], columns_of: Callable[[int, int], _Columns]
) -> None:
    """Write samples with the same number of pads, one after the other; pads that a cube does not
    have are NaN."""
    counts = [len(part.cubes) for part in parts]
    np.concatenate([part.cubes for part in parts], out=rows.cube)
    rows.status[:] = 0
    if any(part.status for part in parts):
        rows.status[:] = np.repeat([part.status for part in parts], counts)
    if wire is not None and all(part.sample.raw for part in parts):
        columns = columns_of(*rows.frequency.shape)
        raws, stamps_ns = [part.sample.raw for part in parts], [part.stamp_ns for part in parts]
        wire.place_rows(raws, stamps_ns, rows.frequency.shape[1], columns.memory)
        columns.copy_to(rows)
    else:
        _fill_values(rows, parts, counts)


class _Columns:
    """Memory for the values of so many rows, as `wire.place_rows` writes them."""

    def __init__(self, n_rows: int, n_pads: int) -> None:
        self.memory = bytearray(n_rows * (20 + 4 * n_pads))
        self._stamp_ns = np.ndarray(n_rows, np.int64, self.memory)
        self._sequence = np.ndarray(n_rows, np.uint32, self.memory, 8 * n_rows)
        self._pad_fault = np.ndarray(n_rows, np.uint32, self.memory, 12 * n_rows)
        self._temperature = np.ndarray(n_rows, np.float32, self.memory, 16 * n_rows)
        self._frequency = np.ndarray((n_rows, n_pads), np.float32, self.memory, 20 * n_rows)

    def copy_to(self, rows: FrequencyRows) -> None:
        rows.stamp_ns[:] = self._stamp_ns
        rows.sequence[:] = self._sequence
        rows.pad_fault[:] = self._pad_fault
        rows.temperature[:] = self._temperature
        rows.frequency[:] = self._frequency


def _fill_values(rows: FrequencyRows, parts: Sequence[_Part], counts: Sequence[int]) -> None:
    samples = [part.sample for part in parts]
    frequency, pad_fault, temperature = join(samples)
    width = frequency.shape[1]
    rows.sequence[:] = np.repeat([sample.sequence for sample in samples], counts)
    rows.stamp_ns[:] = np.repeat([part.stamp_ns for part in parts], counts)
    rows.pad_fault[:] = pad_fault
    _CELSIUS.take(temperature.view(np.uint16), out=rows.temperature, mode="clip")
    measured = rows.frequency[:, :width]
    # In double precision: 1 mHz of 100 kHz is below what float32 multiplies exactly.
    np.multiply(frequency, 1e-3, out=measured, casting="same_kind")
    rows.frequency[:, width:] = np.nan
    if frequency.size and frequency.min() == NOT_MEASURED:
        measured[frequency == NOT_MEASURED] = np.nan
