# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Response of cubes to one small load on the surface of a layer, with numpy alone.

`Kernels` tabulates the same responses for loads of all sizes, but it needs scipy, which the
reconstruction node does not load. Here the wave vectors k are a square grid of finite spacing, so
that the load repeats `PERIOD_DEPTHS` away. The response at the distance r along x is the sum

    response(r) = sum_k c(k) B(k) exp(i k_x r) (spacing / 2 pi)^2

over the transfer functions c of the layer and the spectrum B of the load.
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array
from ..core.modes import COMPONENTS
from .circular import CIRCULAR_FROM_FIELD, FIELD_FROM_CIRCULAR, ORDERS, rotate_loads
from .layer import FIELD, Layer

PERIOD_DEPTHS = 64
"""Distance at which the load repeats, divided by the depth of the cubes' centres. At half of it,
the stress has fallen below a thousandth of that below the load."""

MAX_WAVENUMBER = 14.0
"""Largest wavenumber of the sum over waves, times the depth of the cubes' centres. There, the
stress has fallen to 1e-5 of that on the surface."""

POINTS_PER_DEPTH = 32
"""Number of tabulated distances per length of one depth of the cubes' centres. The error of the
linear interpolation between them is a thousandth of the largest value."""

_OBSERVED = [FIELD.index(name) for name in COMPONENTS]


class LoadResponse:
    """Components that cubes at one depth measure under a small load with a force of 1 N."""

    def __init__(
        self,
        layer: Layer,
        depth: float,
        width: float,
    ) -> None:
        """Tabulate the response over the distance, which takes about a half a second.

        Args:
            layer: Elastic layer that contains the cubes.
            depth: Distance from the centres of the cubes to the surface, in m.
            width: Diameter in m of the contact (Hertz) of a ball.

        Raises:
            ElasticError: The layer does not contain this depth.
        """
        spacing = 2 * np.pi / (PERIOD_DEPTHS * depth)
        count = int(MAX_WAVENUMBER / depth / spacing)
        k: Array = spacing * np.arange(-count, count + 1.0)
        self._step = depth / POINTS_PER_DEPTH
        distance = self._step * np.arange(PERIOD_DEPTHS // 2 * POINTS_PER_DEPTH)

        # The waves of -k_x are the complex conjugates of those of k_x, so half of them suffice. One
        # k_x at a time saves memory.
        field = np.zeros((len(distance), len(FIELD), 3))
        for kx in k[count:, None]:
            load = disc_spectrum(np.hypot(kx, k) * width / 2) * (spacing / (2 * np.pi)) ** 2
            amplitude = (load[:, None, None] * layer.transfer(kx, k, depth)).sum(axis=0)
            waves = np.exp(1j * kx * distance) * (2 if kx else 1)
            field += np.multiply.outer(waves, amplitude).real

        circular = CIRCULAR_FROM_FIELD @ field
        # Towards +x, a force along x is radial, and one along y is across (circular.py).
        parts = [circular[..., 0].real, circular[..., 2].real, circular[..., 1].imag]
        self._table = np.stack(parts, axis=1)

    def __call__(self, offset: Array, angle: Array) -> Array:
        """Compute the components that N cubes measure.

        Args:
            offset: Positions (N, 2) of the cubes from the centre of their load, in m.
            angle: Rotations (N,) of the cubes about z, in rad.

        Returns:
            Components (N, 15, 3) in Pa/N and Pa/(m N), for a force along x, y and z; 0 beyond half
            of the period of the load.
        """
        index = np.hypot(*offset.T) / self._step
        last = len(self._table) - 2
        first = np.minimum(index.astype(int), last)
        share = (index - first)[:, None, None]
        parts = (1 - share) * self._table[first] + share * self._table[first + 1]
        parts[index > last] = 0

        direction = np.arctan2(offset[:, 1], offset[:, 0])
        circular = rotate_loads(parts, direction, direction - angle, ORDERS)
        return np.asarray((circular @ FIELD_FROM_CIRCULAR[:, _OBSERVED]).swapaxes(1, 2))


def disc_spectrum(x: Array) -> Array:
    """Compute the spectrum (Fourier transform) B of the pressure of a Hertz contact with 1 N.

    Args:
        x: Wavenumbers (...) in 1/m multiplied by the radius of the contact in m.
    """
    # Near x = 0, sin x - x cos x would lose all digits, so a Taylor series replaces it.
    safe = np.maximum(x, 1e-2)
    exact = 3 * (np.sin(safe) - safe * np.cos(safe)) / safe**3
    return np.where(x < 1e-2, 1 - x**2 / 10, exact)
