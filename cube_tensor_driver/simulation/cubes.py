# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated cubes: frequencies of their pads under a stress field, and the cubes of each hub.

The response matrix and the law from stress to frequency are those of the driver's core.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..config.skin import Skin, SkinLink
from ..core.arrays import Array, Index
from ..core.calibration import Calibration, tabulate_pads
from ..core.errors import ConfigError
from ..core.modes import COMPONENTS, to_gradient_tensor
from ..core.oscillator import compute_pad_frequency
from ..core.poses import CubePoses
from ..device.wire.protocol import NOT_MEASURED
from .imperfections import NONE, Imperfections, PadBehaviour
from .motion import HeavyPads, read_weight
from .sample_log import ABSENT
from .temperature import ThermalPads

Millihertz = NDArray[np.uint32]
"""Array of frequencies in mHz, as a hub sends them. The value `NOT_MEASURED` stands for a pad
without a frequency."""


class PadErrors(NamedTuple):
    """Deviations of simulated pads from their calibrations.

    Attributes:
        noise: Standard deviation of a frequency divided by the frequency, 0 for no noise. None: the
            noise in the calibration of each cube.
        drift: Relative change of every rest frequency (frequency without load) per second.
        imperfections: Spread, creep, temperature and failure of the pads, and motion of the skin.
    """

    noise: float | None = 0.0
    drift: float = 0.0
    imperfections: Imperfections = NONE


NO_ERRORS = PadErrors()
"""Pads without noise, drift and imperfections."""


class SimulatedCubes:
    """Computes the frequencies of simulated cubes with the same number of pads.

    Attributes:
        n_pads: Number of pads of each cube.
        heavy: Motion and weight of the cubes; None: they weigh nothing.
    """

    def __init__(
        self,
        calibrations: Sequence[Calibration],
        errors: PadErrors = NO_ERRORS,
        *,
        seed: int = 0,
        poses: CubePoses | None = None,
    ) -> None:
        """Create the cubes.

        Args:
            calibrations: Calibration of each cube.
            errors: Deviations of the pads from their calibrations.
            seed: Seed of the random noise. Together with the seed of the imperfections, it also
                determines the deviation of each pad.
            poses: Poses of the cubes in the parent frame of the skin; None: they weigh nothing.
        """
        noise, self._drift, imperfections = errors
        self.n_pads = calibrations[0].layout.n_pads
        self._random = np.random.default_rng(seed)
        self._groups = group_by_calibration(calibrations)

        self._law = [
            tabulate_pads(calibrations, name, self.n_pads, fill=np.nan)
            for name in ("rest_frequency", "beta", "modulus")
        ]

        shape = (len(calibrations), self.n_pads)
        if noise is None:
            self._noise = np.array([compute_frequency_noise(one) for one in calibrations])
        else:
            self._noise = np.full(shape, noise)

        self._behaviour = PadBehaviour(imperfections, shape, seed)
        self._thermal: ThermalPads | None = None
        if imperfections.temperature:
            self._thermal = ThermalPads(imperfections, shape, seed)
        self.heavy: HeavyPads | None = None
        if imperfections.poses and poses is not None:
            response = read_weight(imperfections.weight, self.n_pads)
            self.heavy = HeavyPads(response, poses, imperfections.poses)

    def compute_temperature(self, seconds: float) -> float:
        """Return the temperature, in °C, that the hub measures at a simulated time in s.

        It is NaN if it is unknown.
        """
        return math.nan if self._thermal is None else self._thermal.measure(seconds)

    def compute_frequency(
        self,
        stress: Array,
        gradient: Array,
        seconds: float,
    ) -> Millihertz:
        """Compute the frequencies of all pads under given stress fields.

        Args:
            stress: Stress (cubes, 6) in Pa, order xx yy zz yz zx xy, in the frames of the cubes.
            gradient: Gradient (cubes, 6, 3) in Pa/m: derivatives of the stress along x, y and z.
            seconds: Simulated time in s.

        Returns:
            Frequencies (cubes, pads) in mHz. A pad has `NOT_MEASURED` if its oscillator does not
            run, or if its stress is outside the range of the pad law (stress to frequency).
        """
        pad_stress = np.empty((len(stress), self.n_pads))
        for calibration, rows in self._groups:
            amplitudes = compute_true_amplitudes(
                calibration,
                stress[rows],
                gradient[rows],
            )
            pad_stress[rows] = amplitudes @ calibration.response.T
        rest, beta, modulus = self._law
        rest = rest * (1 + self._drift * seconds)
        if self._thermal is not None:
            thermal_stress, warm = self._thermal.compute_effect(seconds)
            pad_stress += thermal_stress
            rest *= warm
        if self.heavy is not None:
            pad_stress += self.heavy.compute_stress(seconds)
        # Imperfections change the stress that determines a pad's frequency.
        reported = self._behaviour.compute_reported(pad_stress, seconds)
        hertz = compute_pad_frequency(
            reported,
            rest,
            beta,
            modulus,
        )
        hertz *= 1 + self._noise * self._random.standard_normal(hertz.shape)
        # The frequency is NaN if the stress is outside the range of the pad law.
        millihertz = np.rint(hertz * 1e3)
        return np.nan_to_num(millihertz, nan=NOT_MEASURED).astype("<u4")


