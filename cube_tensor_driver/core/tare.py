"""Tare: the present load as no load. And, where asked for, rest frequencies that follow slow drift.

    f0 = mean(f) / factor(T)    per pad, over the windows of `Health`; factor: the calibration's
    temperature model

The mean is of what has been measured already: nobody waits, and what moved a moment ago refuses it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .diagnosis import MIN_COUNT
from .errors import TareError
from .health import HISTORY, Health
from .pipeline import Pipeline
from .statistics import WINDOW_S
from .status import LEFT_OUT

MOVED = 12.0
"""Times the calibration's noise, peak to peak, above which a pad moved: noise alone spans 9 in
10000 rows."""
NOISY = 4.0
"""Times the calibration's noise above which a pad is too noisy for a rest frequency."""
FAR = 0.2
"""Of the calibration's rest frequency: what is further off is a load or another cube, not rest."""
CONTACT = 3e-4
"""Of the rest frequency: a pad further off is in contact, and drift is not followed (about 0.1 kPa
for E = 0.3 MPa)."""
RELEASE_S = 5.0
"""After contact elastomer creeps back for a while."""
APPLY_WINDOWS = 20
"""Drift that was followed comes into force every so many windows, and each time is told: so it can
be replayed."""


def measure_rest(
    pipeline: Pipeline, health: Health, cubes: Sequence[int], duration: float, names: Sequence[str]
) -> np.ndarray:
    """Rest frequencies (cubes of the pipeline, P) in Hz after tare of `cubes`; pads that are left
    out keep theirs.

    duration: s to average over, the newest, in steps of WINDOW_S. names: of all cubes, for the
    reason.
    TareError: a cube's signal moves, is noisy, too far from its calibration, too short, or all its
    pads are bad.
    """
    if not 0 < duration <= HISTORY * WINDOW_S:
        raise TareError(f"tare over {duration:g} s; allowed: above 0 to {HISTORY * WINDOW_S:g} s")
    steps = math.ceil(duration / WINDOW_S - 1e-9)
    if len(health.history) < steps:
        raise TareError(
            f"only {len(health.history) * WINDOW_S:g} s of data since the start; tare takes {duration:g} s: wait"
        )
    # What moves in the window that is not over yet refuses, too.
    newest = health.window()
    windows = [*list(health.history)[-steps:], *([newest] if newest.rows.any() else [])]
    chosen = np.asarray(cubes, dtype=int)
    counts = np.array([window.rows[chosen] for window in windows])
    for cube in chosen[
        (counts[:steps] == 0).any(axis=0) | (counts.sum(axis=0) < MIN_COUNT)
    ].tolist():
        raise TareError(
            f"cube {names[cube]}: no data, or gaps in it, in the last {duration:g} s; see its link"
        )
    calibrations = pipeline.calibrations
    used = (health.state[chosen] & LEFT_OUT == 0) & ~np.isnan(pipeline.rest_frequency[chosen])
    for cube in chosen[~used.any(axis=1)].tolist():
        raise TareError(f"cube {names[cube]}: no pad works; see the diagnostics")
    with np.errstate(invalid="ignore"):
        weight = counts[:, :, None]
        mean = np.array([np.where(w.rows[chosen, None] > 0, w.mean[chosen], 0) for w in windows])
        mean = (mean * weight).sum(axis=0) / weight.sum(axis=0)
        moved = np.fmax.reduce([w.highest[chosen] for w in windows])
        moved = moved - np.fmin.reduce([w.lowest[chosen] for w in windows])
        noise = np.sqrt(
            (np.array([w.noise[chosen] for w in windows]) ** 2 * weight).sum(axis=0)
            / weight.sum(axis=0)
        )
        known = health.noise[chosen]
        temperature = health.temperature[chosen]
        rest = mean / pipeline.temperature_factor(chosen, temperature)
        made = np.full(rest.shape, np.nan)
        for number, cube in enumerate(chosen.tolist()):
            made[number, : calibrations[cube].layout.n_pads] = calibrations[cube].rest_frequency
        off = np.abs(rest - made) / made
        # A jump looks like noise too, but white noise does not span so many times itself.
        noisy = np.where(moved > 10 * noise, 0, noise / known)
    for values, limit, what, unit, fix in (
        (noisy, NOISY, "is noisy", "times its noise", "look for loose leads and interference"),
        (moved / known, MOVED, "moves", "times its noise peak to peak", "let it come to rest"),
        (
            100 * off,
            100 * FAR,
            "is far from its calibration",
            "%",
            "take the load off, or calibrate it anew",
        ),
    ):
        bad = used & ~(values <= limit)
        if bad.any():
            worst = int(np.argmax(np.where(bad, np.nan_to_num(values, nan=np.inf), -1)))
            row, pad = divmod(worst, bad.shape[1])
            cube = int(chosen[row])
            name = calibrations[cube].layout.pads[pad]
            raise TareError(
                f"cube {names[cube]}: pad {name} {what}: {values[row, pad]:.3g} {unit}, the limit is {limit:g}; {fix}"
            )
    result = pipeline.rest_frequency
    result[chosen] = np.where(used, rest, result[chosen])
    return result


class DriftTracker:
    """Rest frequencies that follow a cube's own while nothing touches it.

    f0 += (mean - f0) · WINDOW_S / time_constant at the end of each window, of cubes that stand
    still within CONTACT of rest and have done so for RELEASE_S. A load that holds any pad further
    off than CONTACT freezes it, for as long as the load lasts; a load below that is taken for
    drift.
    """

    def __init__(self, pipeline: Pipeline, health: Health) -> None:
        self._pipeline, self._health = pipeline, health
        self._free = np.zeros(len(pipeline.calibrations), int)  # windows since the last contact
        self._in_force = self._followed = pipeline.rest_frequency
        self._windows = 0

    def step(self, time_constant: float) -> bool:
        """After each window that `Health` closed; time_constant in s. Whether new rest frequencies
        came into force."""
        health, in_force = self._health, self._pipeline.rest_frequency
        if not np.array_equal(in_force, self._in_force, equal_nan=True):  # tare
            self._in_force = self._followed = in_force
        rest = self._followed
        window = health.history[-1]
        cubes = np.arange(len(rest))
        now = window.mean / self._pipeline.temperature_factor(cubes, health.temperature)
        bad = (health.state & LEFT_OUT > 0) | np.isnan(rest)
        with np.errstate(invalid="ignore"):
            near = ((np.abs(now / rest - 1) < CONTACT) | bad).all(axis=1) & ~bad.all(axis=1)
        # Without data nothing is known: silence neither ends a contact nor begins one.
        self._free = np.where(
            window.rows == 0, self._free, np.where(near & health.still, self._free + 1, 0)
        )
        follow = (self._free * WINDOW_S > RELEASE_S) & (window.rows > 0)
        step = np.where(
            follow[:, None] & ~bad, (now - rest) * min(1.0, WINDOW_S / time_constant), 0.0
        )
        self._followed = np.where(np.isnan(rest), rest, rest + step)
        self._windows += 1
        if self._windows % APPLY_WINDOWS or np.array_equal(
            self._followed, in_force, equal_nan=True
        ):
            return False
        self._in_force = self._pipeline.rest_frequency = self._followed
        health.refresh()
        return True
