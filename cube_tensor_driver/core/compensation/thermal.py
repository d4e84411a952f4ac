# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation of temperature: thermal stress and drift of the pads, with the lag of the elastomer.

The elastomer lags behind the temperature T that the thermometer of the hub measures. Its
temperature u is a weighted sum of the outputs x_i of first-order low-pass filters in parallel
(`low_pass.py`)::

    lag_i dx_i/dt = T - x_i,      u = sum_i w_i x_i

If a model states how each pad depends on T - x_i (`ThermalModel.lagging`), u is the mean of x_i.
Otherwise it is T after the filters in series, with w_i = prod_j lag_i / (lag_i - lag_j), where the
product is over all j other than i. A row is one sample of one cube, C the number of cubes of
the skin, P the largest number of pads of a cube.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array, Index, Real, index_cubes
from ..calibration import tabulate_pads
from ..kernel.contract import Columns, Offsets
from ..pipeline import Pipeline
from ..status import THERMAL
from .low_pass import MAX_STEP_NS, LowPass
from .models import tabulate

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
"""Standard deviation of the computed thermal stress on the pads of a cube, in Pa, above which the
cube's rows get the status bit COMPENSATION (the compensation is uncertain). It is a tenth of the
pressure that counts as a contact (300 Pa)."""

DRIFT = 1e-4
"""Standard deviation of the drift of oscillators (relative change of their frequency per K), used
if the calibration does not state the drift. It is the usual temperature coefficient of R and C, 100
ppm/K."""

MIN_LAG_S = 1e-3
"""Smallest time constant of a low-pass filter, in s. It replaces a shorter one in a calibration,
such as 0 (no lag), because the filter divides by the time constant."""


