# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Identification of creep: the viscoelastic law of each pad from one press that is held.

The stress of a pad is s = u - sum_k a_k r_k with its reading u and memories r_k, which are readings
low-passed with relaxation times tau_k (`core/compensation/creep.py`). While a load is held, s is
constant but unknown, and after it s = 0. So s and the amplitudes a_k follow from linear least
squares. How the load came on does not matter, because memories are computed from measured readings.

The relaxation times reach far beyond the hold. What the readings do not determine continues as
they suggest. If creep grows as a power of time, the amplitudes grow by a constant factor q from one
relaxation time to the next, so (a_k+1 - 2 q a_k + q² a_k-1)² is a part of the sum of squares. A
first fit with q = 1 yields q.

The deviation of the law is that which least squares state for a load that lasts `FORECAST` times as
long as the hold.

Source: J. D. Ferry, Viscoelastic Properties of Polymers (1980), 4.A and 11.F.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..bags.source import open_bag
from ..core.arrays import Array, Index
from ..core.calibration import Calibration
from ..core.compensation.low_pass import relaxed_share
from ..core.compensation.models import CreepModel
from ..core.errors import FitError
from ..messages.codec import SECOND
from .fit import measured_stress
from .recorded_loads import average_neighbours, find_cube, read_samples

TIMES_PER_DECADE = 2.0
"""Number of relaxation times of the creep law per decade (factor 10 of time). With 1.5, the error
of the sum of exponentials makes the law wrong by 0.4 % of the load after an hour."""

SHORTEST_TIME_S = 0.1
"""Shortest relaxation time of the creep law, in s. Creep that is faster than this counts as part of
the immediate response of a pad to a load."""

REACH = 60.0
"""Smallest ratio of the longest relaxation time of the creep law to the duration for which the load
was held. It makes a law from a hold of minutes serve for loads that last an hour."""

FORECAST = 6.0
"""Ratio of the duration of a load to that of the hold, for which the law's deviation is computed:
an hour for a hold of ten minutes."""

READING_ERROR = 1e-4
"""Standard deviation of a mean reading, besides noise, divided by the load: the error of a sum of
exponentials (rms)."""

MAX_MISFIT = 5e-3
"""Largest error of the creep law (rms difference between the measured and the computed stress
readings of the pads), divided by the load. With a larger error, the load was not held constant."""

FIRST_BEND = 0.15
"""Standard deviation of the second differences of the amplitudes at successive relaxation times in
the first fit, divided by their mean. For creep that grows as a power of time it is 0.03 to 0.7 for
exponents of 0.1 to 0.4."""

BEND = 0.05
"""The same in the second fit, which takes out a power of time."""

FAST_ERROR = 0.02
"""Standard deviation of the fastest memory's amplitude divided by it: creep of shorter times, which
it stands for, is not a part of the recording."""

REST_S = 2.0
"""Duration at the begin of a recording, in s, in which the cube must be unloaded. The mean stress
readings of the pads in it are subtracted from all readings."""

SETTLE_S = 1.0
"""Time, in s, from the moment at which half of the load is reached to the first stress reading that
is fitted, in which the load must become constant. As much is left out at the end of the load."""

MIN_HOLD_S = 60.0
"""Shortest duration, in s, for which the load must be held constant to determine creep."""

MIN_LOAD_RATIO = 100.0
"""Smallest load of a pad, divided by the noise of its readings, with which creep is determined."""

BLOCKS_PER_E_FOLD = 12
"""Number of averaged stress readings that are fitted for each growth of the time since the press by
the factor e (2.718). Averages over logarithmic intervals suffice, because creep slows down."""

GAIN_TIME_S = 1.0
"""Time after a load began, in s, at which loads are measured for the calibration of gains."""

MAX_RATE_HZ = 50.0
"""Largest rate, in Hz, of the averaged stress readings of the pads from which creep is fitted. The
computing time of the fit grows with the rate."""