@dataclass(frozen=True)
class HubCubes:
    """The cubes of one simulated hub.

    Attributes:
        link: Link of the skin that the hub is on.
        members: (hub cubes,) indices in the skin of the hub's cubes, in the order of the hub;
            `ABSENT` for cubes that are not in the skin.
        cubes: Computes the frequencies of those cubes of the hub that are in the skin.
    """

    link: SkinLink
    members: Index
    cubes: SimulatedCubes

    @property
    def skin_cubes(self) -> Index:
        """Indices in the skin of the hub's cubes, without absent ones, in the order of the hub."""
        return np.asarray(self.members[self.members != ABSENT])

    def compute_frequency(
        self,
        stress: Array,
        gradient: Array,
        seconds: float,
    ) -> Millihertz:
        """Compute the frequencies of the hub's cubes under the stress fields of the whole skin.

        Args:
            stress: Stress (cubes of the skin, 6) in Pa, order xx yy zz yz zx xy.
            gradient: Gradient (cubes of the skin, 6, 3) in Pa/m.
            seconds: Simulated time in s.

        Returns:
            Frequencies (cubes of the hub, pads) in mHz; `NOT_MEASURED` for the pads of cubes that
            are not in the skin.
        """
        shape = (len(self.members), self.cubes.n_pads)
        frequency = np.full(shape, NOT_MEASURED, "<u4")
        in_skin = self.members != ABSENT
        cubes = self.skin_cubes
        frequency[in_skin] = self.cubes.compute_frequency(
            stress[cubes],
            gradient[cubes],
            seconds,
        )
        return frequency


def compute_frequency_noise(calibration: Calibration) -> Array:
    """Convert the noise (standard deviation) of unloaded pads from Pa to frequencies.

    Args:
        calibration: Calibration, which states the noise of each pad in Pa.

    Returns:
        Standard deviation (pads,) of each frequency divided by the frequency.
    """
    # Without load, the stress of a pad grows by E (1 + beta) per relative change of its frequency.
    stress_per_change = calibration.modulus * (1 + calibration.beta)
    return np.asarray(calibration.noise / stress_per_change)


def make_hub_cubes(
    skin: Skin,
    errors: PadErrors = NO_ERRORS,
) -> list[HubCubes]:
    """Create the cubes of all simulated hubs of a skin, in the order of its links.

    Links without cubes are left out.

    Args:
        skin: The skin.
        errors: Deviations of the pads from their calibrations.

    Raises:
        ConfigError: Cubes of one hub have different numbers of pads.
    """
    hubs = []
    poses = skin.poses
    for number, link in enumerate(skin.links):
        members = find_hub_members(skin, link.name)
        present = members[members != ABSENT]
        calibrations = [skin.calibrations[cube] for cube in present]
        if not calibrations:
            continue
        n_pads = {calibration.layout.n_pads for calibration in calibrations}
        if len(n_pads) > 1:
            raise ConfigError(
                f"link {link.name}: its cubes have {sorted(n_pads)} pads; all cubes of a hub must "
                "have the same number"
            )
        # The index of the link is the seed, so that the noise of different hubs differs.
        cubes = SimulatedCubes(
            calibrations,
            errors,
            seed=number,
            poses=CubePoses(*(column[present] for column in poses)),
        )
        hubs.append(HubCubes(link, members, cubes))
    return hubs


