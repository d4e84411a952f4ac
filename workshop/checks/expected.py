# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Expected reading of each pad in each sample, from the load and the sample log alone.

The hubs repeat a table of instants of the load. Faults that last change its readings. The noise of
a fault depends on the time alone, so that it can be computed again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cube_tensor_driver.config.skin import Skin
from cube_tensor_driver.core.arrays import AnyArray, Array, Index, Mask, PadMasks, Single
from cube_tensor_driver.core.matching import NO_MATCH
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.device.wire.protocol import TEMPERATURE_UNKNOWN
from cube_tensor_driver.simulation.cubes import SimulatedCubes, skin_components
from cube_tensor_driver.simulation.faults import PAD_FAULTS
from cube_tensor_driver.simulation.injector import broken_reading, centi_celsius, warmed, warming
from cube_tensor_driver.simulation.load import Load, default_script

from .record import LATEST_NS, HubFault, Samples, Span

EDGE_NS = 5_000_000
"""Time, in nanoseconds, around the begin and around the end of a fault of a pad or hub. A sample
within it may have the fault or not, because the simulator sometimes carries faults out late."""

MIN_EQUAL_SHARE = 0.5
"""Smallest share of the pads of a row (one cube at one sampling time) that must have the expected
reading. With fewer, the row counts as one of another sample with the same number."""

CHUNK = 100_000
"""Maximum number of rows (one cube at one sampling time) that are compared at a time, so that the
memory for intermediate results does not grow with the duration of a run."""

MILLIHERTZ = 1e-3


@dataclass(frozen=True)
class Readings:
    """Values that N rows (one cube at one sampling time each) of frequencies should have.

    Attributes:
        frequency: Frequency of each pad (N, P), in Hz; NaN where nothing is measured.
        is_certain: Whether the frequency is certain (N, P); it is not near begin or end of a fault.
        temperature: Temperature (N,), in °C; NaN where it is unknown.
        pad_fault: Bits (N,), of which bit p is set if the hub reports that pad p is broken; only
            those of pads with `is_certain` must agree.
        is_sound: Whether no pad is broken and the temperature is that of the calibration (N,).
        instant: Index of the instant of the load, which repeats (N,).
    """

    frequency: Single
    is_certain: Mask
    temperature: Single
    pad_fault: PadMasks
    is_sound: Mask
    instant: Index


@dataclass(frozen=True)
class _SoundReadings:
    """Readings of pads without faults.

    Attributes:
        millihertz: Frequency that each pad would have (N, P), in mHz.
        warming: Temperature of the hub above that of the calibration (N,), in K.
        instant: As in `Readings`.
        is_certain: As in `Readings`.
    """

    millihertz: Any
    warming: Array
    instant: Index
    is_certain: Mask


