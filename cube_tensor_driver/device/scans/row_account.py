# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Counting of rows: how many were received, delivered, and left out for each reason.

A row (one sample of one cube) is counted as received as soon as its frame is decoded, before
anything else is done with it. So a row that is lost later, for example by an error, is noticed as
the difference of the counters.
"""

from __future__ import annotations

from dataclasses import dataclass

from .scan import ScanBuilder


@dataclass(frozen=True)
class RowCounts:
    """Numbers of received rows (samples of cubes) by what happened to them.

    Attributes:
        delivered: Rows passed to the callback, which returned without an error.
        unknown_cube: Rows left out because their cube is not in the skin file.
        wrong_pads: Rows left out because the skin file gives their cube another number of pads.
        unaccounted: Received rows that are in none of the other numbers and do not wait for the
            rest of their scan. It is 0 unless the driver has a defect.
        duplicate: Rows left out because they had come before.
        overload: Rows dropped because this host is too slow.
        lost: Rows lost by an exception in the driver or in the callback.
        lost_reason: Text of the last such exception; empty if there was none.
    """

    delivered: int = 0
    unknown_cube: int = 0
    wrong_pads: int = 0
    unaccounted: int = 0
    duplicate: int = 0
    overload: int = 0
    lost: int = 0
    lost_reason: str = ""


class RowAccount:
    """Counts the rows (samples of cubes) of all links. Only the reader's thread uses it.

    Args:
        scans: Builder of the scans, which counts the rows that wait or were left out.

    Attributes:
        received: Number of rows received; the caller increases it.
        delivered: Number of rows delivered; the caller increases it.
        duplicate: Number of rows that had come before; the caller increases it.
        overload: Number of rows dropped because this host is too slow; the caller increases it.
    """

    def __init__(self, scans: ScanBuilder) -> None:
        self.received = 0
        self.delivered = 0
        self.duplicate = 0
        self.overload = 0
        self._scans = scans
        self._unaccounted = 0
        self._lost = 0
        self._lost_reason = ""

    @property
    def counts(self) -> RowCounts:
        """Numbers of rows (samples of cubes) until now, by what happened to them.

        All numbers are current, except that `unaccounted`, the number of missing rows, was
        determined by the last call of `check`.
        """
        return RowCounts(
            delivered=self.delivered,
            unknown_cube=self._scans.cubes.unknown_cube,
            wrong_pads=self._scans.cubes.wrong_pads,
            unaccounted=self._unaccounted,
            duplicate=self.duplicate,
            overload=self.overload,
            lost=self._lost,
            lost_reason=self._lost_reason,
        )

    def count_lost(self, error: Exception) -> int:
        """Count all rows (samples of cubes) that have gone missing since the last `check` as lost.

        Missing rows were received, but are neither delivered nor left out and do not wait.

        This method must be called before further rows are counted as received.

        Args:
            error: The exception by which the rows were lost.

        Returns:
            Number of rows lost.
        """
        lost = self._missing() - self._unaccounted
        self._lost += lost
        self._lost_reason = repr(error)
        return lost

    def check(self) -> None:
        """Store how many received rows (samples of cubes) are missing.

        Missing rows were neither delivered, left out nor counted as lost, and do not wait in a
        scan.
        """
        self._unaccounted = self._missing()

    def _missing(self) -> int:
        """Return how many received rows were neither delivered, left out nor lost, nor wait."""
        cubes = self._scans.cubes
        left_out = cubes.unknown_cube + cubes.wrong_pads + self.duplicate + self.overload
        accounted = self.delivered + left_out + self._lost + self._scans.rows_waiting()
        return self.received - accounted
