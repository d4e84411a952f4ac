"""Simulated cubes: what the oscillators of their pads do under a stress field, and which cubes each
simulated hub carries. Response and pad law are those of the core."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..config.skin import Skin, SkinLink
from ..core.calibration import Calibration
from ..core.errors import ConfigError
from ..core.modes import COMPONENTS, to_matrix
from ..core.oscillator import pad_frequency, stress_slope
from ..device.wire.protocol import NOT_MEASURED
from .imperfections import Imperfections, PadBehaviour
from .sample_log import ABSENT


class SimulatedCubes:
    """Cubes with the same number of pads.

    noise: standard deviation of a frequency relative to itself, 0 for none; None: what the
    calibration of each cube states. drift: relative change of every rest frequency per second;
    seed: of the noise and, with theirs, of the imperfections.
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
        self.n_pads = calibrations[0].layout.n_pads
        self._drift, self._random = drift, np.random.default_rng(seed)
        self._groups = calibration_groups(calibrations)
        self._noise = np.full((len(calibrations), self.n_pads), noise or 0.0)
        if noise is None:
            for calibration, rows in self._groups:
                self._noise[rows] = frequency_noise(calibration)
        self._is_noisy = bool(self._noise.any())
        self._behaviour = None
        if imperfections is not None:
            shape = (len(calibrations), self.n_pads)
            self._behaviour = PadBehaviour(imperfections, shape, seed)

    def frequency(
        self, stress: NDArray[np.float64], gradient: NDArray[np.float64], seconds: float
    ) -> NDArray[np.uint32]:
        """Frequencies (cubes, pads) in mHz under true fields: stress (cubes, 6) Pa, gradient
        (cubes, 6, 3) Pa/m.

        A pad beyond what its law allows reads NOT_MEASURED, as an oscillator that stopped would.
        """
        on_pads = np.empty((len(stress), self.n_pads))
        for calibration, rows in self._groups:
            state = true_state(calibration, stress[rows], gradient[rows])
            on_pads[rows] = state @ calibration.response.T
        if self._behaviour is not None:
            on_pads = self._behaviour.reported(on_pads, seconds)
        hertz = np.empty_like(on_pads)
        for calibration, rows in self._groups:
            rest = calibration.rest_frequency * (1 + self._drift * seconds)
            hertz[rows] = pad_frequency(on_pads[rows], rest, calibration.beta, calibration.modulus)
        if self._is_noisy:
            hertz *= 1 + self._noise * self._random.standard_normal(hertz.shape)
        return np.nan_to_num(np.rint(hertz * 1e3), nan=NOT_MEASURED).astype("<u4")


@dataclass(frozen=True)
class HubCubes:
    """The cubes of one simulated hub.

    link: that the hub is on
    members: (hub cubes,) index in the skin of each of its cubes, ABSENT where the skin has none
    cubes: those that the skin has
    """

    link: SkinLink
    members: NDArray[np.int64]
    cubes: SimulatedCubes

    @property
    def skin_cubes(self) -> NDArray[np.int64]:
        """Index in the skin of each of its cubes that the skin has, in the hub's order."""
        return self.members[self.members != ABSENT]

    def frequency(
        self, stress: NDArray[np.float64], gradient: NDArray[np.float64], seconds: float
    ) -> NDArray[np.uint32]:
        """Frequencies (hub cubes, pads) in mHz under the fields of the whole skin, as
        `SimulatedCubes.frequency`; NOT_MEASURED where the skin has no cube."""
        cubes = self.skin_cubes
        frequency = np.full((len(self.members), self.cubes.n_pads), NOT_MEASURED, "<u4")
        frequency[self.members != ABSENT] = self.cubes.frequency(
            stress[cubes], gradient[cubes], seconds
        )
        return frequency


def frequency_noise(calibration: Calibration) -> NDArray[np.float64]:
    """(pads,) standard deviation of a frequency relative to itself that makes, at rest, the noise
    in Pa that the calibration states."""
    rest = calibration.rest_frequency
    slope = stress_slope(rest, rest, calibration.beta, calibration.modulus)
    relative: NDArray[np.float64] = calibration.noise / (slope * rest)
    return relative


