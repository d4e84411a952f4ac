"""Pressure and shear over a skin by interpolation between its cubes, and the contacts in it.

The pressure p = −σzz in the plane of the cubes, `depth` below the surface, is interpolated from the
values and gradients of the cubes (interpolation.py). The length c = 3 depth was the best of those
tried for indenters of 2 to 20 mm at pitches of 6 to 24 mm (`./cube pictures` draws the errors). The
shear (σzx, σyz) has no measured gradients and is interpolated from values.

Force and position of a contact follow from the equilibrium of the layer above the cubes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..core.arrays import Array, Index, Mask
from ..core.errors import ElasticError
from ..core.modes import COMPONENTS
from ..core.poses import CubePoses
from .interpolation import Interpolation

PRESSURE = [COMPONENTS.index(name) for name in ("zz", "zz_x", "zz_y")]
"""Columns of σzz and of its derivatives along x and y in `COMPONENTS`."""

SHEAR = [COMPONENTS.index(name) for name in ("zx", "yz")]
"""Columns of σzx and σyz in `COMPONENTS`."""

RELATIVE_THRESHOLD = 0.2
"""Fraction of the largest pressure on the skin above which a point counts as in contact."""

LENGTH_PER_DEPTH = 3.0
"""Length c of the radial basis function divided by the depth of the cubes."""


class Field(NamedTuple):
    """Pressure and shear on the M points of a surface.

    Attributes:
        pressure: Pressure (M,) in Pa.
        shear: σzx and σyz (M, 2) in Pa, in the frame of the cube on whose patch the point lies.
    """

    pressure: Array
    shear: Array


class Contact(NamedTuple):
    """One contact in the skin's parent frame.

    Attributes:
        position: Position (3,) in m, where the line of action of the force meets the surface.
        normal: Unit normal (3,) out of the skin.
        force: Force (3,) in N on the skin.
        normal_force: Normal force in N; pressing is positive.
        shear_force: Tangential force in N; NaN if no cube observes shear.
        area: Area in m^2 on which the pressure exceeds half of its maximum.
        position_uncertainty: Standard deviation of the position along each axis, in m.
        force_uncertainty: Standard deviation of the normal force, in N.
    """

    position: Array
    normal: Array
    force: Array
    normal_force: float
    shear_force: float
    area: float
    position_uncertainty: float
    force_uncertainty: float


class Surface:
    """Points of a skin in the plane of its cubes, and the field on them.

    Attributes:
        poses: Poses of the cubes.
        depth: Distance from the centres of the cubes to the surface, in m.
        pitch: Typical distance of neighbouring cubes, in m.
        points: Positions (M, 3) in the parent frame, in m: `side` x `side` around each cube.
        cube: Index (M,) of the cube on whose patch a point lies.
        middle: Index (cubes,) of the point nearest to each cube.
        spacing: Distance of neighbouring points, in m.
        area: Area that a point stands for, in m^2.
    """

    def __init__(
        self,
        poses: CubePoses,
        depth: float,
        side: int = 4,
        gradients: bool = True,
    ) -> None:
        """Set up the points and the interpolation.

        Args:
            poses: Poses of the cubes.
            depth: Distance from the centres of the cubes to the surface, in m.
            side: Number of points along a side of the patch of a cube.
            gradients: Whether the gradients that the cubes observe are used.

        Raises:
            ElasticError: `depth` is not positive, or `side` is below 1.
        """
        if not depth > 0 or side < 1:
            raise ElasticError(
                f"surface: depth {depth} m, {side} points a side; both must be greater than 0"
            )
        n = len(poses.position)
        self.poses = poses
        self.depth = depth
        self.pitch = poses.pitch
        self.spacing = self.pitch / side
        self.area = self.spacing**2
        self._patches = patches(poses, self.spacing, side)
        self.points = self._patches.reshape(-1, 3)
        self.cube = np.repeat(np.arange(n), side**2)
        first_point = np.arange(n) * side**2
        self.middle = first_point + side // 2 * (side + 1)

        self._interpolation = Interpolation(poses, self._patches, LENGTH_PER_DEPTH * depth)
        self._pressure_columns = PRESSURE if gradients else PRESSURE[:1]
        # Pairs (pairs, 2) of neighbouring points, diagonal ones included.
        tree = cKDTree(self.points)
        self._pairs = tree.query_pairs(1.5 * self.spacing, output_type="ndarray")

    def field(self, values: Array) -> Field:
        """Interpolate pressure and shear, in O(M) time.

        Args:
            values: Components (cubes, 15), NaN where unknown. Neighbours replace a missing cube.
        """
        return Field(self._pressure(values), self._shear(values))

    def uncertainty(self, values: Array) -> Array:
        """Compute the standard deviation (M,) of the pressure relative to its own size, 0 to 1."""
        return self._interpolation.uncertainty(values, self._pressure_columns)

    def contacts(self, values: Array, threshold: float) -> list[Contact]:
        """Find contacts, where the pressure exceeds a threshold and a fraction of its maximum.

        The layer above the cubes is in equilibrium: the integral of the pressure is the force. The
        first moment of the pressure is that of the load plus depth × shear force, which is
        subtracted again. For this moment, pressure and shear are interpolated alike, from values.
        Below a point force on an incompressible body, (σzx, σyz, σzz) points away from the force,
        so that each cube by itself gives the position, and so does any weighted mean.

        What spreads beyond the edge of the skin is lost: hardly any pressure, but a fraction of the
        shear of about 1.5 depth / distance to the edge.

        Args:
            values: Components (cubes, 15) as in `field`.
            threshold: Pressure in Pa at the depth of the cubes.

        Returns:
            Contacts, strongest first. Each patch counts for the contact nearest to it.
        """
        # Around cubes without any value, the pressure is unknown and counts as zero.
        pressure = np.nan_to_num(self._pressure(values))
        inside = pressure > max(threshold, RELATIVE_THRESHOLD * float(pressure.max()))
        if not inside.any():
            return []

        shear = np.nan_to_num(self._shear(values))
        value_pressure = -self._interpolation.values(values, PRESSURE[:1])
        loaded = _LoadedSurface(
            pressure=self._by_patch(pressure),
            shear=np.stack([self._by_patch(component) for component in shear.T]),
            moment_pressure=self._by_patch(np.nan_to_num(value_pressure)),
            uncertainty=self._by_patch(self.uncertainty(values)),
            sees_shear=bool(np.isfinite(values[:, SHEAR]).any()),
        )
        owner = self._assign_patches(inside)
        numbers = np.unique(owner)
        contacts = [self._contact(loaded, owner == number) for number in numbers]
        return sorted(contacts, key=lambda contact: -contact.normal_force)

    def _pressure(self, values: Array) -> Array:
        return -self._interpolation.values(values, self._pressure_columns)

    def _shear(self, values: Array) -> Array:
        columns = [self._interpolation.values(values, [column]) for column in SHEAR]
        return np.stack(columns, axis=1)

    def _by_patch(self, on_points: Array) -> Array:
        """Arrange values (M,) as (cubes, points of a patch)."""
        return on_points.reshape(len(self._patches), -1)

    def _assign_patches(self, inside: Mask) -> Index:
        """Return the number (cubes,) of the contact that each patch counts for.

        Points in contact belong to one contact if they are neighbours or lie on one patch.
        """
        n = len(self._patches)
        first, second = self._pairs.T
        joined = inside[first] & inside[second]
        patch_pairs = self.cube[self._pairs[joined]].T
        # Patches are the nodes of a graph; neighbouring points in contact are its edges.
        links = coo_matrix((joined[joined], patch_pairs), shape=(n, n))
        component = connected_components(links, directed=False)[1]

        is_touched = inside.reshape(n, -1).any(axis=1)
        # A patch without contact counts for the nearest one with contact.
        touched = cKDTree(self.poses.position[is_touched])
        nearest = touched.query(self.poses.position)[1]
        return np.asarray(component[is_touched][nearest], np.intp)

    def _contact(self, loaded: _LoadedSurface, chosen: Mask) -> Contact:
        """Compute the contact of the chosen patches (cubes,)."""
        rotation = self.poses.rotation[chosen]
        points = self._patches[chosen]
        pressure = loaded.pressure[chosen]
        weight = loaded.moment_pressure[chosen] * self.area
        normal_force = float(pressure.sum() * self.area)
        # Mean of the cubes' normals, weighted with the pressure.
        normal = _weighted_sum(pressure.sum(axis=1), rotation[:, :, 2])
        normal /= np.linalg.norm(normal)

        shear = self._shear_force(loaded.shear[:, chosen], rotation)
        shear -= normal * (shear @ normal)
        # Moments about the surface: depth × shear force is subtracted from the centre of pressure.
        centre = _weighted_sum(weight, points) / weight.sum()
        position = centre + self.depth * (normal - shear / weight.sum())

        # Interpolation errors are correlated over one pitch: so many points err together.
        deviation = loaded.uncertainty[chosen] * pressure * self.pitch * self.spacing
        variance = deviation**2
        lever = ((points - centre) ** 2).sum(axis=2) / 2
        n_pressed = np.count_nonzero(pressure > 0.5 * pressure.max())
        return Contact(
            position=position,
            normal=normal,
            force=shear - normal * normal_force,
            normal_force=normal_force,
            shear_force=float(np.linalg.norm(shear)) if loaded.sees_shear else np.nan,
            area=float(n_pressed * self.area),
            position_uncertainty=float(np.sqrt((variance * lever).sum()) / normal_force),
            force_uncertainty=float(np.sqrt(variance.sum())),
        )

    def _shear_force(self, shear: Array, rotation: Array) -> Array:
        """Return the shear force (3,) in N.

        Args:
            shear: Shear (2, patches, points) in Pa, in the frames of the cubes.
            rotation: Rotations (patches, 3, 3) of these frames.
        """
        by_patch = shear.sum(axis=2)
        along_x = _weighted_sum(by_patch[0], rotation[:, :, 0])
        along_y = _weighted_sum(by_patch[1], rotation[:, :, 1])
        return (along_x + along_y) * self.area


class _LoadedSurface(NamedTuple):
    """Quantities from which contacts are computed, (cubes, points of a patch), in Pa.

    Attributes:
        pressure: Pressure, interpolated from values and gradients.
        shear: σzx and σyz (2, cubes, points).
        moment_pressure: Pressure, interpolated from values alone, as the shear is.
        uncertainty: Standard deviation of the pressure relative to its own size.
        sees_shear: Whether some cube observes shear.
    """

    pressure: Array
    shear: Array
    moment_pressure: Array
    uncertainty: Array
    sees_shear: bool


def square_points(spacing: float, side: int) -> Array:
    """Return the points (side^2, 2) of a square grid with this spacing around the origin, in m."""
    line = (np.arange(side) - (side - 1) / 2) * spacing
    x, y = np.meshgrid(line, line)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def patches(
    poses: CubePoses,
    spacing: float,
    side: int,
) -> Array:
    """Return the points on the patches of all cubes.

    Args:
        poses: Poses of the cubes.
        spacing: Distance of neighbouring points in m.
        side: Number of points along a side of a patch.

    Returns:
        Positions (cubes, side^2, 3) in m: a square grid in the x-y plane of each cube.
    """
    in_plane = poses.rotation[:, :, :2]
    offset = np.einsum("nij,qj->nqi", in_plane, square_points(spacing, side))
    return np.asarray(poses.position[:, None] + offset)


def _weighted_sum(weights: Array, vectors: Array) -> Array:
    """Return the sum (3,) of weights (...) times vectors (..., 3).

    Einsum, because the threads of a BLAS product would occupy a second core.
    """
    result: Array = np.einsum("n,ni->i", weights.ravel(), vectors.reshape(-1, 3))
    return result
