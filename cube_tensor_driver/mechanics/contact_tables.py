# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of the stress and gradient at cubes under contacts, fast enough for every simulation step.

`DiscTables` are for round contacts, `PolygonTables` for polygons of uniform traction. Both hold
circular components (circular.py) under unit loads, and both compute a field in three steps: they
interpolate the tables, multiply the components by the actual loads and sum them, and rotate the sum
into the frame of the cube.

For round contacts, the functions R, T and Z of circular.py are tabulated over the distance r and
the radius of the contact.

Let the origin O be the point of the surface above a cube. A polygon is the sum of the triangles
between O and its edges; triangles of edges with O on their outer side are subtracted. Each triangle
is the difference of two right triangles. One leg of both is the perpendicular of length d from O to
the line of the edge, in the direction beta; the other leg has the length t along this line. At the
position q from O, the traction is (v_x, v_y, v_z) + w z x q, where w is the gradient of a traction
that turns about O. The circular components of a right triangle then are::

    c = exp(i m beta) (A v + B conj(v) + Z v_z + W w),     v = (v_x + i v_y) exp(-i beta)

A, B, Z and W are functions of d and t: integrals of the R, T and Z of a point force. In polar
coordinates r and alpha about O, with alpha = 0 along the first leg, the hypotenuse is at
r = d / cos(alpha)::

    A = -(-1)^m int exp(i (m-1) alpha) int (R + T) / 2 r dr dalpha
    B = -(-1)^m int exp(i (m+1) alpha) int (R - T) / 2 r dr dalpha
    Z =  (-1)^m int exp(i m alpha) int Z r dr dalpha
    W = -i (-1)^m int exp(i m alpha) int T r^2 dr dalpha
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from ..core.arrays import Array, Complex, Index, Single
from .cache import Arrays, load_or_compute
from .circular import ORDERS, sum_rotated
from .distance_table import POINTS_PER_DEPTH, REACH_DEPTHS
from .layer import Layer
from .load_response import compute_disc_spectrum
from .spectra import compute_layer_spectra, tabulate_bessel

CONTACT_SIZES = np.geomspace(0.1, 5.0, 23)
"""Radii of the tabulated round contacts, divided by the depth of the cubes' centres below the
surface. Other radii are replaced by the nearest one. Within the range, this changes them by at most
10 %; radii outside of the range become the smallest or the largest one."""

GRID_STEP = 1 / 16
"""Step of the grid of the polygon tables, in asinh(d) and in asinh(t / sqrt(1 + d**2)).

d is the distance of the line through a polygon's edge from the point of the surface above the cube.
t is the length along this line, from the point that is nearest to the cube. Both are divided by the
depth of the cubes. The function asinh makes the grid fine near the cube and coarse far away.
"""

MAX_LEG_RATIO = 50.0
"""Largest distance along a polygon's edge for which the polygon tables have entries, divided by the
distance of the line through this edge from the centre of the cube.

The distance along the edge is counted from the point of the line that is nearest to the cube. An
edge that reaches farther is cut off there, because traction farther away hardly causes any stress
at the cube.

The ratio is t / sqrt(1 + d**2), where t is the distance along the edge, and d that of the line from
the point of the surface above the cube. Both are divided by the depth of the cube's centre.
"""

_LAST_DISTANCE = REACH_DEPTHS * POINTS_PER_DEPTH
"""Index of the largest tabulated distance between a round contact and a cube."""

_GRID_ROWS = math.ceil(np.arcsinh(REACH_DEPTHS) / GRID_STEP) + 2
"""Number of rows of the tables of stress at a cube under polygons of traction on the surface.

Row k is for d = sinh(k `GRID_STEP`) from 0 to `REACH_DEPTHS`, where d is the distance of the line
through a polygon's edge from the point of the surface above the cube, divided by the depth of the
cubes' centres. There are two rows more than steps: the one for d = 0, and one beyond the end, which
the interpolation between neighbouring rows needs.
"""

