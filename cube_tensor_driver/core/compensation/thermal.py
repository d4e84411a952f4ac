# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation of temperature: thermal stress and drift of the pads, with the lag of the elastomer.

The thermometer of a hub is not the elastomer, whose temperature u follows the measured one T. It is
a sum of first-order low-pass filters (`low_pass.py`) with the time constants lag_i::

    lag_i dx_i/dt = T - x_i,      u = sum_i w_i x_i,      w_i = prod_j lag_i / (lag_i - lag_j)

so that u is T after one filter after the other. A row is one sample of one cube, C the number of
cubes of the skin, P the largest number of pads of a cube.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array, index_cubes
from ..kernel.contract import Columns
from ..pipeline import Pipeline
from ..status import THERMAL
from .low_pass import MAX_STEP_NS, LowPass

START_KELVIN = 1.0
"""Standard deviation, in K, of the difference between elastomer and thermometer at the first row.

The history before is unknown. Indoors, arm and air change by about 1 K in a quarter of an hour; the
deviation decays with the lag.
"""

LOST_KELVIN = 5.0
"""Standard deviation, in K, towards which that of the elastomer's temperature grows with the lag
while no temperature is measured or no rows arrive."""

MAX_DEVIATION = 30.0
"""Deviation of a pad's stress, in Pa, above which rows get the status bit COMPENSATION: a tenth of
the pressure that counts as a contact (300 Pa)."""

MIN_LAG_S = 1e-3
"""Smallest time constant, in s, that is computed with; a shorter one, such as 0, has this one."""


class Thermal:
    """Computes what temperature does to the pads of one skin.

    Attributes:
        has_model: Whether the calibration of a cube has a model (C,).
        is_known: Whether the effect on a cube is known and not too uncertain (C,).
        offset: What is subtracted from the rows of each cube (C, P), stress / stiffness.
    """

    key = "thermal"
    bit = THERMAL

    def __init__(self, pipeline: Pipeline) -> None:
        """Start without any row.

        Args:
            pipeline: Pipeline with the calibrations and the pads' stiffness.
        """
        self._models = [calibration.thermal for calibration in pipeline.calibrations]
        self.has_model = np.array([model is not None for model in self._models])
        present = [model for model in self._models if model is not None]
        n_lags = max((len(model.lag) for model in present), default=0)
        n_degrees = max((model.coefficient.shape[1] for model in present), default=0)

        stiffness = np.where(pipeline.stiffness > 0, pipeline.stiffness, np.inf)
        n = len(self._models)
        self._filters = LowPass(np.full((n_lags, n), MIN_LAG_S), n, n_signals=1)
        self._reference = np.zeros(n)
        self._weight = np.zeros((n_lags, n))
        self._coefficient = np.zeros((n_degrees, *stiffness.shape))
        # Pa per K of a pad (quadratic mean over the pads of a cube): slope, and deviation per lag.
        self._slope = np.zeros(n)
        self._ramp = np.zeros(n)
        for number, model in enumerate(self._models):
            if model is None:
                continue
            lag = np.maximum(model.lag, MIN_LAG_S)
            self._filters.time[: len(lag), number] = lag
            self._weight[: len(lag), number] = filter_weights(lag)
            self._reference[number] = model.reference
            pads, degrees = model.coefficient.shape
            self._coefficient[:degrees, number, :pads] = model.coefficient.T
            self._slope[number] = np.sqrt((model.coefficient[:, 0] ** 2).mean())
            if model.ramp is not None:
                self._ramp[number] = np.sqrt((model.ramp**2).sum() / pads)
        self._coefficient /= stiffness

        # State after the newest step: time of the row, measured temperature, and standard deviation
        # of the elastomer's temperature because of what is unknown.
        self._time_ns = np.zeros(n, np.int64)
        self._measured = np.full(n, np.nan)
        self._unknown = np.full(n, START_KELVIN)

        # Temperature of the elastomer above the reference, and how far it lags behind, in K.
        self._level = np.zeros(n)
        self._lag = np.full(n, np.nan)
        self.offset = np.zeros_like(stiffness)
        self.is_known = np.zeros(n, bool)

    def advance(self, scan: Columns) -> None:
        """Advance the filters of the cubes of one scan to its time stamps."""
        n = len(self._models)
        cube = index_cubes(scan.cube, n)
        time_ns = self._time_ns.copy()
        time_ns[cube] = scan.stamp_ns
        given = self._measured.copy()
        given[cube] = scan.temperature
        is_missing = np.isnan(given)
        is_first = np.isnan(self._measured) & ~is_missing
        # A time that went back is no time. Before the first temperature nothing is filtered.
        elapsed_ns = np.maximum(time_ns - self._time_ns, 0)
        elapsed_ns[is_first] = 0
        change = np.where(is_missing, 0, given - self._measured)
        change[is_first] = 0
        share = self._filters.advance(elapsed_ns * 1e-9, change[:, None])
        slowest = 1 - share.min(axis=0, initial=1.0)
        is_lost = is_missing | (elapsed_ns > MAX_STEP_NS)
        lost = np.where(is_lost, LOST_KELVIN, 0)
        self._unknown *= slowest
        self._unknown += lost * (1 - slowest)
        self._measured[~is_missing] = given[~is_missing]
        self._time_ns[:] = time_ns
        self.resume()

    def resume(self) -> None:
        """Compute from the state what is subtracted from cubes now, and whether it is known."""
        lag = np.where(np.isnan(self._measured), np.nan, 0)
        for weight, one in zip(self._weight, self._filters.lag, strict=True):
            lag += weight * one[:, 0]
        self._lag[:] = lag
        self._level[:] = np.nan_to_num(self._measured - lag - self._reference)
        self.offset[:] = 0
        for coefficient in self._coefficient[::-1]:
            self.offset += coefficient
            self.offset *= self._level[:, None]

        deviation = self._ramp * abs(self._lag) + self._slope * self._unknown
        # A temperature that has never been measured (NaN) fails the comparison.
        self.is_known = self.has_model & (deviation <= MAX_DEVIATION)

    def deviation(self, cube: int) -> Array:
        """Return patterns (P, k) of one standard deviation each, as `Compensation.growth` does.

        An unknown temperature is taken as the reference, with a standard deviation of 5 K.
        """
        model = self._models[cube]
        n_pads = self.offset.shape[1]
        if model is None:
            return np.zeros((n_pads, 0))
        lag = self._lag[cube]
        unknown = LOST_KELVIN if np.isnan(lag) else self._unknown[cube]
        patterns = [model.coefficient[:, :1] * unknown]
        if model.ramp is not None:
            patterns.append(model.ramp * np.nan_to_num(lag))
        if model.deviation is not None:
            powers = 1 + np.arange(model.deviation.shape[1])
            patterns.append(model.deviation * self._level[cube] ** powers)
        found = np.hstack(patterns)
        return np.pad(found, ((0, n_pads - len(found)), (0, 0)))

    def parts(self) -> list[Array]:
        """Return the arrays of the state, which are changed in place."""
        return [self._time_ns.view(float), self._measured, self._unknown, self._filters.lag]


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
