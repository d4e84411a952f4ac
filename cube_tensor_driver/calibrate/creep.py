# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Identification of creep: the viscoelastic law of each pad from one press that is held.

The stress of a pad is s = u - sum_k a_k r_k. u is the reading of the pad, and the memories r_k are
readings that were low-passed with the relaxation times tau_k (`core/compensation/creep.py`). While
a load is held, s is constant but unknown, and after it s = 0. So s and the amplitudes a_k follow
from linear least squares. How fast the load was applied does not matter, because the memories are
computed from the measured readings.

The longest relaxation times exceed the duration of the hold, so the readings do not determine their
amplitudes. If creep grows as a power of time, the amplitudes grow by a constant factor q from one
relaxation time to the next. To extrapolate this growth, weighted squares of the second differences
a_k+1 - 2 q a_k + q² a_k-1 are added to the sum of squares. A first fit with q = 1 yields q.

The uncertainty of the amplitudes is computed for the creep under a load that lasts `FORECAST` times
as long as the hold.

Source: J. D. Ferry, Viscoelastic Properties of Polymers (1980), 4.A and 11.F.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..bags.source import open_bag
from ..core.arrays import Array
from ..core.calibration import Calibration
from ..core.compensation.low_pass import compute_relaxed_share
from ..core.compensation.models import CreepModel
from ..core.errors import FitError
from ..messages.codec import SECOND
from .block_means import find_lags
from .fit import compute_measured_stress
from .recorded_loads import average_neighbours, find_cube, read_samples

TIMES_PER_DECADE = 2.0
"""Number of relaxation times of the creep law per decade (factor 10 of time). With only 1.5, a sum
of exponentials differs from creep by a power of time by 0.4 % of the load after an hour."""

SHORTEST_TIME_S = 0.1
"""Shortest relaxation time of the creep law, in s. Creep that is faster than this counts as part of
the immediate response of a pad to a load."""

REACH = 60.0
"""Smallest ratio of the longest relaxation time of the creep law to the duration for which the load
was held. The law is then also usable for loads that last much longer than the hold."""

FORECAST = 6.0
"""Duration of a future load for which the uncertainty of the creep law is computed, divided by the
duration for which the load was held: an hour for a hold of ten minutes."""

READING_ERROR = 1e-4
"""Standard deviation of an averaged stress reading in addition to noise, divided by the load. It is
the rms error with which a sum of exponentials describes real creep."""

MAX_MISFIT = 5e-3
"""Largest error of the creep law (rms difference between the measured and the computed stress
readings of the pads), divided by the load. With a larger one the fit raises an error, because the
load was probably not held constant."""

FIRST_BEND = 0.15
"""Standard deviation that the first fit assumes for second differences of the creep law's
amplitudes at successive relaxation times, divided by the mean amplitude.

The assumption makes the amplitudes a smooth sequence. If creep grows as a power of time, with an
exponent of 0.1 to 0.4, the second differences are 0.03 to 0.7 of the mean amplitude.
"""

BEND = 0.05
"""Standard deviation that the second fit assumes for a_k+1 - 2 q a_k + q² a_k-1, where a_k are the
amplitudes of the creep law at successive relaxation times, divided by the mean amplitude.

The first fit determines the factor q by which the amplitudes grow from one relaxation time to the
next. With exactly this growth the expression is 0, so its deviation is assumed to be smaller than
that of the second differences of the first fit (`FIRST_BEND`), for which q = 1.
"""

FAST_ERROR = 0.02
"""Relative standard deviation of the amplitude at the shortest relaxation time of the creep law.
This amplitude also stands for faster creep, which a recording does not show."""

REST_S = 2.0
"""Duration at the start of a recording, in s, in which the cube must be unloaded. The mean stress
readings of the pads in it are subtracted from all readings."""

SETTLE_S = 1.0
"""Time, in s, after half of the load is reached, in which the load must become constant. Stress
readings within this time are not fitted, nor are those within the same time before and after the
end of the load."""

MIN_HOLD_S = 60.0
"""Shortest duration, in s, for which the load must be held constant to determine creep. If it was
held for a shorter time, the fit raises an error."""

MIN_LOAD_RATIO = 100.0
"""Smallest load of a pad, divided by the noise of its readings, with which creep is determined. If
the load of any pad is smaller, the fit raises an error."""

BLOCKS_PER_E_FOLD = 12
"""Number of averaged stress readings that are fitted for each growth of the time since the press by
the factor e (2.718). Averages over logarithmic intervals suffice, because creep slows down."""

GAIN_TIME_S = 1.0
"""Time, in s, from the start of a load to the measurement of the pads' readings in a calibration of
gains (sensitivities of the pads)."""