_CENTRE_COLUMN = math.ceil(np.arcsinh(MAX_LEG_RATIO) / GRID_STEP)
"""Index of the column of the polygon tables for t = 0, where t is the length along the line through
a polygon's edge, from the point of this line that is nearest to the cube."""

_GRID_COLUMNS = 2 * _CENTRE_COLUMN + 1
"""Number of columns of the tables of stress at a cube under polygons of traction on the surface.

Each column is for one value of t / sqrt(1 + d**2), where d and t give the position on the line
through a polygon's edge (see `GRID_STEP`). Values of both signs are tabulated, because t is
negative on one side of the point of the line that is nearest to the cube.
"""

_MIN_EDGE_LENGTH = 1e-12
"""Length of a polygon's edge, divided by the depth of the cubes' centres below the surface, below
which the edge counts as a point and has no effect. The limit avoids a division by 0."""


class _ContactTables:
    """Base class of the tables for round contacts and for polygons, which looks up and sums fields.

    Args:
        layer: Elastic layer that contains the cubes.
        depth: Distance from the centres of the cubes to the surface, in m.

    Raises:
        ElasticError: The layer does not contain this depth.
    """

    _kind: str
    """Name of the kind of tables; the name of their file in the cache begins with it."""

    def __init__(self, layer: Layer, depth: float) -> None:
        layer.check_depth(depth)
        self.layer = layer
        self.depth = depth
        inputs = [layer.thickness, layer.poisson, depth]
        table = load_or_compute(self._kind, inputs, self._compute)["table"]
        # Complex numbers are stored as pairs of real ones, with one row per grid point, so that the
        # interpolation is a product of real matrices.
        n_loads = table.shape[-2]
        width = n_loads * len(ORDERS)
        self._rows = table.reshape(-1, width).view(np.float32)

    def _compute(self) -> Arrays:
        """Compute the table of the stress and gradient at a cube under unit loads on the surface.

        Subclasses implement it. The table contains circular components: complex combinations of
        stresses and gradients whose phase alone changes if the frame is rotated about z.

        Returns:
            Dictionary with the single key `table`: 14 circular components (grid points ..., unit
            loads, 14) for each grid point and each unit load.
        """
        raise NotImplementedError

    def _sum_loads(
        self,
        weights: Single,
        rows: Index,
        loads: Complex,
        rotation: Complex,
    ) -> tuple[Array, Array]:
        """Interpolate the tables and sum the fields of L loads at each of N cubes.

        Args:
            weights: Interpolation weights (N, L, W) of W grid points.
            rows: Rows (N, L, W) of the tables that hold these grid points.
            loads: Amplitudes (N, L, unit loads) in the frame in which the tables are given.
            rotation: Angle (N, L) about z of this frame in the frame of the cube, as the complex
                number exp(i angle).

        Returns:
            Stress (N, 6) in Pa and gradient (N, 6, 3) in Pa/m.
        """
        neighbours = self._rows.take(rows, axis=0)
        interpolated = weights[..., None, :] @ neighbours
        unit_fields = interpolated.view(np.complex64)
        unit_fields = unit_fields.reshape(*loads.shape, len(ORDERS))

        amplitudes = loads.astype(np.complex64)
        circular = amplitudes[..., None, :] @ unit_fields
        return sum_rotated(circular[..., 0, :], rotation)


