# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Counting of rows: how many were received, delivered, and left out for each reason.

A row (one sample of one cube) is counted as received as soon as its frame is decoded, before
anything else is done with it. So a row that is lost later, for example by an error, is noticed as
the difference of the counters.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(kw_only=True)
class RowCounts:
    """Numbers of rows (samples of cubes) of all links, by what happened to them.

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
        received: Rows received, whatever happened to them.
    """

    delivered: int = 0
    unknown_cube: int = 0
    wrong_pads: int = 0
    unaccounted: int = 0
    duplicate: int = 0
    overload: int = 0
    lost: int = 0
    lost_reason: str = ""
    received: int = field(default=0, compare=False)

    def count_not_delivered(self) -> dict[str, int]:
        """Return the numbers of rows that were not delivered, by a description for people."""
        return {
            "rows of unknown cubes": self.unknown_cube,
            "rows with another number of pads": self.wrong_pads,
            "rows that came twice": self.duplicate,
            "rows dropped by a slow host": self.overload,
            "rows lost by errors": self.lost,
            "rows unaccounted": self.unaccounted,
        }

    def count_lost(self, n_waiting: int, error: Exception) -> int:
        """Count all rows that have gone missing since the last `check` as lost.

        It must be called before further rows are counted as received.

        Args:
            n_waiting: Number of rows that wait for the rest of their scan.
            error: The exception by which the rows were lost.

        Returns:
            Number of rows lost.
        """
        lost = self._count_missing(n_waiting) - self.unaccounted
        self.lost += lost
        self.lost_reason = repr(error)
        return lost

    def check(self, n_waiting: int) -> None:
        """Check that every received row is counted once, by what has happened to it.

        `unaccounted` becomes the number of received rows that were not delivered, left out or lost,
        and do not wait for the rest of their scan. It is 0 unless the driver has a defect.

        Args:
            n_waiting: Number of rows that wait for the rest of their scan.
        """
        self.unaccounted = self._count_missing(n_waiting)

    def _count_missing(self, n_waiting: int) -> int:
        """Return the number of received rows that were not delivered, left out or lost, and do not
        wait for the rest of their scan.

        Args:
            n_waiting: Number of rows that wait for the rest of their scan.
        """
        left_out = self.unknown_cube + self.wrong_pads + self.duplicate + self.overload
        return self.received - self.delivered - left_out - self.lost - n_waiting