class CreepFit(NamedTuple):
    """The law of creep that a recording determines.

    Attributes:
        model: The law.
        load: Load of each pad in the hold (P,), in Pa.
        hold_s: Duration of the hold, in s.
        misfit: Error of the law (rms), divided by the load.
        seconds: Times of mean readings since the press (N,), in s.
        before: Mean readings of the pads minus the first one in the hold, during it (N, P), in Pa.
        after: Mean readings minus what the law makes of the load (N, P), in Pa.
    """

    model: CreepModel
    load: Array
    hold_s: float
    misfit: float
    seconds: Array
    before: Array
    after: Array


class _Hold(NamedTuple):
    """Readings of a press that is held, and of the recovery after it, as means of N blocks.

    Attributes:
        time: Time since the press (N,), in s.
        is_loaded: 1 during the hold, 0 after it (N,).
        n_readings: Number of readings in each block (N,).
        reading: Readings of the pads (N, P), in Pa.
    """

    time: Array
    is_loaded: Array
    n_readings: Array
    reading: Array


class _Solution(NamedTuple):
    """Amplitudes by least squares.

    Attributes:
        amplitude: Amplitudes of each pad (P, K).
        error: Errors of the mean readings (N, P), in Pa.
        deviation: Pattern of one standard deviation of the amplitudes (P, K), the one that makes a
            forecast wrong.
    """

    amplitude: Array
    error: Array
    deviation: Array


def fit_recorded_creep(path: Path, name: str | None) -> tuple[CreepFit, Calibration]:
    """Fit the law of creep of a cube to a bag with one press that is held.

    Args:
        path: Path of the bag.
        name: Name of the cube; None: the only one.

    Returns:
        The fit, and the recorded calibration with the law and with gains that fit it.

    Raises:
        BagError: There is no such bag or cube.
        FitError: The bag has no such press, or does not determine the law.
    """
    with open_bag(path) as source:
        number = find_cube(source, path, name)
        settings = source.recording.settings[0]
        calibration = settings.calibrations[number]
        n_pads = calibration.layout.n_pads
        stamp_ns, frequency, temperature = read_samples(source, number, n_pads)
    rest = settings.rest_frequency[number, :n_pads]
    current = replace(calibration, rest_frequency=rest)

    is_complete = np.isfinite(frequency).all(axis=1)
    stamp_ns = stamp_ns[is_complete]
    known = temperature[is_complete] if np.isfinite(temperature).all() else None
    reading = measured_stress(current, frequency[is_complete], known)
    seconds = (stamp_ns - stamp_ns[:1]) / SECOND
    result = fit_creep(seconds, reading, calibration.noise, calibration.layout.pads)
    origin = f"{calibration.source}; creep fitted to {path.name}"
    fitted = add_creep(calibration, result.model)
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
    rate_hz = len(seconds) / max(np.ptp(seconds), 1e-9)
    size = max(1, round(rate_hz / MAX_RATE_HZ))
    seconds = average_neighbours(seconds, size)
    reading = average_neighbours(reading, size)
    is_rest = seconds < seconds[0] + REST_S
    reading = reading - reading[is_rest].mean(axis=0)

    press, release = _find_hold(seconds, reading)
    hold_s = release - press
    blocks = _find_blocks(seconds, press, release)
    means = _Hold(
        time=np.array([seconds[block].mean() - press for block in blocks]),
        is_loaded=np.array([1.0 * (seconds[block[0]] < release) for block in blocks]),
        n_readings=np.array([len(block) * size for block in blocks]),
        reading=np.array([reading[block].mean(axis=0) for block in blocks]),
    )
    held = means.reading[means.is_loaded > 0]
    load = held.mean(axis=0)
    needed = MIN_LOAD_RATIO * noise
    for pad in np.flatnonzero(np.abs(load) < needed).tolist():
        raise FitError(
            f"creep: pad {names[pad]} got {load[pad]:.0f} Pa, needed are {needed[pad]:.0f} Pa; "
            "press harder, so that every pad is loaded"
        )

    decades = np.log10(REACH * hold_s / SHORTEST_TIME_S)
    n_times = 1 + int(np.ceil(TIMES_PER_DECADE * decades))
    time = SHORTEST_TIME_S * 10 ** (np.arange(n_times) / TIMES_PER_DECADE)
    memory = _find_memories(seconds, reading, time, blocks)
    forecast = relaxed_share(FORECAST * hold_s / time)
    first = _solve(means, memory, load, noise, forecast, 1.0, FIRST_BEND)
    # Memories between the time at which readings begin and the end of the hold are well known.
    is_known = (time > SETTLE_S) & (time < hold_s / 3)
    known = first.amplitude[:, is_known]
    growth = float((known[:, 1:] * known[:, :-1]).sum() / (known[:, :-1] ** 2).sum())
    solution = _solve(means, memory, load, noise, forecast, growth, BEND)
    amplitude = solution.amplitude
    misfit = float(np.sqrt(np.mean((solution.error / load) ** 2)))
    total = amplitude.sum(axis=1).max()
    if misfit > MAX_MISFIT or total >= 1:
        raise FitError(
            f"creep: a held load would creep by {100 * total:.3g} % of the stress, and its law "
            f"fits to {100 * misfit:.2g} % ({100 * MAX_MISFIT:g} % allowed); press within "
            f"{SETTLE_S:g} s, and hold a constant load, such as a dead weight"
        )

    # The fastest memory is the reading itself, so its amplitude changes all readings alike.
    fast = np.zeros_like(amplitude)
    fast[:, 0] = np.hypot(misfit, FAST_ERROR * amplitude[:, 0])
    model = CreepModel(time, amplitude, np.array([fast, solution.deviation]))
    before = means.reading - np.outer(means.is_loaded, means.reading[0])
    return CreepFit(model, load, hold_s, misfit, means.time, before, solution.error)


