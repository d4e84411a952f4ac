# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Joining of the samples of all links into scans, and conversion of scans to rows.

A scan holds one sample of each link that delivers samples, taken at about the same time. The
measured values play no part in this.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ...core.rows import FrequencyRows
from ..wire.native import wire
from ..wire.protocol import TEMPERATURE_UNKNOWN, Sample, to_hertz
from .cube_table import CubeAddress, CubeTable, RowIndex
from .row_counts import RowCounts

MAX_SCANS_AHEAD = 4
"""Number of scans (one sample of each link) by which one link may be ahead of the slowest one. If
it is ahead by more, the waiting scans are delivered without the missing samples."""
MAX_SPAN_NS = 2_000_000_000
"""Longest time, in ns, between the earliest and the latest row (sample of a cube) that one call of
`ScanBuilder.build` returns. These rows become one message, whose 32-bit offsets in ns reach up to
2.1 s after its time stamp."""
MAX_PERIODS_EARLIER = 0.75
"""Largest time, in sample periods, by which a scan (one sample of each link) may be earlier than a
sample that is added to it. With 1 or more, a sample could be added to the scan before its own;
with 0, hubs that do not sample at exactly the same time could not share a scan."""

MakeRows = Callable[[int, int], FrequencyRows]
"""Function that makes rows for the caller to fill. Its arguments are the number of rows and the
largest number of pads of a cube."""


def make_empty_rows(n_rows: int, n_pads: int) -> FrequencyRows:
    """Return new rows in uninitialised memory, for the caller to fill."""
    return FrequencyRows(
        cube=np.empty(n_rows, np.uint16),
        sequence=np.empty(n_rows, np.uint32),
        stamp_ns=np.empty(n_rows, np.int64),
        frequency=np.empty((n_rows, n_pads), np.float32),
        temperature=np.empty(n_rows, np.float32),
        pad_fault=np.empty(n_rows, np.uint32),
        status=np.empty(n_rows, np.uint16),
    )


class _SampleRows(NamedTuple):
    """The rows of one sample, each with the index of its cube.

    Attributes:
        cubes: Index in the skin of each cube of the sample (n_cubes,), which may be empty.
        sample: The sample, without the rows of cubes that are not in the skin.
        stamp_ns: Host time at which the sample was taken, in ns since the Unix epoch.
        status: Status bits of all rows of the sample (core/status.py).
    """

    cubes: RowIndex
    sample: Sample
    stamp_ns: int
    status: int


