"""Rest frequencies that follow slow drift while nothing touches a cube."""

from __future__ import annotations

import numpy as np

from ..pipeline import Pipeline
from ..status import LEFT_OUT
from .health import Health
from .statistics import WINDOW_S

CONTACT = 3e-4
"""Of the rest frequency: a pad further off is in contact, and drift is not followed (about 0.1 kPa
for E = 0.3 MPa)."""
RELEASE_S = 5.0
"""After a contact the elastomer creeps back for a while."""
APPLY_WINDOWS = 20
"""The drift that was followed takes effect every so many windows. Each time is published, so that a
recording can be processed again."""


class DriftTracker:
    """At the end of each window

        f0 += (mean(f) / factor(T) - f0) · WINDOW_S / time_constant

    for cubes that are still, within CONTACT of rest, and have been so for RELEASE_S. A load that
    holds any pad further off than CONTACT stops it for as long as it lasts; a smaller load is taken
    for drift.
    """

    def __init__(self, pipeline: Pipeline, health: Health) -> None:
        self._pipeline, self._health = pipeline, health
        self._free_windows = np.zeros(len(pipeline.calibrations), int)  # since the last contact
        self._in_effect = self._followed = pipeline.rest_frequency
        self._windows = 0

    def step(self, time_constant: float) -> bool:
        """Call it after each window that `Health` closed; time_constant in s.

        Returns whether new rest frequencies took effect.
        """
        health, in_effect = self._health, self._pipeline.rest_frequency
        if not np.array_equal(in_effect, self._in_effect, equal_nan=True):  # after a tare
            self._in_effect = self._followed = in_effect
        rest, window = self._followed, health.history[-1]
        factor = self._pipeline.temperature_factor(np.arange(len(rest)), health.temperature)
        now = window.mean / factor
        bad = (health.state & LEFT_OUT > 0) | np.isnan(rest)
        with np.errstate(invalid="ignore"):
            near = ((np.abs(now / rest - 1) < CONTACT) | bad).all(axis=1) & ~bad.all(axis=1)
        self._count_free(near & health.still, window.rows > 0)
        follow = (self._free_windows * WINDOW_S > RELEASE_S) & (window.rows > 0)
        share = min(1.0, WINDOW_S / time_constant)
        change = np.where(follow[:, None] & ~bad, (now - rest) * share, 0.0)
        self._followed = np.where(np.isnan(rest), rest, rest + change)
        self._windows += 1
        unchanged = np.array_equal(self._followed, in_effect, equal_nan=True)
        if self._windows % APPLY_WINDOWS or unchanged:
            return False
        self._in_effect = self._pipeline.rest_frequency = self._followed
        health.refresh()
        return True

    def _count_free(self, free: np.ndarray, came: np.ndarray) -> None:
        """Count windows without contact. Silence neither ends a contact nor begins one."""
        counted = np.where(free, self._free_windows + 1, 0)
        self._free_windows = np.where(came, counted, self._free_windows)