def hub_cubes(
    skin: Skin,
    *,
    noise: float | None = 0.0,
    drift: float = 0.0,
    imperfections: Imperfections | None = None,
) -> list[HubCubes]:
    """The cubes of each simulated hub of a skin, in the order of its links; without those that
    carry none. noise, drift and imperfections as in `SimulatedCubes`.

    ConfigError: cubes of one hub have different numbers of pads.
    """
    hubs = []
    for number, link in enumerate(skin.links):
        members = hub_members(skin, link.name)
        calibrations = [skin.cubes[i].calibration for i in members if i != ABSENT]
        if not calibrations:
            continue
        widths = {calibration.layout.n_pads for calibration in calibrations}
        if len(widths) > 1:
            raise ConfigError(
                f"link {link.name}: its cubes have {sorted(widths)} pads; all cubes of a hub must "
                "have the same number"
            )
        cubes = SimulatedCubes(
            calibrations, noise=noise, drift=drift, imperfections=imperfections, seed=number
        )
        hubs.append(HubCubes(link, members, cubes))
    return hubs


def hub_members(skin: Skin, link: str) -> NDArray[np.int64]:
    """(hub cubes,) index in the skin of each cube that a simulated hub on this link carries, ABSENT
    for none.

    Cubes that are known by uid alone take the free places; without a link they are on the first
    one.
    """
    by_index = {
        cube.index: number
        for number, cube in enumerate(skin.cubes)
        if cube.link == link and cube.index is not None
    }
    first = skin.links[0].name
    by_uid = [
        number
        for number, cube in enumerate(skin.cubes)
        if cube.index is None and (cube.link or first) == link
    ]
    size = max([len(by_index) + len(by_uid), *(index + 1 for index in by_index)], default=0)
    members = np.full(size, ABSENT)
    members[list(by_index)] = list(by_index.values())
    free = np.flatnonzero(members == ABSENT)[: len(by_uid)]
    members[free] = by_uid
    return members


def calibration_groups(
    calibrations: Sequence[Calibration],
) -> list[tuple[Calibration, NDArray[np.int64]]]:
    """Each calibration once, with the numbers of the cubes that have it."""
    numbers: dict[str, list[int]] = {}
    for number, calibration in enumerate(calibrations):
        numbers.setdefault(calibration.id, []).append(number)
    return [(calibrations[cubes[0]], np.array(cubes)) for cubes in numbers.values()]


def true_state(
    calibration: Calibration, stress: NDArray[np.float64], gradient: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Amplitudes (N, modes) in Pa of true fields: stress (N, 6) Pa, gradient (N, 6, 3) Pa/m.

    What the calibration's modes do not have, such as yy for a planar cube, is left out: its
    response does not say how the pads would answer.
    """
    tensor = to_matrix(np.moveaxis(gradient, -1, -2))  # (N, k, i, j)
    return calibration.modes.state(stress, np.moveaxis(tensor, -3, -1) * calibration.half_side)


def true_components(
    calibration: Calibration, stress: NDArray[np.float64], gradient: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The 15 components (N, 15), Pa and Pa/m, that a cube with this calibration should report of
    true fields."""
    scale = np.where(np.arange(len(COMPONENTS)) < 6, 1.0, 1 / calibration.half_side)
    components: NDArray[np.float64] = (
        true_state(calibration, stress, gradient) @ calibration.modes.components.T * scale
    )
    return components


def skin_components(
    skin: Skin, stress: NDArray[np.float64], gradient: NDArray[np.float64]
) -> NDArray[np.float64]:
    """`true_components` (cubes, 15) of all cubes of a skin."""
    components = np.empty((len(skin.cubes), len(COMPONENTS)))
    for calibration, rows in calibration_groups([cube.calibration for cube in skin.cubes]):
        components[rows] = true_components(calibration, stress[rows], gradient[rows])
    return components
