# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Tare: take the present load of a cube as its unloaded state.

    f0 = mean(f) / factor(T, o)

From the mean frequency of each pad over the last windows (of 0.5 s) that `Health` keeps, its
frequency f0 without load is computed. factor(T, o) is the ratio to f0 of the frequency of an
unloaded pad at the temperature T, with the offset o that the compensation (of weight, for example)
subtracts. The mean is of data that have already arrived, so nothing has to wait. A tare is refused
if a frequency moved during these windows, or if the data have a gap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import Array, Index, Mask
from ..calibration import tabulate_pads
from ..errors import TareError
from ..status import LEFT_OUT
from .diagnosis import MIN_ROWS
from .health import HISTORY_WINDOWS, Health
from .statistics import WINDOW_S, Window

MAX_DURATION_S = HISTORY_WINDOWS * WINDOW_S
"""Longest duration over which a tare (measurement of frequencies without load) can average, in s.

It is limited by the number of windows of 0.5 s whose statistics `Health` keeps.
"""

MAX_SPAN_RATIO = 12.0
"""Span (highest minus lowest frequency of a pad) above which a tare is refused because the load
moves, as a multiple of the noise (standard deviation) in the calibration.

In 10000 rows, noise alone spans 9 times its standard deviation.
"""

MAX_NOISE_RATIO = 4.0
"""Measured noise of a pad above which a tare is refused because a mean would be unreliable, as a
multiple of the noise (standard deviation of the frequency) in the calibration."""

MAX_REST_CHANGE = 0.2
"""Largest relative change, against the calibration, of a rest frequency (frequency without load)
with which a tare is accepted.

A larger change shows that a load is on the cube, or that the calibration is of another cube.
"""

JUMP_SPAN_RATIO = 10.0
"""Span (highest minus lowest frequency of a pad), as a multiple of the measured noise, above which
the frequency is assumed to have jumped, because the span of white noise is smaller.

A jump raises the measured noise as well. The error message of the refused tare then names the span
as the reason, and not the noise.
"""

MAX_GAP_S = 0.25
"""Longest gap between two rows of a cube, in s, with which a tare is accepted.

The load might have changed during a longer gap. Where rows come more rarely than 16 times a second,
the limit is 4 mean intervals between rows instead.
"""

MAX_GAP_ROWS = 4.0
"""Longest gap between two rows of a cube with which a tare is accepted, as a multiple of the mean
interval between rows.

It replaces `MAX_GAP_S` where rows come so slowly that it gives the longer time.
"""


class _Means(NamedTuple):
    """Statistics of the frequencies of the cubes to tare, over several windows.

    Attributes:
        frequency: Mean frequency of each pad (cubes, P), in Hz.
        span: Highest minus lowest frequency of each pad (cubes, P), in Hz.
        noise: Standard deviation of each pad's frequency, without slow changes (cubes, P), in Hz.
    """

    frequency: Array
    span: Array
    noise: Array


def measure_rest(
    health: Health,
    cubes: Sequence[int],
    duration: float,
    names: Sequence[str],
) -> Array:
    """Compute the rest frequencies (frequencies without load) that a tare sets.

    Pads that do not work, and cubes that are not tared, keep their rest frequencies.

    Args:
        health: Health of the pads, which holds the statistics of the last windows of 0.5 s, and
            the pipeline with the calibrations and the present rest frequencies.
        cubes: Numbers of the cubes to tare.
        duration: Duration of the newest data to average, in s, in steps of `WINDOW_S`.
        names: Names of all cubes, for messages.

    Returns:
        Rest frequencies of all cubes (cubes, P), in Hz.

    Raises:
        TareError: The frequencies of a cube moved, are noisy, are too far from its calibration, or
            were received for a shorter time than `duration`; or none of its pads works.
    """
    pipeline = health.pipeline
    chosen = np.asarray(cubes, dtype=int)
    windows = _select_windows(health, chosen, duration, names)
    result = pipeline.rest_frequency
    works = health.state[chosen] & LEFT_OUT == 0
    used = works & ~np.isnan(result[chosen])
    is_dead = ~used.any(axis=1)
    for cube in chosen[is_dead].tolist():
        raise TareError(f"cube {names[cube]}: no pad works; see the diagnostics")

    with np.errstate(invalid="ignore"):  # NaN where a cube has no such pad
        means = _average(windows)
        factor = pipeline.compute_unloaded_factor(chosen, health.temperature[chosen])
        rest = means.frequency / factor
        _check_pads(
            health,
            chosen,
            used,
            rest,
            means,
            names,
        )
    result[chosen] = np.where(used, rest, result[chosen])
    return result


def _select_windows(
    health: Health,
    chosen: Index,
    duration: float,
    names: Sequence[str],
) -> Window:
    """Return the statistics of the windows to average.

    Args:
        health: Health of the pads, with the statistics of the last windows.
        chosen: Numbers of the cubes to tare.
        duration: Duration to average, in s.
        names: Names of all cubes, for messages.

    Returns:
        Statistics (windows, cubes, ...) of the last windows that cover the duration, and of the
        present one, which has not ended, for the cubes to tare.

    Raises:
        TareError: The duration is outside its limits, or the data are too short, too few, or have
            a gap.
    """
    if not 0 < duration <= MAX_DURATION_S:
        raise TareError(f"tare over {duration:g} s; allowed: above 0 to {MAX_DURATION_S:g} s")
    # The rounding error of a duration such as 0.1 + 0.2 + 0.2 must not add a window.
    count = math.ceil(duration / WINDOW_S - 1e-9)
    if len(health.history) < count:
        raise TareError(
            f"only {len(health.history) * WINDOW_S:g} s of data since the start; "
            f"tare takes {duration:g} s: wait"
        )
    windows = list(health.history)[-count:]
    # The present window, which has not ended, is included, so that a tare is also refused if a
    # frequency moves in it.
    present = health.read_window()
    if present.rows.any():
        windows.append(present)

    columns = [np.array(values) for values in zip(*windows, strict=True)]
    averaged = Window(*(column[:, chosen] for column in columns))
    has_empty_window = (averaged.rows[:count] == 0).any(axis=0)
    n_rows = averaged.rows.sum(axis=0)
    has_too_few = has_empty_window | (n_rows < MIN_ROWS)
    for cube in chosen[has_too_few].tolist():
        raise TareError(
            f"cube {names[cube]}: no data, or gaps in it, in the last {duration:g} s; see its link"
        )
    _refuse_gaps(health, chosen, averaged, names)
    return averaged


