"""Response of cubes at one depth to traction on the surface, and covariances of random traction.

A layer is the same everywhere and in all directions. Quantities that depend on two positions are
therefore tabulated along one line: the offset p = r (cos phi, sin phi) only multiplies circular
components by a phase. With the spectra c(k) of spectra.py and a prior of the traction with the
spectrum S(k)::

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

from ..core.arrays import Array, Complex, Index
from ..core.modes import COMPONENTS, STRESS
from .cache import Arrays, load_or_compute
from .circular import CIRCULAR_FROM_FIELD, FIELD_FROM_CIRCULAR, ORDERS, Orders
from .layer import FIELD, Layer
from .spectra import BesselTable, Spectra, layer_spectra, tabulate_bessel

PRIOR_LENGTHS = (0.2, 0.8)
"""Correlation lengths of the prior, divided by the depth. They are close to the pair that explained
contacts of 2 to 20 mm best, in a half space at a depth of 5 mm."""

SHEAR_RATIO = 0.5
"""Prior standard deviation of the shear divided by that of the pressure."""

DISC_SIZES = np.geomspace(0.1, 5.0, 44)
"""Tabulated radii of discs, divided by the depth. Between them, `Kernels.response` interpolates
with an error of at most a hundredth of the largest value, at the wide end."""

POINTS_PER_DEPTH = 32
"""Number of tabulated distances per depth. Cubic interpolation between them has an error of 1e-4 of
the peak."""

REACH_DEPTHS = 20
"""Largest tabulated distance from a load to a cube, divided by the depth of the cube. Responses and
covariances at larger distances count as zero."""

_OBSERVED = np.array([FIELD.index(name) for name in COMPONENTS])
_IS_GRADIENT = np.arange(len(COMPONENTS)) >= len(STRESS)
_FIELD_ZZ = FIELD.index("zz")
_CIRCULAR_ZZ = int(np.argmax(CIRCULAR_FROM_FIELD[:, _FIELD_ZZ].real))


class MeasurementModel(NamedTuple):
    """Linear model of what the cubes of a skin measure under traction on the surface.

    All cubes respond to the same n circular components. Cubes of one calibration, and with the same
    pads in use, form a variant: they compute their measured components in the same way.

    Attributes:
        spectra: Spectra of the circular components.
        components: Matrix (variants, 2 n, 15) from the real and imaginary parts of the circular
            components to the measured `COMPONENTS` in the frame of the cube, in Pa and Pa/m.
        variant: Variant (cubes,) of each cube.
        pads: Matrix (variants, 2 n, P) to the stresses of the pads divided by their noise; None if
            cubes are modelled as points.
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
    """Model cubes as points, which measure the stress and its gradient at their centres.

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
    """Tabulated responses and covariances of cubes at one depth in a layer.

    Positions (N, 2) are in m. Measured components are `COMPONENTS` with the gradients multiplied by
    `scale`, so that all are in Pa. They are in the frame of a cube that is rotated about z by
    `angle` (N,) in rad and belongs to the variant `variant` (N,) of the measurement model.
    Tractions and forces are along x, y and z.

    The first set-up takes a few seconds; cache.py keeps the tables.

    Attributes:
        layer: Elastic layer.
        depth: Distance from the centres of the cubes to the surface, in m.
        scale: Length in m that gradients are multiplied by.
        step: Distance in m between two tabulated positions.
        variance: Prior variance (3,) of the traction along x, y and z, relative to the pressure.
        pressure_variance: Prior variance of the pressure at the depth of the cubes.
        component_matrices: `MeasurementModel.components` with scaled gradients.
        inputs: Arrays and numbers that determine the tables.
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
            layer: Elastic layer.
            depth: Distance from the centres of the cubes to the surface, in m.
            scale: Length in m that gradients are multiplied by.
            model: Measurement model of the cubes; by default they are points.

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

        # Cubic interpolation needs one more distance on the left, and two on the right.
        self._last = REACH_DEPTHS * POINTS_PER_DEPTH
        distance = np.arange(-1.0, self._last + 3) * self.step
        bessel = tabulate_bessel(spectra.k, distance)
        self._field = self._tabulate_discs(points.spectra, bessel)
        self._response = self._field
        if model is not None:
            self._response = self._tabulate_discs(spectra, bessel)
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
        """Factors (15,) that convert the gradients from Pa/m to Pa."""
        return np.where(_IS_GRADIENT, self.scale, 1.0)

    def add_variant(self, components: Array) -> int:
        """Add a variant of the measurement model, unless it exists already.

        Args:
            components: Matrix (2 n, 15) as in `MeasurementModel`, for cubes without some pads.

        Returns:
            The number of the variant.
        """
        # Variants are few: cubes that lost the same pad share one.
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
        """Return the tables that depend on the prior.

        Returns:
            cross: R, Z and T (distances, 3, n) of the covariance with the traction at a point.
            real: Covariance (distances, n, n) of real parts.
            imaginary: Covariance (distances, n, n) of imaginary parts.
            pressure: Covariance (distances, n) of real parts with the pressure below a point.
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
        """Compute the measured components (N, 15, 3) under a disc with a force of 1 N.

        Args:
            place: Positions (N, 2) of the cubes from the centre of the disc.
            angle: Rotations (N,) of the cubes.
            variant: Variants (N,) of the cubes.
            size: Radius of the disc in m.
        """
        table = self._interpolate_size(self._response, size, place)
        return self._measure(
            self._rotate_loads(table, place, angle, self._order),
            variant,
        )

    def field(self, place: Array, size: float) -> Array:
        """Compute the stress field under a disc with a force of 1 N.

        Args:
            place: Positions (N, 2) from the centre of the disc.
            size: Radius of the disc in m.

        Returns:
            `FIELD` (N, 24, 3) at the depth of the cubes, in Pa and Pa/m.
        """
        table = self._interpolate_size(self._field, size, place)
        circular = self._rotate_loads(table, place, np.zeros(len(place)), ORDERS)
        return np.asarray((circular @ FIELD_FROM_CIRCULAR).swapaxes(1, 2))

    def disc_pressure(
        self,
        place: Array,
        size: float,
        force: Array,
    ) -> Array:
        """Compute the pressure at the depth of the cubes under a disc.

        Args:
            place: Positions (N, 2) from the centre of the disc.
            size: Radius of the disc in m.
            force: Force (3,) on the disc in N.

        Returns:
            Pressure (N,) in Pa.
        """
        return -self.field(place, size)[:, _FIELD_ZZ] @ force

    def cross(
        self,
        place: Array,
        angle: Array,
        variant: Index,
    ) -> Array:
        """Compute the covariance (N, 15, 3) of cubes with the traction at one point.

        Args:
            place: Positions (N, 2) of the cubes from the point.
            angle: Rotations (N,) of the cubes.
            variant: Variants (N,) of the cubes.
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
        """Compute the covariance (N, 15, 15) of N pairs of cubes.

        Args:
            place: Positions (N, 2) of the first cubes from the other ones.
            angle: Rotations (N,) of the first cubes.
            variant: Variants (N,) of the first cubes.
            other_angle: Rotations (N,) of the other cubes.
            other_variant: Variants (N,) of the other cubes.
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
        """Compute the covariance (N, 15) of cubes with the pressure at their depth below one point.

        Arguments as in `cross`.
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
        """Return circular components in rotated frames under loads along x, y and z.

        Args:
            table: Functions R, Z and T of circular.py (distances, 3, n).
            place: Positions (N, 2) from the load.
            angle: Rotations (N,) of the frames.
            order: Orders (n,) of the components.

        Returns:
            Real and imaginary parts (N, 3, 2 n).
        """
        distance, direction = _polar(place)
        parts = self._interpolate(table, distance)
        radial = parts[:, 0]
        normal = parts[:, 1]
        across = 1j * parts[:, 2]

        # A force along x has the components F_r = cos(phi) and F_t = -sin(phi).
        cosine = np.cos(direction)[:, None]
        sine = np.sin(direction)[:, None]
        along_x = cosine * radial - sine * across
        along_y = sine * radial + cosine * across
        loads = np.stack([along_x, along_y, normal], axis=1)

        rotated = _phases(direction - angle, order)[:, None] * loads
        return np.concatenate([rotated.real, rotated.imag], axis=2)

    def _measure(self, circular: Array, variant: Index) -> Array:
        """Return measured components (N, 15, 3) of circular components (N, 3, 2 n)."""
        matrices = self.component_matrices
        # One product for all rows is faster than one for each row.
        matrix = matrices[0] if len(matrices) == 1 else matrices[variant]
        return np.asarray((circular @ matrix).swapaxes(1, 2))

    def _matrices_towards(self, angle: Array, variant: Index) -> tuple[Array, Array]:
        """Return matrices from circular components in frames along the line between two cubes.

        Args:
            angle: Direction (N,) of the line in the frame of the cube.
            variant: Variants (N,) of the cubes.

        Returns:
            Matrices (N, 15, n) of the real parts and of the imaginary parts.
        """
        phases = _phases(angle, self._order)[:, None]
        real, imaginary = np.split(
            self.component_matrices.swapaxes(1, 2),
            2,
            axis=2,
        )
        # Rotating the frame multiplies a component by a phase, which acts on its coefficients.
        matrices = (real - 1j * imaginary)[variant] * phases
        return matrices.real, -matrices.imag

    def _interpolate_size(
        self,
        discs: Array,
        size: float,
        place: Array,
    ) -> Array:
        """Interpolate a table between the radii of discs.

        Args:
            discs: Functions R, Z and T of circular.py (radii, distances, 3, n).
            size: Radius of the disc in m.
            place: Positions (N, 2) at which the table will be used.

        Returns:
            R, Z and T (distances, 3, n), up to the farthest position.
        """
        farthest = np.hypot(*place.T).max(initial=0.0) / self.step
        n_distances = int(min(farthest, self._last)) + 4

        # The radii are a geometric series: interpolation in the logarithm.
        log_step = np.log(DISC_SIZES[1] / DISC_SIZES[0])
        index = np.log(size / self.depth / DISC_SIZES[0]) / log_step
        first, weights = _cubic_weights(np.clip(index, 1.0, len(DISC_SIZES) - 2.001))
        neighbours = discs[int(first) - 1 : int(first) + 3, :n_distances]
        return np.asarray(np.tensordot(weights, neighbours, axes=1))

    def _interpolate(self, table: Array, distance: Array) -> Array:
        """Interpolate a table (distances, ...) at distances (N,) in m; 0 beyond the last one."""
        index = distance / self.step
        first, weights = _cubic_weights(np.minimum(index, self._last))
        weights = weights * (index <= self._last)

        # Entry 1 of the table belongs to the distance 0.
        shape = (len(index),) + (1,) * (table.ndim - 1)
        weights = weights.reshape(4, *shape)
        neighbours = [weights[j] * table[first + j] for j in range(4)]
        return np.asarray(sum(neighbours))