class ScanBuilder:
    """Collects one sample of each link into a scan, and converts complete scans to rows.

    Args:
        n_links: Number of links.
        addresses: For each cube of the skin, the uid, or the link and index, to find it by.
        make_rows: Makes the rows to fill, for example in the memory of a message.

    Attributes:
        counts: Numbers of rows (samples of cubes) by what happened to them.
        cubes: Table that tells which cube of the skin each row of a sample belongs to.
    """

    def __init__(
        self,
        n_links: int,
        addresses: Sequence[CubeAddress],
        make_rows: MakeRows = make_empty_rows,
    ) -> None:
        self.counts = RowCounts()
        self.cubes = CubeTable(n_links, addresses, self.counts)
        self._make_rows = make_rows
        self._live: set[int] = set()
        # Scans that wait for samples, oldest first: the samples of each scan by link.
        self._pending: list[dict[int, _SampleRows]] = []
        # Host time, in ns, at which the first added sample of each pending scan was taken.
        self._pending_ns: list[int] = []
        # For each link, the number of pending scans up to the one with its newest sample.
        self._n_pending = [0] * n_links
        # Rows that are left for the next call of `build`, because they are later than the others by
        # more than MAX_SPAN_NS.
        self._deferred: list[_SampleRows] = []
        # Whether to wait for the next sample before further rows are built. This is set when this
        # process cannot keep up, so that it builds fewer and larger messages.
        self._holds_back = False
        # For each link, the host time, in ns, of its newest sample that was converted to rows.
        self._built_ns = [0] * n_links

    def forget(self, link: int) -> None:
        """Note that a link does not deliver samples any more, until its next one is added.

        A scan (one sample of each link) waits for the sample of every link that delivers. The cubes
        of a link that delivers nothing may be used from the hub of another link.
        """
        self._holds_back = False
        self._live.discard(link)
        self.cubes.forget(link)

    def add(
        self,
        link: int,
        sample: Sample,
        stamp_ns: int,
        status: int = 0,
    ) -> None:
        """Add a sample of one link to the scan of the same time.

        Args:
            link: Index of the link.
            sample: The sample; the samples of a link are added in the order of their numbers.
            stamp_ns: Host time at which it was taken, in ns since the Unix epoch.
            status: Status bits of its rows (core/status.py).
        """
        self._live.add(link)
        self._holds_back = False
        cubes, kept = self.cubes.find(link, sample)
        # After a loss, the next sample of the link joins the scan of its own time. If it joined
        # the next scan, the link would stay behind the others for good.
        scan = self._n_pending[link]
        if len(self._pending) > 1:
            scan = max(scan, self._find_first_scan_at(stamp_ns))
        if scan == len(self._pending):
            self._pending.append({})
            self._pending_ns.append(stamp_ns)
        self._pending[scan][link] = _SampleRows(cubes, kept, stamp_ns, status)
        self._n_pending[link] = scan + 1

    def is_complete(self, n_scans: int = 1) -> bool:
        """Return whether rows (samples of cubes) can be built from the pending scans now.

        They can be built if every link that delivers has given `n_scans` samples, or one link has
        given one more than that. If `n_scans` is 1, rows can also be built if the only pending scan
        has a sample that came too late for the scan built last.

        Args:
            n_scans: Number of scans to wait for.
        """
        if self._deferred:
            return True
        if not self._pending or self._holds_back:
            return False
        if len(self._pending) > n_scans or not self._live:
            return True
        if len(self._pending) < n_scans:
            return False
        # Links that deliver samples, but have none in the newest scan (one sample of each link).
        missing = self._live - self._pending[-1].keys()
        if not missing:
            return True
        return n_scans == 1 and self._holds_late_sample(missing)

    def build(self, max_scans: int | None = None) -> FrequencyRows | None:
        """Convert the oldest scans that every link has reached to rows, and remove these scans.

        A scan is one sample of each link, a row one sample of one cube. A link has reached a scan
        if it has a sample in this scan or in a later one.

        Args:
            max_scans: Largest number of scans to convert; None for all. Afterwards, `is_complete`
                tells whether there are more.

        Returns:
            The rows; None if no cube of these scans is in the skin.
        """
        taken = self._deferred or self._take_scans(max_scans)
        if not taken:
            return None
        # Rows whose time offset does not fit into one message are left for the next call.
        end_ns = min(part.stamp_ns for part in taken) + MAX_SPAN_NS
        parts = [part for part in taken if part.stamp_ns <= end_ns]
        self._deferred = [part for part in taken if part.stamp_ns > end_ns]

        cubes, samples, stamps_ns, statuses = zip(*parts, strict=True)
        sizes = [len(indices) for indices in cubes]
        rows = self._make_rows(sum(sizes), self.cubes.n_pads)
        np.concatenate(cubes, out=rows.cube)
        rows.status[:] = np.repeat(statuses, sizes) if any(statuses) else 0
        raws = [sample.raw for sample in samples]
        if wire is not None and all(raws):
            _place(rows, raws, list(stamps_ns))
            return rows
        start = 0
        for part, size in zip(parts, sizes, strict=True):
            _fill(rows.select(slice(start, start + size)), part)
            start += size
        return rows

    def drop_oldest(self, n_kept: int) -> int:
        """Drop the oldest pending scans (one sample of each link) because this host is too slow.

        Args:
            n_kept: Number of scans to keep.

        Returns:
            Number of rows (samples of cubes) dropped.
        """
        n_dropped = max(0, len(self._pending) - n_kept)
        return _count_rows(self._remove_scans(n_dropped))

    def count_rows_waiting(self) -> int:
        """Return how many rows (samples of cubes) were added, but not yet built or left out."""
        n_deferred = sum(len(part.cubes) for part in self._deferred)
        return n_deferred + _count_rows(self._pending)

    def _take_scans(self, max_scans: int | None) -> list[_SampleRows]:
        """Remove the oldest scans (one sample of each link), and return their samples.

        Samples without any cube of the skin are left out.

        Args:
            max_scans: Largest number of scans to remove; None for all that can be built.
        """
        n_reached = self._count_reached()
        if len(self._pending) - n_reached > 1:
            self._align_by_order()
            self._holds_back = True
            n_reached = self._count_reached()
        n_scans = len(self._pending)
        # Only scans to which no sample can be added any more are taken. If a link has no sample in
        # any pending scan, or another one is too far ahead, all scans are taken.
        if n_reached and n_scans - n_reached <= MAX_SCANS_AHEAD:
            n_scans = n_reached
        if max_scans is not None and n_scans > max_scans:
            n_scans = max_scans
            self._holds_back = False

        scans = self._remove_scans(n_scans)
        return [scan[link] for scan in scans for link in sorted(scan) if len(scan[link].cubes)]

    def _remove_scans(self, n_scans: int) -> list[dict[int, _SampleRows]]:
        """Remove the oldest pending scans (one sample of each link), and return them.

        Args:
            n_scans: Number of scans to remove.
        """
        scans = self._pending[:n_scans]
        del self._pending[:n_scans]
        del self._pending_ns[:n_scans]
        self._n_pending = [max(0, count - n_scans) for count in self._n_pending]
        for scan in scans:
            for link, part in scan.items():
                self._built_ns[link] = part.stamp_ns
        return scans

    def _holds_late_sample(self, missing: set[int]) -> bool:
        """Return whether a sample of the pending scan belongs to a scan that is already delivered.

        Such a late sample is delivered alone. If it waited for the next samples of the other links,
        its link would stay one sample behind from then on. A sample is late if the last delivered
        sample of every missing link is nearer to it in time than the last delivered sample of its
        own link: then the missing links have already delivered their samples of the same time.

        Args:
            missing: Links that deliver but have no sample in the pending scan.
        """
        first_missing_ns = min(self._built_ns[link] for link in missing)
        for link, part in self._pending[0].items():
            last_ns = self._built_ns[link]
            limit_ns = (part.stamp_ns + last_ns) / 2
            if part.stamp_ns <= last_ns:
                # This frame is another part of a sample whose first part was converted before.
                limit_ns = 0
            if first_missing_ns > limit_ns:
                return True
        return False

    def _count_reached(self) -> int:
        """Return the number of pending scans that every delivering link has reached.

        A link has reached a scan if it has a sample in this scan or in a later one.
        """
        return min((self._n_pending[link] for link in self._live), default=0)

    def _align_by_order(self) -> None:
        """Put the first pending samples of all links into one scan, the second ones into the next.

        This method is called when one link is more than one scan ahead of another, because this
        process cannot keep up with its input. If scans were then built in parts, there would be
        more messages, which cost even more time. With this step the process keeps up with 1260
        cubes at 1 kHz; without it, a third of their rows were lost.
        """
        n_links = len(self._n_pending)
        scans: list[dict[int, _SampleRows]] = [{} for _ in self._pending]
        self._n_pending = [0] * n_links
        for scan in self._pending:
            for link, part in scan.items():
                scans[self._n_pending[link]][link] = part
                self._n_pending[link] += 1
        self._pending = scans[: max(self._n_pending)]
        self._pending_ns = [min(part.stamp_ns for part in scan.values()) for scan in self._pending]

    def _find_first_scan_at(self, stamp_ns: int) -> int:
        """Return the index of the first pending scan that is not too early for a sample.

        A scan is too early if it is earlier than the sample by more than `MAX_PERIODS_EARLIER`
        sample periods. At least two scans must be pending, because their distance is the period.

        Args:
            stamp_ns: Host time of the sample, in ns.
        """
        times = self._pending_ns
        n_periods = len(times) - 1
        period = (times[-1] - times[0]) / n_periods
        tolerance = MAX_PERIODS_EARLIER * period
        return bisect_left(times, stamp_ns - tolerance)


