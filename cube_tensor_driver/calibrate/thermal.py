# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of the effect of temperature on the unloaded pads of a skin, from bags in which it warms.

    v_p(t) = c_p0 + sum_d c_pd u(t)^d + s_p exp(-t / lag_1) + error,    d = 1 ... degree

    v_p    stress on pad p by the pad law at the time t since the beginning of the bag
    T      measured temperature minus the reference temperature
    u      temperature of the elastomer: T after low-pass filters with the time constants lag_1, ...
    c_pd   coefficients of pad p
    s_p    effect of the unknown difference between u and T at the beginning; it is small a priori

Low-pass filters only approximate conduction of heat. This error is mostly larger than the noise,
and grows with T - u. So each block of 1 s has the weight
1 / (noise² + (`LAG_ERROR` × slope × (T - u))²), where slope is the rms of c_p1 over the pads. Times
at which the temperature is nearly constant then determine the coefficients. The time constants
minimise the negative logarithm of the likelihood. A second filter, or a second degree, is used only
if it reduces the residual considerably.

Neighbouring residuals are correlated. So the standard deviations of the coefficients are computed
from sums of residuals over intervals of the length lag_1 (W. K. Newey, K. D. West, Econometrica 55
(1987)). The time constants count as further unknowns of each pad.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..core.arrays import Array
from ..core.calibration import Calibration
from ..core.compensation.models import ThermalModel
from ..core.compensation.thermal import START_KELVIN, filter_weights
from ..core.errors import BagError, FitError
from ..core.oscillator import pad_frequency
from .block_means import BlockMeans, find_lags

BLOCK_NS = 1_000_000_000
"""Duration, in ns, of the blocks whose mean temperatures and pad stresses are fitted."""

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

LAGS_S = np.geomspace(3.0, 1500.0, 26)
"""Time constants of low-pass filters, in s, with which the search for the best time constants of
the elastomer's lag behind the thermometer begins."""

MAX_LAG_STEP = 1.01
"""Ratio of neighbouring time constants of low-pass filters in the search grid at which the search
for the best ones ends. The grid begins with `LAGS_S` and becomes finer around the best ones."""

LAG_ERROR = 0.05
"""Standard deviation of the error of the elastomer's temperature as low-pass filters compute it,
divided by the difference between this temperature and the measured one. The error arises because
filters only approximate conduction of heat."""

MAX_FILTER_RATIO = 0.8
"""Ratio of the rms residual with two low-pass filters to the one with a single filter, below which
two are used to model how the elastomer's temperature lags behind the thermometer."""

MAX_DEGREE_RATIO = 0.3
"""Ratio of the rms residual with a quadratic effect of temperature to that with a linear one, below
which the quadratic one is used.

The ratio can be as small as 0.4 although the effect is linear: conduction of heat, which low-pass
filters only approximate, looks like a quadratic effect while the skin warms once.
"""

