# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation of creep: the inverse of a linear viscoelastic law, one recursion for each row.

The foam of a pad is a generalised Maxwell body (`models.CreepModel`). Its stress s follows from its
reading u (strain times modulus) and K memories r_k, which are low-passed readings::

    s = u - sum_k a_k r_k,      tau_k dr_k/dt = u - r_k

Between two samples at the distance t, the reading is taken as a straight line from u_0 to u_1, and
the step is then exact for any t::

    r += m (u_0 - r) + (1 - m tau / t) (u_1 - u_0),      m = 1 - exp(-t / tau)

A straight line is used, because the strain of foam is continuous: a reading that is constant
between samples would delay every load by half an interval. What is subtracted from a row follows
from the samples before it, with a constant reading since the last one.

Where nothing is known about earlier loads (before the start, within a long gap), the memories are
computed as if there had been none besides the readings at its ends. The share of a memory that is
not known decays with its relaxation time, and is part of the deviation.

A row is one sample of one cube, C the number of cubes of the skin, P the largest number of pads of
a cube. Stresses are divided by the stiffness of the pads.

Source: R. M. Christensen, Theory of Viscoelasticity (1982), 1.3 and 1.6; R. L. Taylor, K. S.
Pister, G. L. Goudreau, Int. J. Numer. Methods Eng. 2 (1970), 45-59 (the recursion).
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from ..arrays import Array, Index, Mask, PadMasks, Real, Times
from ..errors import LayoutError
from ..pipeline import Pipeline
from ..rows import FrequencyRows
from ..status import CREEP
from .effect import Effect

TIME_LIMITS_S = (0.0, 5.0, math.inf)
"""Limits of the relaxation times, in s, of the groups of memories that are advanced together."""

STEPS_NS = (30_000_000, 200_000_000)
"""Shortest step, in ns, by which the memories of each group are advanced.

The memories of the fastest fit have a relaxation time of 0.1 s, those of the second group at least
5 s. Between two steps, what is subtracted changes linearly, which costs less than a step.
"""

MAX_GAP_NS = 5_000_000_000
"""Longest interval between two rows of a cube, in ns, in which the load is taken as known."""

MAX_UNKNOWN = 100.0
"""Deviation of the stress on a pad because of unknown earlier loads, in Pa, above which the
compensation of creep counts as uncertain: the limit from which drift is a nuisance."""


def relaxed_share(ratio: Array) -> Array:
    """Return 1 - exp(-ratio) for ratios from 0 on, with the same bits on every processor.

    The exponential function of a mathematical library differs in its last bit by processor.
    """
    # exp(-64) is far below the resolution of the sum, so larger ratios need no other value.
    part = np.minimum(ratio, 64.0) / 64
    share = np.zeros_like(part)
    # Taylor series 1 - exp(-x) = x (1 - x/2 (1 - x/3 (1 - ...))) for x up to 1.
    for n in range(18, 0, -1):
        share = part / n * (1 - share)
    # 1 - exp(-2 x) = m (2 - m) with m = 1 - exp(-x).
    for _ in range(6):
        share = share * (2 - share)
    return share


def choose(cube: Index, n_cubes: int) -> Index | slice:
    """Return the rows of tables of cubes for the cubes of one scan, as a slice if it has all.

    A scan has at most one row per cube, in rising order. A slice takes no copy.
    """
    return slice(None) if len(cube) == n_cubes else cube


