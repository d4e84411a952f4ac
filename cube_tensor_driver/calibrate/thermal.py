# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of the effect of temperature on the unloaded pads of a skin, from bags in which it warms.

    v_p(t) = c_p0 + sum_d c_pd u(t)^d + sum_l b_pl (T(t) - x_l(t)) + s c_p1 exp(-t / lag_1) + error

    v_p    stress on pad p by the pad law at the time t since the beginning of the bag
    T      measured temperature minus the reference temperature
    x_l    T after a low-pass filter with the time constant lag_l
    u      mean of x_l, which stands for the temperature of the elastomer
    c_pd   coefficients of pad p, d = 1 ... degree
    b_pl   coefficients of pad p for each of the `N_FILTERS` filters
    s      unknown difference between u and T at the beginning; it is small a priori

The time constants are lag_l = lag_1 / `LAG_RATIO`^(l - 1). Conduction of heat has such a series of
time constants, and each pad has its own mixture of them, because pads at different heights measure
different averages of the temperature across the layer.

Low-pass filters only approximate conduction of heat. This error is mostly larger than the noise,
and grows with T - u. So each block of 1 s has the weight
1 / (noise² + (`LAG_ERROR` × slope × (T - u))²), where slope is the rms of c_p1 over the pads. Times
at which the temperature is nearly constant then determine the coefficients. The longest time
constant minimises the negative logarithm of the likelihood. A second degree is used only if it
reduces the residual considerably.

The standard deviations of the coefficients follow from these weights, or from the residuals of a
pad if they are larger than the weights state. Errors of successive blocks are correlated within the
shortest time constant; slower errors are absorbed by the coefficients of the filters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..core.arrays import Array
from ..core.calibration import Calibration
from ..core.compensation.models import ThermalModel
from ..core.compensation.thermal import START_KELVIN
from ..core.errors import BagError, FitError
from ..core.oscillator import compute_pad_frequency, compute_pad_stress
from ..messages.codec import SECOND
from .block_means import BlockMeans, find_lags

BLOCK_S = 1
"""Duration, in s, of the blocks whose mean temperatures and pad stresses are fitted."""

MIN_BLOCKS = 120
"""Smallest number of blocks (of 1 s) with data, in all bags together. With fewer, the dependence of
the pads on temperature is not fitted: the fit raises an error."""

MIN_RANGE = 3.0
"""Smallest difference between the highest and the lowest measured temperature, in K. With a smaller
one, noise and creep would look like an effect of temperature."""

MAX_RESIDUAL = 150.0
"""Largest rms difference between measured and fitted stress of a pad, in Pa. With a larger one the
fit raises an error, because something touched the skin during the recording."""

MAX_SLOPE_DEVIATION = 0.2
"""Largest relative uncertainty of the linear temperature coefficients of the pads' stress (in Pa/K,
rms over the pads) with which a fit is accepted."""

MAX_FINAL_LAG = 0.08
"""Largest difference between measured and filtered temperature at the end of a recording, relative
to the largest one in it, with which a fit is accepted. With more, the skin is not yet warm
throughout, and the final stress of the pads is uncertain: 9 % caused an error of 18 %."""

LAGS_S = np.geomspace(10.0, 1200.0, 30)
"""Longest time constants of the low-pass filters, in s, among which the most likely one is chosen.
The mixture of the filters makes up for the distance between them."""

N_FILTERS = 4
"""Number of low-pass filters. Three leave 15 Pa of what fast warming changes, four leave 3 Pa."""

LAG_RATIO = 2.5
"""Ratio of the time constants of successive low-pass filters. The filters of the measured
temperature stand for the conduction of heat through the elastomer."""

LAG_ERROR = 0.05
"""Standard deviation of the error of the elastomer's temperature as low-pass filters compute it,
divided by the difference between this temperature and the measured one. The error arises because
filters only approximate conduction of heat."""

MAX_DEGREE_RATIO = 0.7
"""Ratio of the rms residual with a quadratic effect of temperature to that with a linear one, below
which the quadratic one is used.

It is 0.99 if the effect is linear. If the skin rests at three temperatures within 20 K, it is 0.36
for a quadratic part of 0.2 % of the effect per kelvin.
"""

