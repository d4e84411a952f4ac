# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of what temperature does to unloaded pads in place, from bags in which the skin warms.

    v_p(t) = c_p0 + sum_d c_pd u(t)^d + s_p exp(-t / lag_1) + error,    d = 1 ... degree
    u      measured temperature minus the reference, after low-pass filters with the lags

The term with s_p is what the elastomer still remembers from before the bag; it is small a priori.
Heat is no low-pass filter, so the error is mostly that of the filters and grows with the lag
T - u. Blocks of a second therefore count with the weight 1 / (noise² + (share × slope × lag)²),
which makes the quiet times decide on the coefficients. The lags minimise the negative logarithm of
the likelihood. A second filter, or a second degree, must earn its place.

Deviations follow from the residuals themselves, summed over blocks as long as the memory of the
elastomer, because neighbouring residuals are alike (W. K. Newey, K. D. West, Econometrica 55
(1987)); the lags count as unknown for each pad.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..bags.source import open_bag
from ..core.arrays import Array
from ..core.calibration import Calibration
from ..core.compensation.models import ThermalModel
from ..core.compensation.thermal import START_KELVIN, filter_weights
from ..core.errors import BagError, FitError
from ..core.oscillator import pad_frequency
from ..core.pipeline import Pipeline

BLOCK_NS = 1_000_000_000
"""Duration, in ns, of the blocks whose mean temperatures and pad stresses are fitted."""

MIN_BLOCKS = 120
"""Smallest number of blocks with data in all bags together."""

MIN_RANGE = 3.0
"""Smallest range of the temperature, in K: below, noise and creep would be taken for its effect."""

MAX_RESIDUAL = 150.0
"""Largest residual of a pad (quadratic mean), in Pa, with which nothing seems to have touched."""

MAX_SLOPE_DEVIATION = 0.2
"""Largest deviation of the coefficients, relative to their quadratic mean over the pads."""

LAGS_S = np.geomspace(3.0, 1500.0, 26)
"""Time constants, in s, among which the search for the best lags begins."""

MAX_LAG_STEP = 1.01
"""Ratio of two lags in the search at which it ends."""

LAG_ERROR = 0.05
"""Error of the filters as a share of the lag, with which residuals are weighted."""

MAX_FILTER_RATIO = 0.8
"""Largest ratio of the residuals with and without a second filter with which the data demand it."""

MAX_DEGREE_RATIO = 0.3
"""Largest ratio of the residuals with and without a second degree with which the data demand it.

While the skin warms once, the conduction of heat, which is no low-pass filter, looks like a
curvature: without any, the ratio is 0.4.
"""

MAX_LAG_PATTERNS = 3
"""Number of patterns of the pads that describe how residuals grow with the lag."""


@dataclass(frozen=True, eq=False)
class Warming:
    """Means of N blocks of an unloaded cube with P pads.

    Attributes:
        name: Bag and cube, for messages.
        seconds: Times of the blocks (N,), in s since the beginning of their bag.
        first: Number of the first block of each bag.
        temperature: Measured temperatures (N,), in °C.
        stress: Stresses on the pads by the pad law (N, P), in Pa.
        noise: Standard deviation of a pad's mean stress, in Pa.
    """

    name: str
    seconds: Array
    first: tuple[int, ...]
    temperature: Array
    stress: Array
    noise: float


