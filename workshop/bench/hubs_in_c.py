"""Hubs in C (firmware/) as the load of a benchmark: what starts them, and what they took."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.simulation.sample_log import NEVER
from cube_tensor_hub.firmware import build

FIRMWARE = Path(__file__).resolve().parents[2] / "firmware"
CUBES_PER_HUB = 80
_SAMPLE = np.dtype([("hub", "u4"), ("number", "u4"), ("device_us", "u8")])
"""Of a sample in the log: firmware/posix/main.c."""


@dataclass(frozen=True)
class HubLoad:
    """So many hubs of so many cubes each."""

    hubs: int
    cubes_per_hub: int

    @classmethod
    def of(cls, cubes: int) -> HubLoad:
        """For so many cubes, or a few more: all hubs have as many."""
        hubs = math.ceil(cubes / CUBES_PER_HUB)
        return cls(hubs, math.ceil(cubes / hubs))

    @property
    def cubes(self) -> int:
        return self.hubs * self.cubes_per_hub

    def build(self, folder: Path) -> str:
        """Make the program in the folder, and return its path. FirmwareError: that cannot be."""
        build(FIRMWARE, folder, "posix")
        return str(folder / "cube_hub")

    def arguments(self, ports: Path, rate: float) -> tuple[str, ...]:
        """Of the program: pseudo-terminals hub0, hub1 and so on in the folder `ports`."""
        period = str(round(1e6 / rate))
        numbers = ("--hubs", str(self.hubs), "--cubes", str(self.cubes_per_hub))
        return ("--ports", str(ports), *numbers, "--period", period)


@dataclass(frozen=True)
class TakenSamples:
    """Which samples hubs in C took and when, for `simulation.verification.compare`.

    start_time_ns: wall clock at device time 0
    hub, number, time_ns: (N,) of each sample; the time is that of the wall clock
    """

    start_time_ns: int
    hub: NDArray[np.int64]
    number: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    load: HubLoad

    @classmethod
    def read(cls, path: Path, load: HubLoad) -> TakenSamples:
        """CubeError: the hubs wrote none."""
        data = path.read_bytes() if path.exists() else b""
        if len(data) <= 8:
            raise CubeError(f"{path}: the hubs took no sample")
        start_ns = int(np.frombuffer(data, np.int64, 1)[0])
        whole = (len(data) - 8) // _SAMPLE.itemsize
        taken: NDArray[Any] = np.frombuffer(data, _SAMPLE, whole, 8)
        time_ns = start_ns + 1000 * taken["device_us"].astype(np.int64)
        hub, number = taken["hub"].astype(np.int64), taken["number"].astype(np.int64)
        return cls(start_ns, hub, number, time_ns, load)

    def rows_taken(self, start_ns: int, end_ns: int) -> int:
        """Rows (one cube, one sample) taken from start_ns to before end_ns of the wall clock."""
        within = (self.time_ns >= start_ns) & (self.time_ns < end_ns)
        return self.load.cubes_per_hub * int(np.count_nonzero(within))

    def taken_ns(
        self, cube: NDArray[Any], sequence: NDArray[Any], stamp_ns: NDArray[Any]
    ) -> NDArray[np.int64]:
        """When samples (N,) were taken, wall clock; NEVER for what no hub took."""
        times = np.full((self.load.hubs, int(self.number.max()) + 1), NEVER, np.int64)
        times[self.hub, self.number] = self.time_ns
        found = np.full(len(cube), NEVER, np.int64)
        known = sequence < times.shape[1]
        hub = cube[known].astype(np.int64) // self.load.cubes_per_hub
        found[known] = times[hub, sequence[known].astype(np.int64)]
        return found