MAX_LAG_PATTERNS = 3
"""Maximum number of columns of `ThermalModel.ramp`: errors of the pads' stresses, in Pa per K by
which the elastomer's temperature lags behind the measured one. The columns are the first principal
components of the residuals of the fit."""


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
    """

    data: Warming
    model: ThermalModel
    offset: Array
    level: Array
    residual: Array

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
            root_mean_square(change),
            root_mean_square(self.residual),
            root_mean_square(deviation[:, 0]),
        )

    def make_calibration(self, base: Calibration, source: str) -> Calibration:
        """Return a calibration with the model, and rest frequencies at its reference temperature.

        Args:
            base: Calibration with which the stresses were computed.
            source: Text that states the origin of the values.
        """
        rest = pad_frequency(
            self.offset,
            base.rest_frequency,
            base.beta,
            base.modulus,
        )
        return replace(
            base,
            rest_frequency=rest,
            temperature=None,
            thermal=self.model,
            source=source,
        )


class _Solution(NamedTuple):
    """Solution by weighted least squares for given time constants and degree of the polynomial.

    Attributes:
        lags: Time constants of the low-pass filters, in s, the longest first.
        behind: How far the filtered temperature u lags behind the measured one (N,), in K.
        columns: Design matrix (N, K): 1, u, ..., u^degree, then exp(-t / longest time constant),
            by which the unknown initial difference of elastomer and thermometer decays.
        weight: Square roots of the weights (N,), in 1/Pa.
        values: Fitted coefficient of each column for each pad (K, P).
        residual: Measured minus fitted stresses (N, P), in Pa.
        misfit: Negative logarithm of the likelihood per stress, without constants.
    """

    lags: tuple[float, ...]
    behind: Array
    columns: Array
    weight: Array
    values: Array
    residual: Array
    misfit: float


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
    bags = [BlockMeans(path, name, BLOCK_NS, "temperature", width=1) for path in paths]
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
        base = replace(
            base,
            temperature=None,
            thermal=None,
            rest_frequency=rest,
        )
        parts = [bag.of_cube(cube) for bag in bags]
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
    """Fit the lag of the elastomer and the effect of its temperature on each pad.

    A second low-pass filter and a quadratic effect are used only where they reduce the residual
    considerably.

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
    unweighted = _search(data, 1, 1, 0.0)
    slope = root_mean_square(unweighted.values[1])
    best = _search(data, 1, 1, slope)
    # In `best`, the weight of a block depends on the difference between its temperatures before and
    # after the low-pass filter. If these weights change the slope much, the data do not determine
    # it, and `_check` raises an error.
    change = abs(root_mean_square(best.values[1]) / slope - 1)

    two = _search(data, 2, 1, slope)
    if two.misfit < best.misfit + np.log(MAX_FILTER_RATIO):
        best = two
    curved = _search(data, len(best.lags), 2, slope)
    if curved.misfit < best.misfit + np.log(MAX_DEGREE_RATIO):
        best = curved

    result = _describe(data, best)
    _check(result, slope, change)
    return result


def root_mean_square(values: Array) -> float:
    """Return the root of the mean of the squares of values (...)."""
    return float(np.sqrt((values**2).mean()))


def _search(
    data: Warming,
    n_lags: int,
    degree: int,
    slope: float,
) -> _Solution:
    """Find the most likely time constants (lags) of the low-pass filters, and the coefficients.

    The filters model how the elastomer's temperature lags behind the thermometer. The search begins
    with the grid `LAGS_S`, which is refined around the best solution.

    Args:
        data: Temperatures and pad stresses, averaged over blocks of 1 s.
        n_lags: Number of low-pass filters.
        degree: Highest power of the filtered temperature in the fitted stress.
        slope: Rms of the linear coefficients over the pads, in Pa/K; 0: not known yet.
    """

    def find_best(choices: Iterable[tuple[float, ...]]) -> _Solution:
        behind = _find_lags(data, list(choices))
        solutions = (_solve(data, *choice, degree, slope) for choice in behind.items())
        return min(solutions, key=lambda solution: solution.misfit)

    best = find_best(itertools.combinations(LAGS_S[::-1].tolist(), n_lags))
    step = LAGS_S[1] / LAGS_S[0]
    while step > MAX_LAG_STEP:
        near = itertools.product(*((lag / step, lag, lag * step) for lag in best.lags))
        # Filters with nearly the same lag would have huge weights of opposite signs.
        found = find_best(
            lags for lags in near if all(a > 1.2 * b for a, b in itertools.pairwise(lags))
        )
        if found.misfit < best.misfit - 1e-4:
            best = found
        else:
            step = step**0.5
    return best


def _find_lags(
    data: Warming,
    choices: Sequence[tuple[float, ...]],
) -> dict[tuple[float, ...], Array]:
    """Return the measured temperature minus that after low-pass filters in series (N,), in K.

    At the begin of each bag, both temperatures are equal.

    Args:
        data: Averages over N blocks of time.
        choices: Sets of time constants of the filters, in s. Each is a key of the result.
    """
    times = sorted({lag for lags in choices for lag in lags})
    readings = np.column_stack([data.seconds, data.temperature])
    bags = np.split(readings, data.first[1:])
    parts = [find_lags(bag[:, 0], bag[:, 1:], np.array(times)) for bag in bags]
    single = dict(zip(times, np.concatenate(parts)[..., 0].T, strict=True))
    return {
        lags: filter_weights(np.array(lags)) @ np.array([single[lag] for lag in lags])
        for lags in choices
    }


