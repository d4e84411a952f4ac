# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pressure and shear over a skin by interpolation between its cubes, and the contacts in it.

The pressure p = −σzz in the plane of the cubes' centres, `depth` below the surface, is interpolated
from the stresses σzz and their gradients that the cubes measure (interpolation.py). The length c of
the radial basis functions is 3 depth. Of the lengths that were tried for indenters of 2 to 20 mm at
pitches (distances of neighbouring cubes) of 6 to 24 mm, it gave the smallest errors (`./cube
pictures` draws them). The shear (σzx, σyz) has no measured gradients and is interpolated from its
values alone.

Force and position of a contact follow from the equilibrium of the layer above the cubes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..core.arrays import Array, Index, Mask
from ..core.errors import ElasticError
from ..core.modes import COMPONENTS
from ..core.poses import CubePoses
from .interpolation import Interpolation

if TYPE_CHECKING:
    from .tracker.contact_tracker import TrackedContact

PRESSURE = [COMPONENTS.index(name) for name in ("zz", "zz_x", "zz_y")]
"""Columns of the stress σzz (negative pressure) and of its derivatives along x and y in
`COMPONENTS`, the 15 components that a cube measures."""

SHEAR = [COMPONENTS.index(name) for name in ("zx", "yz")]
"""Columns of the shear stresses σzx and σyz in `COMPONENTS`, the 15 components that a cube
measures."""

RELATIVE_THRESHOLD = 0.2
"""Pressure above which a point of the skin counts as in contact, divided by the largest pressure on
the skin. An absolute threshold applies in addition."""

LENGTH_PER_DEPTH = 3.0
"""Length c of the radial basis function (1 + r²/c²)^(−5/2) of the interpolation, divided by the
depth of the cubes' centres below the surface."""


class Field(NamedTuple):
    """Pressure and shear at the M points of a `Surface`, in the plane of the cubes' centres.

    Attributes:
        pressure: Pressure (M,) in Pa, positive in compression.
        shear: Shear stresses σzx and σyz (M, 2) in Pa, in the frame of the cube around which the
            point lies.
    """

    pressure: Array
    shear: Array


class Contact(NamedTuple):
    """One contact in the skin's parent frame.

    Attributes:
        position: Position (3,) in m, where the line of action of the force meets the surface.
        normal: Unit normal (3,) of the surface, out of the skin.
        force: Force (3,) in N that the touching body exerts on the skin.
        normal_force: Normal force in N, positive for a body that presses on the skin.
        shear_force: Length of the tangential force in N; NaN if no cube observes shear.
        area: Area in m^2 on which the pressure exceeds half of its maximum.
        position_uncertainty: Standard deviation of the position along each axis, in m.
        force_uncertainty: Standard deviation of the normal force, in N.
        slips: Whether the whole contact slides over the skin; False if it is not known.
        is_coarse: Whether force and position are less exact than usual, because the fit of the
            contact to the newest values, or that of a contact beside it, is not ready yet. Only
            contacts of the method inverse are fitted.
    """

    position: Array
    normal: Array
    force: Array
    normal_force: float
    shear_force: float
    area: float
    position_uncertainty: float
    force_uncertainty: float
    slips: bool = False
    is_coarse: bool = False

    def __repr__(self) -> str:
        return f"Contact({describe_contact(self)})"


def describe_contact(contact: Contact | TrackedContact) -> str:
    """Describe a contact by its forces, position and area.

    Args:
        contact: A `Contact`, or another object with these attributes (`TrackedContact`).
    """
    x, y, z = 1e3 * contact.position
    forces = f"{contact.normal_force:.3g} N normal, {contact.shear_force:.3g} N shear"
    return f"{forces}, at [{x:.1f} {y:.1f} {z:.1f}] mm, {1e6 * contact.area:.3g} mm²"


