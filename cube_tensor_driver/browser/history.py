"""Values of all cubes in the last seconds, and the number of rows per second of each cube."""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Index, Mask
from ..core.modes import COMPONENTS


class History:
    """Values (stress, gradients, residual) of all cubes at the last instants that the page showed.

    They are stored in a ring buffer: a new instant overwrites the oldest one.
    """

    COLUMNS = (*COMPONENTS, "residual")
    """Names of the 16 values that are stored per cube: 6 components of the stress, 9 gradients of
    stress, then the residual (misfit between pads and tensor, relative to the noise)."""

    def __init__(self, cubes: int, length: int) -> None:
        """Make an empty buffer.

        Args:
            cubes: Number of cubes.
            length: Maximum number of instants that are kept.
        """
        self._values = np.full((length, cubes, len(self.COLUMNS)), np.nan, np.float32)
        self._times = np.full(length, np.nan)
        self._count = 0

    def add(
        self,
        now: float,
        values: Array,
        residual: Array,
    ) -> None:
        """Add the values of one instant; the oldest is overwritten if the buffer is full.

        Args:
            now: Time of the instant, in s, on any clock that all calls share.
            values: Stress in Pa and gradients in Pa/m (cubes, 15); NaN where unknown.
            residual: Misfit between pads and tensor relative to the noise (cubes,); about 1 for
                noise alone.
        """
        slot = self._count % len(self._times)
        self._values[slot, :, :-1] = values
        self._values[slot, :, -1] = residual
        self._times[slot] = now
        self._count += 1

    def clear(self) -> None:
        """Remove all instants, for example because a replay has jumped to another time."""
        self._count = 0

    def of(self, cube: int, column: int) -> Array:
        """Return one value of a cube at the M stored instants (M,), in SI units, the oldest first.

        Args:
            cube: Index of the cube.
            column: Index of the value in `COLUMNS`.
        """
        return np.asarray(self._values[self._slots(), cube, column], float)

    @property
    def times(self) -> Array:
        """Times (M,) of the M stored instants minus that of the newest one, in s, so at most 0."""
        times = self._times[self._slots()]
        # Plots end at zero, which is the newest instant.
        return times - times[-1] if len(times) else times

    @property
    def observed(self) -> Mask:
        """Whether each of `COLUMNS` is finite (16,) for any cube at any stored instant."""
        return np.asarray(np.isfinite(self._values[self._slots()]).any(axis=(0, 1)))

    def _slots(self) -> Index:
        """Return the indices (M,) of the stored instants in the ring buffer, the oldest first."""
        length = len(self._times)
        numbers = np.arange(max(0, self._count - length), self._count)
        return np.asarray(numbers % length)


class RowRate:
    """Computes how many rows (measurements of one cube) arrive per second from each cube.

    Attributes:
        rate: (cubes,) rows per second, in Hz; NaN until the first period is over.
    """

    def __init__(
        self,
        cubes: int,
        now: float,
        period: float = 1.0,
    ) -> None:
        """Start to count.

        Args:
            cubes: Number of cubes.
            now: Present time, in s, on the clock that `update` uses too.
            period: Shortest time, in s, over which the rows of a rate are counted.
        """
        self.rate = np.full(cubes, np.nan)
        self._period = period
        self._count = np.zeros(cubes, np.int64)
        self._counted_s = now

    def update(self, now: float, count: Index) -> None:
        """Compute new rates if a period is over.

        Args:
            now: Present time, in s.
            count: Number of rows (cubes,) that have arrived since the skin appeared.
        """
        elapsed_s = now - self._counted_s
        if elapsed_s > self._period:
            self.rate = (count - self._count) / elapsed_s
            self._count, self._counted_s = count.copy(), now
