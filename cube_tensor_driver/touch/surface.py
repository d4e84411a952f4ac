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

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..core.arrays import Array, Index, Mask
from ..core.errors import ElasticError
from ..core.modes import COMPONENTS
from ..core.poses import CubePoses
from .interpolation import NEIGHBOURS, Interpolation
from .nearest_cubes import find_nearest_cubes

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
        self.middle = np.arange(n) * side**2 + side // 2 * (side + 1)

        near = find_nearest_cubes(poses, NEIGHBOURS)
        length = LENGTH_PER_DEPTH * depth
        interpolate = partial(
            Interpolation,
            poses,
            near,
            self._patches,
            length,
        )
        self._zz = interpolate(PRESSURE if gradients else PRESSURE[:1])
        self._zz_alone = interpolate(PRESSURE[:1])
        self._shear = [interpolate([column]) for column in SHEAR]
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
        shear = [one.interpolate(values).ravel() for one in self._shear]
        return Field(-self._zz.interpolate(values).ravel(), np.stack(shear, axis=1))

    def compute_uncertainty(self, values: Array) -> Array:
        """Compute the relative standard deviation (M,) of the interpolated pressure at each point.

        The standard deviation is divided by that of the pressure over the skin: the result is 0 at
        a cube with a value and 1 far from all cubes. Arguments as in `field`.
        """
        return self._zz.compute_uncertainty(values).ravel()

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

        The stress that spreads beyond the edge of the skin is not measured. This reduces the normal
        force only a little, but the shear force by a fraction of about 1.5 times the ratio of the
        depth to the distance from the edge.

        Args:
            values: Components (cubes, 15) as in `field`.
            threshold: Smallest pressure in Pa, at the depth of the cubes, of a point in contact.

        Returns:
            Contacts, strongest first. Every patch of the skin belongs to the contact nearest to it,
            and its whole pressure and shear are part of the force of this contact.
        """
        # Where neither a cube nor its neighbours have a value, the pressure is unknown (NaN) and
        # counts as zero.
        pressure = np.nan_to_num(-self._zz.interpolate(values))
        inside = pressure > max(threshold, RELATIVE_THRESHOLD * pressure.max())
        if not inside.any():
            return []

        shear = np.nan_to_num([one.interpolate(values) for one in self._shear])
        shear = np.einsum(
            "cnq,nic->nqi",
            shear,
            self.poses.rotation[:, :, :2],
        )
        moment_pressure = np.nan_to_num(-self._zz_alone.interpolate(values))
        uncertainty = self._zz.compute_uncertainty(values)
        on_patches = pressure, moment_pressure, shear, uncertainty
        owner = self._assign_patches(inside)
        contacts = []
        for number in np.unique(owner):
            chosen = owner == number
            contacts.append(self._make_contact(chosen, *(one[chosen] for one in on_patches)))
        if not np.isfinite(values[:, SHEAR]).any():
            contacts = [contact._replace(shear_force=np.nan) for contact in contacts]
        return sorted(contacts, key=lambda contact: -contact.normal_force)

    def _assign_patches(self, inside: Mask) -> Index:
        """Assign the patch of each cube (square grid of points around it) to a contact.

        Points in contact belong to one contact if they are neighbours or lie on one patch.

        Args:
            inside: Whether each point (cubes, points of a patch) is in contact; at least one is.

        Returns:
            Number (cubes,) of the contact of each patch. A patch without a point in contact belongs
            to the contact of the nearest cube that has one.
        """
        # Patches are vertices of a graph; pairs of neighbouring points in contact are its edges.
        first, second = inside.ravel()[self._pairs.T]
        joined = self._pairs[first & second]
        n = len(inside)
        links = coo_matrix((np.ones(len(joined)), self.cube[joined].T), shape=(n, n))
        _, component = connected_components(links, directed=False)

        is_touched = inside.any(axis=1)
        position = self.poses.position
        _, nearest = cKDTree(position[is_touched]).query(position)
        return np.asarray(component[is_touched][nearest], np.intp)

    def _make_contact(
        self,
        chosen: Mask,
        pressure: Array,
        moment_pressure: Array,
        shear: Array,
        uncertainty: Array,
    ) -> Contact:
        """Compute force, position and uncertainty of a contact.

        A patch is a square grid of points around one cube; the patches of all cubes cover the skin.

        Args:
            chosen: Whether the patch of each cube (cubes,) is one of the n patches of the contact.
            pressure: Pressure (n, points) in Pa, interpolated from values and gradients.
            moment_pressure: Pressure (n, points) in Pa, interpolated from values alone, as the
                shear is.
            shear: Shear stress (n, points, 3) in Pa, in the skin's parent frame.
            uncertainty: Standard deviation (n, points) of the pressure as a fraction of it, 0 to 1.
        """
        points = self._patches[chosen]
        weight = moment_pressure * self.area
        normal_force = float(pressure.sum() * self.area)
        # The normal of the contact is the mean of its cubes' normals, weighted with the pressure.
        # This sum is an einsum, because a matrix product of BLAS would start threads that occupy a
        # second core.
        cube_normals = self.poses.rotation[chosen, :, 2]
        normal = np.einsum("n,ni->i", pressure.sum(axis=1), cube_normals)
        normal /= np.linalg.norm(normal)
        tangential = shear.sum(axis=(0, 1)) * self.area
        tangential -= normal * (tangential @ normal)
        # The shear force acts on the surface, `depth` above the cubes' plane, and so shifts the
        # centre of pressure in this plane by depth × shear force / normal force.
        centre = np.einsum("nq,nqi->i", weight, points) / weight.sum()
        position = centre + self.depth * (normal - tangential / weight.sum())

        # Interpolation errors are correlated over one pitch (distance of neighbouring cubes), so
        # the errors of the pitch / spacing points along each axis add up instead of averaging out.
        pressure_deviation = uncertainty * pressure
        variance = (pressure_deviation * self.pitch * self.spacing) ** 2
        # The lever lies in the surface. Along one axis, its mean square is half of its square.
        squared_lever = ((points - centre) ** 2).sum(axis=2) / 2
        moment_deviation = np.sqrt((variance * squared_lever).sum())
        n_pressed = np.count_nonzero(pressure > 0.5 * pressure.max())
        return Contact(
            position=position,
            normal=normal,
            force=tangential - normal * normal_force,
            normal_force=normal_force,
            shear_force=float(np.linalg.norm(tangential)),
            area=n_pressed * self.area,
            position_uncertainty=float(moment_deviation / normal_force),
            force_uncertainty=float(np.sqrt(variance.sum())),
        )


def make_square_points(spacing: float, side: int) -> Array:
    """Return a square grid of points that is centred on the origin of the x-y plane.

    Args:
        spacing: Distance of neighbouring points in m.
        side: Number of points along a side of the grid.

    Returns:
        Positions (side^2, 2) in m.
    """
    line = (np.arange(side) - (side - 1) / 2) * spacing
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
    grid = make_square_points(spacing, side)
    offset = np.einsum("nij,qj->nqi", poses.rotation[:, :, :2], grid)
    return np.asarray(poses.position[:, None] + offset)
