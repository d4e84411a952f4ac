"""What each pad read in each sample: from the load, and from the faults of the sample log alone.

The hubs repeat a table of instants of the load. Faults that last change its readings; noise depends
on the time alone, so that it can be computed again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cube_tensor_driver.config.skin import Skin
from cube_tensor_driver.device.wire.protocol import TEMPERATURE_UNKNOWN
from cube_tensor_driver.simulation.cubes import SimulatedCubes, skin_components
from cube_tensor_driver.simulation.faults import PAD_FAULTS
from cube_tensor_driver.simulation.injector import broken_reading, centi_celsius, warmed, warming
from cube_tensor_driver.simulation.load import Load, default_script
from cube_tensor_driver.simulation.sample_log import FaultRecord, SampleLog

from .samples import Samples

EDGE_US = 5_000
"""So near to the begin or end of a fault a sample may be of either side: the simulator is late now
and then."""


@dataclass(frozen=True)
class Readings:
    """What N rows should say.

    frequency: (N, P) Hz, NaN: not measured; certain: (N, P) bool, False near the edge of a fault
    temperature: (N,) °C, NaN: unknown; pad_fault: (N,) bits, as far as `certain`
    sound: (N,) bool, no pad is broken and the temperature is that of the calibration
    instant: (N,) of the load
    """

    frequency: NDArray[np.float32]
    certain: NDArray[np.bool_]
    temperature: NDArray[np.float32]
    pad_fault: NDArray[np.uint32]
    sound: NDArray[np.bool_]
    instant: NDArray[np.int64]


class Expected:
    """The readings of a skin's cubes.

    truth: (instants, cubes, 15) components of the load, Pa and Pa/m
    """

    def __init__(self, skin: Skin, log: SampleLog, samples: Samples, instants: int) -> None:
        """instants: how many of the load the hubs repeat."""
        self._samples, self._log = samples, log
        self._millihertz, self.truth = load_tables(skin, instants)
        n_cubes = len(skin.cubes)
        self._link, self._place = np.zeros((2, n_cubes), np.int64)
        for number, link in enumerate(log.links):
            self._link[link.members] = number
            self._place[link.members] = [link.cubes.index(cube) for cube in link.members]
        self._number = {link.name: number for number, link in enumerate(log.links)}
        self._by_link: list[list[FaultRecord]] = [[] for _ in log.links]
        for record in log.faults:
            self._by_link[self._number[record.fault.link]].append(record)

    def records(self, *kinds: str) -> list[tuple[int, FaultRecord]]:
        """Number of the link and record of the faults of some kinds, in order."""
        return [
            (self._number[record.fault.link], record)
            for record in self._log.faults
            if record.fault.kind in kinds
        ]

    def link_of(self, cube: int) -> int:
        """Number of the link that a cube is on."""
        return int(self._link[cube])

    def cube_of(self, record: FaultRecord) -> int:
        """Index in the skin of the cube that the fault of a pad is on."""
        return self._log.links[self._number[record.fault.link]].cubes[record.fault.cube]

    def of(self, cube: NDArray[np.integer], sample: NDArray[np.int64]) -> Readings:
        """The readings of cubes (N,) in samples (N,) of `Samples`."""
        time_us, period_us = self._samples.time_us[sample], self._samples.period_us[sample]
        link = self._link[cube]
        load_us = time_us.copy()
        certain = np.ones((len(cube), self._millihertz.shape[2]), bool)
        for number, record in self.records("hold"):
            mine = link == number
            load_us[mine & _within(record, time_us)] = record.start_us
            certain[mine & _near_edge(record, time_us)] = False
        instant = load_us // period_us % len(self._millihertz)
        millihertz = self._millihertz[instant, cube]
        warmer = self._warmer(link, time_us, certain)
        warm = warmer != 0
        millihertz[warm] = warmed(millihertz[warm], warmer[warm, None])
        sound, pad_fault = ~warm, np.zeros(len(cube), np.uint32)
        for _, record in self.records(*PAD_FAULTS):
            fault = record.fault
            mine = cube == self.cube_of(record)
            edge = mine & _near_edge(record, time_us)
            certain[edge, fault.pad] = False
            sound &= ~edge
            rows = np.flatnonzero(mine & _within(record, time_us))
            if not len(rows):
                continue
            sound[rows] = False
            if fault.kind == "report":
                pad_fault[rows] |= np.uint32(1 << fault.pad)
                continue
            first = self._first_reading(record) if fault.kind == "stuck" else 0
            readings = zip(
                millihertz[rows, fault.pad].tolist(), time_us[rows].tolist(), strict=True
            )
            millihertz[rows, fault.pad] = [
                broken_reading(fault, sound_mhz, first, at) for sound_mhz, at in readings
            ]
        frequency = (millihertz * 1e-3).astype(np.float32)
        frequency[millihertz == 0] = np.nan
        celsius = centi_celsius(warmer)
        temperature = celsius.astype(np.float32) * np.float32(0.01)
        temperature[celsius == TEMPERATURE_UNKNOWN] = np.nan
        return Readings(frequency, certain, temperature, pad_fault, sound, instant)

    def held(self, cubes: list[int], begin_ns: int, end_ns: int) -> NDArray[np.float64] | None:
        """(cubes, P) Hz that sound cubes of one link read all of a simulated time; None if their
        load did not stay, or nothing was sampled."""
        begin_us, end_us = begin_ns // 1000, end_ns // 1000
        link, time_us = self._link[cubes[0]], self._samples.time_us
        mine = (self._samples.link == link) & (time_us >= begin_us) & (time_us <= end_us)
        # The load is held at an instant of the hub's table, whose numbers depend on the period.
        instants = {
            record.start_us // period % len(self._millihertz)
            for number, record in self.records("hold")
            if number == link and record.start_us <= begin_us and end_us < record.end_us
            for period in np.unique(self._samples.period_us[mine]).tolist()
        }
        if len(instants) != 1:
            return None
        return np.asarray(self._millihertz[instants.pop(), cubes] * 1e-3, np.float64)

    def _warmer(
        self, link: NDArray[np.int64], time_us: NDArray[np.int64], certain: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """(N,) °C above room temperature; marks what is not certain. Each fault lasts until the
        next one."""
        warmer = np.zeros(len(link))
        for number, record in self.records("temperature"):
            since = (link == number) & (time_us >= record.start_us)
            warmer[since] = warming(record.fault, record.start_us, time_us[since])
            certain[(link == number) & (np.abs(time_us - record.start_us) < EDGE_US)] = False
        return warmer

    def _first_reading(self, record: FaultRecord) -> int:
        """What the pad of a fault would have read in the first sample of it, mHz."""
        samples, cube = self._samples, self.cube_of(record)
        number = self._number[record.fault.link]
        later = (samples.link == number) & (samples.time_us >= record.start_us)
        first = int(np.flatnonzero(later)[0])
        at_us, period_us = samples.time_us[first : first + 1], int(samples.period_us[first])
        load_us = int(at_us[0])
        for link, held in self.records("hold"):
            if link == number and held.start_us <= load_us < held.end_us:
                load_us = held.start_us
        millihertz = self._millihertz[load_us // period_us % len(self._millihertz), cube]
        certain = np.ones((1, len(millihertz)), bool)
        warmer = self._warmer(np.array([number]), at_us, certain)
        if warmer[0]:
            millihertz = warmed(millihertz, warmer[0])
        return int(millihertz[record.fault.pad])


class _SkinKey:
    """A skin that is the same as another one of the same calibrations and poses: the tables of
    several runs are computed once."""

    def __init__(self, skin: Skin) -> None:
        self.skin = skin
        self._key = tuple((cube.calibration.id, cube.xyz, cube.rpy) for cube in skin.cubes)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _SkinKey) and self._key == other._key


def load_tables(skin: Skin, instants: int) -> tuple[NDArray[np.uint32], NDArray[np.float64]]:
    """Readings (instants, cubes, pads) of sound pads, mHz, and components (instants, cubes, 15).
    They take some seconds, once for skins of the same cubes."""
    return _tables(_SkinKey(skin), instants)


@lru_cache(maxsize=1)
def _tables(key: _SkinKey, instants: int) -> tuple[NDArray[np.uint32], NDArray[np.float64]]:
    skin = key.skin
    load = Load(skin, default_script())
    cubes = SimulatedCubes([cube.calibration for cube in skin.cubes])
    readings, truth = [], []
    for number in range(instants):
        stress, gradient = load.at(number * load.period / instants)
        readings.append(cubes.frequency(stress, gradient, 0.0))
        truth.append(skin_components(skin, stress, gradient))
    return np.array(readings), np.array(truth)


def _within(record: FaultRecord, time_us: NDArray[np.int64]) -> NDArray[np.bool_]:
    return (time_us >= record.start_us) & (time_us < record.end_us)


def _near_edge(record: FaultRecord, time_us: NDArray[np.int64]) -> NDArray[np.bool_]:
    return (np.abs(time_us - record.start_us) < EDGE_US) | (
        np.abs(time_us - record.end_us) < EDGE_US
    )