class _Memories:
    """Memories of all pads whose relaxation times lie between two limits.

    Attributes:
        amplitude: Amplitudes (K, C, P), 0 where a cube has no such pad or time.
        value: The memories (K, C, P).
        unknown: Share of each memory that depends on loads that are not known (K, C).
        time_ns: Time stamp of the row up to which they are advanced (C,), in ns; 0: none yet.
        reading: Reading of the pads in this row (C, P).
    """

    def __init__(
        self,
        time: Array,
        amplitude: Array,
        step_ns: int,
    ) -> None:
        """Start without any row.

        Args:
            time: Relaxation times (K,), in s.
            amplitude: Amplitudes (K, C, P).
            step_ns: Shortest step, in ns.
        """
        self._time = time
        self._step_ns = step_ns
        self.amplitude = amplitude
        self.value = np.zeros_like(amplitude)
        self.unknown = np.ones(amplitude.shape[:2])
        self.time_ns = np.zeros(amplitude.shape[1], np.int64)
        self.reading = np.zeros(amplitude.shape[1:])
        self._offset = np.zeros_like(self.reading)
        self._slope = np.zeros_like(self.reading)

    def set_offset(self, cube: Index | slice) -> None:
        """Compute what is subtracted from cubes now, and how fast it changes, per second."""
        reading = self.reading[cube]
        offset = np.zeros_like(reading)
        slope = np.zeros_like(reading)
        for time, amplitude, value in zip(self._time, self.amplitude, self.value, strict=True):
            share = amplitude[cube]
            relaxed = value[cube]
            offset += share * relaxed
            slope += share / time * (reading - relaxed)
        self._offset[cube] = offset
        self._slope[cube] = slope

    def line_at(self, cube: Index | slice, time_ns: Times) -> tuple[Array, Array]:
        """Return what is subtracted from cubes at times (n,), and its slope, per second (n, P)."""
        elapsed_ns = time_ns - self.time_ns[cube]
        elapsed_s = 1e-9 * elapsed_ns[:, None]
        slope: Array = self._slope[cube]
        offset = self._offset[cube] + slope * elapsed_s
        return offset, slope

    def offset_at(self, cube: Index, stamp_ns: Times) -> Array:
        """Return sum_k a_k r_k for rows of cubes (n, P), with the reading of the last step."""
        relaxed = self.value[:, cube]
        reading = self.reading[cube]
        elapsed_ns = np.maximum(stamp_ns - self.time_ns[cube], 0)
        self._relax(relaxed, elapsed_ns, reading, reading)
        offset = np.zeros_like(reading)
        for amplitude, value in zip(self.amplitude, relaxed, strict=True):
            offset += amplitude[cube] * value
        return offset

    def update(
        self,
        cube: Index,
        stamp_ns: Times,
        reading: Real,
        bad: PadMasks,
    ) -> tuple[Index, Index, Array] | None:
        """Advance the memories of the cubes that are due.

        Args:
            cube: Numbers of the cubes of the rows of one scan (N,).
            stamp_ns: Time stamps (N,), in ns.
            reading: Readings of the pads (N, P).
            bad: Bit masks of the pads that are not used (N,); they keep their last reading.

        Returns:
            Rows whose cubes were advanced; those of them before which the load is not known (n,),
            which are the first of a cube and those after a gap; and the larger readings before and
            after this time (n, P). None: no cube is due.
        """
        elapsed_ns = stamp_ns - self.time_ns[cube]
        # A time stamp before the last one is from another clock: an interval of unknown length.
        is_lost = (self.time_ns[cube] == 0) | (elapsed_ns < 0)
        due = np.flatnonzero(is_lost | (elapsed_ns >= self._step_ns))
        if not len(due):
            return None
        chosen = choose(cube[due], len(self.time_ns))
        elapsed_ns = elapsed_ns[due]
        is_lost = is_lost[due]
        is_gap = is_lost | (elapsed_ns > MAX_GAP_NS)

        pads = np.arange(reading.shape[1], dtype=np.uint32)
        is_bad = bad[due, None] >> pads & 1 > 0
        last = self.reading[chosen]
        now = np.where(is_bad, last, reading[due])
        before = np.where(is_lost[:, None], now, last)

        value = self.value[:, chosen]
        steps_ns = np.where(is_lost, self._step_ns, elapsed_ns)
        share = self._relax(value, steps_ns, before, now)
        # A slice has given a view of the memories, which `_relax` has changed in place.
        if not isinstance(chosen, slice):
            self.value[:, chosen] = value
        unknown = self.unknown[:, chosen]
        unknown = unknown + share * (is_gap - unknown)
        self.unknown[:, chosen] = np.where(is_lost, 1.0, unknown)

        self.time_ns[chosen] = stamp_ns[due]
        self.reading[chosen] = now
        self.set_offset(chosen)
        larger = np.maximum(np.abs(before), np.abs(now))
        return due, due[is_gap], larger[is_gap]

    def _relax(
        self,
        value: Array,
        elapsed_ns: Times,
        before: Array,
        now: Array,
    ) -> Array:
        """Advance memories over one interval each, by the equations of the module, in place.

        Args:
            value: Memories (K, n, P).
            elapsed_ns: Lengths of the intervals (n,), in ns.
            before, now: Readings at their begins and ends (n, P).

        Returns:
            Share m of each interval (K, n).
        """
        # The cubes of a hub have equal intervals, so few shares are computed.
        lengths_ns, number = np.unique(elapsed_ns, return_inverse=True)
        ratio = 1e-9 * lengths_ns / self._time[:, None]
        share = relaxed_share(ratio)
        slope_share = 1 - share / np.maximum(ratio, 1e-12)
        slope_share = slope_share[:, number, None]
        share = share[:, number]
        change = now - before
        for one, m, b in zip(value, share[..., None], slope_share, strict=True):
            one += m * (before - one) + b * change
        return share


