"""Pressure and shear over a skin's surface from each cube's values and gradients; its contacts.

Pressure is p = −σzz in the cubes' plane, `depth` below the surface. It is interpolated from the
values and gradients of the cubes (interpolation.py), with the length c = 3 depth: the best of those
tried for indenters of 2 to 20 mm at pitches of 6 to 24 mm (`./cube pictures` draws the errors).
Shear (σzx, σyz) has no measured gradients; it is interpolated from values.

A contact's force and position follow from the equilibrium of the layer above the cubes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..core.arrays import Array
from ..core.errors import ElasticError
from ..core.modes import COMPONENTS
from ..core.poses import CubePoses
from .interpolation import Interpolation

PRESSURE = [COMPONENTS.index(name) for name in ("zz", "zz_x", "zz_y")]
SHEAR = [COMPONENTS.index(name) for name in ("zx", "yz")]
RELATIVE_THRESHOLD = 0.2
"""A contact is where the pressure is above this part of the skin's greatest pressure."""
LENGTH_PER_DEPTH = 3.0
"""Length of the radial function over the depth of the cubes."""


class Field(NamedTuple):
    """On the M points of a surface.

    pressure: (M,) Pa; shear: (M, 2) Pa, σzx and σyz in the frame of the point's cube
    """

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
    """Points of a skin's surface, `side` × `side` on the patch of each cube, and the field on them.

    points: (M, 3) m in the parent frame, in the cubes' plane; cube: (M,) whose patch it is
    middle: (cubes,) the point nearest to each cube
    spacing: of the points, m; area: of a point, m²

    Parameters: depth: from the cubes' centres to the surface, m. gradients: False ignores the
    cubes' gradients, which shows what they gain. Raises ElasticError unless depth > 0 and
    side >= 1.
    """

    def __init__(
        self, poses: CubePoses, depth: float, side: int = 4, gradients: bool = True
    ) -> None:
        if not depth > 0 or side < 1:
            raise ElasticError(
                f"surface: depth {depth} m, {side} points a side; both must be greater than 0"
            )
        self.poses, self.depth, self.pitch = poses, depth, poses.pitch
        self.spacing = self.pitch / side
        self.area = self.spacing**2
        self._patches = patches(poses, self.spacing, side)
        self.points = self._patches.reshape(-1, 3)
        self.cube = np.repeat(np.arange(len(poses.position)), side**2)
        self.middle = np.arange(len(poses.position)) * side**2 + side // 2 * (side + 1)
        self._interpolation = Interpolation(poses, self._patches, LENGTH_PER_DEPTH * depth)
        self._pressure_columns = PRESSURE if gradients else PRESSURE[:1]
        # (pairs, 2) points next to each other
        self._pairs = cKDTree(self.points).query_pairs(1.5 * self.spacing, output_type="ndarray")

    def field(self, values: Array) -> Field:
        """The field of values (cubes, 15), NaN where not observed. Takes O(M) time.

        Where a cube has no value, its neighbours fill the gap.
        """
        return Field(self._pressure(values), self._shear(values))

    def uncertainty(self, values: Array) -> Array:
        """(M,) standard deviation of the pressure between the cubes over its own size: 0 to 1."""
        return self._interpolation.uncertainty(values, self._pressure_columns)

    def contacts(self, values: Array, threshold: float) -> list[Contact]:
        """Where the pressure exceeds `threshold` Pa and a part of its greatest; strongest first.

        values: (cubes, 15) as in `field`. Each patch counts for the contact nearest to it.

        The layer above the cubes is in equilibrium: the integral of the pressure is the force. The
        first moment of the pressure is that of the load plus depth × shear force, which is
        subtracted again. For this moment pressure and shear are interpolated alike, from values:
        below a point force (σzx, σyz, σzz) points away from it in an incompressible body, so each
        cube by itself gives the position, and so do any common weights.

        What spreads beyond the skin is lost: hardly any pressure, but of shear about 1.5 depth /
        distance to the edge.
        """
        # Around cubes without any value, no pressure is known: none is assumed.
        pressure = np.nan_to_num(self._pressure(values))
        inside = pressure > max(threshold, RELATIVE_THRESHOLD * float(pressure.max()))
        if not inside.any():
            return []
        shear = np.nan_to_num(self._shear(values))
        loaded = _LoadedSurface(
            pressure=self._by_patch(pressure),
            shear=np.stack([self._by_patch(one) for one in shear.T]),
            moment_pressure=self._by_patch(-np.nan_to_num(self._from_values(values))),
            uncertainty=self._by_patch(self.uncertainty(values)),
            sees_shear=bool(np.isfinite(values[:, SHEAR]).any()),
        )
        owner = self._owners(inside)
        contacts = [self._contact(loaded, owner == k) for k in np.unique(owner)]
        return sorted(contacts, key=lambda contact: -contact.normal_force)

    def _pressure(self, values: Array) -> Array:
        return -self._interpolation.values(values, self._pressure_columns)

    def _from_values(self, values: Array) -> Array:
        """σzz (M,) from values alone, as shear is interpolated."""
        return self._interpolation.values(values, PRESSURE[:1])

    def _shear(self, values: Array) -> Array:
        columns = [self._interpolation.values(values, [column]) for column in SHEAR]
        return np.stack(columns, axis=1)

    def _by_patch(self, on_points: Array) -> Array:
        """(M,) as (cubes, points of a patch)."""
        return on_points.reshape(len(self._patches), -1)

    def _owners(self, inside: NDArray[np.bool_]) -> NDArray[np.int32]:
        """(cubes,) number of the contact that each patch counts for.

        Points in contact that are next to each other, or in one patch, belong to one contact.
        """
        n = len(self._patches)
        here, there = self._pairs.T
        joined = inside[here] & inside[there]
        ends = (self.cube[here[joined]], self.cube[there[joined]])
        links = coo_matrix((joined[joined], ends), shape=(n, n))
        part = connected_components(links, directed=False)[1]
        touched = inside.reshape(n, -1).any(axis=1)
        nearest = cKDTree(self.poses.position[touched]).query(self.poses.position)[1]
        owners: NDArray[np.int32] = part[touched][nearest]
        return owners

    def _contact(self, loaded: _LoadedSurface, mine: NDArray[np.bool_]) -> Contact:
        """The contact of the patches `mine` (cubes,)."""
        rotation, points = self.poses.rotation[mine], self._patches[mine]
        pressure = loaded.pressure[mine]
        weight = loaded.moment_pressure[mine] * self.area
        normal_force = float(pressure.sum() * self.area)
        normal = _weighted_sum(pressure.sum(axis=1), rotation[:, :, 2])
        normal /= np.linalg.norm(normal)
        shear = self._shear_force(loaded.shear[:, mine], rotation)
        shear -= normal * (shear @ normal)
        centre = _weighted_sum(weight, points) / weight.sum()
        position = centre + self.depth * (normal - shear / weight.sum())
        # Errors between cubes are as wide as the pitch: so many points are wrong together.
        deviation = loaded.uncertainty[mine] * pressure * self.pitch * self.spacing
        variance = deviation**2
        lever = ((points - centre) ** 2).sum(axis=2) / 2
        pressed = np.count_nonzero(pressure > 0.5 * pressure.max())
        return Contact(
            position=position,
            normal=normal,
            force=shear - normal * normal_force,
            normal_force=normal_force,
            shear_force=float(np.linalg.norm(shear)) if loaded.sees_shear else np.nan,
            area=float(pressed * self.area),
            position_uncertainty=float(np.sqrt((variance * lever).sum()) / normal_force),
            force_uncertainty=float(np.sqrt(variance.sum())),
        )

    def _shear_force(self, shear: Array, rotation: Array) -> Array:
        """(3,) N from shear (2, patches, points) Pa in the frames rotation (patches, 3, 3)."""
        along_x, along_y = (_weighted_sum(shear[k].sum(axis=1), rotation[:, :, k]) for k in (0, 1))
        return (along_x + along_y) * self.area


