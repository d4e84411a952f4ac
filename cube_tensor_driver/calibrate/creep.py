# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Identification of creep: the viscoelastic law of each pad from one press that is held.

The stress of a pad is s = u - sum_k a_k r_k with its reading u and memories r_k, which are readings
low-passed with relaxation times tau_k (`core/compensation/creep.py`). While a load is held, s is
constant but unknown, and after it s = 0. So s and the amplitudes a_k follow from linear least
squares. How the load came on does not matter, because memories are computed from measured readings.

The relaxation times are a fixed number per decade: the smallest with which the law describes the
readings. They reach far beyond the hold. What the readings do not determine continues smoothly in
k, because the second differences of a_k are part of the sum of squares.

How wrong this continuation is, is measured: the fit is repeated with the first part of the hold
only. The difference of the two laws, moved along the relaxation times by the ratio of the two
durations, is the deviation of the law.

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

TIMES_PER_DECADE = (1.0, 1.5, 2.0)
"""Numbers of relaxation times of the creep law per decade (factor 10 of time) that are tried, in
this order, until its error is at most `GOOD_MISFIT` of the load."""

SHORTEST_TIME_S = 0.1
"""Shortest relaxation time of the creep law, in s. Creep that is faster than this counts as part of
the immediate response of a pad to a load."""

REACH = 20.0
"""Smallest ratio of the longest relaxation time of the creep law to the duration for which the load
was held. It makes a law from a hold of minutes serve for loads that last an hour."""

GOOD_MISFIT = 2e-4
"""Error of the creep law (rms difference between the measured and the computed stress readings of
the pads), divided by the load. At or below this error, no further relaxation times are tried. It is
small against the largest error that is accepted (0.5 %) and visible above the noise of the pads."""

MAX_MISFIT = 5e-3
"""Largest error of the creep law (rms difference between the measured and the computed stress
readings of the pads), divided by the load. With a larger error, the load was not held constant."""

BEND = 0.15
"""Expected second difference of the creep law's amplitudes at successive relaxation times, divided
by their mean. Creep that grows as a power of time has 0.03 to 0.7 for exponents of 0.1 to 0.4."""

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
    """

    model: CreepModel
    load: Array
    hold_s: float
    misfit: float


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

    for order in TIMES_PER_DECADE:
        decades = np.log10(REACH * hold_s / SHORTEST_TIME_S)
        n_times = 1 + int(np.ceil(order * decades))
        time = SHORTEST_TIME_S * 10 ** (np.arange(n_times) / order)
        memory = _find_memories(seconds, reading, time, blocks)
        amplitude, error = _solve(means, memory, load, noise)
        misfit = float(np.sqrt(np.mean((error / load) ** 2)))
        if misfit < GOOD_MISFIT:
            break
    total = amplitude.sum(axis=1).max()
    if misfit > MAX_MISFIT or total >= 1:
        raise FitError(
            f"creep: a held load would creep by {100 * total:.3g} % of the stress, and its law "
            f"fits to {100 * misfit:.2g} % ({100 * MAX_MISFIT:g} % allowed); press within "
            f"{SETTLE_S:g} s, and hold a constant load, such as a dead weight"
        )

    # The first part is shorter than the hold by the ratio of some successive relaxation times, and
    # the law reaches as far beyond it as an hour lies beyond ten minutes.
    shift = max(1, round(order * np.log10(6)))
    first_s = hold_s / 10 ** (shift / order)
    is_first = (means.time < first_s) & (means.is_loaded > 0)
    first = _Hold(*(part[is_first] for part in means))
    early, _ = _solve(first, memory[is_first], load, noise)

    # The amplitudes of a power law grow with the relaxation time, and so does the deviation.
    n_known = int(np.searchsorted(time, hold_s / 3))
    slower = amplitude[:, shift:n_known]
    faster = amplitude[:, : n_known - shift]
    growth = (slower * faster).sum(axis=1) / (faster**2).sum(axis=1)
    change = amplitude - early
    beyond = np.zeros_like(amplitude)
    beyond[:, shift:] = growth[:, None] * change[:, :-shift]

    # The fastest memory is the reading itself, so its amplitude changes all readings alike.
    within = np.zeros_like(amplitude)
    within[:, 0] = misfit
    model = CreepModel(time, amplitude, np.array([within, beyond]))
    return CreepFit(model, load, hold_s, misfit)


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
) -> tuple[Array, Array]:
    """Fit amplitudes to the means of readings by least squares with smooth amplitudes.

    Args:
        means: Readings.
        memory: Memories of the pads (N, K, P), in Pa.
        load: Load of each pad (P,), in Pa.
        noise: Standard deviation of a reading of each pad (P,), in Pa.

    Returns:
        Amplitudes (P, K), and errors of the readings (N, P), in Pa.
    """
    n_times = memory.shape[1]
    held = means.reading[means.is_loaded > 0]
    # The creep during the hold is that of about half the relaxation times.
    creep = np.abs(held[-1] / held[0] - 1).mean()
    mean_amplitude = 2 * creep / n_times
    bend = np.diff(np.eye(n_times), n=2, axis=0)
    slope = np.diff(np.eye(n_times)[:2], axis=0)
    smooth = np.concatenate([slope, bend]) / (BEND * mean_amplitude + 1e-9)
    smooth = np.pad(smooth, ((0, 0), (1, 0)))
    no_bend = np.zeros(len(smooth))

    amplitude = np.empty((len(load), n_times))
    error = np.empty_like(means.reading)
    for pad, pad_load in enumerate(load):
        reading = means.reading[:, pad]
        mean_noise = noise[pad] / np.sqrt(means.n_readings)
        deviation = np.hypot(mean_noise, 0.5 * GOOD_MISFIT * pad_load)
        # Unknown are the stress under the load, and the amplitudes.
        columns = np.column_stack([means.is_loaded, memory[..., pad]])
        system = np.concatenate([columns / deviation[:, None], smooth])
        right = np.concatenate([reading / deviation, no_bend])
        solution = np.linalg.lstsq(system, right, rcond=None)[0]
        amplitude[pad] = solution[1:]
        error[:, pad] = reading - columns @ solution
    return amplitude, error