class DiscTables(_ContactTables):
    """Tables of the stress under round contacts, for cubes at one depth in a layer.

    The first set-up for a depth takes a second or two; cache.py keeps the tables.
    """

    _kind = "disc_tables"

    def _compute(self) -> Arrays:
        spectra = compute_layer_spectra(self.layer, self.depth)
        radii = CONTACT_SIZES * self.depth
        disc_spectra = [compute_disc_spectrum(spectra.k * radius) for radius in radii]

        distance = np.arange(_LAST_DISTANCE + 2) * self.depth / POINTS_PER_DEPTH
        bessel = tabulate_bessel(spectra.k, distance)
        # The table has the axes radius, distance, force (radial, normal, tangential) and component.
        # The equations in circular.py contain the tangential force multiplied by i.
        factors = np.array([1, 1, 1j])[:, None]
        table = spectra.compute_radial_response(bessel, np.stack(disc_spectra)) * factors
        return {"table": table.astype(np.complex64)}

    def compute_field(
        self,
        position: ArrayLike,
        force: ArrayLike,
        radius: ArrayLike,
    ) -> tuple[Array, Array]:
        """Compute the sum of the fields of L Hertz contacts at N cubes.

        Each contact carries the traction 3 F / (2 pi a^2) sqrt(1 - r^2 / a^2). Beyond
        `REACH_DEPTHS` depths, its field falls with the inverse square of the distance.

        Args:
            position: Position (N, L, 2) in m of each cube relative to the centre of the contact, in
                the frame of the cube.
            force: Force (N, L, 3) in N on the skin, in the frame of the cube.
            radius: Radius (L,) of the contacts, in m.

        Returns:
            Stress (N, 6) in Pa and gradient (N, 6, 3) in Pa/m, in the order xx yy zz yz zx xy,
            tension positive, as `contact.field` returns them.
        """
        offset = _to_complex(np.asarray(position, float))
        forces = np.asarray(force, float)
        distance = np.abs(offset)
        is_centred = distance == 0
        distance_safe = np.where(is_centred, 1.0, distance)
        direction = np.where(is_centred, 1.0, offset / distance_safe)

        # The real part is the force along the direction from contact to cube, the imaginary part
        # the force across it.
        polar_force = _to_complex(forces) * direction.conj()
        loads = np.stack(
            [
                polar_force.real,
                forces[..., 2],
                polar_force.imag,
            ],
            axis=-1,
        )

        # The table is interpolated linearly between the two nearest distances.
        index = distance / self.depth * POINTS_PER_DEPTH
        ratio = _LAST_DISTANCE / np.maximum(index, _LAST_DISTANCE)
        index = np.minimum(index, _LAST_DISTANCE)
        below = index.astype(np.intp)
        fraction = index - below
        weights = np.stack(
            [1 - fraction, fraction],
            axis=-1,
            dtype=np.float32,
        )
        weights *= ratio[..., None] ** 2

        n_distances = _LAST_DISTANCE + 2
        first_row = self._find_nearest_size(radius) * n_distances + below
        rows = first_row[..., None] + np.array([0, 1])
        return self._sum_loads(
            weights,
            rows,
            loads.astype(complex),
            direction,
        )

    def _find_nearest_size(self, radius: ArrayLike) -> Index:
        """Return the index (L,) in `CONTACT_SIZES` of the tabulated radius nearest to each radius.

        Args:
            radius: Radii (L,) in m, which are compared with the table on a logarithmic scale.
        """
        smallest, second, *_, largest = CONTACT_SIZES
        size = np.asarray(radius, float) / self.depth
        size = np.clip(size, smallest, largest)
        log_step = np.log(second / smallest)
        steps = np.log(size / smallest) / log_step
        nearest: Index = np.rint(steps).astype(np.intp)
        return nearest


