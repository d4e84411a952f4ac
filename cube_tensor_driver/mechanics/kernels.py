# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Response of cubes at one depth to traction on the surface, and covariances of random traction.

A layer is the same everywhere and in all directions. Quantities that depend on the offset p = r
(cos phi, sin phi) of two positions are therefore tabulated over the distance r only: the direction
phi multiplies circular components (circular.py) by a phase. The tables are integrals over the
wave vector k. With the spectra c(k) of the circular components (spectra.py) and a random traction
with the spectrum S(k) as prior::

    response(p) = int c exp(i k.p) B_a,     B_a = 3 (sin ka - ka cos ka) / (ka)^3
    cross(p)    = int c S exp(i k.p),       covariance(p) = int c S c* exp(i k.p)      [d2k / 4 pi2]

B_a is the spectrum of Hertz's pressure on a disc of radius a with a force of 1 N. The prior is a
Gaussian process with mean zero; normal traction and both shears are independent. Because contacts
may be narrow or wide, it has two correlation lengths, each with half of the variance::

    S = sum_l (1/2) 2 pi l^2 exp(-(k l)^2 / 2)        (shear: SHEAR_RATIO^2 times that)

Source: C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning (2006), 4.2.1
(covariance and spectrum); K. L. Johnson, Contact Mechanics (1985), 4.2 (Hertz).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..core.arrays import Array, Complex, Index, Single
from ..core.modes import COMPONENTS, STRESS
from .cache import Arrays, load_or_compute
from .circular import (
    CIRCULAR_FROM_FIELD,
    FIELD_FROM_CIRCULAR,
    ORDERS,
    Orders,
    rotate_loads,
    rotation_phases,
)
from .layer import FIELD, Layer
from .load_response import disc_spectrum
from .sensitivity import sensitivities
from .spectra import BesselTable, Spectra, layer_spectra, tabulate_bessel

PRIOR_LENGTHS = (0.2, 0.8)
"""Correlation lengths of the random traction that serves as prior, divided by the depth of the
cubes' centres below the surface. They are close to the pair of lengths with the smallest errors for
contacts of 2 to 20 mm in a half space at a depth of 5 mm."""

SHEAR_RATIO = 0.5
"""Prior standard deviation of the shear traction along x and along y, divided by the prior standard
deviation of the pressure."""

DISC_SIZES = np.geomspace(0.1, 5.0, 44)
"""Radii of the tabulated round contacts (discs), divided by the depth of the cubes' centres below
the surface. The error of the interpolation between them in `Kernels.response` is at most a
hundredth of the largest value; it is largest for wide discs."""

_SIZE_LOG_STEP = float(np.log(DISC_SIZES[1] / DISC_SIZES[0]))
"""Difference of the natural logarithms of two neighbouring radii in `DISC_SIZES`."""

POINTS_PER_DEPTH = 32
"""Number of tabulated distances between load and cube per length of one depth (of the cubes'
centres below the surface). The error of the cubic interpolation between them is 1e-4 of the largest
value."""

REACH_DEPTHS = 20
"""Largest tabulated distance along the surface from a load to a cube, divided by the depth of the
cubes' centres below the surface. Responses and covariances at larger distances count as zero."""

_OBSERVED = np.array([FIELD.index(name) for name in COMPONENTS])
"""Indices (15,) of the `COMPONENTS` that cubes measure (six stresses, nine gradients of normal
stresses) in `FIELD`, the names of all 24 stresses and gradients."""

_IS_GRADIENT = np.arange(len(COMPONENTS)) >= len(STRESS)
"""Whether each of the 15 `COMPONENTS` is a gradient in Pa/m; the others are stresses in Pa."""

_FIELD_ZZ = FIELD.index("zz")
"""Index in `FIELD` (names of 24 stresses and gradients) of the stress zz, the negative pressure."""

_CIRCULAR_ZZ = int(np.argmax(CIRCULAR_FROM_FIELD[:, _FIELD_ZZ].real))
"""Index of the circular component that is the stress zz alone. A circular component is a
combination of stresses and gradients that only changes its phase if the frame is rotated about
z."""

