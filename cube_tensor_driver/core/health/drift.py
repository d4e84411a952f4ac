# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Tracking of slow drift in the rest frequencies of cubes.

The frequency of a pad without load changes over minutes and hours (temperature, ageing). While
nothing touches a cube, its rest frequencies follow the measured ones with a first-order low-pass
filter. While something touches the cube, its drift cannot be told from the load, except for a part
that changes no stress. But the unloaded cubes of the skin show the drift that all cubes have in
common, so the rest frequencies of a loaded cube follow the median drift of the unloaded ones. If
fewer than `MIN_UNLOADED_CUBES` are unloaded, the rest frequencies of a loaded cube are kept. The
drift that may remain is stated as a standard deviation.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array, Mask
from ..status import LEFT_OUT
from .health import Health
from .statistics import WINDOW_S

CONTACT_THRESHOLD = 3e-4
"""Relative shift |f/f0 - 1| of a pad's frequency f from its rest frequency f0 above which the pad
counts as loaded.

It corresponds to a stress of about 0.1 kPa for foam with a modulus of 0.3 MPa.
"""

RELEASE_S = 5.0
"""Time, in seconds, for which a cube must stay unloaded before the drift of its rest frequencies
(frequencies without load) is tracked again.

After a contact the elastomer recovers for a few seconds. Earlier tracking would treat this recovery
as drift.
"""

WINDOWS_PER_UPDATE = 20
"""Number of windows of 0.5 s between two updates of the rest frequencies from which stress is
computed.

Every update is published, so that a recording can be reprocessed. Updating in every window would
fill the recording.
"""


MIN_UNLOADED_CUBES = 3
"""Smallest number of unloaded cubes of a layout whose median drift a loaded cube follows. With
fewer, the rest frequencies of the loaded cube are kept.

An unnoticed small load on one of three cubes does not move their median.
"""


