"""Gathering of the samples of all links into scans, and conversion of scans to rows.

A scan holds one sample of each link that delivers. Nothing here looks at a measured value.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import groupby
from typing import NamedTuple

import numpy as np

from ...core.arrays import AnyArray
from ...core.rows import FrequencyRows
from ..wire.native import wire
from ..wire.protocol import NOT_MEASURED, TEMPERATURE_UNKNOWN, Sample, join
from .cube_table import CubeAddress, CubeTable, RowIndex

MAX_SCANS_AHEAD = 4
"""Number of scans that one link may be ahead of another. Beyond it all scans are built as they
are."""
MAX_SPAN_NS = 2_000_000_000
"""Longest time, in ns, between the first and the last row that are built together. A message stores
times that reach up to 2.1 s after its stamp."""
CACHED_SHAPES = 4
"""Number of shapes (rows, pads) whose memory is kept for the next rows."""
MIN_PERIODS_EARLIER = 0.75
"""Part of a sample period. A pending scan that is earlier than a sample by more is too early for
it. Less than one period is needed because hubs sample at different phases and stamps jitter."""

# Temperature, in °C, of each of the 65536 bit patterns of a SAMPLE.
_PATTERNS = np.arange(1 << 16, dtype=np.uint16)
_CELSIUS = _PATTERNS.view(np.int16) * np.float32(0.01)
_CELSIUS[TEMPERATURE_UNKNOWN] = np.nan

MakeRows = Callable[[int, int], FrequencyRows]
"""Makes rows to be filled, from the number of rows and the number of pads."""


def empty_rows(n_rows: int, n_pads: int) -> FrequencyRows:
    """Return new rows to be filled."""
    return FrequencyRows(
        cube=np.empty(n_rows, np.uint16),
        sequence=np.empty(n_rows, np.uint32),
        stamp_ns=np.empty(n_rows, np.int64),
        frequency=np.empty((n_rows, n_pads), np.float32),
        temperature=np.empty(n_rows, np.float32),
        pad_fault=np.empty(n_rows, np.uint32),
        status=np.empty(n_rows, np.uint16),
    )


class StampedSample(NamedTuple):
    """A sample with its stamp.

    Attributes:
        sample: The sample.
        stamp_ns: Time at which it was taken, in the clock of the rows.
        status: Status bits of all its rows.
    """

    sample: Sample
    stamp_ns: int
    status: int


class _SampleRows(NamedTuple):
    """The rows of one sample.

    Attributes:
        cubes: Index in the skin of each cube of the sample (n_cubes,).
        sample: The sample, without the rows that the skin does not have.
        stamp_ns: Time at which it was taken.
        status: Status bits of all rows.
    """

    cubes: RowIndex
    sample: Sample
    stamp_ns: int
    status: int


class ScanBuilder:
    """Gathers samples of all links until a scan is complete, and builds its rows.

    Args:
        n_links: Number of links.
        addresses: Places of the cubes of the skin.

    Attributes:
        cubes: Table that finds the cube of each row.
    """

    def __init__(self, n_links: int, addresses: Sequence[CubeAddress]) -> None:
        self.cubes = CubeTable(n_links, addresses)
        self._live: set[int] = set()
        # Scans that are not built yet: the sample of each link, and the time of the first sample.
        self._pending: list[dict[int, StampedSample]] = []
        self._pending_ns: list[int] = []
        self._n_pending = [0] * n_links  # number of pending scans up to the newest sample of a link
        self._deferred: list[_SampleRows] = []  # beyond MAX_SPAN_NS of the last rows; built next
        self._holds_back = False  # the pending scans wait for the next samples
        self._built_ns = [0] * n_links  # time of the newest sample of a link that was built
        # The same few shapes come again and again, and new memory would cost more than the copy.
        self._columns_of = lru_cache(maxsize=CACHED_SHAPES)(_Columns)

    def set_live(self, link: int, live: bool) -> None:
        """Set whether a link delivers samples, so that scans wait for it."""
        self._holds_back = False
        if live:
            self._live.add(link)
        else:
            self._live.discard(link)
            self.cubes.forget(link)

    def add(
        self,
        link: int,
        samples: Sequence[Sample],
        stamps_ns: Sequence[int],
        status: int = 0,
    ) -> None:
        """Add samples of one link.

        Args:
            link: Index of the link.
            samples: The samples, in order.
            stamps_ns: Time at which each was taken.
            status: Status bits of all their rows, see `status.py`.
        """
        self._live.add(link)
        self._holds_back = False
        for sample, stamp_ns in zip(samples, stamps_ns, strict=True):
            # A link that began later or lost samples leaves gaps. If its samples were only counted,
            # they would stay behind those of the other links for as long as it delivers.
            scan = self._n_pending[link]
            if len(self._pending) > 1:
                scan = max(scan, self._first_scan_at(stamp_ns))
            if scan == len(self._pending):
                self._pending.append({})
                self._pending_ns.append(stamp_ns)
            self._pending[scan][link] = StampedSample(sample, stamp_ns, status)
            self._n_pending[link] = scan + 1

    def is_complete(self, n_scans: int = 1) -> bool:
        """Return whether it is time to build rows.

        It is time when every live link has given `n_scans` samples, or one link has given one more.
        A single scan is also complete if it only holds samples that are late for the last one.
        """
        if self._deferred:
            return True
        if not self._pending or self._holds_back:
            return False
        if len(self._pending) > n_scans or not self._live:
            return True
        if len(self._pending) < n_scans:
            return False
        # The last scan lacks the samples of these links.
        missing = self._live - self._pending[-1].keys()
        if not missing:
            return True
        return n_scans == 1 and self._holds_late_sample(missing)

    def build(
        self,
        make_rows: MakeRows = empty_rows,
        max_scans: int | None = None,
    ) -> FrequencyRows | None:
        """Build the rows of the oldest scans.

        Args:
            make_rows: Makes the rows to fill, for example in the memory of a message.
            max_scans: Largest number of scans to build; `is_complete` tells whether there are more.

        Returns:
            The rows; None if the skin has none of them.
        """
        taken = self._deferred or self._take_scans(max_scans)
        parts, self._deferred = _split_by_span(taken)
        if not parts:
            return None
        rows = make_rows(sum(_n_rows(parts)), self.cubes.n_pads)
        # Usually all cubes have the same number of pads, and then nothing needs to be selected.
        if len({part.sample.n_pads for part in parts}) == 1:
            _fill(rows, parts, self._columns_of)
            return rows

        start = 0
        for _, group in groupby(parts, key=lambda part: part.sample.n_pads):
            same_width = list(group)
            end = start + sum(len(part.cubes) for part in same_width)
            _fill(rows.select(slice(start, end)), same_width, self._columns_of)
            start = end
        return rows

    def rows_waiting(self) -> int:
        """Return the number of rows that were added and neither built nor left out yet."""
        waiting = sum(len(part.cubes) for part in self._deferred)
        for scan in self._pending:
            waiting += sum(stamped.sample.n_cubes for stamped in scan.values())
        return waiting

    def _take_scans(self, max_scans: int | None) -> list[_SampleRows]:
        """Remove the oldest scans, and find the cubes of the skin in them."""
        if len(self._pending) - self._n_reached() > 1:
            self._align_by_order()
            self._holds_back = True
        n_scans = self._n_scans_to_build()
        if max_scans is not None and n_scans > max_scans:
            n_scans = max_scans
            self._holds_back = False

        # They are removed before anything can fail, so that an error does not repeat for ever.
        scans = self._pending[:n_scans]
        del self._pending[:n_scans]
        del self._pending_ns[:n_scans]
        self._n_pending = [max(0, count - n_scans) for count in self._n_pending]

        parts: list[_SampleRows] = []
        for scan in scans:
            for link in sorted(scan):
                sample, stamp_ns, status = scan[link]
                self._built_ns[link] = stamp_ns
                found = self.cubes.find(link, sample)
                if found is not None:
                    cubes, kept = found
                    parts.append(_SampleRows(cubes, kept, stamp_ns, status))
        return parts

    def _holds_late_sample(self, missing: set[int]) -> bool:
        """Return whether the pending scan holds a sample that belongs to the scan built last.

        A link that comes late must not wait for the next samples of the others, or it would stay
        one sample behind from then on. Its sample is late if every link that has given nothing
        since has a built sample that is nearer to it in time than its own last one.
        """
        limits_ns: list[float] = []
        for link, stamped in self._pending[0].items():
            last_ns, stamp_ns = self._built_ns[link], stamped.stamp_ns
            if stamp_ns > last_ns:
                limits_ns.append((stamp_ns + last_ns) / 2)
            else:
                limits_ns.append(0.0)  # another frame of the sample that was built last
        built_ns = [self._built_ns[link] for link in missing]
        return min(built_ns) > min(limits_ns)

    def _n_scans_to_build(self) -> int:
        """Return the number of scans that every live link has reached.

        It is the number of all scans if a live link has given nothing, or one has given far more
        than another. The other scans wait, or a link that was late once would stay a sample behind.
        """
        reached = self._n_reached()
        if not reached or len(self._pending) - reached > MAX_SCANS_AHEAD:
            return len(self._pending)
        return reached

    def _n_reached(self) -> int:
        """Return the number of scans that every live link has reached."""
        return min((self._n_pending[link] for link in self._live), default=0)

    def _align_by_order(self) -> None:
        """Put the first pending samples of all links into one scan, the second ones into the next.

        The links are late by more than one scan and by different times, because this process cannot
        keep up. Parts of scans, in more messages than scans, would cost it even more time. With
        this step it keeps up with 1260 cubes at 1 kHz, where it lost a third of them before.
        """
        queues: dict[int, list[StampedSample]] = {}
        for scan in self._pending:
            for link, stamped in scan.items():
                queues.setdefault(link, []).append(stamped)

        n_scans = max(map(len, queues.values()))
        self._pending = [{} for _ in range(n_scans)]
        for link, queue in queues.items():
            for scan, stamped in zip(self._pending, queue, strict=False):
                scan[link] = stamped
        self._pending_ns = [
            min(stamped.stamp_ns for stamped in scan.values()) for scan in self._pending
        ]
        n_links = len(self._n_pending)
        self._n_pending = [len(queues.get(link, ())) for link in range(n_links)]

    def _first_scan_at(self, stamp_ns: int) -> int:
        """Return the first of several pending scans that is not clearly earlier than a sample."""
        times = self._pending_ns
        n_periods = len(times) - 1
        period = (times[-1] - times[0]) / n_periods
        tolerance = MIN_PERIODS_EARLIER * period
        return bisect_left(times, stamp_ns - tolerance)


def _split_by_span(
    parts: list[_SampleRows],
) -> tuple[list[_SampleRows], list[_SampleRows]]:
    """Return the samples within `MAX_SPAN_NS` of the earliest, and the others."""
    if not parts:
        return [], []
    stamps_ns = [part.stamp_ns for part in parts]
    end_ns = min(stamps_ns) + MAX_SPAN_NS
    if max(stamps_ns) <= end_ns:
        return parts, []
    within = [part for part in parts if part.stamp_ns <= end_ns]
    beyond = [part for part in parts if part.stamp_ns > end_ns]
    return within, beyond


def _fill(
    rows: FrequencyRows,
    parts: Sequence[_SampleRows],
    columns_of: Callable[[int, int], _Columns],
) -> None:
    """Write samples with the same number of pads into rows.

    Frequencies of pads that a cube does not have become NaN.
    """
    np.concatenate([part.cubes for part in parts], out=rows.cube)
    rows.status[:] = 0
    if any(part.status for part in parts):
        statuses = [part.status for part in parts]
        rows.status[:] = np.repeat(statuses, _n_rows(parts))

    raws = [part.sample.raw for part in parts]
    if wire is None or not all(raws):
        _fill_in_python(rows, parts)
        return
    n_rows, n_pads = rows.frequency.shape
    columns = columns_of(n_rows, n_pads)
    stamps_ns = [part.stamp_ns for part in parts]
    wire.place_rows(raws, stamps_ns, n_pads, columns.memory)
    columns.copy_to(rows)


class _Columns:
    """Memory for the columns of rows that `wire.place_rows` writes one after the other."""

    def __init__(self, n_rows: int, n_pads: int) -> None:
        bytes_per_row = 8 + 4 + 4 + 4 + 4 * n_pads
        self.memory = bytearray(n_rows * bytes_per_row)
        # The positions and types are those of `wire.place_rows`.
        self._stamp_ns = self._view(0, n_rows, np.int64)
        self._sequence = self._view(8 * n_rows, n_rows, np.uint32)
        self._pad_fault = self._view(12 * n_rows, n_rows, np.uint32)
        self._temperature = self._view(16 * n_rows, n_rows, np.float32)
        frequency = self._view(20 * n_rows, n_rows * n_pads, np.float32)
        self._frequency = frequency.reshape(n_rows, n_pads)

    def _view(self, offset: int, count: int, dtype: type[np.generic]) -> AnyArray:
        """Return a part of the memory as an array."""
        return np.frombuffer(self.memory, dtype, count, offset)

    def copy_to(self, rows: FrequencyRows) -> None:
        """Copy the columns into rows of the same shape."""
        rows.stamp_ns[:] = self._stamp_ns
        rows.sequence[:] = self._sequence
        rows.pad_fault[:] = self._pad_fault
        rows.temperature[:] = self._temperature
        rows.frequency[:] = self._frequency


def _n_rows(parts: Sequence[_SampleRows]) -> list[int]:
    """Return the number of rows of each sample."""
    return [len(part.cubes) for part in parts]


def _fill_in_python(rows: FrequencyRows, parts: Sequence[_SampleRows]) -> None:
    """Write the values of samples into rows, without the wire module in C."""
    samples = [part.sample for part in parts]
    counts = _n_rows(parts)
    numbers = [sample.sequence for sample in samples]
    rows.sequence[:] = np.repeat(numbers, counts)
    stamps_ns = [part.stamp_ns for part in parts]
    rows.stamp_ns[:] = np.repeat(stamps_ns, counts)

    frequency, pad_fault, temperature = join(samples)
    rows.pad_fault[:] = pad_fault
    patterns = temperature.view(np.uint16)
    _CELSIUS.take(patterns, out=rows.temperature, mode="clip")

    width = frequency.shape[1]
    measured = rows.frequency[:, :width]
    # The product is computed in double precision, as float32 cannot resolve 1 mHz of 100 kHz.
    np.multiply(frequency, 1e-3, out=measured, casting="same_kind")
    rows.frequency[:, width:] = np.nan
    if frequency.size and frequency.min() == NOT_MEASURED:
        measured[frequency == NOT_MEASURED] = np.nan