class Thermal:
    """Computes the effect of temperature on the readings of the pads of one skin.

    Attributes:
        has_model: Whether the calibration of a cube has a model of this effect (C,).
        is_known: Whether the standard deviation of the effect is at most `MAX_DEVIATION` (C,).
        offset: The effect on each pad now (C, P), stress / stiffness.
    """

    key = "thermal"
    bit = THERMAL

    def __init__(self, pipeline: Pipeline, newest: Offsets) -> None:
        """Start without any row.

        Args:
            pipeline: Pipeline with the calibrations, which contain the models of temperature, and
                the stiffness of the pads, by which the thermal stress is divided (see `offset`).
            newest: Values that the kernel shares, with the newest row of each cube.
        """
        self._newest = newest
        models = [calibration.thermal for calibration in pipeline.calibrations]
        self.has_model = np.array([model is not None for model in models])
        n_cubes, n_pads = pipeline.stiffness.shape
        lag = np.maximum(tabulate(models, "lag", (0,)), MIN_LAG_S)
        weight = np.zeros_like(lag)
        for cube, model in enumerate(models):
            if model is not None:
                n_lags = len(model.lag)
                in_series = model.lagging is None
                own = compute_filter_weights(lag[cube, :n_lags]) if in_series else 1 / n_lags
                weight[cube, :n_lags] = own
        self._filters = LowPass(lag.T, weight.T[..., None])
        self._reference = tabulate(models, "reference", ())
        # Attributes of the models as tables: coefficients and their deviations (C, P, degree), in
        # Pa per power of K, and `ramp` (C, P, causes), in Pa/K; 0 where a cube has no model.
        self._coefficient, self._deviation, self._ramp = (
            tabulate(models, name, (n_pads, 0)) for name in ("coefficient", "deviation", "ramp")
        )
        own_pads = np.array([calibration.layout.n_pads for calibration in pipeline.calibrations])
        # Sizes of the linear effect and of `_ramp`, as root mean squares over the pads of a cube.
        linear = self._coefficient[..., :1]
        self._linear_size, self._ramp_size = (
            np.sqrt((values**2).sum(axis=(1, 2)) / own_pads) for values in (linear, self._ramp)
        )
        # Coefficients divided by the stiffness of the pads, the highest power first (D, C, P), for
        # Horner's scheme; 0 for a pad that the cube does not have.
        stiffness = np.where(
            pipeline.stiffness > 0,
            pipeline.stiffness,
            np.inf,
        )
        self._relative = np.moveaxis(self._coefficient, 2, 0)[::-1] / stiffness
        # The drift d of a frequency changes the stress v on a pad by d E (1 + beta), which the
        # model contains, and by d (1 + 2 beta) v (pad law, for small v), which it does not contain
        # for a load v. The latter (C, P) is that of a typical drift, in Pa per K and per reading.
        beta = tabulate_pads(pipeline.calibrations, "beta", n_pads, fill=0)
        is_unknown = np.array([one.temperature is None for one in pipeline.calibrations])
        self._drift = DRIFT * is_unknown[:, None] * (1 + 2 * beta) * pipeline.stiffness
        lagging = tabulate(models, "lagging", (n_pads, 0))
        self._relative_lagging = np.moveaxis(lagging, 2, 0) / stiffness
        self._endless = np.full(n_cubes, np.inf)

        # Time stamp of each cube's row in the last step, in ns, and the last measured temperature,
        # in °C.
        self._time_ns = np.zeros(n_cubes, np.int64)
        self._measured = np.full(n_cubes, np.nan)
        # Standard deviation of the elastomer's temperature, in K, because temperatures before the
        # first row or in a gap are unknown.
        self._unknown = np.full(n_cubes, START_KELVIN)
        self.offset = np.zeros(stiffness.shape)
        self._update()

    def advance(self, scan: Columns) -> None:
        """Advance the temperatures of the elastomer to the time stamps of a scan's rows.

        Args:
            scan: Rows of one scan, with time stamps and measured temperatures.
        """
        cube = index_cubes(scan.cube, len(self.has_model))
        time_ns = self._time_ns.copy()
        time_ns[cube] = scan.stamp_ns
        given = np.full_like(self._measured, np.nan)
        given[cube] = scan.temperature
        is_missing = np.isnan(given)
        is_first = np.isnan(self._measured)
        measured = np.where(is_missing, self._measured, given)
        # The first temperature measured at a cube is taken as that of its elastomer, too.
        before = np.where(is_first, measured, self._measured)
        # If a time stamp precedes the last one, no time counts as elapsed.
        elapsed_ns = np.maximum(time_ns - self._time_ns, 0)
        elapsed_ns[is_first & ~is_missing] = 0
        share = self._filter(elapsed_ns * 1e-9, before, measured)
        # The deviation decays like the slowest filter of the cube.
        decay = 1 - share.min(axis=0, initial=1.0)
        is_gap = elapsed_ns > MAX_STEP_NS
        final = np.where(is_missing | is_gap, LOST_KELVIN, 0)
        self._unknown[:] = final + decay * (self._unknown - final)
        self._measured[:] = measured
        self._time_ns[:] = time_ns
        self._update()

    def resume(self) -> None:
        """Update what depends on the arrays of `collect_parts`, into which a state was restored."""
        nothing = np.zeros(len(self.has_model))
        self._filter(nothing, self._measured, self._measured)
        self._update()

    def _filter(self, elapsed_s: Real, before: Array, now: Array) -> Array:
        """Advance the low-pass filters, which give the elastomer's temperature, by one interval.

        Args:
            elapsed_s: Lengths of the intervals (C,), in s.
            before: Measured temperatures at the start of the intervals (C,), in °C.
            now: Measured temperatures at their end (C,), in °C.

        Returns:
            Fraction 1 - exp(-elapsed_s / lag) of the output of each filter of each cube (filters,
            C) that the interval replaced.
        """
        # An unknown temperature does not change, so any number may stand for it.
        first, last = np.nan_to_num([before, now])[..., None]
        return self._filters.advance(elapsed_s, first, last, self._endless)

    def _update(self) -> None:
        """Compute `offset` and `is_known` from the state."""
        self._is_measured = ~np.isnan(self._measured)
        temperature = self._filters.output[:, 0]
        # Temperature of the elastomer above the reference, and how far it lags behind (C, 1), in K.
        self._level = np.where(self._is_measured, temperature - self._reference, 0)[:, None]
        self._behind = np.nan_to_num(self._measured - temperature)[:, None]
        self.offset[:] = 0
        for coefficient in self._relative:
            self.offset += coefficient
            self.offset *= self._level
        for coefficient, behind_filter in zip(
            self._relative_lagging,
            self._filters.lag,
            strict=False,
        ):
            self.offset += coefficient * behind_filter
        by_lag = self._ramp_size * np.abs(self._behind[:, 0])
        deviation = by_lag + self._linear_size * self._unknown
        is_certain = self._is_measured & (deviation <= MAX_DEVIATION)
        self.is_known = self.has_model & is_certain

    def compute_errors(self, cubes: Index) -> Array:
        """Return the errors (n, P, k) of the thermal stress on the pads of n cubes, in Pa.

        Each of the k columns is the error, of one standard deviation, by one of k independent
        causes: the unknown temperature of the elastomer, its lag behind the thermometer, the
        coefficients of the calibration, and drift of the oscillators, which multiplies the load,
        unless the calibration states it. If no temperature has been measured yet, the reference
        temperature is assumed, with a standard deviation of 5 K.
        """
        unknown = np.where(self._is_measured, self._unknown, LOST_KELVIN)
        powers = 1 + np.arange(self._deviation.shape[2])
        load = np.nan_to_num(self._newest.reading - self._newest.subtracted)
        by_cause = (
            (self._coefficient[..., :1], unknown[:, None]),
            (self._ramp, self._behind),
            (self._deviation, self._level**powers),
            ((self._drift * load)[..., None], self._level),
        )
        return np.concatenate([size[cubes] * by[cubes, None] for size, by in by_cause], axis=2)

    def collect_parts(self) -> list[Array]:
        """Return the arrays that hold all that later rows need of the earlier ones (the state).

        To restore a recorded state, write into them and call `resume`.
        """
        return [
            self._time_ns.view(float),
            self._measured,
            self._unknown,
            self._filters.lag,
        ]


def compute_filter_weights(lag: Array) -> Array:
    """Return the weights (L,) that make parallel low-pass filters equal to the filters in series.

    The sum of weight × output over the L parallel filters is the output of the series.

    Args:
        lag: Time constants of the filters (L,), in s, all different.
    """
    difference = lag[:, None] - lag
    np.fill_diagonal(difference, lag)
    ratio = lag[:, None] / difference
    weights: Array = ratio.prod(axis=1)
    return weights
