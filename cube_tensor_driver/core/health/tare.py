"""Tare: take the present load as no load.

    f0 = mean(f) / factor(T)

per pad, over the windows of `Health`; factor(T) is the calibration's temperature model. The mean is
of data that are there already: nobody waits. A signal that moved a moment ago is refused, and so
are data with a gap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..errors import TareError
from ..pipeline import Pipeline
from ..status import LEFT_OUT
from .diagnosis import MIN_COUNT
from .health import HISTORY, Health
from .statistics import WINDOW_S, Window

MOVED = 12.0
"""Times the calibration's noise, peak to peak, above which a pad moved: noise alone spans 9 in
10000 rows."""
NOISY = 4.0
"""Times the calibration's noise above which a pad is too noisy for a rest frequency."""
FAR = 0.2
"""Of the calibration's rest frequency: beyond this it is a load or another cube, not rest."""
JUMP_SPAN = 10.0
"""Times its own noise beyond which a span is a jump: a jump raises the noise, too, but white noise
does not span so much."""

GAP_S = 0.25
"""What a load did in a longer gap is not known: data from before it are not the present load."""
GAP_ROWS = 4.0
"""Where rows come slowly, a gap is longer than so many of their intervals."""


class _Means(NamedTuple):
    """Of the chosen cubes over some windows, (cubes, P) Hz: mean, peak to peak, noise."""

    frequency: np.ndarray
    span: np.ndarray
    noise: np.ndarray


class _Check(NamedTuple):
    """A quantity (cubes, P) of each pad that must not be above its limit, and what to say then."""

    values: np.ndarray
    limit: float
    problem: str
    unit: str
    fix: str


def measure_rest(
    pipeline: Pipeline, health: Health, cubes: Sequence[int], duration: float, names: Sequence[str]
) -> np.ndarray:
    """Rest frequencies (all cubes, P) in Hz after a tare of `cubes`.

    duration: s of the newest data to average, in steps of WINDOW_S
    names: of all cubes, for messages
    Pads that are left out, and other cubes, keep their rest frequencies. TareError: a cube's signal
    moves, is noisy, too short, or too far from its calibration, or none of its pads works.
    """
    chosen = np.asarray(cubes, dtype=int)
    windows = _newest_windows(health, chosen, duration, names)
    rest_before = pipeline.rest_frequency
    used = (health.state[chosen] & LEFT_OUT == 0) & ~np.isnan(rest_before[chosen])
    for cube in chosen[~used.any(axis=1)].tolist():
        raise TareError(f"cube {names[cube]}: no pad works; see the diagnostics")
    with np.errstate(invalid="ignore"):
        means = _average(windows, chosen)
        factor = pipeline.temperature_factor(chosen, health.temperature[chosen])
        rest = means.frequency / factor
        checks = _checks(pipeline, health, chosen, rest, means)
    for check in checks:
        _apply(check, used, chosen, pipeline, names)
    result = rest_before
    result[chosen] = np.where(used, rest, result[chosen])
    return result


def _newest_windows(
    health: Health, chosen: np.ndarray, duration: float, names: Sequence[str]
) -> list[Window]:
    """The windows to average. TareError: there are not enough data."""
    if not 0 < duration <= HISTORY * WINDOW_S:
        raise TareError(f"tare over {duration:g} s; allowed: above 0 to {HISTORY * WINDOW_S:g} s")
    count = math.ceil(duration / WINDOW_S - 1e-9)
    if len(health.history) < count:
        raise TareError(
            f"only {len(health.history) * WINDOW_S:g} s of data since the start; "
            f"tare takes {duration:g} s: wait"
        )
    windows = list(health.history)[-count:]
    # A signal that moves in the window that is not over yet is refused, too.
    newest = health.window()
    if newest.rows.any():
        windows.append(newest)
    rows = np.array([window.rows[chosen] for window in windows])
    too_few = (rows[:count] == 0).any(axis=0) | (rows.sum(axis=0) < MIN_COUNT)
    for cube in chosen[too_few].tolist():
        raise TareError(
            f"cube {names[cube]}: no data, or gaps in it, in the last {duration:g} s; see its link"
        )
    _refuse_gaps(health, chosen, windows, rows.sum(axis=0), names)
    return windows


