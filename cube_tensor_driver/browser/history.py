# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Values of all cubes in the last seconds, and the sampling rate of each cube."""

from __future__ import annotations

from collections import deque

import numpy as np

from ..core.arrays import Array, Single
from ..core.modes import COMPONENTS
from ..core.rows import StressRows

RATE_PERIOD_S = 1.0
"""Minimum time, in seconds, between the two samples of a cube from which its rate is computed."""

MAX_RATE_PERIOD_S = 60.0
"""Maximum time, in seconds, between the two samples of a cube from which its rate is computed.

A longer time means that the cube was silent or that its clock was set. Then the later sample
becomes the first one of a new pair.
"""

MAX_NUMBER_DIFFERENCE = 2**24
"""Maximum difference of the sequence numbers of the two samples from which a rate is computed.

A larger difference (modulo 2**32) means that the hub has restarted and counts from 0 again.
"""


class History:
    """Values (stress, gradients, residual) of all cubes at the last instants that the page showed.

    Attributes:
        count: Number of instants that were added since the history was empty.
    """

    COLUMNS = (*COMPONENTS, "residual")
    """Names of the 16 values that are stored per cube: 6 components of the stress, 9 gradients of
    stress, then the residual (misfit between pads and tensor, relative to the noise)."""

    def __init__(self, length: int) -> None:
        """Make an empty history.

        Args:
            length: Maximum number of instants that are kept.
        """
        # Time of each instant in s, and values (cubes, 16); the newest instant is the last.
        self._instants: deque[tuple[float, Single]] = deque(maxlen=length)
        self._is_observed = np.zeros(len(self.COLUMNS), bool)
        self.count = 0

    def add(
        self,
        time_s: float,
        values: Array,
        residual: Array,
    ) -> None:
        """Add the values of one instant, and remove the oldest if there are too many.

        Args:
            time_s: Time of the instant, in s, on any clock that all calls share.
            values: Stress in Pa and gradients in Pa/m (cubes, 15); NaN where unknown.
            residual: Misfit between pads and tensor relative to the noise (cubes,); about 1 for
                noise alone.
        """
        if self._instants and time_s < self._instants[-1][0]:
            # A replay has jumped back.
            self.clear()
        both = np.column_stack([values, residual]).astype(np.float32)
        self._instants.append((time_s, both))
        self._is_observed |= np.isfinite(both).any(axis=0)
        self.count += 1

    def clear(self) -> None:
        """Remove all instants, for example because a replay has jumped to another time."""
        self.count = 0
        self._instants.clear()
        self._is_observed[:] = False

    def select(self, cube: int, column: int) -> Array:
        """Return one value of a cube at the M stored instants (M,), in SI units, the oldest first.

        Args:
            cube: Index of the cube.
            column: Index of the value in `COLUMNS`.
        """
        return np.array([values[cube, column] for _, values in self._instants], float)

    @property
    def times(self) -> Array:
        """Times (M,) of the M stored instants minus that of the newest one, in s, so at most 0."""
        times = np.array([time_s for time_s, _ in self._instants])
        # Plots end at zero, which is the newest instant.
        return times - times[-1] if len(times) else times

    @property
    def observed_names(self) -> set[str]:
        """Names of the `COLUMNS` that were finite for any cube at any instant since `clear`."""
        return {self.COLUMNS[column] for column in np.flatnonzero(self._is_observed)}


class SampleRate:
    """Computes the sampling rate of each cube from the numbers and stamps of its samples.

    A hub numbers all samples that it takes. So this is the rate of the sensor, however many of the
    samples reach this process.

    Attributes:
        hertz: (cubes,) samples per second of each cube; 0 until a cube has been sampled for
            `RATE_PERIOD_S` (1 s).
    """

    def __init__(self, n_cubes: int) -> None:
        self.hertz = np.zeros(n_cubes)
        self._first_sequence = np.zeros(n_cubes, np.uint32)
        # Stamps count from 1970. So the first sample of a cube is more than `MAX_RATE_PERIOD_S`
        # after 0, and no rate is computed from it.
        self._first_ns = np.zeros(n_cubes, np.int64)

    def update(self, rows: StressRows) -> None:
        """Compute the rates of cubes whose last rate is older than `RATE_PERIOD_S`.

        Args:
            rows: New rows (one sample of one cube each), with the number and the stamp of the
                sample. Each rate is a difference of numbers divided by a difference of stamps.
        """
        cube = rows.cube
        elapsed_s = 1e-9 * (rows.stamp_ns - self._first_ns[cube])
        # Numbers of samples continue at 0 after 2**32 - 1. The difference of two uint32 is right in
        # that case, too.
        samples = rows.sequence - self._first_sequence[cube]
        # A difference is implausible if the clock was set, or the cube was silent or restarted.
        is_plausible = (
            (elapsed_s >= 0) & (elapsed_s < MAX_RATE_PERIOD_S) & (samples <= MAX_NUMBER_DIFFERENCE)
        )
        is_over = is_plausible & (elapsed_s > RATE_PERIOD_S)
        self.hertz[cube[is_over]] = samples[is_over] / elapsed_s[is_over]
        begins = is_over | ~is_plausible
        self._first_ns[cube[begins]] = rows.stamp_ns[begins]
        self._first_sequence[cube[begins]] = rows.sequence[begins]
