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

import math
from itertools import pairwise

import numpy as np

from ..arrays import Array, Index, Mask, Real, Times
from ..errors import LayoutError
from ..pipeline import Pipeline
from ..rows import FrequencyRows
from ..status import THERMAL
from .creep import relaxed_share
from .effect import Effect
from .models import ThermalModel

SECOND_NS = 1_000_000_000
"""Number of nanoseconds in a second."""

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
    """Computes what temperature does to the pads of one skin; `Effect` has the attributes."""

    key = "thermal"
    bit = THERMAL
    is_recursive = False

    def __init__(self, pipeline: Pipeline) -> None:
        super().__init__(pipeline)
        self._models = [calibration.thermal for calibration in pipeline.calibrations]
        present = [model for model in self._models if model is not None]
        n_lags = max((len(model.lag) for model in present), default=0)
        n_degrees = max((model.coefficient.shape[1] for model in present), default=0)

        n = len(self._models)
        n_pads = pipeline.n_pads
        self._reference = np.zeros(n)
        self._rate = np.ones((n, n_lags))
        self._weight = np.zeros((n, n_lags))
        self._coefficient = np.zeros((n_degrees, n, n_pads))
        # Pa per K of a pad (quadratic mean over the pads of a cube): slope, and deviation per lag.
        self._slope = np.zeros(n)
        self._ramp = np.zeros(n)
        for number, model in enumerate(self._models):
            if model is not None:
                self._take_model(number, model)
        stiffness = np.where(pipeline.stiffness > 0, pipeline.stiffness, np.inf)
        self._coefficient /= stiffness

        # State after the newest row: time, measured temperature, outputs of the filters, and
        # standard deviation of the elastomer's temperature because of what is unknown.
        self._time_ns = np.zeros(n, np.int64)
        self._measured = np.full(n, np.nan)
        self._unknown = np.full(n, START_KELVIN)
        self._filtered = np.zeros((n, n_lags))

        # Temperature of the elastomer above the reference, and how far it lags behind, in K.
        self._level = np.zeros(n)
        self._lag = np.full(n, np.nan)
        self._offset = np.zeros((n, n_pads), pipeline.dtype)
        self._is_known = np.zeros(n, bool)

    def _take_model(self, number: int, model: ThermalModel) -> None:
        """Enter the model of the cube with this number into the tables."""
        lag = np.maximum(model.lag, MIN_LAG_S)
        n_lags = len(lag)
        self._reference[number] = model.reference
        self._rate[number, :n_lags] = 1 / lag
        self._weight[number, :n_lags] = filter_weights(lag)

        pads, degrees = model.coefficient.shape
        self._coefficient[:degrees, number, :pads] = model.coefficient.T
        linear = model.coefficient[:, 0]
        self._slope[number] = np.sqrt((linear**2).mean())
        if model.ramp is not None:
            self._ramp[number] = np.sqrt((model.ramp**2).sum() / pads)

    def add_offset(
        self,
        rows: FrequencyRows,
        cube: Index,
        offset: Real,
    ) -> Mask:
        """Add the effect to the offsets of the pads; see `Effect.add_offset`."""
        is_known = np.zeros(len(cube), bool)
        # A scan (at most one row per cube) begins where the cube number does not rise.
        begins = np.flatnonzero(np.diff(cube) <= 0) + 1
        for begin, end in pairwise([0, *begins.tolist(), len(cube)]):
            scan = slice(begin, end)
            members = cube[scan]
            stamp_ns = rows.stamp_ns[scan]
            elapsed_ns = stamp_ns - self._time_ns[members]
            is_due = (elapsed_ns >= STEP_NS) | (elapsed_ns < 0)
            if is_due.any():
                due = members[is_due]
                measured = rows.temperature[scan][is_due].astype(float)
                self._advance(due, stamp_ns[is_due], measured)
                self._compute(due)

            offset[scan] += self._offset[members]
            is_known[scan] = self._is_known[members]
        return is_known

    def _compute(self, cube: Index | slice) -> None:
        """Compute what is subtracted from cubes now, and whether it is known."""
        filtered = self._filtered[cube]
        weight = self._weight[cube]
        level = np.zeros(len(filtered))
        for number in range(weight.shape[1]):
            level += weight[:, number] * filtered[:, number]

        measured = self._measured[cube]
        lag = measured - level
        self._lag[cube] = lag
        level = np.where(np.isnan(measured), 0, level - self._reference[cube])
        self._level[cube] = level

        total = np.zeros(self._offset[cube].shape)
        for coefficient in self._coefficient[::-1]:
            total += coefficient[cube]
            total *= level[:, None]
        self._offset[cube] = total

        deviation = self._ramp[cube] * abs(lag)
        deviation += self._slope[cube] * self._unknown[cube]
        # A temperature that has never been measured (NaN) fails the comparison.
        self._is_known[cube] = self._has_model[cube] & (deviation <= MAX_DEVIATION)

    def _advance(
        self,
        cube: Index,
        stamp_ns: Times,
        measured: Array,
    ) -> None:
        """Advance the filters of the cubes of one scan to its time stamps.

        Args:
            cube: Numbers of the cubes (N,).
            stamp_ns: Time stamps (N,), in ns.
            measured: Measured temperatures (N,), in °C; NaN where they are unknown.
        """
        before = self._measured[cube]
        elapsed_ns = stamp_ns - self._time_ns[cube]
        is_missing = np.isnan(measured)
        is_first = np.isnan(before) & ~is_missing
        is_lost = is_missing | (elapsed_ns > MAX_GAP_NS)
        measured = np.where(is_missing, before, measured)
        before = np.where(is_first, measured, before)
        now = measured[:, None]
        filtered = np.where(is_first[:, None], now, self._filtered[cube])

        # A time that went back is no time. Before the first temperature nothing is filtered.
        elapsed_ns = np.maximum(elapsed_ns, 0)
        elapsed_s = np.where(is_first, 0, elapsed_ns) * 1e-9
        steps = elapsed_s[:, None] * self._rate[cube]
        share = relaxed_share(steps)
        divisor = np.where(steps > 0, steps, 1)
        mean = np.where(steps > 0, share / divisor, 1)
        rest = 1 - share
        kept = (filtered - before[:, None]) * rest
        rise = now - before[:, None]
        self._filtered[cube] = now + kept - rise * mean

        slowest = rest.max(axis=1)
        lost = np.where(is_lost & ~is_first, LOST_KELVIN, 0)
        unknown = self._unknown[cube] * slowest
        self._unknown[cube] = unknown + lost * (1 - slowest)
        self._measured[cube] = measured
        self._time_ns[cube] = stamp_ns

    def deviation(self, cube: int) -> Array:
        """Return patterns of one standard deviation of the pads' stresses; see `Effect.deviation`.

        An unknown temperature is taken as the reference, with a standard deviation of 5 K.
        """
        model = self._models[cube]
        n_pads = self._coefficient.shape[2]
        if model is None:
            return np.zeros((n_pads, 0))
        lag = self._lag[cube]
        unknown = LOST_KELVIN if np.isnan(lag) else self._unknown[cube]
        linear = model.coefficient[:, :1]
        patterns = [linear * unknown]
        if model.ramp is not None:
            patterns.append(model.ramp * np.nan_to_num(lag))
        if model.deviation is not None:
            powers = 1 + np.arange(model.deviation.shape[1])
            patterns.append(model.deviation * self._level[cube] ** powers)
        found = np.hstack(patterns)
        padded = np.zeros((n_pads, found.shape[1]))
        padded[: len(found)] = found
        return padded

    def state(self) -> Array:
        """Return the state after the newest row, as flat numbers; see `Effect.state`."""
        if not self._has_model.any():
            return np.zeros(0)
        # A float does not hold 64 bits, so the time is in two parts.
        seconds, rest_ns = np.divmod(self._time_ns, SECOND_NS)
        columns = seconds, rest_ns, self._measured, self._unknown, *self._filtered.T
        return np.concatenate(columns)

    def restore(self, state: Array) -> None:
        """Continue from a state that `state` returned; see `Effect.restore`."""
        n, n_lags = self._filtered.shape
        shape = 4 + n_lags, n
        size = math.prod(shape)
        if state.shape != (size,):
            raise LayoutError(
                f"thermal: a state of {state.size} numbers for {n} cubes; it must have {size}: "
                "use the skin of the recording"
            )
        table = state.reshape(shape).copy()
        seconds, rest_ns = table[:2].astype(np.int64)
        self._time_ns = seconds * SECOND_NS + rest_ns
        self._measured, self._unknown = table[2:4]
        self._filtered = table[4:].T.copy()
        self._compute(slice(None))


def filter_weights(lag: Array) -> Array:
    """Return the weights (L,) of L low-pass filters side by side that equal them in a row.

    Args:
        lag: Time constants (L,), in s, all different.
    """
    difference = lag[:, None] - lag
    np.fill_diagonal(difference, lag)
    ratio = lag[:, None] / difference
    weights: Array = ratio.prod(axis=1)
    return weights
