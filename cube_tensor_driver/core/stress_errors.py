# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of the newest stress of a skin other than noise, computed twice a second and when needed.

The reconstruction node publishes them on `stress_errors`, and reprocessing computes the same.
"""

from __future__ import annotations

import numpy as np

from .arrays import Real
from .reconstructor import Reconstructor
from .rows import StressRows
from .status import COMPENSATION

PERIOD_NS = 500_000_000
"""Longest time, in ns, for which errors are kept. They are computed earlier if the compensation of
a cube becomes uncertain (status bit COMPENSATION)."""


class StressErrors:
    """Computes the errors of the newest stress of all cubes of a skin (`Reconstructor.errors`)."""

    def __init__(self, reconstructor: Reconstructor) -> None:
        """Prepare for the rows that a reconstructor computes from now on."""
        self._reconstructor = reconstructor
        self._cubes = np.arange(len(reconstructor.names))
        self._left_out = np.zeros(len(self._cubes), np.uint32)
        self._is_uncertain = np.zeros(len(self._cubes), bool)
        self._last_ns = 0

    def update(self, rows: StressRows, stamp_ns: int) -> Real | None:
        """Return the errors (cubes, 15, causes), in Pa and Pa/m, if they are due, or None.

        They are never due while there are none (`Reconstructor.has_errors`).

        Args:
            rows: The newest rows of the reconstructor, one cube at one sampling time each.
            stamp_ns: Stamp of their message, in ns since the Unix epoch.
        """
        reconstructor = self._reconstructor
        if not reconstructor.has_errors:
            return None
        self._left_out[rows.cube] = rows.left_out
        is_uncertain = self._is_uncertain.copy()
        is_uncertain[rows.cube] = rows.status & COMPENSATION > 0
        is_worse = is_uncertain & ~self._is_uncertain
        is_due = abs(stamp_ns - self._last_ns) >= PERIOD_NS or is_worse.any()
        if not is_due:
            return None
        self._last_ns = stamp_ns
        self._is_uncertain = is_uncertain
        return reconstructor.errors(self._cubes, self._left_out).astype(np.float32)
