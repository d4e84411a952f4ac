# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation of creep: the inverse of a linear viscoelastic law.

The foam of a pad is a generalised Maxwell body (`models.CreepModel`). Its stress s follows from its
reading u (strain times modulus) and K memories r_k, which are low-passed readings::

    s = u - sum_k a_k r_k,      tau_k dr_k/dt = u - r_k

In each step (`low_pass.py`), the memories r_k are advanced to the newest row of each cube, whose
reading is u; d_k = u - r_k is how far they lag behind. The time t later, the reading is u_1. If it
has changed along a straight line, the creep sum_k a_k r_k has then become::

    sum_k a_k r_k + (sum_k a_k m_k d_k + (u_1 - u) sum_k a_k (1 - m_k tau_k / t))

with m_k = 1 - exp(-t / tau_k). Both sums in the large brackets are computed once per step, for the
t of the next scan or the length of a step, whichever is longer, and divided by t. The quotients are
used as constants during the step, so that the kernel (the loop over rows) only needs a slope and a
gain.

Loads before the first row and within a long gap are unknown. The memories are computed as if there
had been no load before the first row, and as if the reading had changed along a straight line
within the gap. The share of a memory that comes from unknown loads decays with its relaxation time.
It causes an error, which `Creep.compute_errors` states.

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
from .models import tabulate

MAX_UNKNOWN = 100.0
"""Standard deviation of the stress on a pad, in Pa, above which the compensation of creep counts as
uncertain. Only the deviation that unknown earlier loads cause is compared with this limit, which is
a third of the pressure of a contact (300 Pa)."""

UNIFORM_DEVIATION = math.sqrt(1 / 3)
"""Root mean square of a number that is uniformly distributed from 0 to 1. An unknown load is taken
as uniformly distributed from 0 to a largest load."""


