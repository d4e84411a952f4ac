# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation of creep: the inverse of a linear viscoelastic law.

The foam of a pad is a generalised Maxwell body (`models.CreepModel`). Its stress s follows from its
reading u (strain times modulus) and K memories r_k, which are low-passed readings::

    s = u - sum_k a_k r_k,      tau_k dr_k/dt = u - r_k

The memories are advanced in steps (`low_pass.py`) to the newest row of each cube, with their lags
d_k = u - r_k. What is subtracted from a row at the time t after it follows likewise, for a reading
that has changed along a straight line to the reading u_1 of this row::

    sum_k a_k r_k + (sum_k a_k m_k(t) d_k + (u_1 - u) sum_k a_k (1 - m_k(t) tau_k / t))

The values of the brackets at the end of the step, divided by its length, count as constant, so that
the kernel only needs a slope and a gain.

Where nothing is known about earlier loads (before the start, within a long gap), the memories are
computed as if there had been none besides the readings at its ends. The share of a memory that is
not known decays with its relaxation time, and is part of the deviation.

A row is one sample of one cube, C the number of cubes of the skin, P the largest number of pads of
a cube. Stresses are divided by the stiffness of the pads.

Source: R. M. Christensen, Theory of Viscoelasticity (1982), 1.3 and 1.6.
"""

from __future__ import annotations

import math

import numpy as np

from ..arrays import Array, Index, Mask, Times, multiply
from ..kernel.contract import Offsets
from ..pipeline import Pipeline
from ..status import CREEP
from .low_pass import MAX_STEP_NS, STEP_NS, LowPass

MAX_UNKNOWN = 100.0
"""Deviation of the stress on a pad because of unknown earlier loads, in Pa, above which the
compensation of creep counts as uncertain: the limit from which drift is a nuisance."""

UNIFORM_DEVIATION = math.sqrt(1 / 3)
"""Root mean square of numbers that are equally likely from 0 to 1."""


class Creep:
    """Computes what earlier loads still do to the pads of one skin.

    Attributes:
        has_model: Whether the calibration of a cube has a law of creep (C,).
        offset: What is subtracted from the newest row of each cube at the last step (C, P).
        slope: How fast it changes after this row (C, P), per second, for later readings of 0.
        gain: Change of the slope with later readings (C, P), per second.
    """

    key = "creep"
    bit = CREEP

    def __init__(self, pipeline: Pipeline, offsets: Offsets) -> None:
        """Start without any row.

        Args:
            pipeline: Pipeline with the calibrations and the pads' stiffness.
            offsets: Newest row of each cube.
        """
        self._pipeline = pipeline
        self._newest = offsets
        self._models = [calibration.creep for calibration in pipeline.calibrations]
        self.has_model = np.array([model is not None for model in self._models])
        n_cubes, n_pads = offsets.reading.shape
        times = {time for model in self._models if model for time in model.time.tolist()}
        self._times = np.array(sorted(times))
        self._memories = LowPass(self._times[:, None], n_cubes, n_pads)
        self._amplitude = np.zeros_like(self._memories.lag)
        for cube, model in enumerate(self._models):
            if model is not None:
                places = np.searchsorted(self._times, model.time)
                self._amplitude[places, cube, : model.n_pads] = model.amplitude.T

        self._total = self._amplitude.sum(axis=0)
        self._stiffness = pipeline.stiffness
        self._rest = pipeline.rest_frequency
        self._rest_version = pipeline.rest_version
        # State at the newest row of each cube at the last step: its time, its reading, the share of
        # each memory that depends on unknown loads, and the larger reading beside times in which
        # the load is not known.
        self._time_ns = np.zeros(n_cubes, np.int64)
        self._reading = np.zeros((n_cubes, n_pads))
        self._unknown = np.ones((len(times), n_cubes))
        self._scale = np.zeros((n_cubes, n_pads))
        self._is_certain = np.ones(n_cubes, bool)
        self.offset = np.zeros((n_cubes, n_pads))
        self.slope = np.zeros((n_cubes, n_pads))
        self.gain = np.zeros((n_cubes, n_pads))

    @property
    def is_known(self) -> Mask:
        """Whether the effect on a cube is known and not too uncertain (C,)."""
        return self.has_model & self._is_certain

    def advance(self, thermal: Array, end_ns: int) -> None:
        """Advance the memories to the newest row of each cube.

        Args:
            thermal: What was subtracted from the readings because of temperature (C, P).
            end_ns: Newest time stamp of the scan that comes next, in ns.
        """
        elapsed_ns, is_lost, is_gap = self._find_gaps()
        newest = self._newest.reading.astype(float)
        # Pads that are not used keep their last reading.
        is_unused = np.isnan(newest)
        now = np.where(is_unused, self._reading, newest - thermal)
        change = now - self._reading
        share = self._memories.advance(elapsed_ns * 1e-9, change)
        # A memory forgets what it was before the interval by this share.
        self._unknown += share * (is_gap - self._unknown)
        self._unknown[:, is_lost] = 1.0
        if is_gap.any():
            larger = np.maximum(np.abs(self._reading), np.abs(now))
            np.maximum(self._scale, larger, out=self._scale, where=is_gap[:, None])
            self._is_certain[is_gap] = False
        self._time_ns[:] = self._newest.newest_ns
        self._reading[:] = now
        self._check_certainty()
        ahead_ns = end_ns - self._time_ns
        duration_ns = np.maximum(ahead_ns, STEP_NS)
        self._set_line(duration_ns * 1e-9)

    def _find_gaps(self) -> tuple[Times, Mask, Mask]:
        """Compare the newest row of each cube with that of the last step.

        Returns:
            Time between them (C,), in ns, 0 if it is unknown; whether it is unknown (C,); and
            whether the load between them is unknown (C,).
        """
        elapsed_ns = self._newest.newest_ns - self._time_ns
        is_first = self._time_ns == 0
        # A time stamp before the last one is from another clock.
        is_lost = is_first | (elapsed_ns < 0)
        is_gap = is_lost | (elapsed_ns > MAX_STEP_NS)
        elapsed_ns[is_lost] = 0
        return elapsed_ns, is_lost, is_gap

    def _set_line(self, duration_s: Array) -> None:
        """Compute what is subtracted from cubes, for a straight line over durations (C,) in s."""
        share, mean = self._memories.find_shares(duration_s)
        # Shares per second of a lag, and of a change of the reading, by which memories change.
        of_lag = share / duration_s
        of_change = (1 - mean) / duration_s
        # Before the first row of a cube, there was no reading that could change.
        of_change[:, self._time_ns == 0] = 0
        self.offset[:] = self._total * self._reading
        self.slope[:] = 0
        self.gain[:] = 0
        for k, amplitude in enumerate(self._amplitude):
            missing = amplitude * self._memories.lag[k]
            self.offset -= missing
            missing *= of_lag[k, :, None]
            self.slope += missing
            self.gain += amplitude * of_change[k, :, None]
        self.slope -= self.gain * self._reading

    def deviation(self, cube: int) -> Array:
        """Return patterns (P, k) of one standard deviation each, as `Compensation.growth` does."""
        model = self._models[cube]
        if model is None:
            return np.zeros((len(self._reading[cube]), 0))
        stiffness = self._stiffness[cube]
        reading = self._reading[cube]
        patterns = [self._find_unknown(np.array([cube]))[0]]
        _, _, is_gap = self._find_gaps()
        if is_gap[cube]:
            # The next step will find how much of the memories depends on the gap: at most all.
            newest = np.nan_to_num(self._newest.reading[cube])
            larger = np.maximum(np.abs(reading), np.abs(newest))
            largest = self._total[cube] * larger * stiffness
            patterns = [largest * UNIFORM_DEVIATION]
        if model.deviation is not None:
            places = np.searchsorted(self._times, model.time)
            memory = reading - self._memories.lag[places, cube]
            pads = slice(model.n_pads)
            known = np.zeros((len(model.deviation), len(reading)))
            products = model.deviation.swapaxes(1, 2) * memory[:, pads]
            known[:, pads] = products.sum(axis=1)
            patterns += list(known * stiffness)
        return np.stack(patterns, axis=1)

    def _check_certainty(self) -> None:
        """Find the cubes whose creep is no longer uncertain because of unknown earlier loads."""
        doubtful = np.flatnonzero(~self._is_certain)
        if len(doubtful):
            is_small = self._find_unknown(doubtful) < MAX_UNKNOWN
            self._is_certain[doubtful] = is_small.all(axis=1)

    def _find_unknown(self, cube: Index) -> Array:
        """Return the standard deviation of the pads' stresses by unknown loads (n, P), in Pa.

        These loads are taken as equally likely from none to the larger reading before and after.

        Args:
            cube: Numbers of cubes (n,).
        """
        share = multiply(self._unknown.T[cube], self._amplitude[:, cube].swapaxes(0, 1))
        largest = share * self._scale[cube] * self._stiffness[cube]
        deviation: Array = largest * UNIFORM_DEVIATION
        return deviation

    def zero_share(self) -> Array:
        """Return how much of a lasting error of the readings is not taken for creep (C, P).

        A rest frequency has to change by more than the compensated reading of an unloaded pad, as
        the error of the reading has also crept into the memories.
        """
        known = (1 - self._unknown)[..., None]
        share: Array = 1 - (known * self._amplitude).sum(axis=0)
        return share

    def follow_rest(self) -> bool:
        """Follow new rest frequencies: what they change has been wrong in earlier readings, too.

        Returns:
            Whether something has changed, so that a step is due.
        """
        pipeline = self._pipeline
        if self._rest_version == pipeline.rest_version:
            return False
        shift = np.nan_to_num(pipeline.shift_of_zero(self._rest))
        self._rest[:] = pipeline.rest_frequency
        self._rest_version = pipeline.rest_version
        self._reading -= shift
        self._newest.reading[:] -= shift
        # The memories shift by their known share of it, so the lags by the other share.
        self._memories.lag -= self._unknown[..., None] * shift
        size = np.abs(self._reading)
        np.minimum(self._scale, size, out=self._scale, where=shift != 0)
        return bool(shift.any())

    def parts(self) -> list[Array]:
        """Return the arrays of the state, which are changed in place."""
        return [
            self._newest.reading,
            self._time_ns.view(float),
            self._rest,
            self._reading,
            self._unknown,
            self._scale,
            self._memories.lag,
            self.offset,
            self.slope,
            self.gain,
        ]

    def resume(self) -> None:
        """Continue from a state that was written to `parts`."""
        self._is_certain[:] = False
        self._check_certainty()
        # The state refers to the rest frequencies of its time.
        self._rest_version = -1