def find_hub_members(skin: Skin, link: str) -> Index:
    """Return the indices in the skin of the cubes that the hub on a link has.

    A cube whose index on the hub is given in the skin file has this index. Cubes for which the skin
    file gives a uid (unique number) instead take the free indices, in the order of the skin. If the
    skin file gives no link for such a cube, it is on the first link of the skin.

    Args:
        skin: The skin.
        link: Name of the link.

    Returns:
        (hub cubes,) index in the skin for each index on the hub; `ABSENT` for an index on the hub
        that no cube of the skin has.
    """
    by_index: dict[int, int] = {}
    by_uid: list[int] = []
    for number, cube in enumerate(skin.cubes):
        if (cube.link or skin.links[0].name) != link:
            continue
        if cube.index is None:
            by_uid.append(number)
        else:
            by_index[cube.index] = number

    # The highest index can exceed the number of the hub's cubes in the skin, because the hub may
    # have further cubes that are not in the skin.
    highest = max(by_index, default=-1)
    size = max(len(by_index) + len(by_uid), highest + 1)
    members = np.full(size, ABSENT)
    members[list(by_index)] = list(by_index.values())
    free = np.flatnonzero(members == ABSENT)
    members[free[: len(by_uid)]] = by_uid
    return members


def group_by_calibration(
    calibrations: Sequence[Calibration],
) -> list[tuple[Calibration, Index]]:
    """Group cubes by calibration.

    Args:
        calibrations: Calibration of each cube.

    Returns:
        Each different calibration, with the indices of the cubes that have it.
    """
    ids = [calibration.id for calibration in calibrations]
    _, first, group = np.unique(ids, return_index=True, return_inverse=True)
    return [
        (calibrations[cube], np.flatnonzero(group == number))
        for number, cube in enumerate(first.tolist())
    ]


def compute_true_amplitudes(
    calibration: Calibration,
    stress: Array,
    gradient: Array,
) -> Array:
    """Compute the amplitudes of the modes in given stress fields.

    The modes are the linear stress fields for which the calibration contains the response of the
    pads. Other parts of the given fields, such as yy for a planar cube, are left out.

    Args:
        calibration: Calibration of the cubes.
        stress: Stress (N, 6) at N cubes in Pa, order xx yy zz yz zx xy.
        gradient: Gradient (N, 6, 3) in Pa/m: derivatives of the stress along x, y and z.

    Returns:
        Amplitudes (N, modes) in Pa.
    """
    # The modes take gradients in Pa, as the change of the stress over half the side of a cube.
    change = to_gradient_tensor(gradient) * calibration.half_side
    return calibration.modes.compute_amplitudes(stress, change)


def compute_skin_components(
    skin: Skin,
    stress: Array,
    gradient: Array,
) -> Array:
    """Return the stress components that the cubes of a skin would measure without errors.

    Args:
        skin: Skin.
        stress: Stress (cubes, 6) in Pa that acts on each cube, order xx yy zz yz zx xy.
        gradient: Gradient (cubes, 6, 3) in Pa/m.

    Returns:
        Components (cubes, 15): six stresses in Pa, then nine gradients in Pa/m.
    """
    components = np.empty((len(skin.cubes), len(COMPONENTS)))
    for calibration, rows in group_by_calibration(skin.calibrations):
        amplitudes = compute_true_amplitudes(
            calibration,
            stress[rows],
            gradient[rows],
        )
        in_pascal = amplitudes @ calibration.modes.components.T
        components[rows] = in_pascal * calibration.component_scale
    return components
