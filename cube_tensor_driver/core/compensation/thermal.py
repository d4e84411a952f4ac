# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation of temperature: thermal stress and drift of the pads, with the lag of the elastomer.

The temperature u of the elastomer lags behind the temperature T that the thermometer of the hub
measures. u is T after first-order low-pass filters in series with the time constants lag_i. It is
computed as a weighted sum of the outputs x_i of the same filters in parallel (`low_pass.py`)::

    lag_i dx_i/dt = T - x_i,      u = sum_i w_i x_i,      w_i = prod_j lag_i / (lag_i - lag_j)

The product is over all j other than i. A row is one sample of one cube, C the number of cubes of
the skin, P the largest number of pads of a cube.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..arrays import Array, Index, index_cubes
from ..kernel.contract import Columns
from ..pipeline import Pipeline
from ..status import THERMAL
from .low_pass import MAX_STEP_NS, LowPass
from .models import ThermalModel

START_KELVIN = 1.0
"""Standard deviation, in K, of the difference between elastomer and thermometer at the first row.

Temperatures before the first row are unknown. Indoors, arm and air change by about 1 K in a quarter
of an hour. The deviation decays with the lag of the elastomer.
"""

LOST_KELVIN = 5.0
"""Standard deviation of the elastomer's temperature, in K, after a long time in which no
temperature was measured or no rows arrived. The deviation approaches it with the lag of the
elastomer."""

MAX_DEVIATION = 30.0
"""Standard deviation of a pad's stress, in Pa, above which rows get the status bit COMPENSATION: a
tenth of the pressure that counts as a contact (300 Pa)."""

MIN_LAG_S = 1e-3
"""Smallest time constant of a low-pass filter, in s. It replaces a shorter one in a calibration,
such as 0 (no lag), because the filter divides by the time constant."""