def hertz_pressure(distance: Array, size: float) -> Array:
    """Compute the pressure in Pa of a Hertz contact with a force of 1 N.

    Args:
        distance: Distances from the centre in m.
        size: Radius of the contact in m.
    """
    # p = 3 F / (2 pi a^2) sqrt(1 - r^2 / a^2), and 0 outside
    inside = np.clip(1 - (distance / size) ** 2, 0, None)
    peak = 3 / (2 * np.pi * size**2)
    return np.asarray(peak * np.sqrt(inside))


def disc_spectrum(x: Array) -> Array:
    """Compute the spectrum B of Hertz's pressure with a force of 1 N.

    Args:
        x: Wavenumbers k multiplied by the radius a of the contact.
    """
    # Near zero, the difference of sin and cos would lose all digits.
    safe = np.maximum(x, 1e-2)
    exact = 3 * (np.sin(safe) - safe * np.cos(safe)) / safe**3
    return np.where(x < 1e-2, 1 - x**2 / 10, exact)


def _prior_spectrum(wavenumber: Array) -> Array:
    """Return the spectrum S of the prior divided by depth^2, over wavenumber times depth."""
    parts = [
        2 * np.pi * length**2 * np.exp(-((wavenumber * length) ** 2) / 2)
        for length in PRIOR_LENGTHS
    ]
    return np.asarray(np.mean(parts, axis=0))


def _polar(place: Array) -> tuple[Array, Array]:
    """Return distance (N,) and direction (N,) in rad of positions (N, 2)."""
    x, y = place.T
    return np.hypot(x, y), np.arctan2(y, x)


def _phases(angle: Array, order: Orders) -> Complex:
    """Return exp(i m angle) (N, n) of angles (N,) and orders m (n,)."""
    phases: Complex = np.exp(1j * angle[:, None] * order)
    return phases


def _cubic_weights(index: Array | float) -> tuple[Index, Array]:
    """Return Lagrange's cubic weights between the two middle ones of four entries.

    Args:
        index: Fractional index (...) into a table.

    Returns:
        Index (...) of the second of the four entries, and the weights (4, ...).
    """
    first = np.floor(index).astype(np.intp)
    t = index - first
    weights = [
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    ]
    return first, np.stack(weights)
