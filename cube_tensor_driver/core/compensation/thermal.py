# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation of temperature: thermal stress and drift of the pads, with the lag of the elastomer.

The thermometer of a hub is not the elastomer, whose temperature u follows the measured one T. It is
a sum of first-order low-pass filters with the time constants lag_i::

    lag_i dx_i/dt = T - x_i,      u = sum_i w_i x_i,      w_i = prod_j lag_i / (lag_i - lag_j)

so that u is T after one filter after the other. Between two steps T is taken as linear, for which
each x_i is advanced exactly, whatever the interval. Steps depend on the rows of a cube alone, so
the result does not depend on how rows are put together. A row is one sample of one cube.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ..arrays import Array, Index, Mask, Real, Times
from ..errors import LayoutError
from ..pipeline import Pipeline
from ..rows import FrequencyRows
from ..status import THERMAL
from .creep import relaxed_share
from .effect import Effect

START_KELVIN = 1.0
"""Standard deviation, in K, of the difference between elastomer and thermometer at the first row.

The history before is unknown. Indoors, arm and air change by about 1 K in a quarter of an hour; the
deviation decays with the lag.
"""

LOST_KELVIN = 5.0
"""Standard deviation, in K, towards which that of the elastomer's temperature grows with the lag
while no temperature is measured or no rows arrive."""

MAX_GAP_NS = 2_000_000_000
"""Longest time between two rows, in ns, over which the temperature counts as measured."""

STEP_NS = 100_000_000
"""Shortest step of the filters, in ns; in between the compensation of a cube does not change.

With a lag of 100 s and 150 Pa/K, it changes by 2 Pa within a step after the skin warmed by 15 K at
once, less than the noise of one sample (3 Pa).
"""

MAX_DEVIATION = 30.0
"""Deviation of a pad's stress, in Pa, above which rows get the status bit COMPENSATION: a tenth of
the pressure that counts as a contact (300 Pa)."""

MIN_LAG_S = 1e-3
"""Smallest time constant, in s, that is computed with; a shorter one, such as 0, has this one."""