class Thermal:
    """Computes the effect of temperature on the readings of the pads of one skin.

    Attributes:
        has_model: Whether the calibration of a cube has a model of this effect (C,).
        is_known: Whether the standard deviation of the effect is at most `MAX_DEVIATION` (C,).
        offset: The effect on each pad now (P, C), stress / stiffness.
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
        has_stiffness = pipeline.stiffness > 0
        stiffness = np.where(has_stiffness, pipeline.stiffness, np.inf).T
        n = len(self._models)
        times = np.full((n_lags, n), MIN_LAG_S)
        self._reference = np.zeros(n)
        self._weight = np.zeros((n_lags, n))
        self._coefficient = np.zeros((n_degrees, *stiffness.shape))
        # Effect of the elastomer's temperature on the stress of a pad, in Pa/K, as the root mean
        # square over the pads of a cube.
        self._slope = np.zeros(n)
        # Standard deviation of the stress of a pad, in Pa per K by which the elastomer lags behind
        # the thermometer, as the root mean square over the pads of a cube.
        self._ramp = np.zeros(n)
        for number, model in enumerate(self._models):
            if model is None:
                continue
            lag = np.maximum(model.lag, MIN_LAG_S)
            filters = slice(len(lag))
            times[filters, number] = lag
            self._weight[filters, number] = filter_weights(lag)
            self._reference[number] = model.reference
            pads, degrees = model.coefficient.shape
            self._coefficient[:degrees, :pads, number] = model.coefficient.T
            self._slope[number] = _find_typical_size(model.coefficient[:, :1])
            if model.ramp is not None:
                self._ramp[number] = _find_typical_size(model.ramp)
        # Errors (C, P, k) of the stresses, in Pa per K (or power of K), by the attribute of the
        # model that states them.
        ramps = [model.ramp for model in present if model.ramp is not None]
        n_ramps = max((ramp.shape[1] for ramp in ramps), default=0)
        widths = {"coefficient": 1, "ramp": n_ramps, "deviation": n_degrees}
        self._error_sizes = {
            name: _stack(self._models, name, (len(stiffness), width))
            for name, width in widths.items()
        }
        self._coefficient /= stiffness
        self._filters = LowPass(times, n_signals=1)

        # Time stamp of each cube's row in the last step, in ns, and the last measured temperature,
        # in °C.
        self._time_ns = np.zeros(n, np.int64)
        self._measured = np.full(n, np.nan)
        # Standard deviation of the elastomer's temperature, in K, because temperatures before the
        # first row or in a gap are unknown.
        self._unknown = np.full(n, START_KELVIN)

        # Temperature of the elastomer minus the reference temperature, in K.
        self._level = np.zeros(n)
        # Measured temperature minus that of the elastomer, in K.
        self._lag = np.full(n, np.nan)
        self.offset = np.zeros(stiffness.shape)
        self.is_known = np.zeros(n, bool)

    def advance(self, scan: Columns) -> None:
        """Advance the temperatures of the elastomer to the time stamps of a scan's rows.

        Args:
            scan: Rows of one scan, with time stamps and measured temperatures.
        """
        n = len(self._models)
        cube = index_cubes(scan.cube, n)
        time_ns = self._time_ns.copy()
        time_ns[cube] = scan.stamp_ns
        given = self._measured.copy()
        given[cube] = scan.temperature
        is_missing = np.isnan(given)
        is_first = np.isnan(self._measured) & ~is_missing
        # If a time stamp precedes the last one, no time counts as elapsed. The first temperature
        # measured at a cube is taken as the temperature of its elastomer, too.
        elapsed_ns = np.maximum(time_ns - self._time_ns, 0)
        elapsed_ns[is_first] = 0
        change = given - self._measured
        change[is_missing | is_first] = 0
        elapsed_s = elapsed_ns * 1e-9
        share = self._filters.advance(elapsed_s, change[None])
        # The deviation decays like the slowest filter of the cube.
        decay = 1 - share.min(axis=0, initial=1.0)
        is_gap = elapsed_ns > MAX_STEP_NS
        final = np.where(is_missing | is_gap, LOST_KELVIN, 0)
        self._unknown *= decay
        self._unknown += final * (1 - decay)
        self._measured[~is_missing] = given[~is_missing]
        self._time_ns[:] = time_ns
        self.resume()

    def resume(self) -> None:
        """Compute `offset` and `is_known` from the state, which may be one from a recording."""
        # NaN as long as no temperature has been measured.
        lag = 0 * self._measured
        for number, weight in enumerate(self._weight):
            lag += weight * self._filters.lag[number, 0]
        self._lag[:] = lag
        level = self._measured - lag - self._reference
        self._level[:] = np.nan_to_num(level)
        self.offset[:] = 0
        for coefficient in self._coefficient[::-1]:
            self.offset += coefficient
            self.offset *= self._level

        lag_deviation = self._ramp * abs(self._lag)
        start_deviation = self._slope * self._unknown
        # The comparison is false for NaN, which means that no temperature has been measured so far.
        is_accurate = lag_deviation + start_deviation <= MAX_DEVIATION
        self.is_known = self.has_model & is_accurate

    def errors(self, cubes: Index) -> Array:
        """Return the errors (n, P, k) of the thermal stress on the pads of n cubes, in Pa.

        Each of the k columns is the error, of one standard deviation, by one of k independent
        causes: the unknown temperature of the elastomer, its lag behind the thermometer, and the
        coefficients of the calibration. If no temperature has been measured yet, the reference
        temperature is assumed, with a standard deviation of 5 K.
        """
        lag = self._lag[cubes]
        unknown = np.where(np.isnan(lag), LOST_KELVIN, self._unknown[cubes])
        powers = 1 + np.arange(len(self._coefficient))
        factors = {
            "coefficient": unknown[:, None],
            "ramp": np.nan_to_num(lag)[:, None],
            "deviation": self._level[cubes][:, None] ** powers,
        }
        errors = [
            self._error_sizes[name][cubes] * factor[:, None] for name, factor in factors.items()
        ]
        return np.concatenate(errors, axis=2)

    def parts(self) -> list[Array]:
        """Return the arrays of the state. To restore a recorded state, write into them."""
        return [
            self._time_ns.view(float),
            self._measured,
            self._unknown,
            self._filters.lag,
        ]


def _stack(models: Sequence[ThermalModel | None], name: str, shape: tuple[int, int]) -> Array:
    """Return an attribute (P, k) of the models of C cubes as (C, P, k); 0 where a model has none.

    Args:
        models: Models of the cubes.
        name: Name of the attribute.
        shape: Numbers P of pads and k of columns; further columns are left out.
    """
    stacked = np.zeros((len(models), *shape))
    for number, model in enumerate(models):
        value = getattr(model, name, None)
        if value is not None:
            part = value[:, : shape[1]]
            stacked[number, : len(part), : part.shape[1]] = part
    return stacked


def _find_typical_size(values: Array) -> float:
    """Return the root sum of squares of the K values (P, K) of a pad, as the rms over P pads."""
    mean_square = (values**2).sum() / len(values)
    return float(np.sqrt(mean_square))


def filter_weights(lag: Array) -> Array:
    """Return weights (L,) with which L parallel low-pass filters add up to the filters in series.

    Args:
        lag: Time constants (L,), in s, all different.
    """
    difference = lag[:, None] - lag
    np.fill_diagonal(difference, lag)
    ratio = lag[:, None] / difference
    weights: Array = ratio.prod(axis=1)
    return weights
