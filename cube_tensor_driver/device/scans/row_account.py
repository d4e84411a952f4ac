"""The account of rows: how many were received, delivered, and left out for each reason.

A row is counted as received from its frame, before anything else is done with it. So nothing that
happens later, an error included, can hide a lost row.
"""

from __future__ import annotations

from dataclasses import dataclass

from .scan import ScanBuilder


@dataclass(frozen=True)
class RowCounts:
    """Numbers of received rows by what happened to them.

    Attributes:
        delivered: Rows given to the callback, which returned.
        unknown_cube: Rows left out because the skin does not have the cube.
        wrong_pads: Rows left out because the skin has the cube with another number of pads.
        unaccounted: Rows in none of the other numbers that do not wait for their scan; always 0
            unless the driver loses rows.
        duplicate: Rows left out because they had come before.
        lost: Rows lost by an error in the driver.
        lost_reason: Text of the last such error.
    """

    delivered: int = 0
    unknown_cube: int = 0
    wrong_pads: int = 0
    unaccounted: int = 0
    duplicate: int = 0
    lost: int = 0
    lost_reason: str = ""


class RowAccount:
    """Counts the rows of all links, in the reader's thread.

    Args:
        scans: Builder of the scans, which knows the rows that wait or were left out.

    Attributes:
        received: Rows received; increased by the caller.
        delivered: Rows delivered; increased by the caller.
        duplicate: Rows that had come before; increased by the caller.
    """

    def __init__(self, scans: ScanBuilder) -> None:
        self.received = 0
        self.delivered = 0
        self.duplicate = 0
        self._scans = scans
        self._unaccounted = 0
        self._lost = 0
        self._lost_reason = ""

    @property
    def counts(self) -> RowCounts:
        """Numbers of rows at the last `check`."""
        return RowCounts(
            delivered=self.delivered,
            unknown_cube=self._scans.cubes.unknown_cube,
            wrong_pads=self._scans.cubes.wrong_pads,
            unaccounted=self._unaccounted,
            duplicate=self.duplicate,
            lost=self._lost,
            lost_reason=self._lost_reason,
        )

    def count_lost(self, error: Exception) -> int:
        """Count the rows that are missing since the last `check` as lost by an error.

        It must be called before further rows are received.

        Returns:
            Number of rows lost.
        """
        lost = self._missing() - self._unaccounted
        self._lost += lost
        self._lost_reason = repr(error)
        return lost

    def check(self) -> None:
        """Check that all received rows were delivered, wait, or are counted as left out."""
        self._unaccounted = self._missing()

    def _missing(self) -> int:
        """Return the number of received rows that are nowhere."""
        cubes = self._scans.cubes
        left_out = cubes.unknown_cube + cubes.wrong_pads + self.duplicate
        accounted = self.delivered + left_out + self._lost + self._scans.rows_waiting()
        return self.received - accounted