MAX_RATE_HZ = 50.0
"""Largest rate, in Hz, of the averaged stress readings of the pads from which creep is fitted. The
computing time of the fit grows with the rate."""


class CreepFit(NamedTuple):
    """The law of creep that a recording determines.

    Attributes:
        model: The law.
        load: Mean reading of each pad while the load was held (P,), in Pa.
        hold_s: Duration for which the load was held, in s.
        misfit: Rms difference between measured and computed readings, divided by the load.
        seconds: Times of averaged readings since the start of the load (N,), in s.
        before: Measured creep (N, P), in Pa: averaged readings minus the first one under the load;
            after the load, the averaged readings themselves.
        after: Creep that the law does not explain (N, P), in Pa: averaged minus computed readings.
    """

    model: CreepModel
    load: Array
    hold_s: float
    misfit: float
    seconds: Array
    before: Array
    after: Array


class _Hold(NamedTuple):
    """Readings of the pads under a load that is held, and after it, averaged over N blocks of time.

    Attributes:
        time: Time since the start of the load (N,), in s.
        is_loaded: 1 under the load, 0 after it (N,).
        n_readings: Number of readings in each block (N,).
        reading: Readings of the pads (N, P), in Pa.
        memory: Low-passed readings (N, K, P), in Pa, for K relaxation times.
    """

    time: Array
    is_loaded: Array
    n_readings: Array
    reading: Array
    memory: Array


def fit_recorded_creep(
    path: Path,
    name: str | None,
) -> tuple[CreepFit, Calibration]:
    """Fit the law of creep of a cube to a bag with one press that is held.

    Args:
        path: Path of the bag.
        name: Name of the cube; None: the only one.

    Returns:
        The fit, without dummy pads; and the recorded calibration with the law, and with gains from
        which the creep that they contain is removed.

    Raises:
        BagError: There is no such bag or cube.
        FitError: The bag has no such press, or does not determine the law.
    """
    with open_bag(path) as source:
        number = find_cube(source, path, name)
        settings = source.recording.settings[0]
        calibration = settings.calibrations[number]
        n_pads = calibration.layout.n_pads
        stamp_ns, frequency, temperature = read_samples(
            source,
            number,
            n_pads,
        )
    rest = settings.rest_frequency[number, :n_pads]
    current = replace(calibration, rest_frequency=rest)

    is_complete = np.isfinite(frequency).all(axis=1)
    stamp_ns = stamp_ns[is_complete]
    known = temperature[is_complete] if np.isfinite(temperature).all() else None
    reading = compute_measured_stress(current, frequency[is_complete], known)
    seconds = (stamp_ns - stamp_ns[:1]) / SECOND
    is_loaded = ~calibration.layout.is_dummy
    pads = tuple(itertools.compress(calibration.layout.pads, is_loaded))
    result = fit_creep(
        seconds,
        reading[:, is_loaded],
        calibration.noise[is_loaded],
        pads,
    )
    origin = f"{calibration.source}; creep fitted to {path.name}"
    # The amplitudes of dummy pads are 0.
    to_all = np.eye(n_pads)[:, is_loaded]
    model = replace(
        result.model,
        amplitude=to_all @ result.model.amplitude,
        deviation=to_all @ np.asarray(result.model.deviation),
    )
    fitted = add_creep(calibration, model)
    return result, replace(fitted, source=origin)