MAX_LAG_PATTERNS = 3
"""Maximum number of columns of `ThermalModel.ramp`. The columns are the largest principal
components of the residuals of the fit: errors of the pads' stresses, in Pa per K of difference
between the measured temperature and that of the elastomer."""


@dataclass(frozen=True, eq=False)
class Warming:
    """Temperatures and stresses of an unloaded cube with P pads, averaged over N blocks of time.

    Attributes:
        name: Bag and cube, for messages.
        seconds: Times of the blocks (N,), in s since the beginning of their bag.
        first: For each bag, the index of its first block in the arrays.
        temperature: Measured temperatures (N,), in °C.
        stress: Stresses on the pads by the pad law (N, P), in Pa.
        noise: Standard deviation of the mean stress of a pad in a block by noise alone, in Pa.
    """

    name: str
    seconds: Array
    first: tuple[int, ...]
    temperature: Array
    stress: Array
    noise: float


@dataclass(frozen=True, eq=False)
class ThermalFit:
    """Effect of temperature on the pads of one cube, fitted to recorded stresses.

    Attributes:
        data: Temperatures and stresses to which the model was fitted.
        model: Model for the calibration.
        offset: Stress on each pad (P,) at the reference temperature, in Pa.
        level: Temperature of the elastomer (N,), in K above the reference.
        residual: Measured minus fitted stresses (N, P), in Pa.
        misfit: Negative logarithm of the likelihood per stress, without constants.
    """

    data: Warming
    model: ThermalModel
    offset: Array
    level: Array
    residual: Array
    misfit: float

    def compute_sizes(self) -> tuple[float, float, float]:
        """Return the rms effect on the pads, before and after compensation, and the uncertainty.

        Returns:
            Rms stress of the unloaded pads before and after the effect of temperature is
            subtracted, in Pa, and rms over the pads of the standard deviation of the linear
            coefficient, in Pa/K.
        """
        deviation = np.array(self.model.deviation)
        change = self.data.stress - self.offset
        return (
            compute_root_mean_square(change),
            compute_root_mean_square(self.residual),
            compute_root_mean_square(deviation[:, 0]),
        )

    def make_calibration(self, base: Calibration, source: str) -> Calibration:
        """Return a calibration with the model, and rest frequencies at its reference temperature.

        Args:
            base: Calibration with which the stresses were computed.
            source: Text that states the origin of the values.
        """
        # With the new rest frequencies, the pad law gives other changes of stress than with those
        # of `base`, to which the model was fitted.
        changes = np.array([[0.0], [1.0]])
        rest, changed = compute_pad_frequency(
            self.offset + changes,
            base.rest_frequency,
            base.beta,
            base.modulus,
        )
        scale = compute_pad_stress(changed, rest, base.beta, base.modulus)[:, None]
        of_pads = "coefficient", "deviation", "ramp", "lagging"
        scaled = {name: scale * getattr(self.model, name) for name in of_pads}
        return replace(
            base,
            rest_frequency=rest,
            thermal=replace(self.model, **scaled),
            source=source,
        )


def read_warming(
    paths: Sequence[Path],
    name: str | None,
) -> dict[str, tuple[Calibration, Warming]]:
    """Read bags that were recorded while the temperature of an unloaded skin changed.

    Args:
        paths: Bags of one skin, between which no tare was made.
        name: Name of the cube; None: all.

    Returns:
        For each cube by its name: the calibration with the rest frequencies that were in use, and
        the averages over blocks of time.

    Raises:
        BagError: A bag has no such cube or states no temperature, or the bags have different cubes.
    """
    bags = [BlockMeans(path, name, BLOCK_S * SECOND, "temperature", width=1) for path in paths]
    first = bags[0]
    for path, bag in zip(paths, bags, strict=True):
        if bag.names != first.names:
            raise BagError(f"{path}: its cubes are not those of {paths[0]}; fit it alone")
        if not bag.counts.any():
            raise BagError(
                f"{path}: its rows state no temperature; record with hubs that measure it"
            )
    found = {}
    for cube in first.cubes:
        base = bags[-1].calibrations[cube]
        rest = bags[-1].rest_frequency[cube, : base.layout.n_pads]
        base = replace(base, thermal=None, rest_frequency=rest)
        parts = [bag.select_cube(cube) for bag in bags]
        seconds, stress, temperature = (np.concatenate(each) for each in zip(*parts, strict=True))
        ends = np.cumsum([len(part[0]) for part in parts])
        rows_per_block = sum(bag.counts[cube].sum() for bag in bags) / max(len(seconds), 1)
        warming = Warming(
            name=f"{paths[0]}: cube {first.names[cube]}",
            seconds=seconds,
            first=(0, *ends[:-1].tolist()),
            temperature=temperature[:, 0],
            stress=stress,
            noise=base.noise.mean() / np.sqrt(max(rows_per_block, 1)),
        )
        found[first.names[cube]] = base, warming
    return found