class Surface:
    """Points of a skin in the plane of its cubes' centres, and pressure and shear at them.

    Each cube has a patch, a square grid of `side` x `side` points around it.

    Attributes:
        poses: Poses of the cubes.
        depth: Distance from the centres of the cubes to the surface, in m.
        pitch: Typical distance of neighbouring cubes, in m.
        points: Positions (M, 3) of the points of all patches in the skin's parent frame, in m.
        cube: Index (M,) of the cube on whose patch a point lies.
        middle: Index (cubes,) of the point nearest to each cube.
        spacing: Distance of neighbouring points, in m.
        area: Area of the square that each point represents in integrals, in m^2.
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
            side: Number of points along a side of the patch (square grid) of a cube.
            gradients: Whether the measured gradients of σzz are used besides its values.

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
        self._patches = place_patches(poses, self.spacing, side)
        self.points = self._patches.reshape(-1, 3)
        self.cube = np.repeat(np.arange(n), side**2)
        first_point = np.arange(n) * side**2
        self.middle = first_point + side // 2 * (side + 1)

        self._interpolation = Interpolation(
            poses,
            self._patches,
            LENGTH_PER_DEPTH * depth,
        )
        self._pressure_columns = PRESSURE if gradients else PRESSURE[:1]
        # `_pairs` (pairs, 2) are the indices of neighbouring points. A distance of 1.5 times the
        # spacing includes diagonal neighbours.
        tree = cKDTree(self.points)
        self._pairs = tree.query_pairs(1.5 * self.spacing, output_type="ndarray")

    def field(self, values: Array) -> Field:
        """Interpolate pressure and shear; the time grows linearly with the number M of points.

        Args:
            values: Components (cubes, 15) in the order of `COMPONENTS`, in Pa and Pa/m; NaN where
                unknown. Around a cube without values, those of its neighbours are interpolated.
        """
        return Field(self._interpolate_pressure(values), self._interpolate_shear(values))

    def compute_uncertainty(self, values: Array) -> Array:
        """Compute the standard deviation (M,) of the interpolated pressure at each point.

        It is divided by the standard deviation of the pressure over the skin: 0 at a cube with a
        value, 1 far from all cubes. Arguments as in `field`.
        """
        return self._interpolation.compute_uncertainty(values, self._pressure_columns)

    def find_contacts(self, values: Array, threshold: float) -> list[Contact]:
        """Find contacts: regions in which the pressure at the cubes' depth is above two thresholds.

        These are the absolute `threshold` and the fraction `RELATIVE_THRESHOLD` of the largest
        pressure on the skin.

        The elastomer above the plane of the cubes' centres is in equilibrium. So the integral of
        the pressure in this plane is the normal force on the surface. The first moment of the
        pressure (integral of position × pressure) in this plane is that of the load on the surface
        plus depth × shear force. This product is subtracted, and the difference divided by the
        normal force is the position of the contact.

        To compute the position, pressure and shear are interpolated with the same weights of the
        cubes, so the gradients of the pressure are not used. Below a point force on an
        incompressible body, the vector (σzx, σyz, σzz) at a cube points away from the force. So
        each single cube gives the correct position, and a sum over cubes also does if pressure and
        shear have the same weights.

        The stress that spreads beyond the edge of the skin is not measured. The pressure loses
        little by this, the shear force a fraction of about 1.5 times the ratio of the depth to the
        distance from the edge.

        Args:
            values: Components (cubes, 15) as in `field`.
            threshold: Smallest pressure in Pa, at the depth of the cubes, of a point in contact.

        Returns:
            Contacts, strongest first. Every patch of the skin belongs to the contact nearest to it,
            and its whole pressure and shear are part of the force of this contact.
        """
        # Where neither a cube nor its neighbours have a value, the pressure is unknown (NaN) and
        # counts as zero.
        pressure = np.nan_to_num(self._interpolate_pressure(values))
        largest = float(pressure.max())
        relative_threshold = RELATIVE_THRESHOLD * largest
        inside = pressure > max(threshold, relative_threshold)
        if not inside.any():
            return []

        shear = np.nan_to_num(self._interpolate_shear(values))
        shear_by_patch = [self._arrange_by_patch(component) for component in shear.T]
        moment_pressure = -self._interpolation.interpolate(values, PRESSURE[:1])
        moment_pressure = np.nan_to_num(moment_pressure)
        uncertainty = self.compute_uncertainty(values)
        is_shear_known = np.isfinite(values[:, SHEAR])
        loaded = _LoadedSurface(
            pressure=self._arrange_by_patch(pressure),
            shear=np.stack(shear_by_patch),
            moment_pressure=self._arrange_by_patch(moment_pressure),
            uncertainty=self._arrange_by_patch(uncertainty),
            sees_shear=bool(is_shear_known.any()),
        )
        owner = self._assign_patches(inside)
        numbers = np.unique(owner)
        contacts = [self._make_contact(loaded, owner == number) for number in numbers]
        return sorted(contacts, key=lambda contact: -contact.normal_force)

    def _interpolate_pressure(self, values: Array) -> Array:
        return -self._interpolation.interpolate(values, self._pressure_columns)

    def _interpolate_shear(self, values: Array) -> Array:
        columns = [self._interpolation.interpolate(values, [column]) for column in SHEAR]
        return np.stack(columns, axis=1)

    def _arrange_by_patch(self, on_points: Array) -> Array:
        """Group values at all points by patch, the square grid of points around each cube.

        Args:
            on_points: Values (M,) at all points.

        Returns:
            The same values (cubes, points of a patch).
        """
        return on_points.reshape(len(self._patches), -1)

    def _assign_patches(self, inside: Mask) -> Index:
        """Assign the patch of each cube (square grid of points around it) to a contact.

        Points in contact belong to one contact if they are neighbours or lie on one patch.

        Args:
            inside: Whether each point (M,) is in contact; at least one is.

        Returns:
            Number (cubes,) of the contact of each patch. A patch without a point in contact belongs
            to the contact of the nearest cube that has one.
        """
        n = len(self._patches)
        first, second = self._pairs.T
        joined = inside[first] & inside[second]
        joined_points = self._pairs[joined]
        patch_pairs = self.cube[joined_points].T
        # Patches are vertices of a graph; pairs of neighbouring points in contact are its edges.
        entries = np.ones(len(joined_points), bool)
        links = coo_matrix((entries, patch_pairs), shape=(n, n))
        _, component = connected_components(links, directed=False)

        inside_by_patch = inside.reshape(n, -1)
        is_touched = inside_by_patch.any(axis=1)
        # A patch without a point in contact joins the contact of the nearest patch that has one.
        position = self.poses.position
        touched = cKDTree(position[is_touched])
        _, nearest = touched.query(position)
        touched_component = component[is_touched]
        return np.asarray(touched_component[nearest], np.intp)

    def _make_contact(self, loaded: _LoadedSurface, chosen: Mask) -> Contact:
        """Compute force, position and uncertainty of a contact.

        A patch is a square grid of points above one cube; the patches of all cubes cover the skin.

        Args:
            loaded: Pressure and shear in Pa at the points of all patches.
            chosen: Whether the patch of each cube (cubes,) belongs to the contact.
        """
        rotation = self.poses.rotation[chosen]
        points = self._patches[chosen]
        pressure = loaded.pressure[chosen]
        weight = loaded.moment_pressure[chosen] * self.area
        normal_force = float(pressure.sum() * self.area)
        # The normal of the contact is the mean of its cubes' normals, weighted with the pressure.
        cube_normals = rotation[:, :, 2]
        cube_weights = pressure.sum(axis=1)
        normal = _sum_weighted(cube_weights, cube_normals)
        normal /= np.linalg.norm(normal)

        shear = self._compute_shear_force(loaded.shear[:, chosen], rotation)
        shear -= normal * (shear @ normal)
        # The shear force acts on the surface, `depth` above the cubes' plane, and so shifts the
        # centre of pressure in this plane by depth × shear force / normal force.
        total_weight = weight.sum()
        centre = _sum_weighted(weight, points) / total_weight
        force_direction = normal - shear / total_weight
        position = centre + self.depth * force_direction

        # Interpolation errors are correlated over one pitch (distance of neighbouring cubes), so
        # the errors of the pitch / spacing points along each axis add up instead of averaging out.
        pressure_deviation = loaded.uncertainty[chosen] * pressure
        variance = (pressure_deviation * self.pitch * self.spacing) ** 2
        lever = points - centre
        # The lever lies in the surface. Along one axis, its mean square is half of its square.
        squared_lever = (lever**2).sum(axis=2) / 2
        moment_variance = (variance * squared_lever).sum()
        moment_deviation = np.sqrt(moment_variance)
        is_pressed = pressure > 0.5 * pressure.max()
        n_pressed = np.count_nonzero(is_pressed)
        shear_force = np.nan
        if loaded.sees_shear:
            shear_force = float(np.linalg.norm(shear))
        return Contact(
            position=position,
            normal=normal,
            force=shear - normal * normal_force,
            normal_force=normal_force,
            shear_force=shear_force,
            area=float(n_pressed * self.area),
            position_uncertainty=float(moment_deviation / normal_force),
            force_uncertainty=float(np.sqrt(variance.sum())),
        )

    def _compute_shear_force(self, shear: Array, rotation: Array) -> Array:
        """Integrate the shear stress over some patches.

        Args:
            shear: Shear stresses σzx and σyz (2, patches, points) in Pa, in the frames of the
                cubes.
            rotation: Rotations (patches, 3, 3) of these frames.

        Returns:
            Shear force (3,) in N, in the skin's parent frame.
        """
        by_patch = shear.sum(axis=2)
        along_x = _sum_weighted(by_patch[0], rotation[:, :, 0])
        along_y = _sum_weighted(by_patch[1], rotation[:, :, 1])
        return (along_x + along_y) * self.area


class _LoadedSurface(NamedTuple):
    """Quantities at the points of all patches from which contacts are computed.

    Attributes:
        pressure: Pressure (cubes, points) in Pa, interpolated from values and gradients.
        shear: Shear stresses σzx and σyz (2, cubes, points) in Pa.
        moment_pressure: Pressure (cubes, points) in Pa, interpolated from values alone, as the
            shear is.
        uncertainty: Relative standard deviation (cubes, points) of the pressure, 0 to 1, as from
            `Surface.compute_uncertainty`.
        sees_shear: Whether some cube observes shear.
    """

    pressure: Array
    shear: Array
    moment_pressure: Array
    uncertainty: Array
    sees_shear: bool


def make_square_points(spacing: float, side: int) -> Array:
    """Return a square grid of points that is centred on the origin of the x-y plane.

    Args:
        spacing: Distance of neighbouring points in m.
        side: Number of points along a side of the grid.

    Returns:
        Positions (side^2, 2) in m.
    """
    steps = np.arange(side) - (side - 1) / 2
    line = steps * spacing
    x, y = np.meshgrid(line, line)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def place_patches(
    poses: CubePoses,
    spacing: float,
    side: int,
) -> Array:
    """Return the points on the patches (square grids around the cubes) of all cubes.

    Args:
        poses: Poses of the cubes.
        spacing: Distance of neighbouring points in m.
        side: Number of points along a side of a patch.

    Returns:
        Positions (cubes, side^2, 3) in the skin's parent frame, in m. Each grid lies in the x-y
        plane of its cube.
    """
    in_plane = poses.rotation[:, :, :2]
    grid = make_square_points(spacing, side)
    offset = np.einsum("nij,qj->nqi", in_plane, grid)
    return np.asarray(poses.position[:, None] + offset)


def _sum_weighted(weights: Array, vectors: Array) -> Array:
    """Return the weighted sum (3,) of vectors (..., 3) with the weights (...).

    The function uses einsum, because a BLAS matrix product would start threads that occupy a second
    core.
    """
    rows = vectors.reshape(-1, 3)
    result: Array = np.einsum("n,ni->i", weights.ravel(), rows)
    return result
