"""The field between the cubes: pressure and shear over a skin's surface from each cube's values and
gradients.

Pressure is p = −σzz in the cubes' plane, `depth` below the surface. It is interpolated by radial
functions that meet the value of every cube and, along the cube's own x and y where it observes
them, the derivative (Hermite or gradient-enhanced interpolation; in statistics co-kriging with
derivatives)::

    φ(r) = (1 + r²/c²)^(−5/2),  c = 3 depth
    cov(p(a), p(b)) = φ,   cov(p(a), ∂_v p(b)) = ∂φ/∂b·v,   cov(∂_u p(a), ∂_v p(b)) = u·∂²φ/∂a∂b·v

The exponent is that of a point force's pressure at a depth (Boussinesq), c is the best of those
tried for indenters of 2 to 20 mm at pitches of 6 to 24 mm (`./cube pictures` draws the errors).
Each cube's patch of the surface takes its NEIGHBOURS nearest cubes. Shear (σzx, σyz) has no
measured gradients; it takes values alone.

Source: G. E. Fasshauer, Meshfree Approximation Methods with MATLAB (2007), ch. 36 (Hermite
interpolation); equilibrium of the layer above the cubes for the contact's force and centre.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..core.errors import ElasticError
from ..core.modes import COMPONENTS
from ..core.scene import CubePoses

Array = NDArray[np.float64]
NEIGHBOURS = 9
RIDGE = 1e-6
"""Added to φ(0) = 1: a thousandth of what is measured counts as noise, which keeps close cubes
solvable."""
PRESSURE = [COMPONENTS.index(name) for name in ("zz", "zz_x", "zz_y")]
SHEAR = [COMPONENTS.index(name) for name in ("zx", "yz")]
FLOOR = 0.2
"""A contact is where the pressure is above this part of the skin's greatest."""


class Field(NamedTuple):
    """On the M points of a surface: pressure (M,) Pa, shear (M, 2) Pa = σzx, σyz in the frame of
    the point's cube."""

    pressure: Array
    shear: Array


class Contact(NamedTuple):
    """One contact in the skin's parent frame; fields and units as in SkinContacts.msg."""

    position: Array
    normal: Array
    force: Array
    normal_force: float
    shear_force: float
    area: float
    position_uncertainty: float
    force_uncertainty: float


