"""Tracking of slow drift in the rest frequencies of unloaded cubes.

The frequency of a pad without load changes over minutes and hours (temperature, ageing). While
nothing touches a cube, its rest frequencies follow the measured ones with a first-order low-pass
filter. While something touches it, they are frozen.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array, Mask
from ..pipeline import Pipeline
from ..status import LEFT_OUT
from .health import Health
from .statistics import WINDOW_S

CONTACT_THRESHOLD = 3e-4
"""Relative frequency shift |f/f0 - 1| above which a pad counts as loaded.

It corresponds to about 0.1 kPa for foam with E = 0.3 MPa.
"""

RELEASE_S = 5.0
"""Time, in seconds, for which a cube must stay unloaded before its drift is tracked again.

After a contact the elastomer recovers for a few seconds, and tracking at once would learn that
recovery as drift.
"""

WINDOWS_PER_UPDATE = 20
"""Number of statistics windows between two updates of the rest frequencies in use.

Every update is published, so that a recording can be reprocessed. Updating in every window would
fill the recording.
"""


class DriftTracker:
    """Follows slow drift of the rest frequencies of one skin.

    At the end of each statistics window, the tracked rest frequency of every unloaded cube moves
    towards the mean frequency of the window::

        f0 += (mean(f) / temperature_factor - f0) * WINDOW_S / time_constant

    A cube is unloaded when all of its usable pads have been still and within `CONTACT_THRESHOLD`
    of rest for `RELEASE_S`. A load that stays below the threshold cannot be told from drift and is
    absorbed.
    """

    def __init__(self, pipeline: Pipeline, health: Health) -> None:
        self._pipeline = pipeline
        self._health = health
        self._rest_in_use = pipeline.rest_frequency
        self._tracked_rest = self._rest_in_use
        self._unloaded_windows = np.zeros(len(pipeline.calibrations), int)
        self._windows = 0

    def step(self, time_constant: float) -> bool:
        """Process the window that `Health` has just closed.

        Args:
            time_constant: Time constant of the low-pass filter, in seconds.

        Returns:
            Whether new rest frequencies have been put into use.
        """
        self._adopt_tare()
        window = self._health.history[-1]
        has_rows = window.rows > 0
        cubes = np.arange(len(has_rows))
        factor = self._pipeline.temperature_factor(cubes, self._health.temperature)
        measured = window.mean / factor
        # Pads that a cube does not have are NaN, and so never usable.
        is_left_out = self._health.state & LEFT_OUT > 0
        usable = ~is_left_out & ~np.isnan(self._tracked_rest)

        self._count_unloaded_windows(self._is_at_rest(measured, usable), has_rows)
        is_settled = self._unloaded_windows * WINDOW_S > RELEASE_S
        follows = (is_settled & has_rows)[:, np.newaxis] & usable
        gain = min(1.0, WINDOW_S / time_constant)
        change = np.where(follows, (measured - self._tracked_rest) * gain, 0.0)
        self._tracked_rest = self._tracked_rest + change
        return self._update_when_due()

    def _adopt_tare(self) -> None:
        """Start again from the rest frequencies in use if a tare has replaced them."""
        current = self._pipeline.rest_frequency
        if not np.array_equal(current, self._rest_in_use, equal_nan=True):
            self._rest_in_use = self._tracked_rest = current

    def _is_at_rest(self, measured: Array, usable: Mask) -> Mask:
        """Return, per cube, whether all usable pads are still and close to their rest frequency."""
        with np.errstate(invalid="ignore"):  # NaN where a cube has no such pad
            is_close = np.abs(measured / self._tracked_rest - 1) < CONTACT_THRESHOLD
        all_close = (is_close | ~usable).all(axis=1)
        at_rest: Mask = all_close & usable.any(axis=1) & self._health.still
        return at_rest

    def _count_unloaded_windows(self, at_rest: Mask, has_rows: Mask) -> None:
        """Count windows since the last contact. Silence neither ends a contact nor begins one."""
        counted = np.where(at_rest, self._unloaded_windows + 1, 0)
        self._unloaded_windows = np.where(has_rows, counted, self._unloaded_windows)

    def _update_when_due(self) -> bool:
        """Put the tracked rest frequencies into use, every `WINDOWS_PER_UPDATE` windows."""
        self._windows += 1
        unchanged = np.array_equal(self._tracked_rest, self._rest_in_use, equal_nan=True)
        if self._windows % WINDOWS_PER_UPDATE or unchanged:
            return False
        self._rest_in_use = self._pipeline.rest_frequency = self._tracked_rest
        self._health.refresh()
        return True