_CUBIC_LAGRANGE = (
    np.array(
        [
            [[0, -2, 3, -1], [6, -3, -6, 3], [0, 6, 3, -3], [0, -1, 0, 1]],
            [[-2, 6, -3, 0], [-3, -12, 9, 0], [6, 6, -9, 0], [-1, 0, 3, 0]],
            [[6, -6, 0, 0], [-12, 18, 0, 0], [6, -18, 0, 0], [0, 6, 0, 0]],
        ]
    )
    / 6
)
"""Coefficients (3, 4 table entries, 4 powers) of the weights of cubic Lagrange interpolation, and
of their first and second derivative: with the fraction t of the index between the second and the
third entry, the weight of an entry is the sum of its coefficients times 1, t, t^2, t^3."""

_MIN_DISTANCE = 1 / 50
"""Distance between contact and cube along the surface, divided by the depth of the cubes' centres,
below which `Kernels.response_slopes` uses the slopes at this distance: directions are undefined at
distance 0."""


class MeasurementModel(NamedTuple):
    """Linear model of the values that the cubes of a skin measure under traction on the surface.

    The values follow from n circular components (circular.py), which are the same for all cubes. A
    variant is a set of cubes with the same calibration and the same pads in use: their values
    follow from the circular components by the same matrix.

    Attributes:
        spectra: Spectra of the circular components over the wavenumber.
        components: Matrix (variants, 2 n, 15) from the real and imaginary parts of the circular
            components to the measured `COMPONENTS` in the frame of the cube, in Pa and Pa/m.
        variant: Index (cubes,) of the variant of each cube.
        pads: Matrix (variants, 2 n, P) from the same parts to the stress of each pad, divided by
            the standard deviation of the pad's noise; None if cubes are modelled as points.
    """

    spectra: Spectra
    components: Array
    variant: Index
    pads: Array | None = None


def model_points(
    layer: Layer,
    depth: float,
    cubes: int,
) -> MeasurementModel:
    """Return the measurement model of points: cubes measure stress and gradient at their centres.

    Args:
        layer: Elastic layer that contains the cubes.
        depth: Distance from the centres of the cubes to the surface, in m.
        cubes: Number of cubes.

    Raises:
        ElasticError: The layer does not contain this depth.
    """
    spectra = layer_spectra(layer, depth)
    components = FIELD_FROM_CIRCULAR[None, :, _OBSERVED]
    return MeasurementModel(spectra, components, np.zeros(cubes, np.intp))


