# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Prior of the traction on the surface, and its covariance with the values that cubes measure.

The prior is a Gaussian process with mean zero; normal traction and both shears are independent.
Because contacts may be narrow or wide, it has two correlation lengths l, each with half of the
variance. Its spectrum S over the wave vector k is::

    S = sum_l (1/2) 2 pi l^2 exp(-(k l)^2 / 2)        (shear: SHEAR_RATIO^2 times that)

Let c(k) be the spectra of the circular components (spectra.py) at a cube, and p the offset to this
cube from a point of the surface or from another cube with the components d. The covariances of the
components with the traction at the point, and with the components at the other cube, are integrals
with the weight d2k / (4 pi^2)::

    cross(p) = int c S exp(i k.p),       covariance(p) = int c S d* exp(i k.p)

Source: C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning (2006), 4.2.1
(covariance and spectrum).
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Index
from ..core.modes import COMPONENTS
from .cache import load_or_compute
from .circular import CIRCULAR_FROM_FIELD, rotate_loads
from .distance_table import DistanceTable, to_polar
from .layer import FIELD
from .measurement_model import CubeMeasurement
from .spectra import tabulate_bessel

PRIOR_LENGTHS = (0.2, 0.8)
"""Correlation lengths of the random traction that serves as prior, divided by the depth of the
cubes' centres below the surface. They are close to the pair of lengths with the smallest errors for
contacts of 2 to 20 mm in a half space at a depth of 5 mm."""

AMPLITUDE = 20e3
"""Prior standard deviation of the pressure on the surface, in Pa, before any value is measured. The
value is the pressure of a firm touch."""

SHEAR_RATIO = 0.5
"""Prior standard deviation of the shear traction along x and along y, divided by the prior standard
deviation of the pressure."""

_FIELD_ZZ = FIELD.index("zz")
"""Index in `FIELD` (names of 24 stresses and gradients) of the stress zz, the negative pressure."""

_CIRCULAR_ZZ = int(np.argmax(CIRCULAR_FROM_FIELD[:, _FIELD_ZZ].real))
"""Index of the circular component that is the stress zz alone. A circular component is a
combination of stresses and gradients that only changes its phase if the frame is rotated about
z."""


