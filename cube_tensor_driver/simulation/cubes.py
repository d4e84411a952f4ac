"""Simulated cubes: frequencies of their pads under a stress field, and the cubes of each hub.

Response and pad law are those of the core.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..config.skin import Skin, SkinLink
from ..core.arrays import Array, Index
from ..core.calibration import Calibration
from ..core.errors import ConfigError
from ..core.modes import COMPONENTS, STRESS, to_matrix
from ..core.oscillator import pad_frequency, stress_slope
from ..device.wire.protocol import NOT_MEASURED
from .imperfections import Imperfections, PadBehaviour
from .sample_log import ABSENT

Millihertz = NDArray[np.uint32]
"""Frequencies in mHz as on the wire; `NOT_MEASURED` stands for a pad without a frequency."""


class SimulatedCubes:
    """Cubes with the same number of pads.

    Attributes:
        n_pads: Number of pads of each cube.
    """

    def __init__(
        self,
        calibrations: Sequence[Calibration],
        *,
        noise: float | None = 0.0,
        drift: float = 0.0,
        imperfections: Imperfections | None = None,
        seed: int = 0,
    ) -> None:
        """Create the cubes.

        Args:
            calibrations: Calibration of each cube.
            noise: Standard deviation of a frequency divided by the frequency, 0 for none; None: as
                the calibration of each cube states.
            drift: Relative change of every rest frequency per second.
            imperfections: Deviations of the pads from their calibrations.
            seed: Seed of the noise and, with their own seed, of the imperfections.
        """
        self.n_pads = calibrations[0].layout.n_pads
        self._drift = drift
        self._random = np.random.default_rng(seed)
        self._groups = calibration_groups(calibrations)

        shape = (len(calibrations), self.n_pads)
        self._noise = np.full(shape, noise or 0.0)
        if noise is None:
            for calibration, rows in self._groups:
                self._noise[rows] = frequency_noise(calibration)
        self._is_noisy = bool(self._noise.any())

        self._behaviour = None
        if imperfections is not None:
            self._behaviour = PadBehaviour(imperfections, shape, seed)

    def frequency(
        self,
        stress: Array,
        gradient: Array,
        seconds: float,
    ) -> Millihertz:
        """Compute the frequencies under true stress fields.

        Args:
            stress: Stress (cubes, 6) in Pa.
            gradient: Gradient (cubes, 6, 3) in Pa/m.
            seconds: Simulated time in s.

        Returns:
            Frequencies (cubes, pads) in mHz. A pad beyond the range of its law reads
            `NOT_MEASURED`, as an oscillator does that stopped.
        """
        pad_stress = np.empty((len(stress), self.n_pads))
        for calibration, rows in self._groups:
            state = true_state(calibration, stress[rows], gradient[rows])
            pad_stress[rows] = state @ calibration.response.T
        # Deviations of real pads act between the stress and the frequency.
        if self._behaviour is not None:
            pad_stress = self._behaviour.reported(pad_stress, seconds)

        hertz = np.empty_like(pad_stress)
        for calibration, rows in self._groups:
            rest = calibration.rest_frequency * (1 + self._drift * seconds)
            hertz[rows] = pad_frequency(
                pad_stress[rows], rest, calibration.beta, calibration.modulus
            )
        if self._is_noisy:
            hertz *= 1 + self._noise * self._random.standard_normal(hertz.shape)
        # The pad law returns NaN beyond its range.
        return np.nan_to_num(np.rint(hertz * 1e3), nan=NOT_MEASURED).astype("<u4")


@dataclass(frozen=True)
class HubCubes:
    """The cubes of one simulated hub.

    Attributes:
        link: Link that the hub is on.
        members: Index (hub cubes,) in the skin of each of its cubes, `ABSENT` where the skin has
            none.
        cubes: The cubes that the skin has.
    """

    link: SkinLink
    members: Index
    cubes: SimulatedCubes

    @property
    def skin_cubes(self) -> Index:
        """Index in the skin of each of its cubes that the skin has, in the order of the hub."""
        return np.asarray(self.members[self.members != ABSENT])

    def frequency(
        self,
        stress: Array,
        gradient: Array,
        seconds: float,
    ) -> Millihertz:
        """Compute the frequencies (hub cubes, pads) under the fields of the whole skin.

        Arguments as in `SimulatedCubes.frequency`. Cubes that the skin does not have read
        `NOT_MEASURED`.
        """
        shape = (len(self.members), self.cubes.n_pads)
        frequency = np.full(shape, NOT_MEASURED, "<u4")
        cubes = self.skin_cubes
        in_skin = self.members != ABSENT
        frequency[in_skin] = self.cubes.frequency(stress[cubes], gradient[cubes], seconds)
        return frequency


def frequency_noise(calibration: Calibration) -> Array:
    """Compute the noise of the frequencies that causes the noise in Pa of a calibration at rest.

    Returns:
        Standard deviation (pads,) of each frequency divided by the frequency.
    """
    rest = calibration.rest_frequency
    slope = stress_slope(rest, rest, calibration.beta, calibration.modulus)
    return np.asarray(calibration.noise / (slope * rest))


def hub_cubes(
    skin: Skin,
    *,
    noise: float | None = 0.0,
    drift: float = 0.0,
    imperfections: Imperfections | None = None,
) -> list[HubCubes]:
    """Create the cubes of all simulated hubs of a skin, in the order of its links.

    Links without cubes are left out. The other arguments are those of `SimulatedCubes`.

    Raises:
        ConfigError: Cubes of one hub have different numbers of pads.
    """
    hubs = []
    for number, link in enumerate(skin.links):
        members = hub_members(skin, link.name)
        calibrations = [skin.cubes[cube].calibration for cube in members if cube != ABSENT]
        if not calibrations:
            continue
        n_pads = {calibration.layout.n_pads for calibration in calibrations}
        if len(n_pads) > 1:
            raise ConfigError(
                f"link {link.name}: its cubes have {sorted(n_pads)} pads; all cubes of a hub must "
                "have the same number"
            )
        # With the number as seed, hubs have different noise.
        cubes = SimulatedCubes(
            calibrations, noise=noise, drift=drift, imperfections=imperfections, seed=number
        )
        hubs.append(HubCubes(link, members, cubes))
    return hubs


def hub_members(skin: Skin, link: str) -> Index:
    """Return the index in the skin of each cube (hub cubes,) of the hub on a link, or `ABSENT`.

    Cubes that have a uid but no index take the free places; those without a link are on the first
    link.
    """
    by_index = {
        cube.index: number
        for number, cube in enumerate(skin.cubes)
        if cube.link == link and cube.index is not None
    }
    first_link = skin.links[0].name
    by_uid = [
        number
        for number, cube in enumerate(skin.cubes)
        if cube.index is None and (cube.link or first_link) == link
    ]

    # A hub may have cubes that the skin does not use: their indices stay free.
    highest = max(by_index, default=-1)
    size = max(len(by_index) + len(by_uid), highest + 1)
    members = np.full(size, ABSENT)
    members[list(by_index)] = list(by_index.values())
    free = np.flatnonzero(members == ABSENT)
    members[free[: len(by_uid)]] = by_uid
    return members


def calibration_groups(calibrations: Sequence[Calibration]) -> list[tuple[Calibration, Index]]:
    """Return each different calibration with the indices of the cubes that have it."""
    cubes_by_id: dict[str, list[int]] = {}
    for number, calibration in enumerate(calibrations):
        cubes_by_id.setdefault(calibration.id, []).append(number)
    return [(calibrations[cubes[0]], np.array(cubes)) for cubes in cubes_by_id.values()]


def true_state(
    calibration: Calibration,
    stress: Array,
    gradient: Array,
) -> Array:
    """Project true stress fields onto the modes of a calibration.

    What the modes do not contain, such as yy for a planar cube, is left out: the response does not
    tell how the pads would react to it.

    Args:
        calibration: Calibration of the cubes.
        stress: Stress (N, 6) in Pa.
        gradient: Gradient (N, 6, 3) in Pa/m.

    Returns:
        Amplitudes (N, modes) in Pa.
    """
    # The gradient of the modes is that over one half side.
    by_axis = to_matrix(np.moveaxis(gradient, -1, -2))  # (N, axis, i, j)
    scaled = np.moveaxis(by_axis, -3, -1) * calibration.half_side
    return calibration.modes.state(stress, scaled)


def true_components(
    calibration: Calibration,
    stress: Array,
    gradient: Array,
) -> Array:
    """Return the components (N, 15) in Pa and Pa/m that a cube should report of true fields.

    Arguments as in `true_state`.
    """
    # The modes of gradients are in Pa; published gradients are in Pa/m.
    is_stress = np.arange(len(COMPONENTS)) < len(STRESS)
    scale = np.where(is_stress, 1.0, 1 / calibration.half_side)
    state = true_state(calibration, stress, gradient)
    return np.asarray(state @ calibration.modes.components.T * scale)


def skin_components(
    skin: Skin,
    stress: Array,
    gradient: Array,
) -> Array:
    """Return the `true_components` (cubes, 15) of all cubes of a skin."""
    components = np.empty((len(skin.cubes), len(COMPONENTS)))
    for calibration, rows in calibration_groups(skin.calibrations):
        components[rows] = true_components(calibration, stress[rows], gradient[rows])
    return components