def _count_rows(scans: list[dict[int, _SampleRows]]) -> int:
    """Return the number of rows (samples of cubes) in scans (samples by link)."""
    return sum(len(part.cubes) for scan in scans for part in scan.values())


def _place(
    rows: FrequencyRows,
    raws: list[bytes],
    stamps_ns: list[int],
) -> None:
    """Write the values and stamps (host times) of samples into rows, by the wire module in C.

    Args:
        rows: Rows to fill, one for each cube of the samples.
        raws: Bytes of the samples, from type to CRC.
        stamps_ns: Host time at which each sample was taken, in ns since the Unix epoch.

    Raises:
        ValueError: A column of the rows is not contiguous in memory.
    """
    columns = rows.stamp_ns, rows.sequence, rows.pad_fault, rows.temperature, rows.frequency
    if not all(column.flags.c_contiguous for column in columns):
        raise ValueError("the columns of the rows are not contiguous in memory")
    n_rows, n_pads = rows.frequency.shape
    addresses = tuple(column.ctypes.data for column in columns)
    wire.place_rows(raws, stamps_ns, n_rows, n_pads, addresses)


def _fill(rows: FrequencyRows, part: _SampleRows) -> None:
    """Write the values and the stamp of one sample into rows, without the wire module in C."""
    sample = part.sample
    rows.sequence[:] = sample.sequence
    rows.stamp_ns[:] = part.stamp_ns
    rows.pad_fault[:] = sample.pad_fault
    rows.temperature[:] = sample.temperature * np.float32(0.01)
    rows.temperature[sample.temperature == TEMPERATURE_UNKNOWN] = np.nan
    rows.frequency[:, : sample.n_pads] = to_hertz(sample.frequency)
    rows.frequency[:, sample.n_pads :] = np.nan
