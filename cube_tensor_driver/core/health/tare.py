"""Tare: take the present load of a cube as its unloaded state.

    f0 = mean(f) / factor(T)

per pad, over the last windows of `Health`; factor(T) is the temperature model of the calibration.
The mean is of data that have already arrived, so nothing has to wait. A tare is refused if the
signal moved during these windows, or if the data have a gap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import Array, Index, Mask, pad_table
from ..errors import TareError
from ..pipeline import Pipeline
from ..status import LEFT_OUT
from .diagnosis import MIN_COUNT
from .health import HISTORY_WINDOWS, Health
from .statistics import WINDOW_S, Window

MAX_DURATION_S = HISTORY_WINDOWS * WINDOW_S
"""Longest duration of a tare, in s: that of the windows which `Health` keeps."""

MAX_SPAN = 12.0
"""Span (peak to peak) of a pad, as a multiple of the calibration's noise, above which it moves.

In 10000 rows, noise alone spans 9 times its standard deviation.
"""

MAX_NOISE = 4.0
"""Noise of a pad, as a multiple of the calibration's noise, above which a mean is unreliable."""

MAX_REST_CHANGE = 0.2
"""Largest relative difference of a new rest frequency from that of the calibration.

A larger one shows a load or another cube.
"""

JUMP_SPAN = 10.0
"""Span of a pad, as a multiple of its own noise, above which the signal has jumped.

A jump raises the noise as well, but white noise does not span so much. The span is then reported,
and not the noise.
"""

MAX_GAP_S = 0.25
"""Longest gap in the data, in s, over which the load counts as unchanged."""

MAX_GAP_ROWS = 4.0
"""Longest gap over which the load counts as unchanged, as a multiple of the rows' mean interval.

It replaces `MAX_GAP_S` where rows come so slowly that it is the longer one.
"""


class _Means(NamedTuple):
    """Statistics of the tared cubes over several windows.

    Attributes:
        frequency, span, noise: Mean, peak-to-peak span and noise (cubes, P), in Hz.
    """

    frequency: Array
    span: Array
    noise: Array


class _Check(NamedTuple):
    """A quantity of each pad that must not exceed a limit.

    Attributes:
        values: The quantity (cubes, P).
        limit: Its limit.
        problem, unit, fix: Words for the error message.
    """

    values: Array
    limit: float
    problem: str
    unit: str
    fix: str


def measure_rest(
    pipeline: Pipeline,
    health: Health,
    cubes: Sequence[int],
    duration: float,
    names: Sequence[str],
) -> Array:
    """Compute the rest frequencies that a tare sets.

    Pads that are left out, and other cubes, keep their rest frequencies.

    Args:
        pipeline: Pipeline with the calibrations and the present rest frequencies.
        health: Health with the last windows.
        cubes: Numbers of the cubes to tare.
        duration: Duration of the newest data to average, in s, in steps of `WINDOW_S`.
        names: Names of all cubes, for messages.

    Returns:
        Rest frequencies of all cubes (cubes, P), in Hz.

    Raises:
        TareError: A cube's signal moves, is noisy, too short or too far from its calibration, or
            none of its pads works.
    """
    chosen = np.asarray(cubes, dtype=int)
    windows = _select_windows(health, chosen, duration, names)
    result = pipeline.rest_frequency
    works = health.state[chosen] & LEFT_OUT == 0
    used = works & ~np.isnan(result[chosen])
    is_dead = ~used.any(axis=1)
    for cube in chosen[is_dead].tolist():
        raise TareError(f"cube {names[cube]}: no pad works; see the diagnostics")

    with np.errstate(invalid="ignore"):  # NaN where a cube has no such pad
        means = _average(windows, chosen)
        factor = pipeline.temperature_factor(chosen, health.temperature[chosen])
        rest = means.frequency / factor
        checks = _list_checks(pipeline, health, chosen, rest, means)
    for check in checks:
        _apply_check(check, used, chosen, pipeline, names)
    result[chosen] = np.where(used, rest, result[chosen])
    return result


def _select_windows(
    health: Health,
    chosen: Index,
    duration: float,
    names: Sequence[str],
) -> list[Window]:
    """Return the windows to average. TareError: there are not enough data."""
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
    # A signal that moves in the present window, which has not ended, is refused, too.
    present = health.window()
    if present.rows.any():
        windows.append(present)

    rows = np.array([window.rows[chosen] for window in windows])
    total = rows.sum(axis=0)
    has_empty_window = (rows[:count] == 0).any(axis=0)
    has_too_few = has_empty_window | (total < MIN_COUNT)
    for cube in chosen[has_too_few].tolist():
        raise TareError(
            f"cube {names[cube]}: no data, or gaps in it, in the last {duration:g} s; see its link"
        )
    _refuse_gaps(health, chosen, windows, total, names)
    return windows