@dataclass(frozen=True, eq=False)
class ThermalFit:
    """Result of the fit for one cube.

    Attributes:
        data: What it was fitted to.
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

    def sizes(self) -> tuple[float, float, float]:
        """Return quadratic means over the pads: stress without the load before and after the
        compensation, in Pa, and deviation of the linear coefficient, in Pa/K."""
        deviation = np.zeros(1) if self.model.deviation is None else self.model.deviation[:, 0]
        changes = self.data.stress - self.offset, self.residual, deviation
        before, after, slope = (float(np.sqrt((values**2).mean())) for values in changes)
        return before, after, slope

    def calibration(self, base: Calibration, source: str) -> Calibration:
        """Return a calibration with the model, whose rest frequencies hold at the reference."""
        rest = pad_frequency(self.offset, base.rest_frequency, base.beta, base.modulus)
        return replace(
            base, rest_frequency=rest, temperature=None, thermal=self.model, source=source
        )


@dataclass(frozen=True, eq=False)
class _Solution:
    """Weighted least squares for given lags and degree.

    Attributes:
        lags, degree: Time constants in s, and highest power of u.
        columns: Columns (N, K) of the design: 1, u, ..., u^degree, start.
        weight: Square roots of the weights (N,).
        values: Coefficients (K, P).
        misfit: Logarithm of the residual that is typical with these weights.
    """

    lags: tuple[float, ...]
    degree: int
    columns: Array
    weight: Array
    values: Array
    misfit: float


def read_warming(paths: Sequence[Path], name: str | None) -> dict[str, tuple[Calibration, Warming]]:
    """Read bags of an unloaded skin while its temperature changes.

    Args:
        paths: Bags of one skin, between which no tare was made.
        name: Name of the cube; None: all.

    Returns:
        Calibration with the rest frequencies in use, and the means, by the name of the cube.

    Raises:
        BagError: A bag has no such cube or states no temperature, or the bags differ.
    """
    parts: list[tuple[Array, Array]] = []
    names: list[str] = []
    for path in paths:
        with open_bag(path) as source:
            if names and names != list(source.skin.names):
                raise BagError(f"{path}: its cubes are not those of {paths[0]}; fit it alone")
            names = list(source.skin.names)
            if name is not None and name not in names:
                raise BagError(f"{path}: no cube {name!r}; its cubes are {', '.join(names[:20])}")
            settings = source.recording.settings[-1]
            pads = [one.layout.n_pads for one in settings.calibrations]
            calibrations = [
                replace(one, temperature=None, thermal=None, rest_frequency=rest[:n])
                for one, rest, n in zip(
                    settings.calibrations, settings.rest_frequency, pads, strict=True
                )
            ]
            pipeline = Pipeline(calibrations)
            n_blocks = (source.bag.end_ns - source.bag.start_ns) // BLOCK_NS + 1
            sums = np.zeros((len(names), n_blocks, pipeline.n_pads + 2))
            for rows in source:
                stress = np.nan_to_num(pipeline.pad_stress(rows, rows.pad_fault & np.uint32(0)))
                ones = np.ones((len(rows), 1))
                values = np.hstack([stress, rows.temperature[:, None], ones])
                block = (rows.stamp_ns - source.bag.start_ns) // BLOCK_NS
                is_used = np.isfinite(rows.temperature) & (block >= 0) & (block < n_blocks)
                np.add.at(sums, (rows.cube[is_used], block[is_used]), values[is_used])
            if not sums[..., -1].any():
                raise BagError(
                    f"{path}: its rows state no temperature; record with hubs that measure it"
                )
            parts.append((sums, np.arange(float(n_blocks)) * (BLOCK_NS * 1e-9)))
    found = {}
    for cube, cube_name in enumerate(names):
        if name is None or name == cube_name:
            warming = _join(parts, cube, calibrations[cube], f"{paths[0]}: cube {cube_name}")
            found[cube_name] = calibrations[cube], warming
    return found


def _join(
    parts: Sequence[tuple[Array, Array]], cube: int, calibration: Calibration, name: str
) -> Warming:
    """Return the means of one cube from sums (cubes, blocks, P + 2) of each bag."""
    columns: list[Array] = []
    first: list[int] = []
    n_rows = 0.0
    for sums, seconds in parts:
        has_rows = np.flatnonzero(sums[cube, :, -1])
        counts = sums[cube, has_rows, -1:]
        first.append(sum(len(one) for one in columns))
        columns.append(np.hstack([seconds[has_rows, None], sums[cube, has_rows, :-1] / counts]))
        n_rows += float(counts.sum())
    table = np.concatenate(columns)
    n_pads = calibration.layout.n_pads
    noise = calibration.noise.mean() / np.sqrt(max(n_rows / max(len(table), 1), 1))
    return Warming(name, table[:, 0], tuple(first), table[:, -1], table[:, 1 : 1 + n_pads], noise)


def fit_thermal(data: Warming) -> ThermalFit:
    """Fit lags and coefficients, with the number of filters and the degree that the data demand.

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
    best = _search(data, 1, 1, 0.0)
    slope = float(np.sqrt((best.values[1] ** 2).mean()))
    best = _search(data, 1, 1, slope)
    # Where the weights decide on the result, the data do not.
    change = abs(float(np.sqrt((best.values[1] ** 2).mean())) / slope - 1)
    two = _search(data, 2, 1, slope)
    if two.misfit < best.misfit + np.log(MAX_FILTER_RATIO):
        best = two
    curved = _search(data, len(best.lags), 2, slope)
    if curved.misfit < best.misfit + np.log(MAX_DEGREE_RATIO):
        best = curved
    result = _describe(data, best, slope)
    _check(result, slope, change)
    return result


def _search(data: Warming, n_lags: int, degree: int, slope: float) -> _Solution:
    """Return the solution with the best lags, from a grid that becomes finer around the best."""
    grid = list(itertools.combinations(LAGS_S[::-1].tolist(), n_lags))
    best = min((_solve(data, lags, degree, slope) for lags in grid), key=_misfit)
    step = LAGS_S[1] / LAGS_S[0]
    while step > MAX_LAG_STEP:
        factors = itertools.product((1 / step, 1.0, step), repeat=n_lags)
        near = [tuple(f * lag for f, lag in zip(each, best.lags, strict=True)) for each in factors]
        # Filters with nearly the same lag would have huge weights of opposite signs.
        distinct = [lags for lags in near if all(a > 1.2 * b for a, b in itertools.pairwise(lags))]
        found = min((_solve(data, lags, degree, slope) for lags in distinct), key=_misfit)
        if found.misfit < best.misfit - 1e-4:
            best = found
        else:
            step = step**0.5
    return best


