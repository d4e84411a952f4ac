# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Response of cubes at one depth to Hertz contacts on the surface.

The response at the offset p = r (cos phi, sin phi) from the contact to the cube is an integral over
the wave vector k, with the weight d2k / (4 pi^2), of the spectra c(k) of the circular components
(spectra.py)::

    response(p) = int c exp(i k.p) B_a,     B_a = 3 (sin ka - ka cos ka) / (ka)^3

B_a is the spectrum (Fourier transform) of Hertz's pressure on a disc of radius a with a force of
1 N.

Source: K. L. Johnson, Contact Mechanics (1985), 4.2 (Hertz).
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import AnyArray, Array, Complex, Index, Single
from ..core.modes import STRESS
from .cache import load_or_compute
from .circular import FIELD_FROM_CIRCULAR, ORDERS, Orders, compute_rotation_phases, rotate_loads
from .distance_table import DistanceTable, compute_cubic_weights, to_polar
from .load_response import compute_disc_spectrum
from .measurement_model import CubeMeasurement
from .sensitivity import compute_sensitivities
from .spectra import BesselTable, Spectra, tabulate_bessel

DISC_SIZES = np.geomspace(0.1, 5.0, 44)
"""Radii of the tabulated round contacts (discs), divided by the depth of the cubes' centres below
the surface. The error of the interpolation between them in `ContactResponse.response` is at most a
hundredth of the largest value; it is largest for wide discs."""

_SIZE_LOG_STEP = float(np.log(DISC_SIZES[1] / DISC_SIZES[0]))
"""Difference of the natural logarithms of two neighbouring radii in `DISC_SIZES`."""

LANES = 16
"""Number of circular components, or of measured components, that the functions in C compute side by
side. Tables and matrices are padded with zeros to multiples of it, as the functions require."""

_MIN_DISTANCE = 1 / 50
"""Smallest distance along the surface between a contact and a cube, divided by the depth of the
cubes' centres, at which derivatives are computed. Nearer contacts get the derivatives at this
distance, because the direction from the contact to the cube is undefined at distance 0."""