def fit_creep(
    seconds: Array,
    reading: Array,
    noise: Array,
    names: tuple[str, ...],
) -> CreepFit:
    """Fit the law of creep to a recording of one press that is held.

    Args:
        seconds: Times (N,), in s.
        reading: Stresses by the pad law (N, P), in Pa.
        noise: Standard deviation of a reading of each pad (P,), in Pa.
        names: Names of the pads, for messages.

    Raises:
        FitError: The recording has no such press, or does not determine the law.
    """
    duration_s = max(np.ptp(seconds), 1e-9)
    rate_hz = len(seconds) / duration_s
    size = max(1, round(rate_hz / MAX_RATE_HZ))
    seconds = average_neighbours(seconds, size)
    reading = average_neighbours(reading, size)
    is_rest = seconds < seconds[0] + REST_S
    reading = reading - reading[is_rest].mean(axis=0)

    press, release = _find_hold(seconds, reading)
    hold_s = release - press
    decades = np.log10(REACH * hold_s / SHORTEST_TIME_S)
    n_times = 1 + int(np.ceil(TIMES_PER_DECADE * decades))
    time = SHORTEST_TIME_S * 10 ** (np.arange(n_times) / TIMES_PER_DECADE)
    means = _average(seconds, reading, time, press, release)
    means = means._replace(n_readings=size * means.n_readings)
    load = means.reading[means.is_loaded > 0].mean(axis=0)
    needed = MIN_LOAD_RATIO * noise
    is_weak = np.abs(load) < needed
    for pad in np.flatnonzero(is_weak).tolist():
        raise FitError(
            f"creep: pad {names[pad]} got {load[pad]:.0f} Pa, needed are {needed[pad]:.0f} Pa; "
            "press harder, so that every pad is loaded"
        )

    forecast = compute_relaxed_share(FORECAST * hold_s / time)
    first, _, _ = _solve(means, load, noise, forecast, 1.0, FIRST_BEND)
    # The recording determines well only the amplitudes whose relaxation time lies between the time
    # of the first fitted reading and a third of the load's duration.
    is_known = (time > SETTLE_S) & (time < hold_s / 3)
    known = first[:, is_known]
    shorter, longer = known[:, :-1], known[:, 1:]
    growth = float((longer * shorter).sum() / (shorter**2).sum())
    amplitude, error, change = _solve(
        means,
        load,
        noise,
        forecast,
        growth,
        BEND,
    )
    misfit = float(np.sqrt(np.mean((error / load) ** 2)))
    total = amplitude.sum(axis=1).max()
    if misfit > MAX_MISFIT or total >= 1:
        raise FitError(
            f"creep: a held load would creep by {100 * total:.3g} % of the stress, and its law "
            f"fits to {100 * misfit:.2g} % ({100 * MAX_MISFIT:g} % allowed); press within "
            f"{SETTLE_S:g} s, and hold a constant load, such as a dead weight"
        )

    # The low-pass filter with the shortest relaxation time hardly changes the readings. So an error
    # of its amplitude changes all computed stresses by the same fraction.
    fast = np.zeros_like(amplitude)
    fast_error = FAST_ERROR * amplitude[:, 0]
    fast[:, 0] = np.hypot(misfit, fast_error)
    deviation = np.array([fast, change])
    first_reading = np.outer(means.is_loaded, means.reading[0])
    return CreepFit(
        model=CreepModel(time, amplitude, deviation),
        load=load,
        hold_s=hold_s,
        misfit=misfit,
        seconds=means.time,
        before=means.reading - first_reading,
        after=error,
    )


def compute_step_reading(model: CreepModel, seconds: float) -> Array:
    """Return the readings of the pads (P,) some time after the stress has risen from 0 to 1.

    Args:
        model: The law of creep.
        seconds: Time after the rise, in s.
    """
    # With the reading u = 1 + a r, the memories r obey the linear equation tau dr/dt = 1 + a r - r,
    # whose solution follows from its eigenvalues.
    n_times = len(model.time)
    system = (model.amplitude[:, None] - np.eye(n_times)) / model.time[:, None]
    values, vectors = np.linalg.eig(system)
    drive = np.linalg.solve(vectors, 1 / np.tile(model.time[:, None], (len(values), 1, 1)))
    grown = np.expm1(values * seconds) / values
    memory = vectors @ (grown[..., None] * drive)
    reading: Array = 1 + (model.amplitude[:, None] @ memory)[:, 0, 0].real
    return reading


def add_creep(calibration: Calibration, model: CreepModel) -> Calibration:
    """Return a calibration with a law of creep, and with gains reduced by the creep they contain.

    The gains (sensitivities of the pads) were measured `GAIN_TIME_S` after the start of a load, so
    they contain the creep until then. The compensation removes creep from the readings, so it must
    be removed from the gains, too.

    Args:
        calibration: Calibration of the recording; it may have an older law of creep.
        model: The new law.
    """
    gain = calibration.gain / compute_step_reading(model, GAIN_TIME_S)
    if calibration.creep is not None:
        gain = gain * compute_step_reading(calibration.creep, GAIN_TIME_S)
    return replace(calibration, creep=model, gain=gain)


def _find_hold(seconds: Array, reading: Array) -> tuple[float, float]:
    """Return the times at which the load began and ended, in s.

    Raises:
        FitError: There is no load, more than one, or one that was held too briefly or was not
            preceded by enough time without load.
    """
    total = np.abs(reading).sum(axis=1)
    is_loaded = total > 0.5 * np.quantile(total, 0.95)
    loaded = np.flatnonzero(is_loaded)
    begin, end = loaded[[0, -1]]
    press = float(seconds[begin])
    release = float(seconds[end])
    rest_s = press - seconds[0]
    if rest_s < REST_S:
        raise FitError(
            f"creep: the load begins {rest_s:.2g} s after the recording; record "
            f"{REST_S:g} s or more without load first"
        )
    if not is_loaded[begin:end].all():
        raise FitError("creep: the load came and went; press once, and hold it")
    if release - press < MIN_HOLD_S:
        raise FitError(
            f"creep: the load was held for {release - press:.3g} s; hold it for {MIN_HOLD_S:g} s "
            "or more, for loads of an hour 9 minutes"
        )
    return press, release


