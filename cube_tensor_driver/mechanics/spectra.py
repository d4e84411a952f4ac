# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Response of circular components to waves of traction, independent of the direction of the wave.

A circular component (circular.py) of order m is a combination of stresses and gradients at a point
that a rotation about z by an angle multiplies by exp(-i m angle). A layer is the same in all
directions. The component c therefore responds to a wave of the traction F on the surface, with the
wavenumber k and the direction phi, as follows; F+ = F_x + i F_y and F- = F_x - i F_y::

    c(k) = (-i)^m exp(i m phi) (N F_z + (i/2) P exp(-i phi) F+  -  (i/2) M exp(i phi) F-)

The spectra P (plus), M (minus) and N (normal) are real functions of k. A force that is distributed
over the surface with the spectrum (Fourier transform) S causes circular components at the distance
r that the functions R, T and Z of circular.py describe. They are Hankel transforms, integrals over
k dk / 2 pi::

    R + T = int P S J_{m-1}(kr),   R - T = int M S J_{m+1}(kr),   Z = int N S J_m(kr)

A random traction has a pressure with the spectrum S and independent shears along x and y with s^2
times this spectrum. Two components c of order m and d of order n at two positions, with a distance
r in the direction phi, then have the following covariances (* is the complex conjugate, P', M', N'
are the spectra of d)::

    <c d*> = exp(i (m - n) phi) int S (N N' + (P P' + M M') s^2 / 2) J_{m-n}(kr)
    <c d>  = exp(i (m + n) phi) (-1)^n int S (N N' - (P M' + M P') s^2 / 2) J_{m+n}(kr)

Source: I. N. Sneddon, Fourier Transforms (1951), 52 (Hankel transforms of any order).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.special import jv

from ..core.arrays import Array
from .circular import CIRCULAR_FROM_FIELD, ORDERS, Orders
from .layer import Layer

BesselTable = Callable[[int], Array]
"""Function of the order m that returns the Bessel functions J_m(k r) (positions, waves) at fixed
distances r (one for each position) and wavenumbers k (one for each wave)."""

MAX_WAVENUMBER_TIMES_DEPTH = 25.0
"""Upper limit of integrals over the wavenumber k of traction on the surface, multiplied by the
depth of the cubes' centres below the surface. At this depth, the stress under a wave of traction
with this wavenumber has decayed by a factor of about exp(-25)."""

N_WAVENUMBERS = 256
"""Number of Gauss points in integrals over the wavenumber k. They resolve the Bessel functions
J(k r) for distances r from the load up to 20 times the depth of the cubes' centres."""


@dataclass(frozen=True, eq=False)
class Spectra:
    """Responses of n circular components (circular.py) to waves of traction F on the surface.

    Attributes:
        k: Wavenumbers (waves,) in 1/m.
        weight: Weights (waves,) of integrals over k dk / 2 pi, in 1/m^2.
        order: Order (n,) m of each component.
        plus: Spectra P (waves, n): factor of F+ = F_x + i F_y.
        minus: Spectra M (waves, n): factor of F- = F_x - i F_y.
        normal: Spectra N (waves, n): factor of F_z.
    """

    k: Array
    weight: Array
    order: Orders
    plus: Array
    minus: Array
    normal: Array

    def compute_radial_response(
        self,
        bessel: BesselTable,
        load_spectra: Array,
    ) -> Array:
        """Compute the response at given distances from forces distributed over the surface.

        Args:
            bessel: Bessel functions J_m(k r) at the distances r from the load at which the response
                is computed.
            load_spectra: Spectra S (loads, waves) of the distributions of the forces.

        Returns:
            Radial functions R, Z and T of circular.py (loads, distances, 3, n), which multiply the
            radial, normal and tangential force; in units of the component per N.
        """
        n_distances = len(bessel(0))
        shape = (len(load_spectra), n_distances, len(self.order))
        plus = np.zeros(shape)
        minus = np.zeros(shape)
        normal = np.zeros(shape)

        # Components of one order have the same Bessel functions, so that one matrix product per
        # order computes all of them.
        for order in np.unique(self.order):
            chosen = self.order == order
            parts = (
                (plus, self.plus, -1),
                (minus, self.minus, 1),
                (normal, self.normal, 0),
            )
            for total, spectrum, shift in parts:
                wave = bessel(int(order) + shift) * self.weight
                for load, load_spectrum in enumerate(load_spectra):
                    weighted = spectrum[:, chosen] * load_spectrum[:, None]
                    total[load][:, chosen] = wave @ weighted

        # `plus` is the sum R + T of two of the functions, and `minus` is their difference R - T.
        return np.stack(
            [
                (plus + minus) / 2,
                normal,
                (plus - minus) / 2,
            ],
            axis=2,
        )

    def compute_covariance(
        self,
        other: Spectra,
        bessel: BesselTable,
        prior: Array,
        shear: float,
    ) -> tuple[Array, Array]:
        """Compute covariances of the components at two positions under a random traction.

        The n components of this object are at the first position, which lies in the direction x
        from the other position.

        Args:
            other: Spectra of the n' components at the other position.
            bessel: Bessel functions J_m(k r) at the distances r between the two positions.
            prior: Spectrum S (waves,) of the pressure.
            shear: Standard deviation s of the shear divided by that of the pressure.

        Returns:
            Covariances (distances, n, n') of the real parts, and of the imaginary parts. For
            positions along x, real parts are independent of imaginary parts.
        """
        normal = _multiply_outer(self.normal, other.normal)
        plus_plus = _multiply_outer(self.plus, other.plus)
        minus_minus = _multiply_outer(self.minus, other.minus)
        plus_minus = _multiply_outer(self.plus, other.minus)
        minus_plus = _multiply_outer(self.minus, other.plus)
        same = plus_plus + minus_minus
        crossed = plus_minus + minus_plus
        half = shear**2 / 2

        # `conjugate` and `direct` are the covariances <c d*> and <c d> of two complex components c
        # and d (formulas at the head of this file), for the direction phi = 0 from one position to
        # the other.
        order = self.order[:, None]
        sign = (-1.0) ** other.order
        of_conjugate = normal + half * same
        of_direct = sign * (normal - half * crossed)
        conjugate = self._integrate(
            of_conjugate,
            order - other.order,
            bessel,
            prior,
        )
        direct = self._integrate(
            of_direct,
            order + other.order,
            bessel,
            prior,
        )

        # The covariances of real and imaginary parts follow from those of the complex components:
        # Re c Re d = Re(c d* + c d) / 2 and Im c Im d = Re(c d* - c d) / 2.
        return (conjugate + direct) / 2, (conjugate - direct) / 2

    def _integrate(
        self,
        spectrum: Array,
        order: Orders,
        bessel: BesselTable,
        prior: Array,
    ) -> Array:
        """Compute covariances of components at two positions, as integrals over the wavenumber k.

        The integrals are those of <c d*> or <c d> at the head of this file, without their phases.

        Args:
            spectrum: Factor (waves, n, n') of S in the integral, for each pair of n components at
                one position and n' at the other.
            order: Order (n, n') of the Bessel function for each pair of components.
            bessel: Bessel functions at the distances between the two positions.
            prior: Spectrum S (waves,) of the random pressure on the surface.

        Returns:
            Covariances (distances, n, n').
        """
        n_distances = len(bessel(0))
        result = np.zeros((n_distances, *order.shape))
        for one in np.unique(order):
            chosen = order == one
            weighted_prior = self.weight * prior
            wave = bessel(int(one)) * weighted_prior
            result[:, chosen] = wave @ spectrum[:, chosen]
        return result


def _multiply_outer(first: Array, second: Array) -> Array:
    """Return the products of all pairs of two sets of spectra.

    Args:
        first: Spectra (waves, n).
        second: Spectra (waves, n').

    Returns:
        Products (waves, n, n').
    """
    return first[:, :, None] * second[:, None]


def tabulate_bessel(k: Array, r: Array) -> BesselTable:
    """Return a function that computes Bessel functions J_m(k r) for fixed k and r.

    Args:
        k: Wavenumbers (waves,) in 1/m.
        r: Distances (positions,) in m.

    Returns:
        Function that returns J_m(kr) (positions, waves) for any order m. Every order is computed
        once and then kept.
    """
    x = np.outer(r, k)

    @cache
    def evaluate(order: int) -> Array:
        if order < 0:  # J_{-m} = (-1)^m J_m
            return np.asarray((-1) ** order * evaluate(-order))
        return np.asarray(jv(order, x))

    return evaluate


def make_wavenumber_quadrature(depth: float) -> tuple[Array, Array]:
    """Return Gauss points for integrals over the wavenumber k.

    Args:
        depth: Depth below the surface in m, which limits the wavenumbers that have an effect.

    Returns:
        Wavenumbers (waves,) in 1/m, and their weights (waves,) in integrals over k dk / 2 pi.
    """
    points, weights = np.polynomial.legendre.leggauss(N_WAVENUMBERS)
    half_range = MAX_WAVENUMBER_TIMES_DEPTH / depth / 2
    k = (points + 1) * half_range
    return k, weights * half_range * k / (2 * np.pi)


def compute_layer_spectra(
    layer: Layer,
    depth: float,
    waves_of: float | None = None,
) -> Spectra:
    """Return the field at a depth below a unit traction wave on the surface, for all wavenumbers.

    The field (`FIELD`) is stress and its gradient, in circular components: combinations that a
    rotation about the normal multiplies by a phase factor (circular.py).

    Args:
        layer: Elastic layer.
        depth: Distance from the point to the surface, in m.
        waves_of: Another depth in m, whose wavenumbers (`make_wavenumber_quadrature`) are used
            instead of those of `depth`. Only spectra with the same wavenumbers can be subtracted.

    Raises:
        ElasticError: The layer does not contain this depth.
    """
    k, weight = make_wavenumber_quadrature(waves_of or depth)
    along_x = layer.compute_transfer(k, np.zeros_like(k), depth)
    circular = np.einsum("cf,kfi->kci", CIRCULAR_FROM_FIELD, along_x)

    # Under a traction F that is a wave along x, a component c of order m is given by
    # i^m c = N F_z + (i/2) P (F_x + i F_y) - (i/2) M (F_x - i F_y).
    rotated = 1j ** ORDERS[:, None] * circular
    x, y, z = np.moveaxis(rotated, -1, 0)
    plus = x.imag - y.real
    minus = -x.imag - y.real
    return Spectra(
        k,
        weight,
        ORDERS,
        plus,
        minus,
        z.real,
    )
