"""The account of rows: what became of each one that came in.

A row is counted as received from its frame, before anything is done with it. So nothing that
happens to it later, an error included, can hide it.
"""

from __future__ import annotations

from dataclasses import dataclass

from .scan import ScanBuilder


@dataclass(frozen=True)
class RowCounts:
    """What became of the rows that came in.

    delivered: given to the callback, which returned
    unknown_cube: left out because the skin does not have the cube
    wrong_pads: left out because the skin has the cube with another number of pads
    unaccounted: none of all these, and not waiting for their scan; always 0
    duplicate: had come before
    lost: an error in the driver lost them; lost_reason: the last one
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

    received, delivered, duplicate: to be counted up; see `RowCounts`
    """

    def __init__(self, scans: ScanBuilder) -> None:
        self.received = self.delivered = self.duplicate = 0
        self._scans = scans
        self._unaccounted = 0
        self._lost = 0
        self._reason = ""

    @property
    def counts(self) -> RowCounts:
        """As of the last `check`."""
        return RowCounts(
            self.delivered,
            self._scans.cubes.unknown_cube,
            self._scans.cubes.wrong_pads,
            self._unaccounted,
            self.duplicate,
            self._lost,
            self._reason,
        )

    def lose(self, error: Exception) -> int:
        """An error was caught: the rows that are missing since the last `check` are lost by it.

        Returns how many. To be called before further rows are received.
        """
        lost = self._missing() - self._unaccounted
        self._lost += lost
        self._reason = repr(error)
        return lost

    def check(self) -> None:
        """All that was received is delivered, waits, or is counted elsewhere: see whether it is."""
        self._unaccounted = self._missing()

    def _missing(self) -> int:
        cubes = self._scans.cubes
        left_out = cubes.unknown_cube + cubes.wrong_pads
        accounted = self.delivered + left_out + self.duplicate + self._lost
        return self.received - accounted - self._scans.rows_waiting()