class TractionPrior:
    """Prior covariances of the components that cubes measure and the traction on the surface.

    In the methods, positions (N, 2) are in m. The components are in the frame of a cube that is
    rotated about z by `angle` (N,) in rad and has the index `variant` (N,) in the measurement
    model. Covariances are for a prior of the pressure with the variance 1 Pa^2.

    The first set-up for a layer takes about a second; later ones load the tables from the cache.

    Attributes:
        variance: Prior variances (4,) of the traction along x, y and z and of the pressure at the
            depth of the cubes, divided by the prior variance of the pressure on the surface.
        inputs: Arrays and numbers on which the covariances depend, as keys for the cache.
    """

    def __init__(self, cubes: CubeMeasurement) -> None:
        """Compute the tables of the prior covariances, or load them from the cache.

        They are covariances of the components that cubes measure, with each other and with the
        traction on the surface.

        Args:
            cubes: Layer, depth and measurement model of the cubes.
        """
        self._cubes = cubes
        self._table = DistanceTable(cubes.depth)
        self.inputs = [*cubes.layer_inputs, cubes.matrices]
        tables = load_or_compute("prior", cubes.layer_inputs, self._tabulate)
        self._cross = tables["cross"]
        self._pressure = tables["pressure"]
        self._real = tables["real"]
        self._imaginary = tables["imaginary"]
        self.variance = np.array([SHEAR_RATIO**2, SHEAR_RATIO**2, 1.0, tables["own"]])

    def _tabulate(self) -> dict[str, Array]:
        """Compute the covariances of the n circular components at the tabulated distances.

        Circular components (circular.py) are complex combinations of the stresses and gradients at
        a cube. Here they are in a frame whose x axis points to the cube from the other position (a
        cube or a point of the surface). Their real parts are then independent of the imaginary
        ones.

        Returns:
            Dictionary with the following arrays.
            cross: Covariance of the components with the traction at a point of the surface, as
                the radial functions R, Z and T of circular.py (distances, 3, n).
            real: Covariance (distances, n, n) of the real parts of the components at two cubes.
            imaginary: Covariance (distances, n, n) of the imaginary parts at two cubes.
            pressure: Covariance (distances, n) of the real parts with the pressure at the cubes'
                depth below a point of the surface.
            own: Variance of the pressure at the cubes' depth.
        """
        spectra = self._cubes.spectra
        points = self._cubes.point_spectra
        depth = self._cubes.depth
        bessel = tabulate_bessel(spectra.k, self._table.distances)
        prior = _compute_prior_spectrum(spectra.k * depth) * depth**2
        shear, normal = SHEAR_RATIO**2, 1.0
        axis_variance = np.array([shear, normal, shear])
        radial = spectra.compute_radial_response(bessel, prior[None])[0]
        cross = radial * axis_variance[:, None]

        real, imaginary = spectra.compute_covariance(
            spectra,
            bessel,
            prior,
            SHEAR_RATIO,
        )
        with_points, _ = spectra.compute_covariance(
            points,
            bessel,
            prior,
            SHEAR_RATIO,
        )
        at_zero = tabulate_bessel(spectra.k, np.zeros(1))
        own, _ = points.compute_covariance(
            points,
            at_zero,
            prior,
            SHEAR_RATIO,
        )
        return {
            "cross": cross,
            "real": real,
            "imaginary": imaginary,
            "pressure": -with_points[:, :, _CIRCULAR_ZZ],  # pressure = -zz
            "own": own[0, _CIRCULAR_ZZ, _CIRCULAR_ZZ],
        }

    def compute_surface_covariance(
        self,
        place: Array,
        angle: Array,
        variant: Index,
    ) -> Array:
        """Compute the prior covariance of the measured components with the load at one point.

        Args:
            place: Positions (N, 2) of the cubes from the point of the surface, in m.
            angle: Rotations (N,) of the cubes about z, in rad.
            variant: Index (N,) of each cube's variant in the measurement model.

        Returns:
            Covariance (N, 15, 4) with the traction along x, y and z, and with the pressure below
            the point at the depth of the cubes, for a surface pressure of variance 1 Pa^2.
        """
        distance, direction = to_polar(place)
        relative = direction - angle
        parts = self._table.interpolate(self._cross, distance)
        order = self._cubes.spectra.order
        circular = rotate_loads(parts, direction, relative, order)
        with_traction = self._cubes.measure(circular, variant).swapaxes(1, 2)

        real, _ = self._cubes.compute_matrices(relative, variant)
        pressure = self._table.interpolate(self._pressure, distance)
        with_pressure = real @ pressure[:, :, None]
        return np.concatenate([with_traction, with_pressure], axis=2)

    def compute_covariance(
        self,
        place: Array,
        angle: Array,
        variant: Index,
        other_angle: Array,
        other_variant: Index,
    ) -> Array:
        """Compute the prior covariance between the measured components of N pairs of cubes.

        Args:
            place: Position (N, 2) of the first cube of each pair from the other one, in m.
            angle: Rotations (N,) of the first cubes about z, in rad.
            variant: Index (N,) of each first cube's variant in the measurement model.
            other_angle: Rotations (N,) of the other cubes, in rad.
            other_variant: Index (N,) of each other cube's variant.

        Returns:
            Covariance (N, 15, 15) for a pressure of variance 1 Pa^2.
        """
        distance, direction = to_polar(place)
        first = self._cubes.compute_matrices(direction - angle, variant)
        second = self._cubes.compute_matrices(direction - other_angle, other_variant)

        n_components = len(COMPONENTS)
        total = np.zeros((len(place), n_components, n_components))
        tables = (self._real, self._imaginary)
        for left, table, right in zip(first, tables, second, strict=True):
            circular = self._table.interpolate(table, distance)
            total += left @ circular @ right.swapaxes(1, 2)
        return total


def _compute_prior_spectrum(wavenumber: Array) -> Array:
    """Return the spectrum S of the random pressure that serves as prior, divided by depth^2.

    The pressure has the variance 1 Pa^2 and the correlation lengths `PRIOR_LENGTHS`.

    Args:
        wavenumber: Wavenumbers multiplied by the depth of the cubes.
    """
    parts = []
    for length in PRIOR_LENGTHS:
        decay = np.exp(-((wavenumber * length) ** 2) / 2)
        parts.append(2 * np.pi * length**2 * decay)
    return np.asarray(np.mean(parts, axis=0))