class ExpectedReadings:
    """Computes what the pads of a simulated skin must read, from its load and its faults.

    Attributes:
        truth: Components of the load (instants, cubes, 15), in Pa and Pa/m.
    """

    def __init__(
        self,
        skin: Skin,
        samples: Samples,
        instants: int,
    ) -> None:
        """Compute the load.

        Args:
            skin: The skin.
            samples: All samples that the hubs took.
            instants: Number of instants of the load that the hubs repeat.
        """
        self._samples = samples
        self._millihertz, self.truth = load_tables(skin, instants)

    def of(self, cube: AnyArray, sample: Index) -> Readings:
        """Compute the readings of cubes (N,) in samples (N,)."""
        sound = self._compute_sound(cube, sample)
        millihertz, certain = sound.millihertz, sound.is_certain
        time_ns = self._samples.time_ns[sample]
        is_sound = sound.warming == 0
        pad_fault = np.zeros(len(cube), np.uint32)

        for fault in self._samples.faults(*PAD_FAULTS):
            pad = fault.fault.pad
            mine = cube == fault.cube
            is_edge = mine & _is_at_edge(fault, time_ns)
            certain[is_edge, pad] = False
            rows = np.flatnonzero(mine & fault.contains(time_ns))
            is_sound &= ~is_edge
            is_sound[rows] = False
            if fault.kind == "report":
                pad_fault[rows] |= np.uint32(1 << pad)
            elif len(rows):
                time_us = self._samples.time_us[sample[rows]]
                readings = millihertz[rows, pad]
                millihertz[rows, pad] = self._break(fault, readings, time_us)

        frequency = (millihertz * MILLIHERTZ).astype(np.float32)
        # A hub sends 0 for a pad whose oscillator has stopped.
        frequency[millihertz == 0] = np.nan
        celsius = centi_celsius(sound.warming)
        # The decoder computes the same float32 product, so that the results must have equal bits.
        temperature = celsius.astype(np.float32) * np.float32(0.01)
        temperature[celsius == TEMPERATURE_UNKNOWN] = np.nan
        return Readings(frequency, certain, temperature, pad_fault, is_sound, sound.instant)

    def _compute_sound(self, cube: AnyArray, sample: Index) -> _SoundReadings:
        """Compute the readings of cubes (N,) in samples (N,) without broken pads."""
        samples = self._samples
        link, time_ns = samples.link[sample], samples.time_ns[sample]
        time_us = samples.time_us[sample]
        load_us = time_us.copy()
        n_pads = self._millihertz.shape[2]
        certain = np.ones((len(cube), n_pads), bool)

        for fault in samples.faults("hold"):
            mine = link == fault.link
            load_us[mine & fault.contains(time_ns)] = fault.start_us
            certain[mine & _is_at_edge(fault, time_ns)] = False
        # A hub goes to the next instant with each sample.
        instant = load_us // samples.period_us[sample] % len(self._millihertz)

        warmer = np.zeros(len(cube))
        for fault in samples.faults("temperature"):
            # A hub keeps its temperature until the next such fault, so the end does not matter.
            since = (link == fault.link) & (time_us >= fault.start_us)
            warmer[since] = warming(fault.fault, fault.start_us, time_us[since])
            is_edge = np.abs(time_ns - fault.begin_ns) < EDGE_NS
            certain[(link == fault.link) & is_edge] = False

        millihertz = self._millihertz[instant, cube]
        is_warm = warmer != 0
        warming_of_pads = warmer[is_warm, np.newaxis]
        millihertz[is_warm] = warmed(millihertz[is_warm], warming_of_pads)
        return _SoundReadings(millihertz, warmer, instant, certain)

    def _break(
        self,
        fault: HubFault,
        millihertz: Any,
        time_us: Index,
    ) -> list[int]:
        """Return the readings of a broken pad (M,), given those of the sound pad, in mHz."""
        first = 0
        if fault.kind == "stuck":
            # A stuck pad repeats what it would have read in the first sample of the fault.
            is_later = self._samples.time_ns >= fault.begin_ns
            is_later &= self._samples.link == fault.link
            later = np.flatnonzero(is_later)
            cubes = np.array([fault.cube])
            sound = self._compute_sound(cubes, later[:1])
            first = int(sound.millihertz[0, fault.fault.pad])
        return [
            broken_reading(fault.fault, reading, first, at)
            for reading, at in zip(
                millihertz.tolist(),
                time_us.tolist(),
                strict=True,
            )
        ]

    def find_held(self, cubes: list[int], span: Span) -> Array | None:
        """Return the constant readings of cubes of one link in a span of time.

        Returns:
            Readings (cubes, P), in Hz; None if the fault "hold" did not keep the load of the hub
            constant for all of the span, or if nothing was sampled.
        """
        samples = self._samples
        link = samples.table.link_of_cube[cubes[0]]
        mine = (samples.link == link) & span.contains(samples.time_ns)
        # The load is held at one row of the hub's table of readings. The index of this row depends
        # on the sampling period.
        instants = {
            fault.start_us // period_us % len(self._millihertz)
            for fault in samples.faults("hold")
            if fault.link == link and _covers(fault, span)
            for period_us in np.unique(samples.period_us[mine]).tolist()
        }
        if len(instants) != 1:
            return None
        return self._millihertz[instants.pop(), cubes] * MILLIHERTZ

    def find_samples(self, rows: FrequencyRows) -> Index:
        """Find the sample of each row (N,); `NO_MATCH` if no hub took such a sample.

        A hub that restarts uses the same sample numbers again, and after a long cut the stamp of a
        row may be nearer to the wrong sample with its number. If the readings of that sample differ
        from the row, a sample with this number and the right readings is taken instead.
        """
        table, boot = self._samples.table, self._samples.boot
        sample = table.match(rows)
        known = np.flatnonzero(sample != NO_MATCH)
        is_alike = self._resembles(rows.select(known), sample[known])
        unlike = known[~is_alike]
        others = rows.select(unlike)

        best_ns = np.full(len(unlike), LATEST_NS)
        for number in np.unique(boot):
            # Within one life of a hub, each number occurs once.
            candidate = table.match(others, np.flatnonzero(boot == number))
            found = np.flatnonzero(candidate != NO_MATCH)
            is_alike = self._resembles(others.select(found), candidate[found])
            found = found[is_alike]
            taken_ns = table.time_ns[candidate[found]]
            distance_ns = np.abs(taken_ns - others.stamp_ns[found])
            is_nearer = distance_ns < best_ns[found]
            nearer = found[is_nearer]
            best_ns[nearer] = distance_ns[is_nearer]
            sample[unlike[nearer]] = candidate[nearer]
        return sample

    def _resembles(self, rows: FrequencyRows, sample: Index) -> Mask:
        """Return whether rows (N,) mostly have the readings of samples (N,)."""
        resembles = np.zeros(len(rows), bool)
        for part in split_in_chunks(np.arange(len(rows))):
            expected = self.of(rows.cube[part], sample[part]).frequency
            # Pads that measure nothing do not tell samples apart.
            is_equal = expected == rows.frequency[part]
            is_equal |= np.isnan(expected)
            resembles[part] = is_equal.mean(axis=1) >= MIN_EQUAL_SHARE
        return resembles