class PolygonTables(_ContactTables):
    """Tables of the stress under right triangles of traction, for cubes at one depth in a layer.

    The traction is uniform or turns about the point of the surface above the cube. Every polygon is
    a sum of such triangles (file head).

    The first set-up for a depth takes a second or two; cache.py keeps the tables.
    """

    _kind = "polygon_tables"

    def _compute(self) -> Arrays:
        """Tabulate the circular components of right triangles.

        Returns:
            Functions A, B, Z and W (rows, columns, 4, 14) of the triangle's legs d (rows) and t
            (columns), which the head of this file defines.
        """
        over_distance = self._integrate_distance()

        # The rows of the grid are for the leg d of the triangle, the columns for the leg t, both
        # divided by the depth; r is the length of the hypotenuse.
        column = np.arange(-_CENTRE_COLUMN, _CENTRE_COLUMN + 1)
        row = np.arange(_GRID_ROWS)[:, None]
        eta = column * GRID_STEP
        d = np.sinh(row * GRID_STEP)
        t_scale = np.hypot(1.0, d)
        t = t_scale * np.sinh(eta)
        r = np.hypot(d, t)
        is_origin = r == 0
        r_safe = np.where(is_origin, 1.0, r)
        # The angle alpha between leg d and hypotenuse is represented as exp(i alpha).
        direction = np.where(is_origin, 1.0, (d + 1j * t) / r_safe)

        # The integral over the angle alpha = atan(t / d) is computed as an integral over the grid
        # variable eta, with t = sqrt(1 + d^2) sinh(eta).
        t_slope = t_scale * np.cosh(eta)
        alpha_slope = d * t_slope / r_safe**2
        added_orders = np.array([-1, 1, 0, 0])
        exponents = ORDERS + added_orders[:, None]
        phases = direction[..., None, None] ** exponents
        reached = np.minimum(r, REACH_DEPTHS)
        integrand = over_distance(reached) * phases
        integrand *= alpha_slope[..., None, None]
        integral = CubicSpline(eta, integrand, axis=1).antiderivative()
        table = integral(eta)
        table -= integral(0.0)[:, None]  # the integral begins at t = 0

        load_sign = np.array([-1.0, -1.0, 1.0, -1j])
        sign = (-1.0) ** ORDERS * load_sign[:, None]
        # Lengths in the integrals were divided by the depth. So the integrals A, B and Z over an
        # area are multiplied by depth^2, and W, which contains one more length, by depth^3.
        dimension = np.array([2.0, 2.0, 2.0, 3.0])
        unit = self.depth ** dimension[:, None]
        signed = table * sign * unit
        return {"table": signed.astype(np.complex64)}

    def _integrate_distance(self) -> CubicSpline:
        """Integrate the response to a point force over the distance r (for A, B, Z and W).

        Returns:
            Spline over r (divided by the depth) of the integrals (..., 4, 14) from 0 to r: the
            inner integrals of A, B, Z and W at the head of this file.
        """
        spectra = compute_layer_spectra(self.layer, self.depth)
        r = np.arange(_LAST_DISTANCE + 2) / POINTS_PER_DEPTH
        bessel = tabulate_bessel(spectra.k, r * self.depth)
        point_force = np.ones((1, len(spectra.k)))
        radial = spectra.compute_radial_response(bessel, point_force)[0]
        along, normal, across = radial.swapaxes(0, 1)

        distance = r[:, None]
        a = (along + across) / 2
        b = (along - across) / 2
        w = across * distance
        integrand = np.stack([a, b, normal, w], axis=1)
        integrand *= distance[..., None]
        return CubicSpline(r, integrand).antiderivative()

    def compute_field(
        self,
        start: ArrayLike,
        end: ArrayLike,
        traction: ArrayLike,
        twist: ArrayLike,
    ) -> tuple[Array, Array]:
        """Compute the sum of the fields of polygons with L edges in total at N cubes.

        Point forces farther away than `REACH_DEPTHS` depths have no effect.

        Args:
            start: Start (N, L, 2) of each edge relative to the cube, in m, in the frame of the
                cube. Polygons run counterclockwise as seen from outside of the skin.
            end: End (N, L, 2) of each edge, likewise.
            traction: Traction (N, L, 3) in Pa on the skin that the edge's polygon has at the
                origin, the point of the surface above the cube.
            twist: Gradient (N, L) in Pa/m of a tangential traction that turns about the origin. At
                the position q from the origin, it adds twist z x q to the traction.

        Returns:
            Stress (N, 6) in Pa and gradient (N, 6, 3) in Pa/m, as `contact.field`.
        """
        starts = _to_complex(np.asarray(start, float))
        stops = _to_complex(np.asarray(end, float))
        first = starts / self.depth
        second = stops / self.depth
        # `edge` is the unit vector along the edge as a complex number x + i y.
        edge = second - first
        edge /= np.maximum(np.abs(edge), _MIN_EDGE_LENGTH)

        # The two ends of each edge are rotated into axes along and across the edge. The real part
        # of an end is then its position t along the edge. The imaginary part is the same for both
        # ends: it is minus the signed distance of the edge's line from the origin.
        ends = np.stack([first, second], axis=-1)
        local = ends * edge.conj()[..., None]
        signed_distance = -local[..., 0].imag
        side = np.where(signed_distance < 0, -1.0, 1.0)
        # `direction` is the unit vector exp(i beta) from the origin towards the line of the edge.
        direction = -1j * edge * side
        d = np.abs(signed_distance)
        t = local.real * side[..., None]

        # Beyond the largest tabulated distance, traction has no effect. The integral over the
        # triangle of a more distant edge therefore depends only on the angle under which the edge
        # appears from the cube, and the edge can be moved to the largest distance.
        shrink = REACH_DEPTHS / np.maximum(d, REACH_DEPTHS)
        weights, rows = _find_triangle_neighbours(d * shrink, t * shrink[..., None])

        tractions = np.asarray(traction, float)
        v = _to_complex(tractions) * direction.conj()
        loads = np.stack(
            [
                v,
                v.conj(),
                tractions[..., 2],
                np.asarray(twist, float),
            ],
            axis=-1,
        )
        return self._sum_loads(
            weights,
            rows,
            loads,
            direction,
        )