class Kernels:
    """Tabulated responses of cubes to loads on the surface, and covariances under random loads.

    All cubes are at one depth in a layer. In the methods, positions (N, 2) are in m. Measured
    components are `COMPONENTS` with the gradients multiplied by `scale`, so that all are in Pa.
    They are in the frame of a cube that is rotated about z by `angle` (N,) in rad and has the index
    `variant` (N,) in the measurement model. Tractions and forces are along x, y and z. Covariances
    are for a prior of the pressure with the variance 1 Pa^2.

    The first set-up for a layer takes a few seconds; later ones load the tables from the cache.

    Attributes:
        layer: Elastic layer.
        depth: Distance from the centres of the cubes to the surface, in m.
        scale: Length in m that gradients are multiplied by.
        step: Distance in m between two tabulated positions.
        variance: Prior variance (3,) of the traction along x, y and z, divided by the prior
            variance of the pressure on the surface.
        pressure_variance: Prior variance of the pressure at the depth of the cubes, divided by the
            prior variance of the pressure on the surface.
        component_matrices: Matrices `MeasurementModel.components` with gradients multiplied by
            `scale`.
        inputs: Arrays and numbers on which the tables depend, as keys for the cache.
    """

    def __init__(
        self,
        layer: Layer,
        depth: float,
        scale: float,
        model: MeasurementModel | None = None,
    ) -> None:
        """Compute the tables or load them from the cache.

        Args:
            layer: Elastic layer that contains the cubes.
            depth: Distance from the centres of the cubes to the surface, in m.
            scale: Length in m by which gradients are multiplied.
            model: Measurement model of the cubes; None: they measure stress and gradient at points.

        Raises:
            ElasticError: The layer does not contain this depth.
        """
        points = model_points(layer, depth, 1)
        spectra, components, *_ = model or points
        self.layer = layer
        self.depth = depth
        self.scale = scale
        self.step = depth / POINTS_PER_DEPTH
        self.variance = np.array(
            [
                SHEAR_RATIO**2,
                SHEAR_RATIO**2,
                1.0,
            ]
        )
        self.component_matrices = components * self._unit_factors
        self._order = spectra.order
        table_inputs = [
            layer.thickness,
            layer.poisson,
            depth,
            *vars(spectra).values(),
        ]
        self.inputs = [*table_inputs, self.component_matrices]

        # Cubic interpolation uses two table entries on each side. So the table has one distance
        # before 0, and two beyond the largest distance.
        self._last = REACH_DEPTHS * POINTS_PER_DEPTH
        distance = np.arange(-1.0, self._last + 3) * self.step
        bessel = tabulate_bessel(spectra.k, distance)
        self._field = self._tabulate_discs(points.spectra, bessel)
        self._response = self._field
        if model is not None:
            self._response = self._tabulate_discs(spectra, bessel)
        # One row for each radius and distance, for `response_to_forces` and `sensitivity`
        self._rows = self._response.reshape(-1, 3 * len(self._order)).astype(np.float32)
        changes = [self._tabulate_discs(one, bessel) for one in sensitivities(layer, depth)]
        by_quantity = np.stack(changes, axis=2).astype(np.float32)
        self._sensitivity_rows = by_quantity.reshape(len(self._rows), -1)
        matrix = points.components[0] * self._unit_factors
        self._point_matrix = matrix.astype(np.float32)
        tables = load_or_compute(
            "kernels", table_inputs, lambda: self._tabulate_prior(spectra, points.spectra, bessel)
        )
        self._cross = tables["cross"]
        self._pressure = tables["pressure"]
        self._real = tables["real"]
        self._imaginary = tables["imaginary"]
        self.pressure_variance = float(tables["own"])

    @property
    def _unit_factors(self) -> Array:
        """Factors (15,) that convert components to Pa: 1 for stresses, `scale` for gradients."""
        return np.where(_IS_GRADIENT, self.scale, 1.0)

    def add_variant(self, components: Array) -> int:
        """Add a variant of the measurement model, unless an equal one exists already.

        Args:
            components: Matrix (2 n, 15) as in `MeasurementModel`, for cubes of which only some pads
                are used; gradients are in Pa/m.

        Returns:
            Index of the variant in `component_matrices`.
        """
        # Cubes in which the same pads are left out share a variant, so there are few to compare.
        matrix = components * self._unit_factors
        is_equal = self.component_matrices == matrix
        equal = np.flatnonzero(is_equal.all(axis=(1, 2)))
        if len(equal):
            return int(equal[0])
        self.component_matrices = np.concatenate([self.component_matrices, matrix[None]])
        return len(self.component_matrices) - 1

    def _tabulate_discs(self, spectra: Spectra, bessel: BesselTable) -> Array:
        """Tabulate the response to forces on discs of all radii `DISC_SIZES`.

        Args:
            spectra: Spectra of the n circular components.
            bessel: Bessel functions at the tabulated distances.

        Returns:
            Functions R, Z and T of circular.py (radii, distances, 3, n).
        """
        inputs = [self.depth, *vars(spectra).values()]

        def compute() -> Arrays:
            radii = DISC_SIZES * self.depth
            loads = np.stack([disc_spectrum(spectra.k * radius) for radius in radii])
            return {"discs": spectra.radial(bessel, loads)}

        return load_or_compute("discs", inputs, compute)["discs"]

    def _tabulate_prior(
        self,
        spectra: Spectra,
        points: Spectra,
        bessel: BesselTable,
    ) -> Arrays:
        """Compute the tables that depend on the prior (random traction on the surface).

        Args:
            spectra: Spectra of the n circular components that the cubes measure.
            points: Spectra of the circular components of the stress at a point.
            bessel: Bessel functions at the tabulated distances.

        Returns:
            cross: Functions R, Z and T of circular.py (distances, 3, n) for the covariance of the
                circular components with the traction at a point of the surface.
            real: Covariance (distances, n, n) of the real parts of two cubes' components.
            imaginary: Covariance (distances, n, n) of their imaginary parts.
            pressure: Covariance (distances, n) of the real parts with the pressure at the cubes'
                depth below a point of the surface.
            own: Variance of this pressure.
        """
        prior = _prior_spectrum(spectra.k * self.depth) * self.depth**2
        shear, normal = SHEAR_RATIO**2, 1.0
        axis_variance = np.array([shear, normal, shear])[:, None]
        cross = spectra.radial(bessel, prior[None])[0] * axis_variance

        real, imaginary = spectra.covariance(spectra, bessel, prior, SHEAR_RATIO)
        with_points, _ = spectra.covariance(points, bessel, prior, SHEAR_RATIO)
        at_zero = tabulate_bessel(spectra.k, np.zeros(1))
        own, _ = points.covariance(points, at_zero, prior, SHEAR_RATIO)
        return {
            "cross": cross,
            "real": real,
            "imaginary": imaginary,
            "pressure": -with_points[:, :, _CIRCULAR_ZZ],  # pressure = -zz
            "own": own[0, _CIRCULAR_ZZ, _CIRCULAR_ZZ],
        }

    def response(
        self,
        place: Array,
        angle: Array,
        variant: Index,
        size: float,
    ) -> Array:
        """Compute the measured components under a Hertz contact with a force of 1 N.

        Args:
            place: Positions (N, 2) of the cubes from the centre of the contact, in m.
            angle: Rotations (N,) of the cubes about z, in rad.
            variant: Index (N,) of each cube's variant in the measurement model.
            size: Radius of the contact in m.

        Returns:
            Components (N, 15, 3) in Pa/N, for a force along x, y and z.
        """
        table = self._interpolate_size(self._response, size, place)
        return self._measure(
            self._rotate_loads(table, place, angle, self._order),
            variant,
        )

    def response_slopes(
        self,
        place: Array,
        angle: Array,
        variant: Index,
        size: Array,
        force: Array,
    ) -> Array:
        """Compute the measured components under Hertz contacts, and their derivatives.

        Args:
            place: Positions (N, 2) of the cubes from the centre of a contact, in m.
            angle: Rotations (N,) of the cubes about z, in rad.
            variant: Index (N,) of each cube's variant in the measurement model.
            size: Radius (N,) of the contact in m.
            force: Force (N, 3) in N of the contact, along x, y and z.

        Returns:
            Components (N, 8, 15). The first three are those under a force of 1 N along x, y and z.
            The next four are derivatives of those under `force`: by x and y of the contact's
            centre, and first and second derivative by the logarithm of the radius. The last are
            those under a moment of 1 N m about z.
        """
        true_distance, direction = _polar(place)
        distance = np.maximum(true_distance, _MIN_DISTANCE * self.depth)
        parts = self._interpolate_slopes(distance, size)

        # c = exp(i m phi) (R F_r + Z F_z + i T F_t), and its derivatives by r and by phi
        cosine = np.cos(direction).astype(np.float32)[:, None]
        sine = np.sin(direction).astype(np.float32)[:, None]
        force_x, force_y, force_z = force.astype(np.float32).T[..., None]
        radial = cosine * force_x + sine * force_y
        tangential = cosine * force_y - sine * force_x
        loads = np.empty((len(place), 4, len(self._order)), np.complex64)
        loads.real = radial[:, None] * parts[:, :, 0] + force_z[:, None] * parts[:, :, 1]
        loads.imag = tangential[:, None] * parts[:, :, 2]
        value, by_r, by_log, by_log_twice = loads.swapaxes(0, 1)
        order = self._order.astype(np.float32)
        inverse = (1 / distance).astype(np.float32)[:, None]
        r, z, t = parts[:, 0].swapaxes(0, 1)
        r_slope, z_slope, t_slope = parts[:, 1].swapaxes(0, 1)
        by_phi = 1j * (order * value - radial * t) + tangential * r
        moment = 0.5j * (inverse * (order * r - t) - t_slope)
        # Nearer than `_MIN_DISTANCE`, the value follows from the slope.
        below = (true_distance - distance).astype(np.float32)[:, None]
        r = r + below * r_slope
        z = z + below * z_slope
        t = 1j * (t + below * t_slope)

        circular: Complex = np.empty((len(place), 8, len(self._order)), np.complex64)
        circular[:, 0] = cosine * r - sine * t
        circular[:, 1] = sine * r + cosine * t
        circular[:, 2] = z
        circular[:, 3] = sine * inverse * by_phi - cosine * by_r
        circular[:, 4] = -cosine * inverse * by_phi - sine * by_r
        circular[:, 5] = by_log
        circular[:, 6] = by_log_twice
        circular[:, 7] = moment
        circular *= _fast_phases(direction - angle, self._order)[:, None]
        measured: Array = self._measure(_split(circular), variant).swapaxes(1, 2)
        return measured

    def _interpolate_slopes(self, distance: Array, size: Array) -> Single:
        """Interpolate the functions R, Z and T of circular.py, and their derivatives.

        Args:
            distance: Distances (N,) of the cubes from the centre of a contact, in m.
            size: Radius (N,) of the contact in m.

        Returns:
            Functions (N, 4, 3, n) and their derivatives: value, slope over the distance, first and
            second derivative by the logarithm of the radius.
        """
        first, by_distance, distance_slope = self._distance_weights(distance, 2)
        size_row, *by_size = _cubic_weights(_size_index(size, self.depth), 3)

        # Rows of the table at four radii times four distances.
        columns = self._response.shape[1]
        corner = (size_row - 1) * columns + first
        steps = np.add.outer(columns * np.arange(4), np.arange(4)).ravel()
        neighbours = self._rows.take(corner[:, None] + steps, axis=0)

        by_log = by_size[1] / _SIZE_LOG_STEP
        by_log_twice = by_size[2] / _SIZE_LOG_STEP**2
        over_size = np.stack([by_size[0], by_size[0], by_log, by_log_twice]).T
        slope = distance_slope / self.step
        over_distance = np.stack([by_distance, slope, by_distance, by_distance]).T
        weights = over_size[:, :, None] * over_distance[:, None]
        by_row = weights.reshape(-1, 16, 4).swapaxes(1, 2).astype(np.float32)
        return np.asarray(by_row @ neighbours).reshape(len(distance), 4, 3, -1)

    def response_to_forces(
        self,
        place: Array,
        angle: Array,
        variant: Index,
        size: Array,
        force: Array,
    ) -> Array:
        """Compute the measured components under Hertz contacts, faster and less exactly.

        The tables are interpolated linearly, with an error of at most a hundredth of the largest
        value, and a thousandth two depths away.

        Args:
            place: Positions (N, 2) of the cubes from the centre of a contact, in m.
            angle: Rotations (N,) of the cubes about z, in rad.
            variant: Index (N,) of each cube's variant in the measurement model.
            size: Radius (N,) of the contact in m.
            force: Force (N, 3) in N of the contact, along x, y and z.

        Returns:
            Components (N, 15) in Pa.
        """
        circular = self._respond_fast(self._rows, self._order, place, angle, size, force)
        return self._measure(_split(circular), variant)[:, :, 0]

    def sensitivity(
        self,
        place: Array,
        angle: Array,
        size: Array,
        force: Array,
    ) -> Array:
        """Compute how the measured components change by errors of the elastomer's data.

        The change is that of the stress at points (sensitivity.py), whatever the measurement model.

        Args:
            place: Positions (N, 2) of the cubes from the centre of a contact, in m.
            angle: Rotations (N,) of the cubes about z, in rad.
            size: Radius (N,) of the contact in m.
            force: Force (N, 3) in N of the contact, along x, y and z.

        Returns:
            Changes (N, S, 15) in Pa by one standard deviation of each of S quantities.
        """
        circular = self._respond_fast(self._sensitivity_rows, ORDERS, place, angle, size, force)
        return np.asarray(_split(circular) @ self._point_matrix)

    def _respond_fast(
        self,
        rows: Single,
        order: Orders,
        place: Array,
        angle: Array,
        size: Array,
        force: Array,
    ) -> Complex:
        """Return circular components under Hertz contacts, by linear interpolation of tables.

        Args:
            rows: S tables of the functions R, Z and T of circular.py (radii x distances, S x 3 n).
            order: Orders m (n,) of the circular components.
            place: Positions (N, 2) of the cubes from the centre of a contact, in m.
            angle: Rotations (N,) of the cubes about z, in rad.
            size: Radius (N,) of the contact in m.
            force: Force (N, 3) in N of the contact, along x, y and z.

        Returns:
            Components (N, S, n) in the frames of the cubes; 0 beyond `REACH_DEPTHS`.
        """
        distance, direction = _polar(place)
        index = np.minimum(distance / self.step, self._last)
        below = index.astype(np.intp)
        size_index = _size_index(size, self.depth)
        narrower = size_index.astype(np.intp)

        # Two neighbouring distances of two neighbouring radii. The table begins one step before
        # the distance 0.
        columns = self._response.shape[1]
        first = narrower * columns + below + 1
        neighbours = rows.take(first[:, None] + [0, 1, columns, columns + 1], axis=0)
        farther = index - below
        wider = size_index - narrower
        by_distance = np.stack([1 - farther, farther]) * (index < self._last)
        weights = np.concatenate([(1 - wider) * by_distance, wider * by_distance])
        weights = weights.T.astype(np.float32)[:, None]
        parts = (weights @ neighbours).reshape(len(place), -1, 3, len(order))

        towards = np.exp(1j * direction).astype(np.complex64)
        in_plane = (force[:, 0] + 1j * force[:, 1]).astype(np.complex64) * towards.conj()
        in_plane = in_plane[:, None, None]
        along_z = force[:, 2].astype(np.float32)[:, None, None]
        circular = np.empty((len(place), parts.shape[1], len(order)), np.complex64)
        circular.real = in_plane.real * parts[:, :, 0] + along_z * parts[:, :, 1]
        circular.imag = in_plane.imag * parts[:, :, 2]
        circular *= _fast_phases(direction - angle, order)[:, None]
        return circular

    def field(self, place: Array, size: float) -> Array:
        """Compute stress and gradient under a Hertz contact with a force of 1 N.

        Args:
            place: Positions (N, 2) from the centre of the contact, in m.
            size: Radius of the contact in m.

        Returns:
            Quantities `FIELD` (N, 24, 3) at the depth of the cubes, in Pa and Pa/m per N, for a
            force along x, y and z.
        """
        table = self._interpolate_size(self._field, size, place)
        circular = self._rotate_loads(table, place, np.zeros(len(place)), ORDERS)
        return np.asarray((circular @ FIELD_FROM_CIRCULAR).swapaxes(1, 2))

    def cross(
        self,
        place: Array,
        angle: Array,
        variant: Index,
    ) -> Array:
        """Compute the prior covariance of the measured components with the traction at one point.

        Args:
            place: Positions (N, 2) of the cubes from the point, in m.
            angle: Rotations (N,) of the cubes about z, in rad.
            variant: Index (N,) of each cube's variant in the measurement model.

        Returns:
            Covariance (N, 15, 3) for a pressure of variance 1 Pa^2.
        """
        circular = self._rotate_loads(self._cross, place, angle, self._order)
        return self._measure(circular, variant)

    def covariance(
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
        distance, direction = _polar(place)
        first = self._matrices_towards(direction - angle, variant)
        second = self._matrices_towards(direction - other_angle, other_variant)

        total = np.zeros(
            (
                len(place),
                len(COMPONENTS),
                len(COMPONENTS),
            )
        )
        for left, table, right in zip(
            first,
            (self._real, self._imaginary),
            second,
            strict=True,
        ):
            total += left @ self._interpolate(table, distance) @ right.swapaxes(1, 2)
        return total

    def pressure(
        self,
        place: Array,
        angle: Array,
        variant: Index,
    ) -> Array:
        """Compute the prior covariance of measured components with the pressure below one point.

        The components are those that a cube measures: 6 stresses, and 9 gradients of normal stress.
        The pressure is taken at the depth of the cubes, below one point of the surface.

        Args:
            place: Positions (N, 2) of the cubes from the point, in m.
            angle: Rotations (N,) of the cubes about z, in rad.
            variant: Index (N,) of each cube's variant in the measurement model.

        Returns:
            Covariance (N, 15) for a surface pressure of variance 1 Pa^2.
        """
        distance, direction = _polar(place)
        covariance = self._interpolate(self._pressure, distance)
        real, _ = self._matrices_towards(direction - angle, variant)
        measured = real @ covariance[:, :, None]
        return np.asarray(measured[:, :, 0])

    def _rotate_loads(
        self,
        table: Array,
        place: Array,
        angle: Array,
        order: Orders,
    ) -> Array:
        """Return circular components in rotated frames under unit loads along x, y and z.

        Args:
            table: Functions R, Z and T of circular.py (distances, 3, n) over the distance from the
                load.
            place: Positions (N, 2) from the load, in m.
            angle: Rotations (N,) of the frames about z, in rad.
            order: Orders m (n,) of the circular components: a rotation of the frame by an angle
                multiplies a component by exp(-i m angle).

        Returns:
            Real parts and then imaginary parts (N, 3, 2 n), for loads along x, y and z.
        """
        distance, direction = _polar(place)
        parts = self._interpolate(table, distance)
        return rotate_loads(parts, direction, direction - angle, order)

    def _measure(self, circular: Array, variant: Index) -> Array:
        """Convert the n circular components at N cubes to the components that the cubes measure.

        Args:
            circular: Real parts and then imaginary parts (N, 3, 2 n), for loads along x, y and z.
            variant: Index (N,) of each cube's variant in the measurement model.

        Returns:
            Measured components (N, 15, 3), for the same loads.
        """
        matrices = self.component_matrices
        # With only one variant, a single matrix product for all cubes is faster than one per cube.
        matrix = matrices[0] if len(matrices) == 1 else matrices[variant]
        matrix = matrix.astype(circular.dtype)
        return np.asarray((circular @ matrix).swapaxes(1, 2))

    def _matrices_towards(self, angle: Array, variant: Index) -> tuple[Array, Array]:
        """Return the matrices from circular components to measured components of N cubes.

        The circular components are in a frame whose x axis points along the line between two cubes,
        the measured components in the frame of the cube.

        Args:
            angle: Direction (N,) of the line in the frame of the cube, in rad.
            variant: Index (N,) of each cube's variant in the measurement model.

        Returns:
            Two matrices (N, 15, n): for the real parts of the circular components, and for their
            imaginary parts.
        """
        phases = rotation_phases(angle, self._order)[:, None]
        real, imaginary = np.split(
            self.component_matrices.swapaxes(1, 2),
            2,
            axis=2,
        )
        # A rotation of the frame multiplies a circular component by a phase. Here, the coefficients
        # with which the component enters the measured components are multiplied instead.
        matrices = (real - 1j * imaginary)[variant] * phases
        return matrices.real, -matrices.imag

    def _interpolate_size(
        self,
        discs: Array,
        size: float,
        place: Array,
    ) -> Array:
        """Interpolate a table of round contacts between the tabulated radii.

        Args:
            discs: Functions R, Z and T of circular.py (radii, distances, 3, n).
            size: Radius of the contact in m.
            place: Positions (N, 2) from the centre of the contact, in m, for which the result will
                be used.

        Returns:
            Functions R, Z and T (distances, 3, n) at the tabulated distances up to the farthest of
            these positions.
        """
        farthest = np.hypot(*place.T).max(initial=0.0) / self.step
        n_distances = int(min(farthest, self._last)) + 4

        first, weights = _cubic_weights(_size_index(size, self.depth))
        neighbours = discs[int(first) - 1 : int(first) + 3, :n_distances]
        return np.asarray(np.tensordot(weights, neighbours, axes=1))

    def _distance_weights(self, distance: Array, count: int = 1) -> tuple[Array, ...]:
        """Return the rows and weights of the interpolation of a table over the distance.

        Args:
            distance: Distances (N,) in m.
            count: Number of derivatives by the index of the row, the value included.

        Returns:
            Number (N,) of the second of four rows, and for each derivative the weights (4, N) of
            these rows; 0 beyond `REACH_DEPTHS`. The first row belongs to the distance -`step`.
        """
        index = distance / self.step
        first, *weights = _cubic_weights(np.minimum(index, self._last), count)
        return first, *(one * (index <= self._last) for one in weights)

    def _interpolate(self, table: Array, distance: Array) -> Array:
        """Interpolate a table over the distance between load and cube, or between two cubes.

        Args:
            table: Values (distances, ...) at the tabulated distances.
            distance: Distances (N,) in m.

        Returns:
            Values (N, ...); 0 at distances of more than `REACH_DEPTHS` depths of the cubes.
        """
        first, weights = self._distance_weights(distance)
        # The table begins one step before the distance 0, so entry 1 belongs to the distance 0.
        shape = (len(distance),) + (1,) * (table.ndim - 1)
        weights = weights.reshape(4, *shape)
        neighbours = [weights[j] * table[first + j] for j in range(4)]
        return np.asarray(sum(neighbours))


def _prior_spectrum(wavenumber: Array) -> Array:
    """Return the spectrum S of the random pressure that serves as prior, divided by depth^2.

    The pressure has the variance 1 Pa^2 and the correlation lengths `PRIOR_LENGTHS`.

    Args:
        wavenumber: Wavenumbers multiplied by the depth of the cubes.
    """
    parts = [
        2 * np.pi * length**2 * np.exp(-((wavenumber * length) ** 2) / 2)
        for length in PRIOR_LENGTHS
    ]
    return np.asarray(np.mean(parts, axis=0))


def _polar(place: Array) -> tuple[Array, Array]:
    """Convert positions (N, 2) in the x-y plane to polar coordinates about the origin.

    Returns:
        Distances (N,) from the origin, and directions (N,) from the x axis on, in rad.
    """
    x, y = place.T
    return np.hypot(x, y), np.arctan2(y, x)


def _fast_phases(angle: Array, order: Orders) -> Complex:
    """Return exp(i m angle) (N, n) as powers of exp(i angle), which takes a third of the time.

    Args:
        angle: Angles (N,) in rad.
        order: Orders m (n,).
    """
    one = np.exp(1j * angle).astype(np.complex64)
    powers = [np.ones_like(one)]
    for _ in range(int(order.max())):
        powers.append(powers[-1] * one)
    return np.stack(powers, axis=1)[:, order]


def _size_index(size: Array | float, depth: float) -> Array:
    """Return the fractional indices (...) of radii in `DISC_SIZES`, within the table.

    Args:
        size: Radii (...) in m.
        depth: Depth of the cubes' centres below the surface, in m.
    """
    # The tabulated radii are a geometric series, so their logarithms are equally spaced.
    index = np.log(size / depth / DISC_SIZES[0]) / _SIZE_LOG_STEP
    return np.asarray(np.clip(index, 1.0, len(DISC_SIZES) - 2.001))


def _split(circular: Complex) -> Array:
    """Return the real parts and then the imaginary parts (..., 2 n) of components (..., n)."""
    return np.concatenate([circular.real, circular.imag], axis=-1)


def _cubic_weights(index: Array | float, count: int = 1) -> tuple[Array, ...]:
    """Return the weights of cubic Lagrange interpolation from four neighbouring table entries.

    Args:
        index: Fractional index (...), which lies between the second and the third entry.
        count: Number of derivatives by the index, the value included.

    Returns:
        Index (...) of the second entry, and for each derivative the weights (4, ...) of all four.
    """
    first = np.floor(index).astype(np.intp)
    t = index - first
    powers = np.stack([np.ones_like(t), t, t * t, t * t * t])
    return first, *(_CUBIC_LAGRANGE[:count] @ powers)