def _solve(
    data: Warming,
    lags: tuple[float, ...],
    behind: Array,
    degree: int,
    slope: float,
) -> _Solution:
    """Fit the stress on each pad as a polynomial in the temperature of the elastomer.

    Args:
        data: Averages over blocks of time.
        lags: Time constants, in s, of the low-pass filters that compute the temperature of the
            elastomer, the longest first.
        behind: Measured temperature minus temperature of the elastomer (N,), in K.
        degree: Degree of the polynomial.
        slope: Rms of the linear coefficients over the pads, in Pa/K, for the weights of the blocks;
            0: not known yet.
    """
    u = data.temperature - data.temperature[0] - behind
    start = np.exp(-data.seconds / lags[0])
    columns = np.column_stack([*(u**d for d in range(degree + 1)), start])
    weight = 1 / np.hypot(data.noise, LAG_ERROR * slope * behind)
    weighted = columns * weight[:, None]
    normal = weighted.T @ weighted
    # The prior of the last unknown states that, at the start, the temperature of the elastomer
    # differs from the measured one by about 1 K.
    start_deviation = START_KELVIN * max(slope, 1.0)
    normal[-1, -1] += 1 / start_deviation**2
    values = np.linalg.solve(normal, weighted.T @ (data.stress * weight[:, None]))
    residual = data.stress - columns @ values
    size = root_mean_square(residual * weight[:, None])
    misfit = np.log(size) - np.log(weight).mean()
    return _Solution(
        lags,
        behind,
        columns,
        weight,
        values,
        residual,
        float(misfit),
    )


def _describe(data: Warming, best: _Solution) -> ThermalFit:
    """Return the result of the fit, with the standard deviations of the coefficients.

    Args:
        data: Temperatures and pad stresses, averaged over blocks of 1 s.
        best: Solution with the most likely time constants of the low-pass filters.
    """
    lags, behind, columns, weight, values, residual, _ = best
    covariance = residual.T @ residual / max(float(behind @ behind), 1e-12)
    variances, directions = np.linalg.eigh(covariance)
    patterns = directions * np.sqrt(np.maximum(variances, 0))
    # `eigh` returns eigenvalues in rising order, so the largest errors come last.
    ramp = patterns[:, ::-1][:, :MAX_LAG_PATTERNS]

    # The lags are uncertain, too. Each counts as one more unknown, whose column is the derivative
    # of the filtered temperature with respect to the logarithm of the lag.
    moved = [(*lags[:n], 1.05 * lag, *lags[n + 1 :]) for n, lag in enumerate(lags)]
    shifts = [(behind - other) / 0.05 for other in _find_lags(data, moved).values()]
    weighted = np.column_stack([columns, *shifts]) * weight[:, None]
    inverse = np.linalg.pinv(weighted.T @ weighted)
    block = (data.seconds // lags[0]).astype(int)
    starts = np.flatnonzero(np.diff(block, prepend=-1))
    scores = weighted[:, :, None] * (residual * weight[:, None])[:, None]
    spread = inverse @ np.add.reduceat(scores, starts, axis=0)
    size = np.sqrt((spread**2).sum(axis=0))

    degrees = slice(1, columns.shape[1] - 1)
    sign = np.where(ramp[:, :1] < 0, -1.0, 1.0)
    model = ThermalModel(
        reference=np.array(round(float(data.temperature[0]), 3)),
        lag=np.array(lags),
        coefficient=values[degrees].T,
        deviation=size[degrees].T * sign,
        ramp=ramp,
    )
    return ThermalFit(data, model, values[0], columns[:, 1], residual)


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
    data, model = fit.data, fit.model
    worst = max(root_mean_square(pad) for pad in fit.residual.T)
    stated = fit.compute_sizes()[2]
    size = max(stated / slope, change)
    fix = (
        "let nothing touch the skin, begin with half a minute at rest, warm it quickly, and record "
        "until the skin is warm throughout"
    )
    if size > MAX_SLOPE_DEVIATION or model.lag[0] >= np.ptp(data.seconds):
        raise FitError(
            f"{data.name}: the effect of temperature is known to {100 * size:.0f} % with a lag of "
            f"{model.lag[0]:.3g} s; at most {100 * MAX_SLOPE_DEVIATION:g} % are usable: {fix}"
        )
    if worst > MAX_RESIDUAL:
        raise FitError(
            f"{data.name}: {worst:.3g} Pa of a pad do not follow the temperature, at most "
            f"{MAX_RESIDUAL:g} Pa are usual: {fix}"
        )