def fit_thermal(data: Warming) -> ThermalFit:
    """Fit how the elastomer's temperature lags the measured one, and how it affects each pad.

    A quadratic effect is used only where it reduces the residual considerably.

    Raises:
        FitError: The bags are too short, the temperature varies too little, something touched the
            cube, or the bags do not determine the coefficients.
    """
    span = float(np.ptp(data.temperature)) if len(data.temperature) else 0.0
    if len(data.seconds) < MIN_BLOCKS or span < MIN_RANGE:
        raise FitError(
            f"{data.name}: {len(data.seconds)} s in which the temperature varies by {span:.2g} K; "
            f"{MIN_BLOCKS} s and {MIN_RANGE:g} K are needed: record while the skin warms or cools"
        )
    unweighted = _search(data, 1, np.zeros(data.stress.shape[1]))
    slopes = unweighted.model.coefficient[:, 0]
    slope = compute_root_mean_square(slopes)
    best = _search(data, 1, slopes)
    # In `best`, the weight of a block depends on the difference between its temperatures before and
    # after the low-pass filter. If these weights change the slope much, the data do not determine
    # it, and `_check` raises an error.
    change = abs(compute_root_mean_square(best.model.coefficient[:, 0]) / slope - 1)

    curved = _search(data, 2, slopes)
    if curved.misfit < best.misfit + np.log(MAX_DEGREE_RATIO):
        best = curved

    _check(best, slope, change)
    return best


def compute_root_mean_square(values: Array) -> float:
    """Return the root of the mean of the squares of values (...)."""
    return float(np.sqrt((values**2).mean()))


def _search(data: Warming, degree: int, slope: Array) -> ThermalFit:
    """Find the most likely longest time constant (lag) of the filters, and the coefficients.

    Args:
        data: Temperatures and pad stresses, averaged over blocks of 1 s.
        degree: Highest power of the filtered temperature in the fitted stress.
        slope: Linear coefficient of each pad (P,), in Pa/K; 0: not known yet.
    """
    solutions = []
    for longest in LAGS_S:
        lags = longest / LAG_RATIO ** np.arange(N_FILTERS)
        solutions.append(_solve(data, lags, degree, slope))
    return min(solutions, key=lambda solution: solution.misfit)


def _find_lags(data: Warming, lags: Array) -> Array:
    """Return the measured temperature minus that after each of L low-pass filters (N, L), in K.

    At the start of each bag, both temperatures are equal.

    Args:
        data: Averages over N blocks of time.
        lags: Time constants of the filters (L,), in s.
    """
    readings = np.column_stack([data.seconds, data.temperature])
    bags = np.split(readings, data.first[1:])
    parts = [find_lags(bag[:, 0], bag[:, 1:], lags) for bag in bags]
    behind: Array = np.concatenate(parts)[..., 0]
    return behind