class DriftTracker:
    """Follows slow drift of the rest frequencies of one skin.

    At the end of each window of 0.5 s, the tracked rest frequency f0 (frequency without load) of
    every pad of an unloaded cube moves towards the mean frequency of the window::

        f0 += (mean(f) / unloaded_factor - f0) * WINDOW_S / time_constant

    The factor (`Pipeline.compute_unloaded_factor`) corrects for temperature and for the effects
    that are compensated.

    A cube is unloaded when all of its usable pads have been still and within `CONTACT_THRESHOLD`
    of their rest frequency for `RELEASE_S`. A load that stays below the threshold cannot be
    distinguished from drift and becomes part of the rest frequency. The rest frequencies of a
    loaded cube follow the median drift of the unloaded cubes with the same layout.

    Attributes:
        deviation: Standard deviation of the drift that remains uncorrected at a loaded cube
            (cubes,), relative to the rest frequencies; 0 for an unloaded cube.
    """

    def __init__(self, health: Health) -> None:
        pipeline = health.pipeline
        self._pipeline = pipeline
        self._health = health
        self._rest_in_use = pipeline.rest_frequency
        self._tracked_rest = self._rest_in_use
        n_cubes = len(pipeline.calibrations)
        self._unloaded_windows = np.zeros(n_cubes, int)
        self._windows = 0
        # Rest frequencies at the last tare. Then, for each cube: the number of windows since the
        # tare in which it was unloaded, and the number of windows since it was last unloaded.
        self._tared_rest = self._rest_in_use
        self._followed_windows = np.zeros(n_cubes, int)
        self._loaded_windows = np.zeros(n_cubes, int)
        names = np.array([calibration.layout.name for calibration in pipeline.calibrations])
        self._layouts = []
        for name in np.unique(names):
            self._layouts.append(np.flatnonzero(names == name))
        self.deviation = np.zeros(n_cubes)

    def step(self, time_constant: float) -> None:
        """Move the tracked rest frequencies by the statistics of the window that has just ended.

        Args:
            time_constant: Time constant of the low-pass filter, in seconds.
        """
        self._adopt_tare()
        window = self._health.history[-1]
        has_rows = window.rows > 0
        cubes = np.arange(len(has_rows))
        factor = self._pipeline.compute_unloaded_factor(cubes, self._health.temperature)
        measured = window.mean / factor
        # The rest frequency of a pad that a cube does not have is NaN, so this pad is never usable.
        is_left_out = self._health.state & LEFT_OUT > 0
        usable = ~is_left_out & ~np.isnan(self._tracked_rest)

        at_rest = self._is_at_rest(measured, usable)
        self._count_unloaded_windows(at_rest, has_rows)
        is_settled = self._unloaded_windows * WINDOW_S > RELEASE_S
        is_unloaded = is_settled & has_rows
        is_loaded = ~is_settled & has_rows
        follows = is_unloaded[:, np.newaxis] & usable
        follows_others = is_loaded[:, np.newaxis] & usable
        gain = min(1.0, WINDOW_S / time_constant)
        distance = measured - self._tracked_rest
        change = np.where(follows, distance * gain, 0.0)
        self._follow_others(change, follows, follows_others)
        self._tracked_rest = self._tracked_rest + change
        self._update_when_due()

    def _follow_others(
        self,
        change: Array,
        follows: Mask,
        follows_others: Mask,
    ) -> None:
        """Correct the drift of loaded cubes by the median of unloaded ones, and set `deviation`.

        The rates of drift since the last tare differ between the unloaded cubes of a layout. Their
        standard deviation, times the time for which a cube has been loaded, is its `deviation`. If
        too few cubes are unloaded, the rms of the rates of all cubes is used instead, because no
        drift is corrected then.

        Args:
            change: Changes of the tracked rest frequencies in this window (cubes, P), in Hz. Those
                of loaded cubes are 0 and are replaced.
            follows: Whether the rest frequency of a pad follows its own frequency (cubes, P).
            follows_others: Whether the rest frequency follows the pads of other cubes instead
                (cubes, P).
        """
        is_unloaded: Mask = np.asarray(follows.any(axis=1))
        self._followed_windows += is_unloaded
        self._loaded_windows = np.where(
            is_unloaded,
            0,
            self._loaded_windows + 1,
        )
        change_since_tare = self._tracked_rest / self._tared_rest - 1
        drift = np.nanmean(change_since_tare, axis=1)
        for cubes in self._layouts:
            unloaded = cubes[is_unloaded[cubes]]
            rate = drift / np.maximum(self._followed_windows, 1)
            mean_square = np.mean(rate[cubes] ** 2)
            spread = float(np.sqrt(mean_square))
            if len(unloaded) >= MIN_UNLOADED_CUBES:
                ratio = change[unloaded] / self._tracked_rest[unloaded]
                common = np.median(np.nan_to_num(ratio), axis=0)
                common_change = common * self._tracked_rest[cubes]
                change[cubes] += np.where(follows_others[cubes], common_change, 0.0)
                spread = float(np.std(rate[unloaded]))
            self.deviation[cubes] = spread * self._loaded_windows[cubes]

    def _adopt_tare(self) -> None:
        """Track drift from the new rest frequencies if a tare has replaced those of the pipeline.

        The counts of windows since the tare begin again at 0.
        """
        current = self._pipeline.rest_frequency
        if not np.array_equal(current, self._rest_in_use, equal_nan=True):
            self._rest_in_use = self._tracked_rest = self._tared_rest = current
            self._followed_windows[:] = 0
            self._loaded_windows[:] = 0

    def _is_at_rest(self, measured: Array, usable: Mask) -> Mask:
        """Return whether the usable pads of a cube are still and near their rest frequencies.

        Args:
            measured: Mean frequencies of the window at the reference temperature (cubes, P), in Hz.
            usable: Whether a cube has this pad and the pad works (cubes, P).

        Returns:
            Whether each cube is at rest (cubes,); False for a cube without usable pads.
        """
        with np.errstate(invalid="ignore"):  # NaN where a cube has no such pad
            shift = np.abs(measured / self._tracked_rest - 1)
            is_close = shift < CONTACT_THRESHOLD
        all_close = (is_close | ~usable).all(axis=1)
        return all_close & usable.any(axis=1) & self._health.diagnosis.still

    def _count_unloaded_windows(self, at_rest: Mask, has_rows: Mask) -> None:
        """Count the windows (of 0.5 s) for which each cube has been unloaded.

        A cube without rows keeps its count, because nothing shows whether it is loaded.

        Args:
            at_rest: Whether all usable pads are near their rest frequencies (cubes,).
            has_rows: Whether the cube had rows in the window (cubes,).
        """
        counted = np.where(at_rest, self._unloaded_windows + 1, 0)
        self._unloaded_windows = np.where(
            has_rows,
            counted,
            self._unloaded_windows,
        )

    def _update_when_due(self) -> None:
        """Give the tracked rest frequencies to the pipeline every `WINDOWS_PER_UPDATE` windows."""
        self._windows += 1
        unchanged = np.array_equal(
            self._tracked_rest,
            self._rest_in_use,
            equal_nan=True,
        )
        if self._windows % WINDOWS_PER_UPDATE == 0 and not unchanged:
            self._rest_in_use = self._pipeline.rest_frequency = self._tracked_rest
            self._health.refresh()