class Weights:
    """What makes points of cubes: matrix (M, cubes × width), its entries data (cubes, points,
    neighbours × width).

    known (cubes, width): what they were solved for; doubt (cubes, points): relative uncertainty;
    blank (cubes,): none of the neighbours has a value.
    """

    def __init__(self, near: NDArray[np.intp], points: int, known: NDArray[np.bool_]) -> None:
        n, width = known.shape
        columns = (near[:, :, None] * width + np.arange(width)).reshape(n, -1)
        self.known, self.blank, self.doubt = known, np.zeros(n, bool), np.zeros((n, points // n))
        self.data = np.zeros((n, points // n, columns.shape[1]))
        place = np.repeat(columns, points // n, axis=0).ravel()
        ends = np.arange(points + 1) * columns.shape[1]
        self.matrix = csr_matrix(
            (self.data.ravel(), place, ends), shape=(points, n * width), copy=False
        )


class Surface:
    """Points of a skin's surface, `side` × `side` on each cube's patch, and the field on them.

    points (M, 3) m in the parent frame, in the cubes' plane; cube (M,) which cube's patch; area: of
    a point, m².
    depth: from the cubes' centres to the surface, m. gradients: False leaves them out, to see what
    they buy. Raises ElasticError unless depth > 0 and side >= 1.
    """

    def __init__(
        self, places: CubePoses, depth: float, side: int = 4, gradients: bool = True
    ) -> None:
        if not depth > 0 or side < 1:
            raise ElasticError(
                f"surface: depth {depth} m, {side} points a side; both must be greater than 0"
            )
        self.places, self.depth, self.pitch = places, depth, places.pitch
        self.spacing = self.pitch / side
        self.area, self._scale = self.spacing**2, 3.0 * depth
        offset = (np.arange(side) - (side - 1) / 2) * self.spacing
        grid = np.stack(
            [*(a.ravel() for a in np.meshgrid(offset, offset)), np.zeros(side**2)], axis=1
        )
        patches = places.position[:, None] + np.einsum("nij,qj->nqi", places.rotation, grid)
        self.points = patches.reshape(-1, 3)
        self.cube = np.repeat(np.arange(len(places.position)), side**2)
        count = min(NEIGHBOURS, len(places.position))
        apart, near = cKDTree(places.position).query(
            places.position, min(3 * count, len(places.position))
        )
        apart, near = apart.reshape(len(near), -1), near.reshape(len(near), -1)
        # of cubes equally far the first ones, not those that rounding favours
        order = np.lexsort((near, (apart / self.pitch).round(6)))[:, :count]
        self._near = np.take_along_axis(near, order, axis=1)
        self._columns = PRESSURE if gradients else PRESSURE[:1]
        pairs = cKDTree(self.points).query_pairs(1.5 * self.spacing, output_type="ndarray")
        self._from, self._to = pairs.T
        self._solved: dict[tuple[int, ...], Weights] = {}

    def field(self, values: Array) -> Field:
        """The field of values (cubes, 15), NaN where not observed; such a cube is filled in by the
        others. O(M)."""
        return Field(self._pressure(values), self._shear(values))

    def uncertainty(self, values: Array) -> Array:
        """(M,) standard deviation of the pressure between the cubes, as a part of its own size (0
        .. 1)."""
        return self._weights(np.isfinite(values), self._columns).doubt.ravel()

    def contacts(self, values: Array, least: float) -> list[Contact]:
        """Where pressure exceeds `least` Pa and FLOOR of the greatest: the strongest first; see
        Contact.

        The layer above the cubes is in equilibrium: the pressure's integral is the force, its first
        moment is that of the load plus depth × shear force, which is taken off again. For the
        moment pressure and shear are interpolated
        alike, by values: below a point force (σzx, σyz, σzz) points away from it in an
        incompressible body, so that each cube by itself gives the place, and any common weights do.
        Each patch counts for the contact nearest to it.
        What spreads beyond the skin is lost: hardly any pressure, of shear about 1.5 depth /
        distance to the edge.
        """
        # Where no cube around has a value nothing presses that we know of.
        pressure = np.nan_to_num(self._pressure(values))
        inside = pressure > max(least, FLOOR * float(pressure.max()))
        if not inside.any():
            return []
        field = Field(pressure, np.nan_to_num(self._shear(values)))
        doubt, alike = (
            self.uncertainty(values),
            -np.nan_to_num(self._interpolate(values, PRESSURE[:1])),
        )
        sheared = bool(np.isfinite(values[:, SHEAR]).any())
        owner = self._owners(inside)
        found = [self._contact(owner == k, field, alike, doubt, sheared) for k in np.unique(owner)]
        return sorted(found, key=lambda contact: -contact.normal_force)

    def _owners(self, inside: NDArray[np.bool_]) -> NDArray[np.int32]:
        """(cubes,) number of the contact that each patch counts for; what meets in a patch is one
        contact."""
        n = len(self._near)
        joined = inside[self._from] & inside[self._to]
        links = coo_matrix(
            (joined[joined], (self.cube[self._from[joined]], self.cube[self._to[joined]])),
            shape=(n, n),
        )
        part = connected_components(links, directed=False)[1]
        touched = inside.reshape(n, -1).any(axis=1)
        nearest = cKDTree(self.places.position[touched]).query(self.places.position)[1]
        owners: NDArray[np.int32] = part[touched][nearest]
        return owners

    def _contact(
        self, mine: NDArray[np.bool_], field: Field, alike: Array, doubt: Array, sheared: bool
    ) -> Contact:
        """The contact of the patches `mine` (cubes,)."""

        def of_mine(on_points: Array) -> Array:
            return on_points.reshape(len(mine), -1)[mine]

        turn, points = self.places.rotation[mine], self.points.reshape(len(mine), -1, 3)[mine]
        pressure, weight = of_mine(field.pressure), of_mine(alike) * self.area
        normal_force = float(pressure.sum() * self.area)
        normal = _total(pressure.sum(axis=1), turn[:, :, 2])
        normal /= np.linalg.norm(normal)
        shear = (
            sum(_total(of_mine(field.shear[:, k]).sum(axis=1), turn[:, :, k]) for k in (0, 1))
            * self.area
        )
        shear -= normal * (shear @ normal)
        centre = _total(weight, points) / weight.sum()
        position = centre + self.depth * (normal - shear / weight.sum())
        # errors between cubes are as wide as the pitch is: so many points are wrong together
        variance = (of_mine(doubt) * pressure * self.pitch * self.spacing) ** 2
        apart = ((points - centre) ** 2).sum(axis=2) / 2
        return Contact(
            position,
            normal,
            shear - normal * normal_force,
            normal_force,
            float(np.linalg.norm(shear)) if sheared else np.nan,
            float(np.count_nonzero(pressure > 0.5 * pressure.max()) * self.area),
            float(np.sqrt((variance * apart).sum()) / normal_force),
            float(np.sqrt(variance.sum())),
        )

    def _pressure(self, values: Array) -> Array:
        return -self._interpolate(values, self._columns)

    def _shear(self, values: Array) -> Array:
        return np.stack([self._interpolate(values, [column]) for column in SHEAR], axis=1)

    def _interpolate(self, values: Array, columns: list[int]) -> Array:
        """(M,) the first of the columns of values (cubes, 15) on all points; the others are its
        gradient."""
        known = np.isfinite(values)
        if not known[:, columns[0]].any():
            return np.full(len(self.points), np.nan)
        weights = self._weights(known, columns)
        scale = np.array([1.0, self._scale, self._scale])[: len(columns)]
        value: Array = weights.matrix @ (np.where(known, values, 0)[:, columns] * scale).ravel()
        value[np.repeat(weights.blank, value.size // weights.blank.size)] = np.nan
        return value

    def _weights(self, known: NDArray[np.bool_], columns: list[int]) -> Weights:
        """Weights of these columns; they depend on what is known alone, and are solved anew where
        that has changed."""
        mine = known[:, columns]
        if tuple(columns) not in self._solved:
            self._solved[tuple(columns)] = Weights(self._near, len(self.points), ~mine)
        solved = self._solved[tuple(columns)]
        if not np.array_equal(mine, solved.known):
            changed = np.flatnonzero((mine != solved.known)[self._near].any(axis=(1, 2)))
            solved.data[changed], solved.doubt[changed] = self._solve(changed, mine)
            solved.known, solved.blank = mine, ~mine[self._near, 0].any(axis=1)
        return solved

    def _solve(self, patches: NDArray[np.intp], known: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Weights (patches, points of a patch, neighbours × width) and relative uncertainty
        (patches, points)."""
        near, n, width = self._near[patches], len(patches), known.shape[1]
        size = near.shape[1] * width
        seen = known[near].reshape(n, size)
        places = self.places.position[near] / self._scale
        axes = np.swapaxes(self.places.rotation[:, :, : width - 1], 1, 2)[near]  # (n, k, 2 or 0, 3)
        points = self.points.reshape(len(self._near), -1, 3)[patches] / self._scale
        matrix = _covariance(places[:, :, None] - places[:, None], axes[:, :, None], axes[:, None])
        matrix = np.moveaxis(matrix, 3, 2).reshape(n, size, size)
        matrix *= seen[:, :, None] & seen[:, None]
        matrix[:, np.arange(size), np.arange(size)] += np.where(seen, RIDGE, 1.0)
        none = np.zeros((n, points.shape[1], 1, 0, 3))
        to_points = _covariance(points[:, :, None] - places[:, None], none, axes[:, None])
        to_points = to_points.reshape(n, -1, size) * seen[:, None]
        weights = np.swapaxes(np.linalg.solve(matrix, np.swapaxes(to_points, 1, 2)), 1, 2)
        return weights, np.sqrt(np.clip(1 - np.einsum("nqd,nqd->nq", weights, to_points), 0, 1))


def _total(weights: Array, vectors: Array) -> Array:
    """(3,) the sum of weights (...) times vectors (..., 3). Not by BLAS: its threads burn a second
    core over this."""
    result: Array = np.einsum("n,ni->i", weights.ravel(), vectors.reshape(-1, 3))
    return result


def _covariance(d: Array, u: Array, v: Array) -> Array:
    """(..., 1 + A, 1 + B) covariances of value and derivatives along u (..., A, 3) with those along
    v (..., B, 3).

    d (..., 3) is the first place minus the second, over c.
    """
    b = 1 + np.einsum("...i,...i->...", d, d)
    f, f1, f2 = b**-2.5, -2.5 * b**-3.5, 8.75 * b**-4.5
    du, dv = (np.einsum("...i,...ai->...a", d, axes) for axes in (u, v))
    shape = (*b.shape, 1 + du.shape[-1], 1 + dv.shape[-1])
    result = np.empty(shape)
    result[..., 0, 0] = f
    result[..., 0, 1:] = -2 * f1[..., None] * dv
    result[..., 1:, 0] = 2 * f1[..., None] * du
    straight = np.einsum("...ai,...bi->...ab", u, v)
    result[..., 1:, 1:] = (
        -2 * f1[..., None, None] * straight
        - 4 * f2[..., None, None] * du[..., None] * dv[..., None, :]
    )
    return result