class _LoadedSurface(NamedTuple):
    """What contacts are computed from, by patch: (cubes, points of a patch), in Pa.

    shear: (2, cubes, points) σzx and σyz
    moment_pressure: interpolated from values alone, as shear is
    uncertainty: relative; sees_shear: some cube observes shear
    """

    pressure: Array
    shear: Array
    moment_pressure: Array
    uncertainty: Array
    sees_shear: bool


def patches(poses: CubePoses, spacing: float, side: int) -> Array:
    """(cubes, side², 3) m: a square of points around each cube, in its x-y plane."""
    line = (np.arange(side) - (side - 1) / 2) * spacing
    x, y = np.meshgrid(line, line)
    square = np.stack([x.ravel(), y.ravel(), np.zeros(side**2)], axis=1)
    return poses.position[:, None] + np.einsum("nij,qj->nqi", poses.rotation, square)


def square(spacing: float, side: int) -> Array:
    """(side^2, 2) m: the points of a patch about its cube, in the order of `patches`."""
    line = (np.arange(side) - (side - 1) / 2) * spacing
    x, y = np.meshgrid(line, line)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _weighted_sum(weights: Array, vectors: Array) -> Array:
    """(3,) the sum of weights (...) times vectors (..., 3).

    Not by BLAS: its threads would burn a second core for this.
    """
    result: Array = np.einsum("n,ni->i", weights.ravel(), vectors.reshape(-1, 3))
    return result
