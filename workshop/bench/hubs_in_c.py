# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Hubs in C (`firmware/`) as the load of a benchmark: their start, and the samples they took."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cube_tensor_driver.config.grid import describe_grid
from cube_tensor_driver.config.yaml import write_yaml
from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.processes.skin_processes import Process
from cube_tensor_driver.simulation.sample_log import CUBE_RANGE, SampleTable
from cube_tensor_hub.firmware import build

FIRMWARE = Path(__file__).resolve().parents[2] / "firmware"
"""Folder of the source of the program that simulates hubs."""

LAYOUTS = {8: "planar", 24: "cube"}
"""Layout of the cubes by their number of pads."""

DEPTH = 0.005
"""Distance from the centres of the cubes to the surface of the skin, in m."""

MAX_CUBES_PER_HUB = 80
"""Largest number of cubes on one simulated hub."""

START_TIME_BYTES = 8
"""Length, in bytes, of the first number in the hubs' log: the wall clock, in ns since the Unix
epoch, at which the clocks of the hubs were 0."""

SAMPLE_RECORD = np.dtype(
    [
        ("hub", "u4"),
        ("number", "u4"),
        ("device_us", "u8"),
    ]
)
"""Format of one sample in the hubs' log, as `firmware/posix/main.c` writes it."""


@dataclass(frozen=True)
class HubLoad:
    """Hubs in C and their cubes.

    Attributes:
        hubs: Number of hubs.
        cubes_per_hub: Number of cubes on each hub.
        pads: Number of pads of each cube, a key of `LAYOUTS`.
    """

    hubs: int
    cubes_per_hub: int
    pads: int = 8

    @classmethod
    def choose(cls, cubes: int, pads: int = 8) -> HubLoad:
        """Choose the smallest number of equal hubs that have at least `cubes` cubes together."""
        hubs = math.ceil(cubes / MAX_CUBES_PER_HUB)
        return cls(hubs, math.ceil(cubes / hubs), pads)

    @property
    def cubes(self) -> int:
        """Number of cubes of all hubs."""
        return self.hubs * self.cubes_per_hub

    def write_skin(self, folder: Path, rate: float) -> Path:
        """Write the file of a skin of these hubs, as square as possible, and return its path.

        Each cube is sampled `rate` times a second.
        """
        path = folder / "skin.yaml"
        sides = range(1, math.isqrt(self.cubes) + 1)
        side = max(side for side in sides if self.cubes % side == 0)
        data = describe_grid(
            nx=self.cubes // side,
            ny=side,
            links=self.hubs,
            rate=rate,
            layout=LAYOUTS[self.pads],
        )
        data["elastomer"] = {"depth": DEPTH, "thickness": 0.0}
        write_yaml(path, data)
        return path

    def make_process(
        self,
        folder: Path,
        ports: Path,
        rate: float,
        log: Path | None = None,
    ) -> Process:
        """Build the program of the hubs, and return how to start it.

        Args:
            folder: Folder to build in.
            ports: Folder for the pseudo-terminals hub0, hub1, …
            rate: Samples per second of each cube.
            log: File for the samples that the hubs take; None: they write none.

        Raises:
            FirmwareError: A tool is missing, or the compiler failed.
        """
        build(FIRMWARE, folder, "posix")
        # The program expects the folder to exist.
        ports.mkdir(exist_ok=True)
        options = {
            "--ports": ports,
            "--hubs": self.hubs,
            "--cubes": self.cubes_per_hub,
            "--pads": self.pads,
            "--period": round(1e6 / rate),
        }
        if log is not None:
            options["--log"] = log
        words = tuple(str(word) for option in options.items() for word in option)
        return Process(
            "hubs",
            "",
            node=False,
            program=str(folder / "cube_hub"),
            arguments=words,
        )


def read_samples(path: Path, load: HubLoad) -> SampleTable:
    """Read which samples the hubs took, for `demo.verification.compare`.

    Raises:
        CubeError: The hubs wrote no sample.
    """
    data = path.read_bytes() if path.exists() else b""
    if len(data) <= START_TIME_BYTES:
        raise CubeError(f"{path}: the hubs took no sample")
    start_ns = int(np.frombuffer(data, np.int64, 1)[0])
    # The program may have been ended while it wrote the last record.
    count = (len(data) - START_TIME_BYTES) // SAMPLE_RECORD.itemsize
    taken = np.frombuffer(data, SAMPLE_RECORD, count, START_TIME_BYTES)
    return SampleTable(
        link=taken["hub"].astype(np.int64),
        # Hubs in C are not restarted, so their numbers do not begin again.
        number=taken["number"].astype(np.int64),
        time_ns=start_ns + 1000 * taken["device_us"].astype(np.int64),
        rows_per_sample=np.full(load.hubs, load.cubes_per_hub),
        link_of_cube=np.arange(CUBE_RANGE) // load.cubes_per_hub,
    )
