"""Simulated cubes: what their pads' oscillators do under a stress field. Response and pad law are
those of the core."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.calibration import Calibration
from ..core.modes import COMPONENTS, to_matrix
from ..core.oscillator import pad_frequency
from ..device.protocol import NOT_MEASURED


class SimulatedCubes:
    """The cubes of one hub, all with the same number of pads.

    noise: standard deviation of a frequency relative to itself, 0 for none; drift: relative change
    of every rest frequency per second.
    """

    def __init__(
        self,
        calibrations: Sequence[Calibration],
        noise: float = 0.0,
        drift: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.n_pads = calibrations[0].layout.n_pads
        self._noise, self._drift, self._random = noise, drift, np.random.default_rng(seed)
        kinds: dict[str, list[int]] = {}
        for number, calibration in enumerate(calibrations):
            kinds.setdefault(calibration.id, []).append(number)
        self._kinds = [(calibrations[rows[0]], np.array(rows)) for rows in kinds.values()]

    def frequency(
        self, stress: NDArray[np.float64], gradient: NDArray[np.float64], seconds: float
    ) -> NDArray[np.uint32]:
        """Frequencies (cubes, pads) in mHz under true fields: stress (cubes, 6) Pa, gradient
        (cubes, 6, 3) Pa/m.

        A pad beyond what its law allows reads NOT_MEASURED, as an oscillator that stopped would.
        """
        hertz = np.empty((len(stress), self.n_pads))
        for calibration, rows in self._kinds:
            state = true_state(calibration, stress[rows], gradient[rows])
            rest = calibration.rest_frequency * (1 + self._drift * seconds)
            hertz[rows] = pad_frequency(
                state @ calibration.response.T, rest, calibration.beta, calibration.modulus
            )
        if self._noise:
            hertz *= 1 + self._noise * self._random.standard_normal(hertz.shape)
        return np.nan_to_num(np.rint(hertz * 1e3), nan=NOT_MEASURED).astype("<u4")


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