def _refuse_gaps(
    health: Health,
    chosen: Index,
    windows: Sequence[Window],
    rows: Index,
    names: Sequence[str],
) -> None:
    """Raise TareError if rows of a cube are too far apart in time to be averaged.

    Args:
        health: Health, for the age of the newest rows.
        chosen: Numbers of the cubes to tare.
        windows: Windows to average.
        rows: Number of rows of each of these cubes in the windows.
        names: Names of all cubes.
    """
    # A gap before the first window does not matter, because no earlier row is averaged.
    before = [window.gap_before[chosen] for window in windows[1:]]
    within = [window.gap_within[chosen] for window in windows]
    # The time since the newest row is a gap, too.
    gaps_ns = [*before, *within, health.age_ns[chosen]]
    gaps_s = 1e-9 * np.abs(gaps_ns)
    mean_interval_s = len(windows) * WINDOW_S / rows
    limit_s = np.maximum(MAX_GAP_S, MAX_GAP_ROWS * mean_interval_s)
    longest_s = gaps_s.max(axis=0)
    for number in np.flatnonzero(longest_s > limit_s).tolist():
        raise TareError(
            f"cube {names[chosen[number]]}: a gap of {longest_s[number]:.3g} s in the data to "
            f"average, the limit is {limit_s[number]:.2g} s: wait until there are data after it"
        )


def _average(windows: Sequence[Window], chosen: Index) -> _Means:
    """Average the windows, each weighted with its number of rows."""
    rows = np.array([window.rows[chosen] for window in windows])
    rows = rows[:, :, None]
    mean = np.array([window.mean[chosen] for window in windows])
    noise = np.array([window.noise[chosen] for window in windows])
    variance = noise**2
    highest = np.fmax.reduce([window.highest[chosen] for window in windows])
    lowest = np.fmin.reduce([window.lowest[chosen] for window in windows])

    # The mean of a window without rows is NaN, which its weight 0 would not remove.
    known_mean = np.where(rows > 0, mean, 0)
    total = (known_mean * rows).sum(axis=0)
    # The first rows of a cube have no differences yet, so the noise of their window is NaN.
    rows_with_noise = rows * np.isfinite(variance)
    total_variance = (np.nan_to_num(variance) * rows_with_noise).sum(axis=0)
    n_with_noise = np.maximum(rows_with_noise.sum(axis=0), 1)
    return _Means(
        frequency=total / rows.sum(axis=0),
        span=highest - lowest,
        noise=np.sqrt(total_variance / n_with_noise),
    )


def _list_checks(
    pipeline: Pipeline,
    health: Health,
    chosen: Index,
    rest: Array,
    means: _Means,
) -> list[_Check]:
    calibrations = [pipeline.calibrations[cube] for cube in chosen.tolist()]
    frequencies = [calibration.rest_frequency for calibration in calibrations]
    calibrated = pad_table(frequencies, pipeline.n_pads, np.nan)
    noise = health.noise[chosen]
    jumped = means.span > JUMP_SPAN * means.noise
    return [
        _Check(
            values=np.where(jumped, 0, means.noise / noise),
            limit=MAX_NOISE,
            problem="is noisy",
            unit="times its noise",
            fix="look for loose leads and interference",
        ),
        _Check(
            values=means.span / noise,
            limit=MAX_SPAN,
            problem="moves",
            unit="times its noise peak to peak",
            fix="let it come to rest",
        ),
        _Check(
            values=100 * np.abs(rest - calibrated) / calibrated,
            limit=100 * MAX_REST_CHANGE,
            problem="is far from its calibration",
            unit="%",
            fix="take the load off, or calibrate the cube again",
        ),
    ]


def _apply_check(
    check: _Check,
    used: Mask,
    chosen: Index,
    pipeline: Pipeline,
    names: Sequence[str],
) -> None:
    """Raise TareError that names the worst pad, if one of the used pads exceeds the limit."""
    # Written so that NaN exceeds every limit.
    exceeds = used & ~(check.values <= check.limit)
    if not exceeds.any():
        return
    values = np.nan_to_num(check.values, nan=np.inf)
    excess = np.where(exceeds, values, -1)
    row, pad = np.unravel_index(np.argmax(excess), excess.shape)
    cube = int(chosen[row])
    pad_name = pipeline.calibrations[cube].layout.pads[pad]
    raise TareError(
        f"cube {names[cube]}: pad {pad_name} {check.problem}: {check.values[row, pad]:.3g} "
        f"{check.unit}, the limit is {check.limit:g}; {check.fix}"
    )