def _refuse_gaps(
    health: Health,
    chosen: Index,
    windows: Window,
    names: Sequence[str],
) -> None:
    """Raise TareError if the time between two rows of a cube is too long for a tare.

    Args:
        health: Health of the pads, which states the age of the newest row of each cube.
        chosen: Numbers of the cubes to tare.
        windows: Statistics (windows, cubes, ...) to average.
        names: Names of all cubes, for messages.
    """
    # A gap before the first window does not matter, because no earlier row is averaged.
    before = windows.gap_before[1:]
    # The time from the newest row of a cube to the newest row of any cube is a gap, too.
    age_ns = health.newest_ns - health.sums.cubes["time_ns"][chosen]
    gaps_ns = [*before, *windows.gap_within, age_ns]
    gaps_s = 1e-9 * np.abs(gaps_ns)
    duration_s = len(windows.rows) * WINDOW_S
    mean_interval_s = duration_s / windows.rows.sum(axis=0)
    limit_s = np.maximum(MAX_GAP_S, MAX_GAP_ROWS * mean_interval_s)
    longest_s = gaps_s.max(axis=0)
    for number in np.flatnonzero(longest_s > limit_s).tolist():
        raise TareError(
            f"cube {names[chosen[number]]}: a gap of {longest_s[number]:.3g} s in the data to "
            f"average, the limit is {limit_s[number]:.2g} s: wait until there are data after it"
        )


def _average(windows: Window) -> _Means:
    """Combine the statistics of windows (windows, cubes, ...), weighted with numbers of rows."""
    rows = windows.rows[:, :, None]
    variance = windows.noise**2
    # The mean frequency of a window without rows is NaN. It is replaced, because NaN times the
    # weight 0 of this window would still be NaN.
    known_mean = np.where(rows > 0, windows.mean, 0)
    total = (known_mean * rows).sum(axis=0)
    # The noise of a window is NaN if it holds the first rows of a cube ever, because these have no
    # differences to rows before.
    rows_with_noise = rows * np.isfinite(variance)
    known_variance = np.nan_to_num(variance)
    total_variance = (known_variance * rows_with_noise).sum(axis=0)
    n_with_noise = np.maximum(rows_with_noise.sum(axis=0), 1)
    highest = np.fmax.reduce(windows.highest)
    lowest = np.fmin.reduce(windows.lowest)
    return _Means(
        frequency=total / rows.sum(axis=0),
        span=highest - lowest,
        noise=np.sqrt(total_variance / n_with_noise),
    )


def _check_pads(
    health: Health,
    chosen: Index,
    used: Mask,
    rest: Array,
    means: _Means,
    names: Sequence[str],
) -> None:
    """Raise TareError if a quantity of a pad exceeds its limit; the error names the worst pad.

    Args:
        health: Health of the pads, with their noise and calibrations.
        chosen: Numbers of the cubes to tare.
        used: Whether a pad of these cubes is checked (cubes, P).
        rest: New rest frequencies (frequencies without load) of these cubes, in Hz.
        means: Statistics of the frequencies of these cubes.
        names: Names of all cubes.
    """
    pipeline = health.pipeline
    calibrations = [pipeline.calibrations[cube] for cube in chosen.tolist()]
    calibrated = tabulate_pads(
        calibrations,
        "rest_frequency",
        pipeline.n_pads,
        np.nan,
    )
    noise = health.diagnosis.noise[chosen]
    jumped = means.span > JUMP_SPAN_RATIO * means.noise
    noise_ratio = np.where(jumped, 0, means.noise / noise)
    change_percent = 100 * np.abs(rest - calibrated) / calibrated
    for values, limit, problem, unit, fix in (
        (
            noise_ratio,
            MAX_NOISE_RATIO,
            "is noisy",
            "times its noise",
            "look for loose leads and interference",
        ),
        (
            means.span / noise,
            MAX_SPAN_RATIO,
            "moves",
            "times its noise peak to peak",
            "let it come to rest",
        ),
        (
            change_percent,
            100 * MAX_REST_CHANGE,
            "is far from its calibration",
            "%",
            "take the load off, or calibrate the cube again",
        ),
    ):
        # A comparison with NaN is False. So "not <=" counts NaN as above the limit, unlike ">".
        exceeds = used & ~(values <= limit)
        if not exceeds.any():
            continue
        comparable = np.nan_to_num(values, nan=np.inf)
        excess = np.where(exceeds, comparable, -1)
        row, pad = np.unravel_index(np.argmax(excess), excess.shape)
        pad_name = calibrations[row].layout.pads[pad]
        value = values[row, pad]
        # The format .3g would show large numbers with an exponent, such as 1.23e+03.
        shown = f"{value:.0f}" if value > 100 else f"{value:.3g}"
        raise TareError(
            f"cube {names[chosen[row]]}: pad {pad_name} {problem}: {shown} {unit}, "
            f"the limit is {limit:g}; {fix}"
        )
