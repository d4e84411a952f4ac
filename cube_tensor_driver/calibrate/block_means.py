# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Means of a recording over blocks of time, and low-pass filters of values at given times."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..bags.source import open_bag
from ..core.arrays import Array
from ..core.compensation.low_pass import find_shares
from ..core.pipeline import Pipeline
from ..messages.codec import SECOND
from .recorded_loads import find_cubes


class BlockMeans:
    """Means over blocks of time of the pads' stresses and of another quantity in a bag (recording).

    Attributes:
        names: Names of all cubes in the bag.
        cubes: Numbers of the cubes that were asked for.
        calibrations: Recorded calibrations of all cubes.
        rest_frequency: Frequencies without load (cubes, P), in Hz, that were in use last.
        counts: Number of rows (samples of one cube) in each block (cubes, blocks).
    """

    def __init__(
        self,
        path: Path,
        name: str | None,
        block_ns: int,
        quantity: str,
        width: int,
    ) -> None:
        """Read a bag.

        Args:
            path: Path of the bag.
            name: Name of a cube; None: all.
            block_ns: Duration of a block, in ns.
            quantity: Name of the column of `FrequencyRows` with the other quantity to average, such
                as "temperature". Rows in which it is unknown (NaN) are left out.
            width: Number of values of this quantity in a row.

        Raises:
            BagError: The bag has no such cube.
        """
        with open_bag(path) as source:
            self.names = list(source.skin.names)
            self.cubes = find_cubes(source, path, name)
            settings = source.recording.settings[-1]
            self.calibrations = settings.calibrations
            self.rest_frequency = settings.rest_frequency
            pipeline = Pipeline(self.calibrations)
            pipeline.rest_frequency = self.rest_frequency
            start_ns = source.bag.start_ns
            shape = len(self.names), (source.bag.end_ns - start_ns) // block_ns + 1
            self.counts = np.zeros(shape)
            self._sums = np.zeros((*shape, pipeline.n_pads + width))
            self._block_s = block_ns / SECOND
            for rows in source:
                known = getattr(rows, quantity)
                if known is None:
                    continue
                # The stresses of all pads are computed, even of those that the device reports as
                # broken, because every block must have the same pads.
                stress = pipeline.compute_pad_stress(rows, np.zeros_like(rows.pad_fault))
                values = np.column_stack([np.nan_to_num(stress), known])
                block = (rows.stamp_ns - start_ns) // block_ns
                is_within = (block >= 0) & (block < shape[1])
                is_used = is_within & np.isfinite(values).all(axis=1)
                place = rows.cube[is_used], block[is_used]
                np.add.at(self._sums, place, values[is_used])
                np.add.at(self.counts, place, 1)

    def select_cube(self, cube: int) -> tuple[Array, Array, Array]:
        """Return the means of one cube, for the n blocks in which it has rows.

        Returns:
            Times of the blocks since the beginning of the bag (n,), in s; mean stresses of the
            cube's pads (n, P), in Pa; and means of the other quantity (n, width).
        """
        number = np.flatnonzero(self.counts[cube])
        seconds = number.astype(float) * self._block_s
        means: Array = self._sums[cube, number] / self.counts[cube, number, None]
        n_pads = len(self.rest_frequency[0])
        own = self.calibrations[cube].layout.n_pads
        return seconds, means[:, :own], means[:, n_pads:]


def find_lags(seconds: Array, values: Array, time: Array) -> Array:
    """Return the values minus the outputs of K low-pass filters of these values (N, K, P).

    At the first time, each output equals the value.

    Args:
        seconds: Times of the values (N,), in s.
        values: Values to filter (N, P), which change along straight lines between the times.
        time: Time constants of the filters (K,), in s.
    """
    share, mean = find_shares(np.diff(seconds)[:, None, None] / time[:, None])
    change = mean * np.diff(values, axis=0)[:, None]
    lag = np.zeros((len(seconds), len(time), values.shape[1]))
    for n, kept in enumerate(1 - share):
        lag[n + 1] = kept * lag[n] + change[n]
    return lag