class Thermal(Effect):
    """Computes what temperature does to the pads of one skin.

    Attributes:
        key: Name of the effect.
        bit: Status bit of rows from which the effect is subtracted.
        is_recursive: Whether the effect depends on the stresses of earlier rows.
    """

    key = "thermal"
    bit = THERMAL
    is_recursive = False

    def __init__(self, pipeline: Pipeline) -> None:
        """Take the models of the skin's calibrations.

        Args:
            pipeline: Pipeline with the calibrations and the pads' stiffness.
        """
        models = [calibration.thermal for calibration in pipeline.calibrations]
        self._models, n, n_pads = models, len(models), pipeline.n_pads
        present = [model for model in models if model is not None]
        n_lags = max((len(model.lag) for model in present), default=0)
        n_degrees = max((model.coefficient.shape[1] for model in present), default=0)
        self._has_model = np.array([model is not None for model in models])
        self._reference = np.zeros(n)
        self._rate, self._weight = np.ones((n, n_lags)), np.zeros((n, n_lags))
        self._coefficient = np.zeros((n_degrees, n, n_pads))
        # Pa per K of a pad (quadratic mean over the pads of a cube): slope, and deviation per lag.
        self._slope, self._ramp = np.zeros(n), np.zeros(n)
        for number, model in enumerate(models):
            if model is None:
                continue
            lag = np.maximum(model.lag, MIN_LAG_S)
            self._reference[number] = model.reference
            self._rate[number, : len(lag)] = 1 / lag
            self._weight[number, : len(lag)] = filter_weights(lag)
            pads, degrees = model.coefficient.shape
            self._coefficient[:degrees, number, :pads] = model.coefficient.T
            self._slope[number] = np.sqrt((model.coefficient[:, 0] ** 2).mean())
            if model.ramp is not None:
                self._ramp[number] = np.sqrt((model.ramp**2).sum() / pads)
        stiffness = np.where(pipeline.stiffness > 0, pipeline.stiffness, np.inf)
        self._coefficient /= stiffness

        # State after the newest row: time, measured temperature, outputs of the filters, and
        # standard deviation of the elastomer's temperature because of what is unknown.
        self._time_ns = np.zeros(n, np.int64)
        self._measured, self._unknown = np.full(n, np.nan), np.full(n, START_KELVIN)
        self._filtered = np.zeros((n, n_lags))
        # Temperature of the elastomer above the reference, and how far it lags behind, in K.
        self._level, self._lag = np.zeros(n), np.full(n, np.nan)
        self._offset = np.zeros((n, n_pads), pipeline.dtype)
        self._is_known = np.zeros(n, bool)

    def applies(self, rows: FrequencyRows) -> bool:
        """Return whether a calibration has a model of temperature."""
        return bool(self._has_model.any())

    def add_offset(self, rows: FrequencyRows, cube: Index, offset: Real) -> Mask:
        """Add the effect to the offsets of the pads; see `Effect.add_offset`."""
        is_known = np.zeros(len(cube), bool)
        # A scan (at most one row per cube) begins where the cube number does not rise.
        begins = [0, *(np.flatnonzero(np.diff(cube) <= 0) + 1).tolist(), len(cube)]
        for scan in (slice(*ends) for ends in pairwise(begins)):
            members, stamp_ns = cube[scan], rows.stamp_ns[scan]
            elapsed_ns = stamp_ns - self._time_ns[members]
            due = np.flatnonzero((elapsed_ns >= STEP_NS) | (elapsed_ns < 0))
            if len(due):
                measured = rows.temperature[scan][due].astype(float)
                self._advance(members[due], stamp_ns[due], measured)
                self._compute(members[due])
            offset[scan] += self._offset[members]
            is_known[scan] = self._is_known[members]
        return is_known

    def _compute(self, cube: Index | slice) -> None:
        """Compute what is subtracted from cubes now, and whether it is known."""
        filtered = np.zeros(len(self._filtered[cube]))
        for number in range(self._weight.shape[1]):
            filtered += self._weight[cube, number] * self._filtered[cube, number]
        self._lag[cube] = self._measured[cube] - filtered
        is_measured = ~np.isnan(self._measured[cube])
        self._level[cube] = np.where(is_measured, filtered - self._reference[cube], 0)
        total = np.zeros(self._offset[cube].shape)
        for coefficient in self._coefficient[::-1]:
            total = (total + coefficient[cube]) * self._level[cube, None]
        self._offset[cube] = total
        deviation = (
            self._ramp[cube] * abs(self._lag[cube]) + self._slope[cube] * self._unknown[cube]
        )
        # A temperature that has never been measured (NaN) fails the comparison.
        self._is_known[cube] = self._has_model[cube] & (deviation <= MAX_DEVIATION)

    def _advance(self, cube: Index, stamp_ns: Times, measured: Array) -> None:
        """Advance the filters of the cubes of one scan to its time stamps.

        Args:
            cube: Numbers of the cubes (N,).
            stamp_ns: Time stamps (N,), in ns.
            measured: Measured temperatures (N,), in °C; NaN where they are unknown.
        """
        before = self._measured[cube]
        is_first = np.isnan(before) & ~np.isnan(measured)
        is_lost = np.isnan(measured) | (stamp_ns - self._time_ns[cube] > MAX_GAP_NS)
        measured = np.where(np.isnan(measured), before, measured)
        before = np.where(is_first, measured, before)
        filtered = np.where(is_first[:, None], measured[:, None], self._filtered[cube])

        # A time that went back is no time. Before the first temperature nothing is filtered.
        elapsed = np.where(is_first, 0, np.maximum(stamp_ns - self._time_ns[cube], 0)) * 1e-9
        steps = elapsed[:, None] * self._rate[cube]
        share = relaxed_share(steps)
        mean = np.where(steps > 0, share / np.where(steps > 0, steps, 1), 1)
        rise = (measured - before)[:, None]
        kept = (filtered - before[:, None]) * (1 - share)
        self._filtered[cube] = measured[:, None] + kept - rise * mean
        slowest = (1 - share).max(axis=1)
        lost = np.where(is_lost & ~is_first, LOST_KELVIN, 0)
        self._unknown[cube] = self._unknown[cube] * slowest + lost * (1 - slowest)
        self._measured[cube], self._time_ns[cube] = measured, stamp_ns

    def deviation(self, cube: int) -> Array:
        """Return patterns of one standard deviation of the pads' stresses; see `Effect.deviation`.

        An unknown temperature is taken as the reference, with a standard deviation of 5 K.
        """
        model = self._models[cube]
        if model is None:
            return np.zeros((self._coefficient.shape[2], 0))
        level, lag = self._level[cube], self._lag[cube]
        unknown = LOST_KELVIN if np.isnan(lag) else self._unknown[cube]
        patterns = [model.coefficient[:, :1] * unknown]
        if model.ramp is not None:
            patterns.append(model.ramp * np.nan_to_num(lag))
        if model.deviation is not None:
            powers = 1 + np.arange(model.deviation.shape[1])
            patterns.append(model.deviation * level**powers)
        found = np.hstack(patterns)
        missing = self._coefficient.shape[2] - len(found)
        padded: Array = np.pad(found, ((0, missing), (0, 0)))
        return padded

    def state(self) -> Array:
        """Return the state after the newest row, as flat numbers; see `Effect.state`."""
        if not self._has_model.any():
            return np.zeros(0)
        # A float does not hold 64 bits, so the time is in two parts.
        seconds, rest_ns = np.divmod(self._time_ns, 1_000_000_000)
        columns = seconds, rest_ns, self._measured, self._unknown, *self._filtered.T
        return np.concatenate(columns)

    def restore(self, state: Array) -> None:
        """Continue from a state that `state` returned; see `Effect.restore`."""
        n, n_lags = self._filtered.shape
        if state.shape != ((4 + n_lags) * n,):
            raise LayoutError(
                f"thermal: a state of {state.size} numbers for {n} cubes; it must have "
                f"{(4 + n_lags) * n}: use the skin of the recording"
            )
        seconds, rest_ns, measured, unknown, *filtered = state.reshape(4 + n_lags, n)
        self._time_ns = seconds.astype(np.int64) * 1_000_000_000 + rest_ns.astype(np.int64)
        self._measured, self._unknown = measured.copy(), unknown.copy()
        self._filtered = np.stack(filtered, axis=1)
        self._compute(slice(None))


def filter_weights(lag: Array) -> Array:
    """Return the weights (L,) of L low-pass filters side by side that equal them in a row.

    Args:
        lag: Time constants (L,), in s, all different.
    """
    difference = lag[:, None] - lag
    np.fill_diagonal(difference, lag)
    weights: Array = np.prod(lag[:, None] / difference, axis=1)
    return weights