class Creep(Effect):
    """Computes what earlier loads still do to the pads of one skin; `Effect` has the attributes."""

    key = "creep"
    bit = CREEP
    is_recursive = True

    def __init__(self, pipeline: Pipeline) -> None:
        super().__init__(pipeline)
        self._pipeline = pipeline
        self._models = [calibration.creep for calibration in pipeline.calibrations]
        self._is_certain = np.ones(len(self._models), bool)
        shape = len(self._models), pipeline.n_pads
        self._stiffness = pipeline.stiffness
        # The larger reading beside times in which the load is not known, stress / stiffness.
        self._scale = np.zeros(shape)
        # What is subtracted is a straight line over the time since a step.
        self._time_ns = np.zeros(len(self._models), np.int64)
        self._offset = np.zeros(shape)
        self._slope = np.zeros(shape)
        self._rest = pipeline.rest_frequency
        self._rest_version = pipeline.rest_version

        self._groups: list[_Memories] = []
        # Relaxation time -> group and number of its memories.
        self._places: dict[float, tuple[_Memories, int]] = {}
        times = {time for model in self._models if model for time in model.time.tolist()}
        for (above, limit), step_ns in zip(pairwise(TIME_LIMITS_S), STEPS_NS, strict=True):
            chosen = sorted(time for time in times if above < time <= limit)
            if not chosen:
                continue
            amplitude = np.zeros((len(chosen), *shape))
            group = _Memories(np.array(chosen), amplitude, step_ns)
            self._groups.append(group)
            for k, time in enumerate(chosen):
                self._places[time] = group, k

        for cube, model in enumerate(self._models):
            if model is not None:
                for time, column in zip(model.time.tolist(), model.amplitude.T, strict=True):
                    group, k = self._places[time]
                    group.amplitude[k, cube, : len(column)] = column

    def add_offset(
        self,
        rows: FrequencyRows,
        cube: Index,
        offset: Real,
    ) -> Mask:
        if self._rest_version != self._pipeline.rest_version:
            self._shift_zero()
        chosen = choose(cube, len(self._models))
        between_ns = rows.stamp_ns - self._time_ns[chosen]
        elapsed_ns = np.maximum(between_ns, 0)
        elapsed_s = 1e-9 * elapsed_ns[:, None]
        offset += self._offset[chosen] + self._slope[chosen] * elapsed_s

        # Over more than a step, the straight line leads too far.
        late = np.flatnonzero(between_ns >= 2 * STEPS_NS[0])
        if len(late):
            numbers = cube[late]
            stamp_ns = rows.stamp_ns[late]
            straight = self._offset[numbers] + self._slope[numbers] * elapsed_s[late]
            exact = sum(group.offset_at(numbers, stamp_ns) for group in self._groups)
            offset[late] += exact - straight

        is_close = (between_ns >= 0) & (between_ns <= MAX_GAP_NS)
        is_certain = self._has_model & self._is_certain
        is_known: Mask = is_certain[chosen] & is_close
        return is_known

    def update(
        self,
        rows: FrequencyRows,
        cube: Index,
        v: Real,
        bad: PadMasks,
    ) -> None:
        for group in self._groups:
            found = group.update(cube, rows.stamp_ns, v, bad)
            # The steps of the slower group are longer, so it is not due before the faster one.
            if found is None:
                break
            due, lost, scale = found
            doubtful = cube[lost]
            self._scale[doubtful] = np.maximum(self._scale[doubtful], scale)
            self._is_certain[doubtful] = False
            self._set_line(choose(cube[due], len(self._models)))
            self._check_certainty()

    def _set_line(self, cube: Index | slice) -> None:
        """Compute what all groups subtract from cubes: a value and a slope from a time on."""
        self._time_ns[cube] = self._groups[0].time_ns[cube]
        lines = [group.line_at(cube, self._time_ns[cube]) for group in self._groups]
        self._offset[cube] = sum(offset for offset, _ in lines)
        self._slope[cube] = sum(slope for _, slope in lines)

    def deviation(self, cube: int) -> Array:
        model = self._models[cube]
        n_pads = self._scale.shape[1]
        if model is None:
            return np.zeros((n_pads, 0))
        patterns = [self._unknown(cube)]
        for pattern in () if model.deviation is None else model.deviation:
            known = np.zeros(n_pads)
            for time, column in zip(model.time.tolist(), pattern.T, strict=True):
                group, k = self._places[time]
                pads = slice(len(column))
                known[pads] += column * group.value[k, cube, pads]
            patterns.append(known * self._stiffness[cube])
        return np.stack(patterns, axis=1)

    def _check_certainty(self) -> None:
        """Find the cubes whose creep is no longer uncertain because of unknown earlier loads."""
        doubtful = np.flatnonzero(~self._is_certain)
        if len(doubtful):
            is_small = self._unknown(doubtful) < MAX_UNKNOWN
            self._is_certain[doubtful] = is_small.all(axis=1)

    def _unknown(self, cube: Index | int) -> Array:
        """Return the standard deviation of the pads' stresses by unknown loads (..., P), in Pa.

        These loads are taken as equally likely from none to the larger reading before and after.

        Args:
            cube: Number of a cube, or numbers (...) of cubes.
        """
        share = np.zeros_like(self._scale[cube])
        for group in self._groups:
            for unknown, amplitude in zip(group.unknown, group.amplitude, strict=True):
                share += unknown[cube, None] * amplitude[cube]
        # Numbers equally likely from 0 to 1 have the root mean square 1 / sqrt(3).
        largest = share * self._scale[cube] * self._stiffness[cube]
        deviation: Array = largest / math.sqrt(3)
        return deviation

    def zero_share(self) -> Array:
        """Return how much of a lasting error of the readings is not taken for creep (C, P).

        A rest frequency has to change by more than the compensated reading of an unloaded pad, as
        the error of the reading has also crept into the memories.
        """
        share = np.ones_like(self._scale)
        for group in self._groups:
            for unknown, amplitude in zip(group.unknown, group.amplitude, strict=True):
                share -= (1 - unknown[:, None]) * amplitude
        return share

    def _shift_zero(self) -> None:
        """Follow new rest frequencies: what they change has been wrong in earlier readings, too."""
        pipeline = self._pipeline
        shift = np.nan_to_num(pipeline.shift_of_zero(self._rest))
        self._rest = pipeline.rest_frequency
        self._rest_version = pipeline.rest_version
        has_moved = shift != 0
        for group in self._groups:
            group.reading -= shift
            known = 1 - group.unknown[..., None]
            group.value -= known * shift
            group.set_offset(slice(None))
            size = np.abs(group.reading)
            np.minimum(self._scale, size, out=self._scale, where=has_moved)
        self._set_line(slice(None))

    def state(self) -> Array:
        parts = [part.ravel() for part in self._parts()]
        return np.concatenate(parts)

    def restore(self, state: Array) -> None:
        parts = self._parts()
        ends = np.cumsum([part.size for part in parts])
        if len(state) != ends[-1]:
            raise LayoutError(
                f"a state of creep has {len(state)} numbers; this skin needs {ends[-1]}"
            )
        for part, values in zip(parts, np.split(state, ends[:-1]), strict=True):
            part[:] = values.reshape(part.shape)
        for group in self._groups:
            group.set_offset(slice(None))
        self._set_line(slice(None))
        self._is_certain[:] = False
        self._check_certainty()
        # The state refers to the rest frequencies of its time.
        self._rest_version = -1

    def _parts(self) -> list[Array]:
        """Return the arrays of the state, which are changed in place; none without a law."""
        parts = [self._rest, self._scale] if self._groups else [np.zeros(0)]
        for group in self._groups:
            # The bits of an integer time stamp, as a float would round it.
            parts += [group.time_ns.view(float), group.reading, group.value, group.unknown]
        return parts