def _misfit(solution: _Solution) -> float:
    return solution.misfit


def _filter(data: Warming, lags: tuple[float, ...]) -> Array:
    """Return the temperature (N,) after low-pass filters in a row, which start at rest."""
    total = np.zeros(len(data.seconds))
    bounds = [*data.first, len(data.seconds)]
    for lag, weight in zip(lags, filter_weights(np.array(lags)), strict=True):
        for begin, end in itertools.pairwise(bounds):
            measured = data.temperature[begin:end]
            steps = np.diff(data.seconds[begin:end]) / lag
            decay, mean = np.exp(-steps), -np.expm1(-steps) / steps
            x = total_x = measured[0]
            filtered = [total_x]
            for n, (before, now) in enumerate(itertools.pairwise(measured.tolist())):
                x = now + (x - before) * decay[n] - (now - before) * mean[n]
                filtered.append(x)
            total[begin:end] += weight * np.array(filtered)
    return total


def _solve(data: Warming, lags: tuple[float, ...], degree: int, slope: float) -> _Solution:
    """Solve for the coefficients.

    Args:
        data: Means of the blocks.
        lags: Time constants, in s, the longest first.
        degree: Highest power of the temperature.
        slope: Quadratic mean of the coefficients over the pads, in Pa/K; 0: not known yet.
    """
    filtered = _filter(data, lags)
    u = filtered - data.temperature[0]
    start = np.exp(-data.seconds / lags[0])
    powers = [u**d for d in range(degree + 1)]
    columns = np.column_stack([*powers, start])
    variance = data.noise**2 + (LAG_ERROR * slope * (data.temperature - filtered)) ** 2
    weight = 1 / np.sqrt(variance)
    weighted = columns * weight[:, None]
    normal = weighted.T @ weighted
    # The start differs from rest by about 1 K.
    normal[-1, -1] += 1 / (START_KELVIN * max(slope, 1.0)) ** 2
    values = np.linalg.solve(normal, weighted.T @ (data.stress * weight[:, None]))
    residual = (data.stress - columns @ values) * weight[:, None]
    misfit = 0.5 * np.log((residual**2).mean()) - np.log(weight).mean()
    return _Solution(lags, degree, columns, weight, values, float(misfit))


def _describe(data: Warming, best: _Solution, slope: float) -> ThermalFit:
    """Return the model of a solution, with its deviations."""
    degrees = slice(1, 1 + best.degree)
    residual = data.stress - best.columns @ best.values
    level = best.columns[:, 1]
    behind = data.temperature - data.temperature[0] - level
    covariance = residual.T @ residual / max(float((behind**2).sum()), 1e-12)
    sizes, patterns = np.linalg.eigh(covariance)
    ramp = (patterns * np.sqrt(np.maximum(sizes, 0)))[:, ::-1][:, :MAX_LAG_PATTERNS]

    # A small change of each lag moves the temperature; this counts as one more unknown.
    moved = []
    for number, lag in enumerate(best.lags):
        changed = list(best.lags)
        changed[number] = 1.05 * lag
        moved.append((_filter(data, tuple(changed)) - data.temperature[0] - level) / 0.05)
    columns = np.column_stack([best.columns, *moved])
    weighted = columns * best.weight[:, None]
    inverse = np.linalg.pinv(weighted.T @ weighted)
    block = (data.seconds // best.lags[0]).astype(int)
    starts = np.flatnonzero(np.diff(block, prepend=-1))
    scores = weighted[:, :, None] * (residual * best.weight[:, None])[:, None]
    summed = np.add.reduceat(scores, starts, axis=0)
    spread = np.einsum("kl,blp->bkp", inverse, summed)
    sign = np.sign(ramp[:, :1]) + (ramp[:, :1] == 0)
    deviation = np.sqrt((spread**2).sum(axis=0)[degrees]).T * sign
    model = ThermalModel(
        np.array(round(float(data.temperature[0]), 3)),
        np.array(best.lags),
        best.values[degrees].T,
        deviation,
        ramp,
    )
    return ThermalFit(data, model, best.values[0], level, residual)


def _check(fit: ThermalFit, slope: float, change: float) -> None:
    """Raise FitError where a result cannot be trusted.

    Args:
        fit: The result.
        slope: Quadratic mean of the coefficients over the pads, in Pa/K.
        change: Relative difference of this mean with equal weights of all blocks.
    """
    data, model = fit.data, fit.model
    worst = float(np.sqrt((fit.residual**2).mean(axis=0)).max())
    deviation = model.deviation
    stated = 0.0 if deviation is None else float(np.sqrt((deviation[:, 0] ** 2).mean()))
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
