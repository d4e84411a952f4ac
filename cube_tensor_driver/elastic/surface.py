"""The field between the cubes: pressure and shear over a skin's surface from each cube's values and gradients.

Pressure is p = −σzz in the cubes' plane, `depth` below the surface. It is interpolated by radial functions that meet
the value of every cube and, along the cube's own x and y where it observes them, the derivative (Hermite or
gradient-enhanced interpolation; in statistics co-kriging with derivatives)::

    φ(r) = (1 + r²/c²)^(−5/2),  c = 3 depth
    cov(p(a), p(b)) = φ,   cov(p(a), ∂_v p(b)) = ∂φ/∂b·v,   cov(∂_u p(a), ∂_v p(b)) = u·∂²φ/∂a∂b·v

The exponent is that of a point force's pressure at a depth (Boussinesq), c is the best of those tried for indenters of
2 to 20 mm at pitches of 6 to 24 mm (`./cube pictures` draws the errors). Each cube's patch of the surface takes its
NEIGHBOURS nearest cubes. Shear (σzx, σyz) has no measured gradients; it takes values alone.

Source: G. E. Fasshauer, Meshfree Approximation Methods with MATLAB (2007), ch. 36 (Hermite interpolation); equilibrium
of the layer above the cubes for the contact's force and centre.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..core.errors import ElasticError
from ..core.modes import COMPONENTS
from ..core.scene import Places

Array = NDArray[np.float64]
NEIGHBOURS = 9
RIDGE = 1e-6
"""Added to φ(0) = 1: a thousandth of what is measured counts as noise, which keeps close cubes solvable."""
PRESSURE = [COMPONENTS.index(name) for name in ("zz", "zz_x", "zz_y")]
SHEAR = [COMPONENTS.index(name) for name in ("zx", "yz")]
FLOOR = 0.2
"""A contact is where the pressure is above this part of the skin's greatest."""


class Field(NamedTuple):
    """On the M points of a surface: pressure (M,) Pa, shear (M, 2) Pa = σzx, σyz in the frame of the point's cube."""

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