def reading_after_step(model: CreepModel, seconds: float) -> Array:
    """Return the readings of the pads after a step of the stress by 1 (P,).

    Args:
        model: The law.
        seconds: Time after the step, in s.
    """
    times = np.geomspace(1e-4, seconds, 300)
    amplitude = model.amplitude.T
    memory = np.zeros_like(amplitude)
    reading = np.ones(len(model.amplitude))
    for step in np.diff(times, prepend=0.0):
        ratio = step / model.time[:, None]
        share = relaxed_share(ratio)
        slope_share = 1 - share / ratio
        # The new reading u_1 stands on both sides: u_1 = 1 + a r, and r contains u_1.
        memory += share * (reading - memory) - slope_share * reading
        known = 1 + (amplitude * memory).sum(axis=0)
        weight = 1 - (amplitude * slope_share).sum(axis=0)
        reading = known / weight
        memory += slope_share * reading
    return reading


def add_creep(calibration: Calibration, model: CreepModel) -> Calibration:
    """Return a calibration with a law of creep, and with gains that fit it.

    Gains are sensitivities `GAIN_TIME_S` after a load began. Without creep, a pad reads less then.

    Args:
        calibration: Calibration of the recording; it may have an older law of creep.
        model: The new law.
    """
    gain = calibration.gain / reading_after_step(model, GAIN_TIME_S)
    if calibration.creep is not None:
        gain = gain * reading_after_step(calibration.creep, GAIN_TIME_S)
    return replace(calibration, creep=model, gain=gain)


def _find_hold(seconds: Array, reading: Array) -> tuple[float, float]:
    """Return the times at which the load came on and went, in s.

    Raises:
        FitError: There is not one load that was held long enough after a time without load.
    """
    total = np.abs(reading).sum(axis=1)
    is_loaded = total > 0.5 * np.quantile(total, 0.95)
    begin, end = np.flatnonzero(is_loaded)[[0, -1]]
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