def _solve(
    data: Warming,
    lags: Array,
    degree: int,
    slope: Array,
) -> ThermalFit:
    """Fit the stress on each pad as a polynomial in the temperature of the elastomer.

    Args:
        data: Averages over blocks of time.
        lags: Time constants of the low-pass filters (L,), in s, the longest first.
        degree: Degree of the polynomial.
        slope: Linear coefficient of each pad (P,), in Pa/K, for the weights of the blocks; 0: not
            known yet.
    """
    each_behind = _find_lags(data, lags)
    behind = each_behind.mean(axis=1)
    u = data.temperature - data.temperature[0] - behind
    columns = np.column_stack([*(u**d for d in range(degree + 1)), each_behind])
    size = compute_root_mean_square(slope)
    weight = 1 / np.hypot(data.noise, LAG_ERROR * size * behind)
    weighted = columns * weight[:, None]
    normal = weighted.T @ weighted
    # The coefficients of the filters are about as large as the slope a priori.
    of_filters = np.arange(degree + 1, len(normal))
    normal[of_filters, of_filters] += 1 / max(size, 1.0) ** 2

    def fit(stress: Array) -> tuple[Array, Array]:
        """Return coefficients (K, n) and weighted residuals (N, n) of stresses (N, n)."""
        wanted = stress * weight[:, None]
        values = np.linalg.solve(normal, weighted.T @ wanted)
        return values, wanted - weighted @ values

    # The unknown initial difference between elastomer and thermometer is one number for all pads.
    start = np.exp(-data.seconds / lags[0])[:, None]
    values, rest = fit(data.stress)
    start_values, start_rest = fit(start)
    precision = float((start_rest**2).sum() * (slope @ slope)) + 1 / START_KELVIN**2
    difference = float((start_rest.T @ rest @ slope).sum()) / precision
    values = values - difference * start_values * slope
    residual = data.stress - columns @ values - difference * start * slope

    weighted_residual = residual * weight[:, None]
    scatter = np.sqrt((weighted_residual**2).mean(axis=0)).clip(1)
    variance = np.diag(np.linalg.inv(normal))[:, None] * scatter**2
    variance = variance + (start_values * slope) ** 2 / precision
    n_correlated = max(1.0, lags[-1] / BLOCK_S)
    deviation = np.sqrt(n_correlated * variance[1 : degree + 1]).T

    covariance = residual.T @ residual / max(float(behind @ behind), 1e-12)
    variances, directions = np.linalg.eigh(covariance)
    patterns = directions * np.sqrt(np.maximum(variances, 0))
    # `eigh` returns eigenvalues in rising order, so the largest errors come last.
    ramp = patterns[:, ::-1][:, :MAX_LAG_PATTERNS]
    model = ThermalModel(
        reference=np.array(round(float(data.temperature[0]), 3)),
        lag=lags,
        coefficient=values[1 : degree + 1].T,
        deviation=deviation * np.where(values[1] < 0, -1.0, 1.0)[:, None],
        ramp=ramp,
        lagging=values[degree + 1 :].T,
    )
    misfit = np.log(compute_root_mean_square(weighted_residual)) - np.log(weight).mean()
    return ThermalFit(data, model, values[0], u, residual, float(misfit))


def _check(
    fit: ThermalFit,
    slope: float,
    change: float,
) -> None:
    """Raise FitError if the result is too uncertain or a load acted on the cube.

    Args:
        fit: The result.
        slope: Rms of the linear coefficients over the pads, in Pa/K, with equal weights of all
            blocks.
        change: Relative difference between `slope` and the rms with the weights of the fit.
    """
    data = fit.data
    worst = max(compute_root_mean_square(pad) for pad in fit.residual.T)
    stated = fit.compute_sizes()[2]
    size = max(stated / slope, change)
    behind = np.abs(data.temperature - data.temperature[0] - fit.level)
    left = float(behind[-1] / behind.max())
    fix = (
        "let nothing touch the skin, begin with half a minute at rest, warm it quickly, and record "
        "until the skin is warm throughout"
    )
    if size > MAX_SLOPE_DEVIATION or left > MAX_FINAL_LAG:
        raise FitError(
            f"{data.name}: the effect of temperature is known to {100 * size:.0f} %, and "
            f"{100 * left:.0f} % of the largest lag are left at the end; at most "
            f"{100 * MAX_SLOPE_DEVIATION:g} % and {100 * MAX_FINAL_LAG:g} % are usable: {fix}"
        )
    if worst > MAX_RESIDUAL:
        raise FitError(
            f"{data.name}: {worst:.3g} Pa of a pad do not follow the temperature, at most "
            f"{MAX_RESIDUAL:g} Pa are usual: {fix}"
        )