class ContactResponse:
    """Tabulated responses of cubes to Hertz contacts.

    In the methods, positions (N, 2) are in m. Measured components are in Pa (`CubeMeasurement`), in
    the frame of a cube that is rotated about z by `angle` (N,) in rad and has the index `variant`
    (N,) in the measurement model. Forces are along x, y and z.

    The first set-up for a layer takes a few seconds; later ones load the tables from the cache.

    Attributes:
        n_quantities: Number S of quantities of the elastomer whose errors change the response
            (`compute_sensitivity`).
    """

    def __init__(self, cubes: CubeMeasurement) -> None:
        """Compute the tables or load them from the cache.

        Args:
            cubes: Layer, depth and measurement model of the cubes.
        """
        self._cubes = cubes
        self._depth = cubes.depth
        self._order = cubes.spectra.order
        self._table = DistanceTable(cubes.depth)
        bessel = tabulate_bessel(cubes.spectra.k, self._table.distances)
        self._field = self._tabulate_discs(cubes.point_spectra, bessel)
        self._response = self._field
        if cubes.spectra is not cubes.point_spectra:
            self._response = self._tabulate_discs(cubes.spectra, bessel)

        # For `compute_response_to_forces` and `compute_sensitivity`, the tables are matrices with
        # one row for each pair of a radius and a distance.
        self._rows = _make_rows(self._response)
        self._point_matrix = cubes.point_matrix.astype(np.float32)
        changes = []
        for spectra in compute_sensitivities(cubes.layer, cubes.depth):
            change = self._tabulate_discs(spectra, bessel)
            changes.append(change)
        self.n_quantities = len(changes)
        self._sensitivity_rows = _make_rows(np.concatenate(changes, axis=2))
        # Result of `collect_tables`, and the measurement matrices for which it was computed.
        self._packed: tuple[AnyArray, ...] = ()
        self._packed_matrices: Array | None = None

    def collect_tables(self, columns: Index) -> tuple[AnyArray, ...]:
        """Return the tables of the skin for the functions in C (native/cube_contact.h).

        These are `scale`, then table, orders and matrices of the response, and then those of its
        changes by errors of the elastomer.

        Args:
            columns: Indices (C,) of the measured components that the functions compute; the same
                ones in every call.
        """
        matrices = self._cubes.matrices
        if matrices is not self._packed_matrices:
            self._packed_matrices = matrices
            scale = [
                self._table.step,
                _MIN_DISTANCE * self._depth,
                np.log(DISC_SIZES[0] * self._depth),
                _SIZE_LOG_STEP,
                np.count_nonzero(columns < len(STRESS)),
            ]
            shape = self._response.shape[:2]
            self._packed = (
                np.array(scale),
                self._rows.reshape(*shape, 3, -1),
                _pad(self._order),
                _pack(matrices, columns),
                self._sensitivity_rows.reshape(*shape, -1, LANES),
                _pad(ORDERS),
                _pack(self._cubes.point_matrix[None], columns),
            )
        return self._packed

    def _tabulate_discs(self, spectra: Spectra, bessel: BesselTable) -> Array:
        """Tabulate the response to forces on discs of all radii `DISC_SIZES`.

        Args:
            spectra: Spectra of the n circular components.
            bessel: Bessel functions at the tabulated distances.

        Returns:
            Radial functions R, Z and T (radii, distances, 3, n) (circular.py).
        """
        inputs = [self._depth, *vars(spectra).values()]

        def compute() -> dict[str, Array]:
            radii = DISC_SIZES * self._depth
            loads = [compute_disc_spectrum(spectra.k * radius) for radius in radii]
            return {"discs": spectra.compute_radial_response(bessel, np.stack(loads))}

        return load_or_compute("discs", inputs, compute)["discs"]

    def compute_response(
        self,
        place: Array,
        angle: Array,
        variant: Index,
        size: float,
    ) -> Array:
        """Compute what N cubes measure under a Hertz contact with a force of 1 N.

        Args:
            place: Positions (N, 2) of the cubes from the centre of the contact, in m.
            angle: Rotations (N,) of the cubes about z, in rad.
            variant: Index (N,) of each cube's variant in the measurement model. Cubes with the same
                calibration and the same pads in use are one variant.
            size: Radius of the contact in m.

        Returns:
            Six stresses and nine gradients (N, 15, 3) at each cube, in Pa/N, for a force along x, y
            and z. Gradients are multiplied by a length (`CubeMeasurement`).
        """
        table = self._interpolate_size(self._response, size, place)
        circular = self._rotate_loads(table, place, angle, self._order)
        measured = self._cubes.measure(circular, variant)
        return np.asarray(measured.swapaxes(1, 2))

    def compute_response_slopes(
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
            Eight sets (N, 8, 15) of components. Sets 0 to 2 are the components under a force of 1 N
            along x, y and z. Sets 3 to 6 are derivatives of the components under `force`: by x and
            y of the contact's centre, then the first and second derivative by the natural logarithm
            of the radius. Set 7 is the components under a moment of 1 N m about z.
        """
        true_distance, direction = to_polar(place)
        distance = np.maximum(true_distance, _MIN_DISTANCE * self._depth)
        parts = self._interpolate_slopes(distance, size)

        # A circular component c of order m (circular.py) is a combination of the stresses and
        # gradients at a cube that a rotation of the frame about z multiplies by a phase. Let phi be
        # the direction from the contact to the cube. A force F_r along it, F_t across it and F_z
        # along z causes c = exp(i m phi) (R F_r + Z F_z + i T F_t), where R, Z and T depend on the
        # distance. `loads` has four parts: c / exp(i m phi) under `force`, its derivative by the
        # distance, and its first and second derivative by the natural logarithm of the radius.
        cosine = np.cos(direction).astype(np.float32)[:, None]
        sine = np.sin(direction).astype(np.float32)[:, None]
        force = force[..., None].astype(np.float32)
        force_x, force_y, force_z = force.swapaxes(0, 1)
        radial = cosine * force_x + sine * force_y
        tangential = cosine * force_y - sine * force_x
        n, n_orders = len(place), len(self._order)
        all_r, all_z, all_t = parts.transpose(2, 0, 1, 3)
        by_radial = radial[:, None] * all_r
        by_normal = force_z[:, None] * all_z
        loads = np.empty((n, 4, n_orders), np.complex64)
        loads.real = by_radial + by_normal
        loads.imag = tangential[:, None] * all_t
        value, by_r, by_log, by_log_twice = loads.swapaxes(0, 1)
        order = self._order.astype(np.float32)
        inverse = (1 / distance).astype(np.float32)[:, None]
        r, z, t = parts[:, 0].swapaxes(0, 1)
        r_slope, z_slope, t_slope = parts[:, 1].swapaxes(0, 1)
        by_phase = order * value - radial * t
        by_phi = 1j * by_phase + tangential * r
        twisting = inverse * (order * r - t)
        moment = 0.5j * (twisting - t_slope)
        # R, Z and T were interpolated at `_MIN_DISTANCE` if the contact is nearer. Their values at
        # the true distance are extrapolated linearly from there.
        below = true_distance - distance
        below = below[:, None].astype(np.float32)
        r = r + below * r_slope
        z = z + below * z_slope
        t = 1j * (t + below * t_slope)

        circular: Complex = np.empty((n, 8, n_orders), np.complex64)
        circular[:, 0] = cosine * r - sine * t
        circular[:, 1] = sine * r + cosine * t
        circular[:, 2] = z
        by_x = sine * inverse * by_phi - cosine * by_r
        by_y = -cosine * inverse * by_phi - sine * by_r
        circular[:, 3] = by_x
        circular[:, 4] = by_y
        circular[:, 5] = by_log
        circular[:, 6] = by_log_twice
        circular[:, 7] = moment
        in_cube = np.exp(1j * (direction - angle))
        phases = compute_rotation_phases(in_cube.astype(np.complex64), self._order)
        circular *= phases[:, None]
        return self._cubes.measure(_split(circular), variant)

    def _interpolate_slopes(self, distance: Array, size: Array) -> Single:
        """Interpolate the radial functions R, Z and T (circular.py), and their derivatives.

        Args:
            distance: Distances (N,) of the cubes from the centre of a contact, in m.
            size: Radius (N,) of the contact in m.

        Returns:
            Array (N, 4, 3, n) of the three functions for n circular components. Its second axis
            holds the value, the derivative by the distance, and the first and second derivative by
            the natural logarithm of the radius.
        """
        first, by_distance, distance_slope = self._table.compute_weights(distance, 2)
        size_index = _find_size_index(size, self._depth)
        size_row, *by_size = compute_cubic_weights(size_index, 3)

        # Bicubic interpolation uses 16 rows of the table: four radii times four distances.
        columns = self._response.shape[1]
        corner = (size_row - 1) * columns + first
        four = np.arange(4)
        steps = np.add.outer(columns * four, four)
        indices = corner[:, None] + steps.ravel()
        neighbours = self._rows.take(indices, axis=0)

        value, size_slope, size_curvature = by_size
        by_log = size_slope / _SIZE_LOG_STEP
        by_log_twice = size_curvature / _SIZE_LOG_STEP**2
        over_size = np.stack([value, value, by_log, by_log_twice])
        slope = distance_slope / self._table.step
        over_distance = np.stack([by_distance, slope, by_distance, by_distance])
        weights = over_size.T[:, :, None] * over_distance.T[:, None]
        by_row = weights.reshape(-1, 16, 4).swapaxes(1, 2)
        functions = by_row.astype(np.float32) @ neighbours
        by_function = functions.reshape(len(distance), 4, 3, -1)
        return np.asarray(by_function[..., : len(self._order)])

    def compute_response_to_forces(
        self,
        place: Array,
        angle: Array,
        variant: Index,
        size: Array,
        force: Array,
    ) -> Array:
        """Compute the measured components under Hertz contacts approximately, but fast.

        `response` interpolates the tables cubically, this method linearly. The error is at most a
        hundredth of the largest value, and a thousandth at a distance of two depths.

        Args:
            place: Positions (N, 2) of the cubes from the centre of a contact, in m.
            angle: Rotations (N,) of the cubes about z, in rad.
            variant: Index (N,) of each cube's variant in the measurement model.
            size: Radius (N,) of the contact in m.
            force: Force (N, 3) in N of the contact, along x, y and z.

        Returns:
            Components (N, 15) in Pa.
        """
        circular = self._respond_fast(
            self._rows,
            self._order,
            place,
            angle,
            size,
            force,
        )
        return self._cubes.measure(_split(circular), variant)[:, 0]

    def compute_sensitivity(
        self,
        place: Array,
        angle: Array,
        size: Array,
        force: Array,
    ) -> Array:
        """Compute how errors of depth, thickness and Poisson's ratio change the components.

        The cubes are modelled as points here, whatever the measurement model (sensitivity.py).

        Args:
            place: Positions (N, 2) of the cubes from the centre of a contact, in m.
            angle: Rotations (N,) of the cubes about z, in rad.
            size: Radius (N,) of the contact in m.
            force: Force (N, 3) in N of the contact, along x, y and z.

        Returns:
            Changes (N, S, 15) in Pa for one standard deviation of each of S quantities: depth,
            Poisson's ratio and, in a layer of finite thickness, the thickness.
        """
        circular = self._respond_fast(
            self._sensitivity_rows,
            ORDERS,
            place,
            angle,
            size,
            force,
        )
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
            rows: S tables (radii x distances, S x 3 n) of the radial functions R, Z and T
                (circular.py).
            order: Orders m (n,) of the circular components.
            place: Positions (N, 2) of the cubes from the centre of a contact, in m.
            angle: Rotations (N,) of the cubes about z, in rad.
            size: Radius (N,) of the contact in m.
            force: Force (N, 3) in N of the contact, along x, y and z.

        Returns:
            Components (N, S, n) in the frames of the cubes.
        """
        distance, direction = to_polar(place)
        index, decay = self._table.locate(distance)
        below = index.astype(np.intp)
        size_index = _find_size_index(size, self._depth)
        narrower = size_index.astype(np.intp)

        # Bilinear interpolation uses two neighbouring distances of two neighbouring radii. The
        # table begins one step before the distance 0, hence the 1 in the row number.
        columns = self._response.shape[1]
        first = narrower * columns + below + 1
        steps = [0, 1, columns, columns + 1]
        indices = first[:, None] + steps
        neighbours = rows.take(indices, axis=0)
        upper_share = index - below
        wider = size_index - narrower
        by_distance = np.stack([1 - upper_share, upper_share]) * decay
        of_narrower = (1 - wider) * by_distance
        of_wider = wider * by_distance
        weights = np.concatenate([of_narrower, of_wider])
        weights = weights.T.astype(np.float32)
        n, n_orders = len(place), len(order)
        interpolated = weights[:, None] @ neighbours
        n_padded = n_orders + -n_orders % LANES
        parts = interpolated.reshape(n, -1, 3, n_padded)[..., :n_orders]

        # The radial and the tangential force are the real and the imaginary part of the tangential
        # vector F_x + i F_y, rotated into the direction from the contact to the cube.
        force_x, force_y, force_z = force.T
        towards = np.exp(1j * direction).astype(np.complex64)
        tangential = (force_x + 1j * force_y).astype(np.complex64)
        in_plane = tangential * towards.conj()
        in_plane = in_plane[:, None, None]
        along_z = force_z.astype(np.float32)
        r, z, t = parts.transpose(2, 0, 1, 3)
        by_radial = in_plane.real * r
        by_normal = along_z[:, None, None] * z
        circular = np.empty(r.shape, np.complex64)
        circular.real = by_radial + by_normal
        circular.imag = in_plane.imag * t
        in_cube = np.exp(1j * (direction - angle))
        phases = compute_rotation_phases(in_cube.astype(np.complex64), order)
        circular *= phases[:, None]
        return circular

    def compute_field(self, place: Array, size: float) -> Array:
        """Compute stress and gradient under a Hertz contact with a force of 1 N.

        Args:
            place: Positions (N, 2) from the centre of the contact, in m.
            size: Radius of the contact in m.

        Returns:
            Quantities `FIELD` (N, 24, 3) at the depth of the cubes, in Pa and Pa/m per N, for a
            force along x, y and z.
        """
        table = self._interpolate_size(self._field, size, place)
        no_rotation = np.zeros(len(place))
        circular = self._rotate_loads(table, place, no_rotation, ORDERS)
        field = circular @ FIELD_FROM_CIRCULAR
        return np.asarray(field.swapaxes(1, 2))

    def _rotate_loads(
        self,
        table: Array,
        place: Array,
        angle: Array,
        order: Orders,
    ) -> Array:
        """Return circular components in rotated frames under unit loads along x, y and z.

        Args:
            table: Radial functions R, Z and T (distances, 3, n) over the distance from the load
                (circular.py).
            place: Positions (N, 2) from the load, in m.
            angle: Rotations (N,) of the frames about z, in rad.
            order: Orders m (n,) of the circular components: a rotation of the frame by an angle
                multiplies a component by exp(-i m angle).

        Returns:
            Real parts and then imaginary parts (N, 3, 2 n), for loads along x, y and z.
        """
        distance, direction = to_polar(place)
        parts = self._table.interpolate(table, distance)
        return rotate_loads(parts, direction, direction - angle, order)

    def _interpolate_size(
        self,
        discs: Array,
        size: float,
        place: Array,
    ) -> Array:
        """Interpolate a table of round contacts between the tabulated radii.

        Args:
            discs: Radial functions R, Z and T (radii, distances, 3, n) (circular.py).
            size: Radius of the contact in m.
            place: Positions (N, 2) from the centre of the contact, in m, for which the result will
                be used.

        Returns:
            Functions R, Z and T (distances, 3, n) at the tabulated distances up to the most distant
            of these positions.
        """
        distance, _ = to_polar(place)
        last_step = distance.max(initial=0.0) / self._table.step
        n_distances = int(min(last_step, self._table.last)) + 4

        size_index = _find_size_index(size, self._depth)
        first, weights = compute_cubic_weights(size_index)
        start = int(first) - 1
        neighbours = discs[start : start + 4, :n_distances]
        return np.asarray(np.tensordot(weights, neighbours, axes=1))


def _find_size_index(size: Array | float, depth: float) -> Array:
    """Return the fractional indices (...) of radii in `DISC_SIZES`.

    The indices are limited to the range in which cubic interpolation is possible, which needs one
    tabulated radius below and two above.

    Args:
        size: Radii (...) in m.
        depth: Depth of the cubes' centres below the surface, in m.
    """
    # The tabulated radii are a geometric series, so their logarithms are equally spaced.
    ratio = size / depth / DISC_SIZES[0]
    index = np.log(ratio) / _SIZE_LOG_STEP
    last = len(DISC_SIZES) - 2.001
    return np.asarray(np.clip(index, 1.0, last))


def _pad(values: AnyArray, axis: int = -1) -> AnyArray:
    """Append zeros along an axis until its length is a multiple of `LANES`."""
    widths = [(0, 0)] * values.ndim
    widths[axis] = 0, -values.shape[axis] % LANES
    return np.pad(values, widths)


def _make_rows(table: Array) -> Single:
    """Return a table (radii, distances, ..., n) with one row for each pair of radius and distance.

    The last axis is padded (`_pad`) first.
    """
    padded = _pad(table).astype(np.float32)
    return padded.reshape(len(table) * table.shape[1], -1)


def _pack(matrices: Array, columns: Index) -> Single:
    """Return the chosen columns of measurement matrices (variants, 2 n, 15) as a padded array.

    Returns:
        Array (variants, 2, n, C) for the real and the imaginary parts; n and C are padded (`_pad`).
    """
    by_part = matrices[..., columns].reshape(
        len(matrices),
        2,
        -1,
        len(columns),
    )
    return _pad(_pad(by_part), axis=2).astype(np.float32)


def _split(circular: Complex) -> Array:
    """Return the real parts and then the imaginary parts (..., 2 n) of components (..., n)."""
    return np.concatenate([circular.real, circular.imag], axis=-1)