class Surface:
    """Points of a skin's surface, `side` × `side` on each cube's patch, and the field on them.

    points (M, 3) m in the parent frame, in the cubes' plane; cube (M,) which cube's patch; area: of a point, m².
    depth: from the cubes' centres to the surface, m. gradients: False leaves them out, to see what they buy.
    Raises ElasticError unless depth > 0 and side >= 1.
    """

    def __init__(self, places: Places, depth: float, side: int = 4, gradients: bool = True) -> None:
        if not depth > 0 or side < 1:
            raise ElasticError(f"surface: depth {depth} m, {side} points a side; both must be greater than 0")
        self.places, self.depth, self.pitch = places, depth, places.pitch
        self.spacing = self.pitch / side
        self.area = self.spacing**2
        offset = (np.arange(side) - (side - 1) / 2) * self.spacing
        grid = np.stack([*(a.ravel() for a in np.meshgrid(offset, offset)), np.zeros(side**2)], axis=1)
        patches = places.position[:, None] + np.einsum("nij,qj->nqi", places.rotation, grid)
        self.points = patches.reshape(-1, 3)
        self.cube = np.repeat(np.arange(len(places.position)), side**2)
        count = min(NEIGHBOURS, len(places.position))
        apart, near = cKDTree(places.position).query(places.position, min(3 * count, len(places.position)))
        apart, near = apart.reshape(len(near), -1), near.reshape(len(near), -1)
        # of cubes equally far the first ones, not those that rounding favours
        order = np.lexsort((near, (apart / self.pitch).round(6)))[:, :count]
        self._near = np.take_along_axis(near, order, axis=1)
        self._gradients = gradients
        pairs = cKDTree(self.points).query_pairs(1.5 * self.spacing, output_type="ndarray")
        self._from, self._to = pairs.T
        self._weights = lru_cache(maxsize=4)(self._make_weights)

    def field(self, values: Array) -> Field:
        """The field of values (cubes, 15), NaN where not observed; such a cube is filled in by the others. O(M)."""
        pressure, _ = self._interpolate(values[:, PRESSURE if self._gradients else PRESSURE[:1]])
        shear = [self._interpolate(values[:, [column]])[0] for column in SHEAR]
        return Field(-pressure, np.stack(shear, axis=1))

    def uncertainty(self, values: Array) -> Array:
        """(M,) standard deviation of the pressure between the cubes, as a part of its own size (0 .. 1)."""
        return self._interpolate(values[:, PRESSURE if self._gradients else PRESSURE[:1]])[1]

    def contacts(self, values: Array, least: float) -> list[Contact]:
        """Where pressure exceeds `least` Pa and FLOOR of the greatest: the strongest first; see Contact.

        The layer above the cubes is in equilibrium: the pressure's integral is the force, its first moment is that of
        the load plus depth × shear force, which is taken off again. For the moment pressure and shear are interpolated
        alike, by values: below a point force (σzx, σyz, σzz) points away from it in an incompressible body, so that
        each cube by itself gives the place, and any common weights do. Each point counts for the contact nearest to it.
        What spreads beyond the skin is lost: hardly any pressure, of shear about 1.5 depth / distance to the edge.
        """
        field = self.field(values)
        top = float(field.pressure.max(initial=0.0))
        inside = field.pressure > max(least, FLOOR * top)
        if not inside.any():
            return []
        joined = inside[self._from] & inside[self._to]
        n = len(self.points)
        links = coo_matrix((np.ones(joined.sum()), (self._from[joined], self._to[joined])), shape=(n, n))
        label = connected_components(links, directed=False)[1][inside]
        owner = label[cKDTree(self.points[inside]).query(self.points)[1]] if np.ptp(label) else np.full(n, label[0])
        doubt, alike = self.uncertainty(values), -self._interpolate(values[:, PRESSURE[:1]])[0]
        sheared = bool(np.isfinite(values[:, SHEAR]).any())
        found = [self._contact(np.flatnonzero(owner == k), field, alike, doubt, sheared) for k in np.unique(label)]
        return sorted(found, key=lambda contact: -contact.normal_force)

    def _contact(self, mine: NDArray[np.intp], field: Field, alike: Array, doubt: Array, sheared: bool) -> Contact:
        pressure, points, cubes = field.pressure[mine], self.points[mine], self.cube[mine]
        turn = self.places.rotation[cubes]
        weight = pressure * self.area
        normal_force = float(weight.sum())
        normal = np.einsum("n,ni->i", weight, turn[:, :, 2])
        normal /= np.linalg.norm(normal)
        shear = np.einsum("nij,nj->i", turn[:, :, :2], np.nan_to_num(field.shear[mine])) * self.area
        shear -= normal * (shear @ normal)
        moment = alike[mine] * self.area
        centre = moment @ points / moment.sum()
        position = centre + self.depth * (normal - shear / moment.sum())
        # errors between cubes are as wide as the pitch is: so many points are wrong together
        sigma = doubt[mine] * np.abs(pressure) * self.area
        together = (self.pitch / self.spacing) ** 2
        apart = ((points - centre) ** 2).sum(axis=1) / 2
        return Contact(
            position,
            normal,
            shear - normal * normal_force,
            normal_force,
            float(np.linalg.norm(shear)) if sheared else np.nan,
            float(np.count_nonzero(pressure > 0.5 * pressure.max()) * self.area),
            float(np.sqrt(together * (sigma**2 @ apart)) / normal_force),
            float(np.sqrt(together * (sigma**2).sum())),
        )

    def _interpolate(self, data: Array) -> tuple[Array, Array]:
        """On all points: interpolated first column and its relative uncertainty; data (cubes, 1 or 3)."""
        scaled = data * np.array([1.0, self._scale, self._scale])[: data.shape[1]]
        known = np.isfinite(scaled)
        weights, doubt = self._weights(known.tobytes(), scaled.shape[1])
        near = np.nan_to_num(scaled)[self._near].reshape(len(data), -1)
        value = np.matmul(weights, near[:, :, None])[..., 0].ravel()
        empty = ~known[self._near, 0].any(axis=1)  # none of the neighbours has a value
        return np.where(empty[self.cube], np.nan, value), doubt

    @property
    def _scale(self) -> float:
        return 3.0 * self.depth

    def _make_weights(self, known_bytes: bytes, width: int) -> tuple[Array, Array]:
        """Weights (cubes, points of a patch, neighbours × width) and relative uncertainty (M,)."""
        n, k = self._near.shape
        known = np.frombuffer(known_bytes, bool).reshape(n, width)[self._near].reshape(n, k * width)
        places = self.places.position[self._near] / self._scale
        axes = np.swapaxes(self.places.rotation[:, :, :2], 1, 2)[self._near]  # (n, k, 2, 3)
        if width == 1:
            axes = axes[:, :, :0]
        points = self.points.reshape(n, -1, 3) / self._scale
        matrix = _covariance(places[:, :, None] - places[:, None], axes[:, :, None], axes[:, None])
        matrix = np.moveaxis(matrix, 3, 2).reshape(n, k * width, k * width)
        matrix *= known[:, :, None] & known[:, None]
        matrix[:, np.arange(k * width), np.arange(k * width)] += np.where(known, RIDGE, 1.0)
        none = np.zeros((n, points.shape[1], 1, 0, 3))
        to_points = _covariance(points[:, :, None] - places[:, None], none, axes[:, None])
        to_points = to_points.reshape(n, -1, k * width) * known[:, None]
        weights = np.swapaxes(np.linalg.solve(matrix, np.swapaxes(to_points, 1, 2)), 1, 2)
        doubt = np.sqrt(np.clip(1 - np.einsum("nqd,nqd->nq", weights, to_points), 0, 1)).ravel()
        return np.ascontiguousarray(weights), doubt


def _covariance(d: Array, u: Array, v: Array) -> Array:
    """(..., 1 + A, 1 + B) covariances of value and derivatives along u (..., A, 3) with those along v (..., B, 3).

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
        -2 * f1[..., None, None] * straight - 4 * f2[..., None, None] * du[..., None] * dv[..., None, :]
    )
    return result