class Creep:
    """Computes the part of the pads' readings that is creep under earlier loads, for one skin.

    A reading is the stress on a pad by the pad law, divided by the stiffness of the pad. At the
    time t (in s) after the newest reading, creep is the part offset + (slope + gain u) t of the
    next reading u.

    Attributes:
        has_model: Whether the calibration of a cube has a law of creep (C,).
        offset: Creep in the newest row of each cube at the last step (C, P).
        slope: Factor of t (C, P), per second.
        gain: Factor of u t (C, P), per second.
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
        models = [calibration.creep for calibration in pipeline.calibrations]
        self.has_model = np.array([model is not None for model in models])
        shape = n_cubes, n_pads = offsets.reading.shape
        time = tabulate(models, "time", (0,)).T
        amplitude = tabulate(models, "amplitude", (n_pads, 0))
        self._amplitude = np.ascontiguousarray(np.moveaxis(amplitude, 2, 0))
        # Errors of the amplitudes by independent causes (C, causes, P, K).
        self._amplitude_errors = tabulate(
            models,
            "deviation",
            (0, n_pads, len(time)),
        )
        # A cube with fewer relaxation times than another one has the amplitude 0 for the rest.
        self._memories = LowPass(np.where(time > 0, time, 1.0), self._amplitude)
        self.offset, self.slope, self.gain = self._memories.sums
        self._total = self._amplitude.sum(axis=0)
        self._stiffness = pipeline.stiffness
        self._rest = pipeline.rest_frequency
        self._rest_version = pipeline.rest_changes

        # Time stamp, in ns, and readings of the newest row of each cube at the last step.
        self._time_ns = np.zeros(n_cubes, np.int64)
        self._reading = np.zeros(shape)
        # Fraction of each low-passed reading that depends on loads that were not measured.
        self._unknown = np.ones(time.shape)
        # Largest reading of each pad that unmeasured loads are assumed to have caused.
        self._largest_unknown = np.zeros(shape)
        self._is_certain = np.ones(n_cubes, bool)

    @property
    def is_known(self) -> Mask:
        """Whether a cube has a law of creep, and unknown earlier loads cause a small error (C,)."""
        return self.has_model & self._is_certain

    def advance(self, thermal: Array, end_ns: int) -> None:
        """Advance the low-pass filters of the readings to the newest row of each cube.

        Args:
            thermal: Effect of temperature (C, P), stress / stiffness, which the readings contain.
            end_ns: Newest time stamp of the scan that is processed next, in ns.
        """
        elapsed_ns, is_lost, is_gap = self._find_gaps()
        newest: Array = self._newest.reading - thermal
        # The newest reading of a pad that is not used is NaN. The earlier one is kept instead.
        now = np.where(np.isnan(newest), self._reading, newest)
        newest_ns = self._newest.newest_ns
        ahead_s = np.maximum(end_ns - newest_ns, STEP_NS) * 1e-9
        # Before the first row of a cube, its reading is unknown. Infinity makes slope and gain 0.
        ahead_s[newest_ns == 0] = np.inf
        share = self._memories.advance(
            elapsed_ns * 1e-9,
            self._reading,
            now,
            ahead_s,
        )
        # Over the interval, each filter replaces this share of its output by the readings of the
        # interval. The unknown fraction of these readings is 0 or, in a gap, 1.
        self._unknown += share * (is_gap - self._unknown)
        if is_gap.any():
            self._unknown[:, is_lost] = 1
            larger = np.maximum(np.abs(self._reading), np.abs(now))
            largest = self._largest_unknown
            np.maximum(largest, larger, out=largest, where=is_gap[:, None])
            self._is_certain[is_gap] = False
        self._time_ns[:] = newest_ns
        self._reading[:] = now
        self._update_certainty()

    def _find_gaps(self) -> tuple[Times, Mask, Mask]:
        """Return the interval from each cube's newest row at the last step to its newest row now.

        Returns:
            Length of the interval (C,), in ns, 0 if it is unknown; whether the length is unknown
            (C,); and whether the load within the interval is unknown (C,).
        """
        elapsed_ns = self._newest.newest_ns - self._time_ns
        is_first = self._time_ns == 0
        # A time stamp that precedes the last one is from another clock.
        is_lost = is_first | (elapsed_ns < 0)
        is_gap = is_lost | (elapsed_ns > MAX_STEP_NS)
        elapsed_ns[is_lost] = 0
        return elapsed_ns, is_lost, is_gap

    def compute_errors(self, cubes: Index) -> Array:
        """Return the errors (n, P, k) of the computed creep of n cubes, in Pa.

        The k independent causes are unknown earlier loads and errors of the law of creep. Each
        column has the size of one standard deviation.
        """
        reading = self._reading[cubes]
        stiffness = self._stiffness[cubes]
        _, _, is_gap = self._find_gaps()
        # If a cube had a gap without rows before its newest row, the filters have not been advanced
        # over it yet. Until they are, the whole of the creep counts as unknown.
        newest = np.nan_to_num(self._newest.reading[cubes])
        larger = np.maximum(np.abs(reading), np.abs(newest))
        largest = self._total[cubes] * larger * stiffness * UNIFORM_DEVIATION
        unknown = np.where(
            is_gap[cubes, None],
            largest,
            self._find_unknown(cubes),
        )
        memory = reading - self._memories.lag[:, cubes]
        by_law = np.einsum(
            "nspk,knp->nps",
            self._amplitude_errors[cubes],
            memory,
        )
        return np.dstack([unknown, by_law * stiffness[..., None]])

    def _update_certainty(self) -> None:
        """Mark the creep of a cube as certain again if the error by unknown loads is small enough.

        The limit of the error is `MAX_UNKNOWN`.
        """
        doubtful = np.flatnonzero(~self._is_certain)
        if len(doubtful):
            is_small = self._find_unknown(doubtful) < MAX_UNKNOWN
            self._is_certain[doubtful] = is_small.all(axis=1)

    def _find_unknown(self, cube: Index) -> Array:
        """Return the standard deviation of computed creep that unknown loads cause (n, P), in Pa.

        The reading in a gap is taken as uniformly distributed from 0 to the larger one of the
        readings before and after the gap.

        Args:
            cube: Numbers of cubes (n,).
        """
        amplitude = self._amplitude[:, cube].swapaxes(0, 1)
        share = multiply(self._unknown[:, cube].T, amplitude)
        largest = share * self._largest_unknown[cube] * self._stiffness[cube]
        deviation: Array = largest * UNIFORM_DEVIATION
        return deviation

    def find_visible_share(self) -> Array:
        """Return the fraction of a constant error of the readings that is not subtracted (C, P).

        A wrong rest frequency adds a constant to the readings. The compensation takes a part of it
        for creep and subtracts this part, so an unloaded pad shows only the rest of the error. A
        tare divides what it measures by the fraction, in order to correct the whole error.
        """
        known = 1 - self._unknown
        visible: Array = 1 - (known[..., None] * self._amplitude).sum(axis=0)
        return visible

    def follow_rest(self) -> bool:
        """Correct the earlier readings, and their low-passed values, by new rest frequencies.

        The change of a rest frequency, for example by a tare, shows that earlier readings were
        wrong by the same amount.

        Returns:
            Whether a reading changed, so that `offset`, `slope` and `gain` must be computed again.
        """
        pipeline = self._pipeline
        if self._rest_version == pipeline.rest_changes:
            return False
        shift = np.nan_to_num(pipeline.compute_zero_shift(self._rest))
        self._rest[:] = pipeline.rest_frequency
        self._rest_version = pipeline.rest_changes
        self._reading -= shift
        self._newest.reading[:] -= shift
        # The known fraction of a low-passed reading shifts with the readings. So the lag, reading
        # minus low-passed reading, changes by the unknown fraction of the shift.
        self._memories.lag -= self._unknown[..., None] * shift
        largest = self._largest_unknown
        np.minimum(
            largest,
            np.abs(self._reading),
            out=largest,
            where=shift != 0,
        )
        return bool(shift.any())

    def collect_parts(self) -> list[Array]:
        """Return the arrays that hold all that later rows need of the earlier ones (the state).

        To restore a recorded state, write into them and call `resume`.
        """
        return [
            self._newest.reading,
            self._time_ns.view(float),
            self._rest,
            self._reading,
            self._unknown,
            self._largest_unknown,
            self._memories.lag,
            self.offset,
            self.slope,
            self.gain,
        ]

    def resume(self) -> None:
        """Update what depends on the arrays of `collect_parts`, into which a state was restored."""
        self._is_certain[:] = False
        self._update_certainty()
        # The state may have been recorded with other rest frequencies. A version that never occurs
        # makes `follow_rest` compare them.
        self._rest_version = -1