def split_in_chunks(index: Index) -> list[Index]:
    """Split indices (N,) into parts of at most `CHUNK`."""
    return np.array_split(index, 1 + len(index) // CHUNK)


def load_tables(skin: Skin, instants: int) -> tuple[Any, Array]:
    """Compute what pads without faults read, and the load.

    It takes some seconds, but only once for skins of the same calibrations and poses.

    Returns:
        Readings (instants, cubes, pads) in mHz, and components (instants, cubes, 15).
    """
    cubes = [(cube.calibration.id, cube.xyz, cube.rpy) for cube in skin.cubes]
    key = (instants, *cubes)
    if key not in _tables:
        # Only the tables of one skin are kept, because they are large.
        _tables.clear()
        _tables[key] = _compute_tables(skin, instants)
    return _tables[key]


_tables: dict[Any, tuple[Any, Array]] = {}
"""Result of `load_tables` (readings of sound pads, and the load) for the last skin."""


def _compute_tables(skin: Skin, instants: int) -> tuple[Any, Array]:
    load = Load(skin, default_script())
    cubes = SimulatedCubes(skin.calibrations)
    readings, truth = [], []
    for number in range(instants):
        stress, gradient = load.at(number * load.period / instants)
        readings.append(cubes.frequency(stress, gradient, 0.0))
        truth.append(skin_components(skin, stress, gradient))
    return np.array(readings), np.array(truth)


def _covers(outer: Span, inner: Span) -> bool:
    return outer.begin_ns <= inner.begin_ns and inner.end_ns < outer.end_ns


def _is_at_edge(fault: HubFault, time_ns: Index) -> Mask:
    """Find the times (N,) within `EDGE_NS` of the begin or the end of a fault."""
    from_begin_ns = np.abs(time_ns - fault.begin_ns)
    from_end_ns = np.abs(time_ns - fault.end_ns)
    return np.minimum(from_begin_ns, from_end_ns) < EDGE_NS