def _average(
    seconds: Array,
    reading: Array,
    time: Array,
    press: float,
    release: float,
) -> _Hold:
    """Average readings over blocks, whose length grows with the time since the load changed.

    Readings within `SETTLE_S` of a change of the load are in no block.

    Args:
        seconds: Times of the readings (S,), in s.
        reading: Readings of the pads (S, P), in Pa, of which the first is without load.
        time: Relaxation times of the law (K,), in s.
        press: Time at which the load began, in s.
        release: Time at which it ended, in s.
    """
    is_after = seconds > release
    elapsed = seconds - np.where(is_after, release, press)
    is_ending = ~is_after & (seconds >= release - SETTLE_S)
    chosen = np.flatnonzero((elapsed > SETTLE_S) & ~is_ending)
    place = np.floor(BLOCKS_PER_E_FOLD * np.log(elapsed[chosen]))
    starts = np.flatnonzero(np.diff(place, prepend=-1))
    n_readings = np.diff(starts, append=len(chosen))

    def average(values: Array) -> Array:
        """Return the means of values (S, ...) over the blocks (N, ...)."""
        sums = np.add.reduceat(values[chosen], starts, axis=0)
        means: Array = (sums.T / n_readings).T
        return means

    memory = reading[:, None] - find_lags(seconds, reading, time)
    return _Hold(
        time=average(seconds) - press,
        is_loaded=np.where(is_after[chosen[starts]], 0.0, 1.0),
        n_readings=n_readings,
        reading=average(reading),
        memory=average(memory),
    )


def _solve(
    means: _Hold,
    load: Array,
    noise: Array,
    forecast: Array,
    growth: float,
    bend: float,
) -> tuple[Array, Array, Array]:
    """Fit the amplitudes of the creep law to averaged readings by regularised least squares.

    The regularisation makes the amplitudes a_k of successive relaxation times a smooth sequence.

    Args:
        means: Averages of the readings over N blocks of time.
        load: Mean reading of each pad under the load (P,), in Pa.
        noise: Standard deviation of a reading of each pad (P,), in Pa.
        forecast: Low-passed readings (K,) at the end of a long load with a constant reading of 1.
        growth: Expected ratio q of an amplitude to that of the next shorter relaxation time.
        bend: Expected standard deviation of the differences a_k+1 - 2 q a_k + q² a_k-1, divided by
            the mean amplitude.

    Returns:
        Amplitudes of each pad (P, K); measured minus computed averages of the readings (N, P), in
        Pa; and the uncertainty of the amplitudes as a change of them (P, K), which changes the
        predicted creep under a long load by the standard deviation of this prediction.
    """
    n_times = means.memory.shape[1]
    held = means.reading[means.is_loaded > 0]
    # Only amplitudes whose relaxation time is shorter than the duration of the load contribute to
    # the creep under it. They are about half of all amplitudes, and their sum is the creep.
    creep = np.abs(held[-1] / held[0] - 1).mean()
    mean_amplitude = 2 * creep / n_times
    identity = np.eye(n_times)
    steps = identity[1:] - growth * identity[:-1]
    bends = steps[1:] - growth * steps[:-1]
    rows = np.concatenate([steps[:1], bends]) / (bend * mean_amplitude + 1e-9)
    # The first column stands for the stress under the load, which the regularisation leaves free.
    smooth = np.pad(rows, [(0, 0), (1, 0)])

    error = np.empty_like(means.reading)
    amplitude, change = np.empty((2, len(load), n_times))
    for pad, pad_load in enumerate(load):
        reading = means.reading[:, pad]
        mean_noise = noise[pad] / np.sqrt(means.n_readings)
        deviation = np.hypot(mean_noise, READING_ERROR * pad_load)
        # The unknowns are the constant stress under the load, then the amplitudes.
        columns = np.column_stack([means.is_loaded, means.memory[..., pad]])
        system = np.concatenate([columns / deviation[:, None], smooth])
        right = np.pad(reading / deviation, (0, len(smooth)))
        solution, *_ = np.linalg.lstsq(system, right, rcond=None)
        amplitude[pad] = solution[1:]
        error[:, pad] = reading - columns @ solution
        # The creep at the end of a long load is predicted. Its gradient g with respect to the
        # amplitudes is `forecast`, and C is the covariance of the amplitudes. A change of them by
        # C g / sqrt(g' C g) changes the prediction by one standard deviation. The stress under the
        # load counts as known, because the calibration of gains determines it.
        of_amplitudes = system[:, 1:]
        spread = np.linalg.solve(of_amplitudes.T @ of_amplitudes, forecast)
        change[pad] = spread / np.sqrt(forecast @ spread)
    return amplitude, error, change