def _refuse_gaps(
    health: Health,
    chosen: np.ndarray,
    windows: Sequence[Window],
    rows: np.ndarray,
    names: Sequence[str],
) -> None:
    """TareError: rows of a cube are too far apart in time to be averaged.

    rows: (len(chosen),) how many of each cube there are in the windows.
    """
    before = [window.gap_before[chosen] for window in windows[1:]]
    within = [window.gap_within[chosen] for window in windows]
    gaps_s = 1e-9 * np.abs([*before, *within, health.age_ns[chosen]])
    limit_s = np.maximum(GAP_S, GAP_ROWS * len(windows) * WINDOW_S / rows)
    for at in np.flatnonzero((gaps_s > limit_s).any(axis=0)).tolist():
        raise TareError(
            f"cube {names[chosen[at]]}: a gap of {gaps_s[:, at].max():.3g} s in the data to "
            f"average, the limit is {limit_s[at]:.2g} s: wait until there are data after it"
        )


def _average(windows: Sequence[Window], chosen: np.ndarray) -> _Means:
    rows = np.array([window.rows[chosen] for window in windows])[:, :, None]
    mean = np.array([window.mean[chosen] for window in windows])
    variance = np.array([window.noise[chosen] for window in windows]) ** 2
    # The first rows of a cube have no differences yet: the noise of their window is NaN.
    with_noise = rows * np.isfinite(variance)
    highest = np.fmax.reduce([window.highest[chosen] for window in windows])
    lowest = np.fmin.reduce([window.lowest[chosen] for window in windows])
    total = rows.sum(axis=0)
    return _Means(
        frequency=(np.where(rows > 0, mean, 0) * rows).sum(axis=0) / total,
        span=highest - lowest,
        noise=np.sqrt(
            (np.nan_to_num(variance) * with_noise).sum(axis=0)
            / np.maximum(with_noise.sum(axis=0), 1)
        ),
    )


def _checks(
    pipeline: Pipeline, health: Health, chosen: np.ndarray, rest: np.ndarray, means: _Means
) -> tuple[_Check, ...]:
    calibrated = np.full(rest.shape, np.nan)
    for row, cube in zip(calibrated, chosen.tolist(), strict=True):
        calibration = pipeline.calibrations[cube]
        row[: calibration.layout.n_pads] = calibration.rest_frequency
    known = health.noise[chosen]
    jumped = means.span > JUMP_SPAN * means.noise
    return (
        _Check(
            np.where(jumped, 0, means.noise / known),
            NOISY,
            "is noisy",
            "times its noise",
            "look for loose leads and interference",
        ),
        _Check(
            means.span / known,
            MOVED,
            "moves",
            "times its noise peak to peak",
            "let it come to rest",
        ),
        _Check(
            100 * np.abs(rest - calibrated) / calibrated,
            100 * FAR,
            "is far from its calibration",
            "%",
            "take the load off, or calibrate the cube again",
        ),
    )


def _apply(
    check: _Check, used: np.ndarray, chosen: np.ndarray, pipeline: Pipeline, names: Sequence[str]
) -> None:
    """TareError that names the worst pad, if one of the used pads is above the limit."""
    bad = used & ~(check.values <= check.limit)
    if not bad.any():
        return
    size = np.where(bad, np.nan_to_num(check.values, nan=np.inf), -1)
    row, pad = np.unravel_index(np.argmax(size), size.shape)
    cube = int(chosen[row])
    name = pipeline.calibrations[cube].layout.pads[pad]
    raise TareError(
        f"cube {names[cube]}: pad {name} {check.problem}: {check.values[row, pad]:.3g} "
        f"{check.unit}, the limit is {check.limit:g}; {check.fix}"
    )