def _find_blocks(
    seconds: Array,
    press: float,
    release: float,
) -> list[Index]:
    """Return the numbers of the readings in each block, which grow with the time since a change."""
    blocks: list[Index] = []
    for begin, end in ((press, release), (release, np.inf)):
        is_settled = (seconds > begin + SETTLE_S) & (seconds < end - SETTLE_S)
        chosen = np.flatnonzero(is_settled)
        elapsed = seconds[chosen] - begin
        place = np.floor(BLOCKS_PER_E_FOLD * np.log(elapsed))
        bounds = np.flatnonzero(np.diff(place)) + 1
        parts = np.split(chosen, bounds)
        blocks += [part for part in parts if len(part)]
    return blocks


def _find_memories(
    seconds: Array,
    reading: Array,
    time: Array,
    blocks: list[Index],
) -> Array:
    """Return the memories of the pads as means of blocks (N, K, P).

    Args:
        seconds: Times of the readings, in s.
        reading: Readings of the pads (S, P), in Pa, of which the first is without load.
        time: Relaxation times (K,), in s.
        blocks: Numbers of the readings in each block.
    """
    ratio = np.diff(seconds)[:, None, None] / time[:, None]
    share = relaxed_share(ratio)
    slope_share = 1 - share / ratio
    change = np.diff(reading, axis=0)
    memory = np.zeros((len(seconds), len(time), reading.shape[1]))
    for n, before in enumerate(memory[:-1]):
        relaxed = before + share[n] * (reading[n] - before)
        memory[n + 1] = relaxed + slope_share[n] * change[n]
    return np.array([memory[block].mean(axis=0) for block in blocks])


def _solve(
    means: _Hold,
    memory: Array,
    load: Array,
    noise: Array,
    forecast: Array,
    growth: float,
    bend: float,
) -> _Solution:
    """Fit amplitudes to the means of readings by least squares with smooth amplitudes.

    Args:
        means: Readings.
        memory: Memories of the pads (N, K, P), in Pa.
        load: Load of each pad (P,), in Pa.
        noise: Standard deviation of a reading of each pad (P,), in Pa.
        forecast: Memories (K,) of a reading of 1 that has lasted for the time of the forecast.
        growth: Expected ratio of successive amplitudes.
        bend: Standard deviation of second differences divided by the mean amplitude.
    """
    n_times = memory.shape[1]
    held = means.reading[means.is_loaded > 0]
    # The creep during the hold is that of about half the relaxation times.
    creep = np.abs(held[-1] / held[0] - 1).mean()
    mean_amplitude = 2 * creep / n_times
    steps = np.eye(n_times)[1:] - growth * np.eye(n_times)[:-1]
    bends = steps[1:] - growth * steps[:-1]
    smooth = np.concatenate([steps[:1], bends]) / (bend * mean_amplitude + 1e-9)
    smooth = np.pad(smooth, ((0, 0), (1, 0)))

    shape = len(load), n_times
    found = _Solution(np.empty(shape), np.empty_like(means.reading), np.empty(shape))
    for pad, pad_load in enumerate(load):
        reading = means.reading[:, pad]
        mean_noise = noise[pad] / np.sqrt(means.n_readings)
        deviation = np.hypot(mean_noise, READING_ERROR * pad_load)
        # Unknown are the stress under the load, and the amplitudes.
        columns = np.column_stack([means.is_loaded, memory[..., pad]])
        system = np.concatenate([columns / deviation[:, None], smooth])
        right = np.concatenate([reading / deviation, np.zeros(len(smooth))])
        solution = np.linalg.lstsq(system, right, rcond=None)[0]
        found.amplitude[pad] = solution[1:]
        found.error[:, pad] = reading - columns @ solution
        # The error of the amplitudes that makes the forecast wrong by its standard deviation, if
        # the stress is known, in whose place gains are calibrated.
        spread = np.linalg.solve(system[:, 1:].T @ system[:, 1:], forecast)
        found.deviation[pad] = spread / np.sqrt(forecast @ spread)
    return found
