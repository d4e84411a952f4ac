# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A simulated skin as a source of frequencies, without ports, threads and waiting."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from ..config.skin import Skin, as_skin
from ..core.arguments import check_number
from ..core.arrays import Array
from ..core.rows import COUNTER_RANGE, FrequencyRows
from ..device.wire.protocol import to_hertz
from .cubes import NO_ERRORS, PadErrors, make_hub_cubes
from .hub import PERIOD_LIMITS_US, SimulatedHub
from .imperfections import NONE, Imperfections
from .load import AnyLoad, read_load, remember


def simulate(
    skin: Skin | Path | str,
    load: AnyLoad | Path | str | None = None,
    *,
    rate: float | None = None,
    duration: float | None = None,
    noise: float = 0.0,
    drift: float = 0.0,
    imperfections: Imperfections | None = None,
) -> SimulatedSource:
    """Simulate the frequencies that the hubs of a skin would send under a load, scan by scan.

    Args:
        skin: Skin to simulate, or the path of a skin file.
        load: Load on the skin (a `Load`, a `MujocoLoad`), or the file of a load script; None: the
            shipped script, an indenter that wanders over the skin.
        rate: Samples per second; None: the rate in the skin file, or 100.
        duration: Simulated time in s; None: without end.
        noise: Standard deviation of a frequency divided by the frequency (8e-6 is usual).
        drift: Relative change of every rest frequency (frequency without load) per second.
        imperfections: Spread, creep and failure of the pads; None: none of them.

    Returns:
        Source of frequency rows.

    Raises:
        ConfigError: The rate is out of the range of the hubs, another number is out of its range,
            the load script cannot be used, or cubes of one hub have different numbers of pads.
    """
    skin = as_skin(skin)
    if load is None or isinstance(load, (Path, str)):
        load = read_load(skin, None if load is None else Path(load))
    if rate is None:
        rate = skin.rate or 1e6 / SimulatedHub.period_us
    # The limits of a hub are sample periods; the longest period gives the lowest rate.
    low, high = (1e6 / limit for limit in reversed(PERIOD_LIMITS_US))
    check_number(
        "rate",
        rate,
        lambda x: low <= x <= high,
        f"{low:g} to {high:g} samples per second",
    )
    if duration is not None:
        check_number(
            "duration",
            duration,
            lambda x: x > 0,
            "a time greater than 0 s, or None",
        )
    check_number(
        "noise",
        noise,
        lambda x: 0 <= x < math.inf,
        "a number of at least 0",
    )
    check_number(
        "drift",
        drift,
        math.isfinite,
        "a finite number",
    )

    # The cubes are created again in each iteration. Creating them here, too, raises errors of the
    # skin before the first iteration.
    make_hub_cubes(skin)
    errors = PadErrors(noise, drift, imperfections or NONE)
    return SimulatedSource(
        skin,
        load,
        round(1e6 / rate),
        duration,
        errors,
    )


@dataclass
class SimulatedSource:
    """A source (`core.rows.Source`) of simulated frequencies. Each iteration starts at time 0.

    One scan has a row (sample) of every cube. The rows are sorted link by link, as the driver
    delivers them. All rows of scan k have the sequence number k and the stamp k × period, in ns
    since the start of the load script. Frequencies are in Hz as float32, rounded to whole mHz as
    those of a real hub. They are NaN for pads that a cube does not have or whose oscillator
    stopped.
    The temperature is unknown (NaN) unless the imperfections state it, and the rows have specific
    forces if the imperfections state poses.

    Attributes:
        skin: Skin to simulate.
        load: Load on the skin.
        period_us: Time between two scans in µs.
        duration: Simulated time in s; None: without end.
        errors: Deviations of the pads from their calibrations: noise, drift, imperfections.
        scans: Number of scans since the last iteration began.
    """

    skin: Skin
    load: AnyLoad
    period_us: int
    duration: float | None = None
    errors: PadErrors = NO_ERRORS
    scans: int = 0
    is_live: ClassVar[bool] = False  # rows are computed on request, not measured

    def __repr__(self) -> str:
        end = "endless" if self.duration is None else f"{self.duration:g} s"
        sizes = f"{len(self.skin.cubes)} cubes, {1e6 / self.period_us:g} Hz, {end}"
        return f"SimulatedSource({self.skin.name!r}: {sizes}, {self.scans} scans given)"

    def statistics(self) -> dict[str, object]:
        """Return how much the latest iteration over this source has simulated.

        Returns:
            Numbers of rows (samples of one cube) and scans (samples of all cubes), and the
            simulated time in s.
        """
        return {
            "rows given": self.scans * len(self.skin.cubes),
            "scans given": self.scans,
            "simulated seconds": self.scans * self.period_us / 1e6,
        }

    def __iter__(self) -> Iterator[FrequencyRows]:
        pads = SkinPads(self.skin, self.errors)
        field_at = remember(self.load)
        end_us = math.inf if self.duration is None else round(1e6 * self.duration)
        self.scans = 0
        while (time_us := self.scans * self.period_us) < end_us:
            self.scans += 1
            stress, gradient = field_at(time_us)
            yield pads.compute_rows(stress, gradient, self.scans - 1, time_us)

    def __enter__(self) -> SimulatedSource:
        return self

    def __exit__(self, *error: object) -> None:
        """Do nothing: no resource is held."""


class SkinPads:
    """Computes the frequencies of all pads of a skin under given stress fields at the cubes."""

    def __init__(self, skin: Skin, errors: PadErrors) -> None:
        """Create the pads.

        Args:
            skin: Skin whose pads are simulated.
            errors: Deviations of the pads from their calibrations.

        Raises:
            ConfigError: Cubes of one hub have different numbers of pads.
        """
        self._hubs = make_hub_cubes(skin, errors)
        # The rows are sorted link by link, as the driver delivers them.
        cubes = [hub.skin_cubes for hub in self._hubs]
        self._cube = np.concatenate(cubes).astype(np.uint16)
        self._n_pads = max(hub.cubes.n_pads for hub in self._hubs)

    def compute_rows(
        self,
        stress: Array,
        gradient: Array,
        number: int,
        time_us: int,
    ) -> FrequencyRows:
        """Compute one scan with a row of every cube.

        Args:
            stress: Stress (cubes, 6) in Pa, order xx yy zz yz zx xy, in the frames of the cubes.
            gradient: Gradient (cubes, 6, 3) in Pa/m.
            number: Sequence number of the scan.
            time_us: Simulated time in µs.
        """
        seconds = 1e-6 * time_us
        frequency = np.full(
            (len(self._cube), self._n_pads),
            np.nan,
            np.float32,
        )
        temperature = np.empty(len(self._cube))
        forces = []
        start = 0
        for hub in self._hubs:
            cubes = hub.skin_cubes
            pads = hub.cubes
            rows = slice(start, start + len(cubes))
            # Frequencies from a real hub are also whole mHz.
            millihertz = pads.compute_frequency(
                stress[cubes],
                gradient[cubes],
                seconds,
            )
            frequency[rows, : pads.n_pads] = to_hertz(millihertz)
            temperature[rows] = pads.compute_temperature(seconds)
            if pads.heavy is not None:
                forces.append(pads.heavy.compute_specific_force(seconds))
            start = rows.stop
        return FrequencyRows.from_values(
            self._cube,
            frequency,
            sequence=number % COUNTER_RANGE,
            stamp_ns=1000 * time_us,
            temperature=temperature,
            specific_force=np.concatenate(forces) if forces else None,
        )
