# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Response of cubes to one small load on the surface of a layer, with numpy alone.

`ContactResponse` tabulates the same responses for loads of all sizes, but it needs scipy, which the
reconstruction node does not load. Here the wave vectors k are a square grid of finite spacing, so
that the load repeats along x and y with a period of `PERIOD_DEPTHS` depths. The response at the
distance r along x is the following sum, with the transfer functions c of the layer and the spectrum
B of the load::

    response(r) = sum_k c(k) B(k) exp(i k_x r) (spacing / 2 pi)^2
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array
from .circular import CIRCULAR_FROM_FIELD, FIELD_FROM_CIRCULAR, ORDERS, rotate_loads
from .layer import FIELD, MEASURED, Layer

PERIOD_DEPTHS = 64
"""Period of the load along x and along y, divided by the depth of the cubes' centres. The load is
periodic because its wavenumbers are equally spaced. At a distance of half a period, the stress is
less than a thousandth of that below the load, so that the repetitions hardly matter."""

MAX_WAVENUMBER = 14.0
"""Largest wavenumber in the Fourier sum of the load, multiplied by the depth of the cubes' centres.
The stress that a wave with this wavenumber causes at this depth is 1e-5 of that on the surface."""

POINTS_PER_DEPTH = 32
"""Number of tabulated distances between load and cube in an interval as long as the depth of the
cubes' centres. The error of the linear interpolation between two distances is about a thousandth
of the largest value of each component."""


class LoadResponse:
    """Table of the stress and gradient that cubes at one depth measure under a Hertz contact with
    1 N, over the distance between contact and cube."""

    def __init__(
        self,
        layer: Layer,
        depth: float,
        width: float,
    ) -> None:
        """Tabulate the components over the distance between load and cube along the surface.

        This takes about half a second.

        Args:
            layer: Elastic layer that contains the cubes.
            depth: Distance from the centres of the cubes to the surface, in m.
            width: Diameter in m of the contact of a ball (Hertz contact).

        Raises:
            ElasticError: The layer does not contain this depth.
        """
        period = PERIOD_DEPTHS * depth
        spacing = 2 * np.pi / period
        count = int(MAX_WAVENUMBER / depth / spacing)
        number = np.arange(-count, count + 1.0)
        k: Array = spacing * number
        self._step = depth / POINTS_PER_DEPTH
        n_points = PERIOD_DEPTHS // 2 * POINTS_PER_DEPTH
        distance = self._step * np.arange(n_points)

        # The term of the sum for -k_x is the complex conjugate of the term for k_x. So only terms
        # for k_x >= 0 are computed, and the real parts of those for k_x > 0 are counted twice. A
        # loop over k_x takes much less memory than an array of all terms.
        field = np.zeros((len(distance), len(FIELD), 3))
        cell = (spacing / (2 * np.pi)) ** 2
        for kx in k[count:, None]:
            wavenumber = np.hypot(kx, k)
            load = compute_disc_spectrum(wavenumber * width / 2) * cell
            transfer = layer.compute_transfer(kx, k, depth)
            response = load[:, None, None] * transfer
            amplitude = response.sum(axis=0)

            n_waves = 2 if kx else 1
            waves = np.exp(1j * kx * distance) * n_waves
            along_x = np.multiply.outer(waves, amplitude)
            field += along_x.real

        circular = CIRCULAR_FROM_FIELD @ field
        # All distances are along x. So a force along x is the radial force F_r of circular.py, and
        # a force along y is the tangential force F_t.
        radial = circular[..., 0].real
        tangential = circular[..., 1].imag
        along_z = circular[..., 2].real
        parts = [radial, along_z, tangential]
        self._table = np.stack(parts, axis=1)

    def __call__(self, offset: Array, angle: Array) -> Array:
        """Compute the components that N cubes measure, by linear interpolation of the table.

        Args:
            offset: Positions (N, 2) of the cubes from the centre of their load, in m.
            angle: Rotations (N,) of the cubes about z, in rad.

        Returns:
            Components (N, 15, 3) in Pa/N and Pa/(m N), for a force along x, y and z; 0 at
            distances of more than half a period, `PERIOD_DEPTHS` / 2 depths.
        """
        x, y = offset.T
        index = np.hypot(x, y) / self._step
        last = len(self._table) - 2
        first = np.minimum(index.astype(int), last)
        share = (index - first)[:, None, None]
        below = self._table[first]
        above = self._table[first + 1]
        parts = (1 - share) * below + share * above
        parts[index > last] = 0

        direction = np.arctan2(y, x)
        circular = rotate_loads(parts, direction, direction - angle, ORDERS)
        components = circular @ FIELD_FROM_CIRCULAR[:, MEASURED]
        return np.asarray(components.swapaxes(1, 2))


def compute_disc_spectrum(x: Array) -> Array:
    """Compute the spectrum (Fourier transform) B of the pressure of a Hertz contact with 1 N.

    Args:
        x: Wavenumbers (...) in 1/m multiplied by the radius of the contact in m.
    """
    # Near x = 0, sin x - x cos x would lose all digits, so a Taylor series replaces it.
    safe = np.maximum(x, 1e-2)
    difference = np.sin(safe) - safe * np.cos(safe)
    exact = 3 * difference / safe**3
    series = 1 - x**2 / 10
    return np.where(x < 1e-2, series, exact)
