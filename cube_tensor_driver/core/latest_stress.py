# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The latest stress of each cube of a skin, and whether it is usable."""

from __future__ import annotations

import numpy as np

from .arrays import Array, Index, Mask
from .health.diagnosis import has_high_residual
from .health.statistics import WINDOW_S
from .modes import COMPONENTS
from .rows import StressRows
from .status import INVALID, RESIDUAL

FINE = 0
"""Health of a cube: the latest stress is usable without reservation."""
DOUBTFUL = 1
"""Health of a cube: the latest stress has a status bit other than that for a high residual
(disagreement of the pads), or many recent samples of the cube have a high residual."""
FAULTY = 2
"""Health of a cube: all components of the latest stress are unknown (NaN)."""
STALE = 3
"""Health of a cube: no stress of this cube has arrived for some time (`STALE_S`, if the caller does
not choose another)."""

HEALTH_WORDS = ("ok", "doubtful", "no tensor", "stale")
"""Text for each health of a cube: `FINE`, `DOUBTFUL`, `FAULTY` and `STALE`, in this order."""

STALE_S = 1.0
"""Default time without a stress message of a cube, in seconds, after which the cube is stale."""


class LatestStress:
    """The latest row (stress of one sample) of each of N cubes, and the time at which it arrived.

    The class reads no clock: the caller states the time, in seconds from any origin.

    Attributes:
        values: Components of stress in Pa and of gradient in Pa/m (N, 15); NaN before the first
            row of a cube.
        residual: Residual (disagreement of the pads) of the latest row (N,), about 1 for noise
            alone.
        status: Status bits of the latest row (N,).
        left_out: Bit masks of the pads that were not used for the latest row (N,).
        arrived: Time of arrival of the latest row (N,), in s; minus infinity before the first row.
        count: Number of rows so far (N,).
        high_residual: Whether many recent rows of a cube have a residual above its limit (N,), by
            the rule of `has_high_residual`. Noise alone exceeds the limit in one row of a thousand,
            so on a large skin some cube exceeds it at any moment.
    """

    def __init__(self, n_cubes: int) -> None:
        shape = (n_cubes, len(COMPONENTS))
        self.values = np.full(shape, np.nan)
        self.residual = np.full(n_cubes, np.nan)
        self.status = np.zeros(n_cubes, np.uint16)
        self.left_out = np.zeros(n_cubes, np.uint32)
        self.arrived = np.full(n_cubes, -np.inf)
        self.count = np.zeros(n_cubes, np.int64)
        self.high_residual = np.zeros(n_cubes, bool)
        self._window_start = -np.inf
        self._count_at_start = self.count.copy()
        self._over_limit = np.zeros(n_cubes, np.int64)

    def update(self, rows: StressRows, now: float) -> None:
        """Store new rows, each the stress of one sample of one cube.

        If a cube has several new rows, the last one is kept. Rows of cubes that the skin does not
        have are ignored.

        Args:
            rows: New rows.
            now: Time at which the rows arrived, in s.
        """
        is_known = rows.cube < len(self.status)
        if not is_known.all():
            rows = rows.select(is_known)
        cube = rows.cube
        self.values[cube] = rows.components
        self.residual[cube] = rows.residual
        self.status[cube] = rows.status
        self.left_out[cube] = rows.left_out
        self.arrived[cube] = now

        self._close_window_when_over(now)
        # If a cube has several of the new rows, `count[cube] += 1` would count only one of them.
        np.add.at(self.count, cube, 1)
        is_over_limit = rows.status & RESIDUAL != 0
        np.add.at(self._over_limit, cube[is_over_limit], 1)

    def compute_health(self, now: float, stale_after: float) -> Index:
        """Return the health of each cube.

        Args:
            now: Present time, in s.
            stale_after: Time without a row after which a cube is stale, in s.

        Returns:
            `FINE`, `DOUBTFUL`, `FAULTY` or `STALE` of each cube (N,).
        """
        # A high residual of a single row may be noise, so its bit is ignored. `high_residual`
        # states whether many recent rows have a high residual.
        other_bits = self.status & ~np.uint16(RESIDUAL)
        is_doubtful = self.high_residual | (other_bits != 0)
        health = np.where(is_doubtful, DOUBTFUL, FINE)
        is_faulty = self.status & INVALID != 0
        is_stale = now - self.arrived > stale_after
        health[is_faulty] = FAULTY
        health[is_stale] = STALE
        return health

    def select_usable_values(self, health: Index) -> Array:
        """Return the latest components (N, 15), in Pa and Pa/m.

        Args:
            health: Health of the cubes (N,), as `compute_health` returns it. Cubes that are
                `FAULTY` or `STALE` get NaN.
        """
        is_usable: Mask = health < FAULTY
        return np.where(is_usable[:, None], self.values, np.nan)

    def _close_window_when_over(self, now: float) -> None:
        """Decide, every `WINDOW_S` seconds, which cubes have many rows with a high residual.

        The counts of rows then start again at 0.

        Args:
            now: Present time, in s. A time before the start of the counts also ends them.
        """
        elapsed_s = now - self._window_start
        if 0 <= elapsed_s < WINDOW_S:
            return
        rows = self.count - self._count_at_start
        self.high_residual = has_high_residual(
            self.high_residual,
            self._over_limit,
            rows,
        )
        self._window_start = now
        self._count_at_start = self.count.copy()
        self._over_limit[:] = 0
