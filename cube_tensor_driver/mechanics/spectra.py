"""What cubes see of waves of traction, whatever the direction: spectra of circular components.

The layer is the same in all directions. So a circular component of order m (circular.py) sees of
traction of the wavenumber k in the direction phi, with F+ = F_x + i F_y and F- = F_x - i F_y::

    c(k) = (-i)^m exp(i m phi) (N F_z + (i/2) P exp(-i phi) F+  -  (i/2) M exp(i phi) F-)

The spectra P, M and N are real. Of a force that is spread with the spectrum S around it, at the
distance r the components have the R, T and Z of circular.py::

    R + T = int P S J_{m-1}(kr),   R - T = int M S J_{m+1}(kr),   Z = int N S J_m(kr)  [k dk / 2 pi]

A random traction of the spectrum S, whose axes are independent and whose shear has s^2 times the
variance of the pressure, makes two components of orders m and n vary together as::

    <c d*> = exp(i (m - n) phi) int S (N N' + (P P' + M M') s^2 / 2) J_{m-n}(kr)
    <c d>  = exp(i (m + n) phi) (-1)^n int S (N N' - (P M' + M P') s^2 / 2) J_{m+n}(kr)

Source: I. N. Sneddon, Fourier Transforms (1951), 52 (Hankel transforms of any order).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import jv

from ..core.arrays import Array
from .circular import CIRCULAR, ORDERS
from .layer import Layer

Bessel = Callable[[int], Array]

GREATEST = 25.0
"""Wavenumber times depth at which integrals end: the field has decayed by exp(-25)."""
WAVES = 256
"""Gauss points in k, which resolve the Bessel functions out to 20 depths."""


@dataclass(frozen=True, eq=False)
class Spectra:
    """Of n components that a cube sees.

    k: (waves,) 1/m; weight: (waves,) of integrals k dk / 2 pi
    order: (n,) m of each component; plus, minus, normal: (waves, n) P, M and N
    """

    k: Array
    weight: Array
    order: NDArray[np.int64]
    plus: Array
    minus: Array
    normal: Array

    def radial(self, bessel: Bessel, factors: Array) -> Array:
        """(factors, places, 3, n) R, Z and T at the places of `bessel` of forces that are spread
        with each of the factors (factors, waves)."""
        sums = np.zeros((3, len(factors), len(bessel(0)), len(self.order)))
        for order in np.unique(self.order):
            mine = self.order == order
            for part, spectrum, shift in zip(
                sums, (self.plus, self.minus, self.normal), (-1, 1, 0), strict=True
            ):
                wave = bessel(int(order) + shift) * self.weight
                for total, factor in zip(part, factors, strict=True):
                    total[:, mine] = wave @ (spectrum[:, mine] * factor[:, None])
        plus, minus, normal = sums
        return np.stack([(plus + minus) / 2, normal, (plus - minus) / 2], axis=2)

    def covariance(
        self, other: Spectra, bessel: Bessel, factor: Array, shear: float
    ) -> tuple[Array, Array]:
        """(places, n, n') of the real parts and of the imaginary parts, at the places of `bessel`
        along x from the other's; real and imaginary parts are independent there.

        factor: (waves,) spectrum of the pressure; shear: s
        """
        half = shear**2 / 2
        normal = self.normal[:, :, None] * other.normal[:, None]
        same = self.plus[:, :, None] * other.plus[:, None]
        same += self.minus[:, :, None] * other.minus[:, None]
        crossed = self.plus[:, :, None] * other.minus[:, None]
        crossed += self.minus[:, :, None] * other.plus[:, None]
        sign = (-1.0) ** other.order
        difference = self.order[:, None] - other.order
        total = self.order[:, None] + other.order
        with_conjugate = self._integral(normal + half * same, difference, bessel, factor)
        without = self._integral(sign * (normal - half * crossed), total, bessel, factor)
        return (with_conjugate + without) / 2, (with_conjugate - without) / 2

    def _integral(
        self, spectrum: Array, order: NDArray[np.int64], bessel: Bessel, factor: Array
    ) -> Array:
        """(places, n, n') int factor spectrum J_order(kr), with an order (n, n') for each."""
        result = np.zeros((len(bessel(0)), *order.shape))
        for one in np.unique(order):
            mine = order == one
            result[:, mine] = (bessel(int(one)) * (self.weight * factor)) @ spectrum[:, mine]
        return result


def bessel_functions(k: Array, r: Array) -> Bessel:
    """J(kr) (places, waves) of any order, at distances r (places,) m."""
    x = np.outer(r, k)

    @cache  # each takes long, and is needed many times
    def of(order: int) -> Array:
        return np.asarray(jv(order, x)) if order >= 0 else (-1) ** order * of(-order)

    return of


def waves(depth: float) -> tuple[Array, Array]:
    """Wavenumbers (waves,) 1/m and their weights in integrals k dk / 2 pi, for this depth, m."""
    nodes, weights = np.polynomial.legendre.leggauss(WAVES)
    k = (nodes + 1) * GREATEST / depth / 2
    return k, weights * GREATEST / depth / 2 * k / (2 * np.pi)


def layer_spectra(layer: Layer, depth: float) -> Spectra:
    """Of the circular components of FIELD in a layer. Raises ElasticError where there is no such
    depth."""
    k, weight = waves(depth)
    along_x = layer.transfer(k, np.zeros_like(k), depth)
    seen = 1j ** ORDERS[:, None] * np.einsum("cf,kfi->kci", CIRCULAR, along_x)
    x, y, z = np.moveaxis(seen, -1, 0)
    return Spectra(k, weight, ORDERS, x.imag - y.real, -x.imag - y.real, z.real)