def _to_complex(vectors: Array) -> Complex:
    """Return x + i y (...) of vectors (..., 2) or (..., 3); their z component is ignored."""
    result: Complex = vectors[..., 0] + 1j * vectors[..., 1]
    return result


def _find_triangle_neighbours(d: Array, t: Array) -> tuple[Single, Index]:
    """Return weights and table rows for the triangle between the origin and a polygon's edge.

    The origin is the point of the surface above the cube. The triangle is the difference of two
    right triangles. Their common leg is the perpendicular from the origin to the line of the edge;
    the other legs run along this line to the end and to the start of the edge.

    Args:
        d: Length (...) of the common leg, divided by the depth.
        t: Signed lengths (..., 2) of the legs to the start and to the end of the edge, divided by
            the depth.

    Returns:
        Weights (..., 8) of bilinear interpolation, and the rows (..., 8) of the table to which they
        belong. The first four are for the right triangle at the start of the edge, which is
        subtracted and so has negative weights, the others for the one at its end.
    """
    t_scale = np.hypot(1.0, d)
    eta = np.arcsinh(t / t_scale[..., None])
    last_column = _GRID_COLUMNS - 1 - 1e-6
    column = eta / GRID_STEP + _CENTRE_COLUMN
    column = np.clip(column, 0, last_column)
    row = np.arcsinh(d) / GRID_STEP
    above = row.astype(np.intp)
    left = column.astype(np.intp)

    down = (row - above)[..., None]
    right = column - left
    up = 1 - down
    corner_weights = [
        up * (1 - right),
        up * right,
        down * (1 - right),
        down * right,
    ]
    weights = np.stack(corner_weights, axis=-1, dtype=np.float32)
    weights[..., 0, :] *= -1

    corners = np.array([0, 1, _GRID_COLUMNS, _GRID_COLUMNS + 1])
    first = _GRID_COLUMNS * above[..., None] + left
    rows = first[..., None] + corners
    shape = (*d.shape, 8)
    return weights.reshape(shape), rows.reshape(shape)
