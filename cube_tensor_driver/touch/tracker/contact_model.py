"""Hertz contacts on a skin: the response of the cubes to them and their traction on the surface.

The pressure of a Hertz contact of radius a falls from its centre to its rim as sqrt(1 - r^2/a^2).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from ...core.arrays import Array, Index
from ...mechanics.kernels import REACH_DEPTHS, hertz_pressure
from ...mechanics.layer import FIELD
from ..inverse import SurfaceInverse, TractionField
from ..surface import square_points
from .contact_fit import ContactResponse

SUBPOINTS = 8
"""Number of positions along each side of the square that a point of the surface represents. The
traction of a contact is averaged over them, because a contact may be narrower than the square."""

_PRESSURE_REACH_DEPTHS = 6.0
"""Distance from the centre of a contact beyond which its pressure at the depth of the cubes counts
as zero, divided by this depth (of the cubes' centres below the surface)."""

_MIN_FACING = 0.5
"""Smallest cosine of the angle between the outward normals of two cubes at which one of them
responds to a contact above the other. On a bent skin, cubes that face away do not respond."""


@dataclass
class HertzContact:
    """A Hertz contact in the frame of its home, the cube nearest to it.

    Attributes:
        id: Number of the contact, which stays the same as long as the contact is tracked.
        home: Index of the home cube.
        place: Position (2,) of the centre in the x-y plane of the home cube, in m.
        size: Radius in m.
        force: Force (3,) in N on the skin, in the frame of the home cube.
        residual_scale: Standard deviation, in Pa, of the pressure that the contacts do not explain
            (residual field) around this contact.
        place_ambiguity: Variance of the position in m^2 over fits from several starts; infinite
            before the first fit, 0 if all fits ended at the same position.
        force_ambiguity: Variance (3,) of the force in N^2 over these fits.
        covariance: Covariance (9, 9) of force, position, ln(size) and shapes as from
            `ContactFit.covariance`, plus the two ambiguities.
        split_tested_at: Residual scale in Pa at the last test whether the contact is in fact two
            contacts; 0 if it was not tested.
        was_split: Whether the contact is one of two into which a contact was split
            (contact_split.py). Two contacts with this mark are not merged if the pressure between
            them has no valley (minimum), but only if they overlap too much.
    """

    id: int
    home: int
    place: Array
    size: float
    force: Array
    residual_scale: float
    place_ambiguity: float = np.inf
    force_ambiguity: Array = field(default_factory=lambda: np.zeros(3))
    covariance: Array = field(default_factory=lambda: np.zeros((9, 9)))
    split_tested_at: float = 0.0
    was_split: bool = False


class ContactModel:
    """Computes the response of all cubes to Hertz contacts, and the traction on the surface.

    Attributes:
        inverse: Poses, surface points and kernels of the skin.
    """

    def __init__(self, inverse: SurfaceInverse) -> None:
        self.inverse = inverse
        self._cubes = cKDTree(inverse.poses.position)
        self._points = cKDTree(inverse.points)
        self._subpoints = square_points(inverse.spacing / SUBPOINTS, SUBPOINTS)

    def centre(self, contact: HertzContact) -> Array:
        """Return the centre (3,) of a contact on the surface, in m in the skin's parent frame."""
        poses = self.inverse.poses
        local = np.array([*contact.place, self.inverse.depth])
        offset = poses.rotation[contact.home] @ local
        return np.asarray(poses.position[contact.home] + offset)

    def response(self, contacts: list[HertzContact]) -> Array:
        """Compute the values that all cubes measure under some contacts together.

        Returns:
            Values (cubes, C) in Pa of the C components `SurfaceInverse.columns`. Gradients are
            multiplied by half the side of a cube. Cubes far from a contact do not respond to it.
        """
        inverse = self.inverse
        total = np.zeros(inverse.observed.shape)
        for contact in contacts:
            # The skin is laid flat around the home cube, in whose frame the contact is described.
            cubes, place, angle = self._cubes_around(contact.home)
            offset = place - contact.place
            variant = inverse.variant[cubes]
            response = inverse.kernels.response(offset, angle, variant, contact.size)
            total[cubes] += response[:, inverse.columns] @ contact.force
        return total

    def depth_pressure(self, contacts: list[HertzContact]) -> Array:
        """Compute the pressure that contacts cause at the depth of the cubes' centres.

        Returns:
            Pressure (M,) in Pa below each of the M points of the surface, positive in compression.
        """
        pressure = np.zeros(len(self.inverse.points))
        for contact in contacts:
            points, offset, _ = self._points_around(contact)
            pressure[points] += self.inverse.kernels.disc_pressure(
                offset, contact.size, contact.force
            )
        return pressure

    def add_contacts(
        self,
        residual: TractionField,
        depth_pressure: Array,
        contacts: list[HertzContact],
    ) -> TractionField:
        """Add the traction of contacts to the residual field.

        Args:
            residual: Traction field that the contacts do not explain.
            depth_pressure: Total pressure (M,) at the cubes' depth in Pa, contacts included.
            contacts: Contacts to add.

        Returns:
            Total field. The traction of a contact is averaged over the square that each point
            represents, so that the sum over all points times the area of a square is the force,
            however small the contact is.
        """
        traction = residual.traction.copy()
        for contact in contacts:
            points, offset, rotation = self._points_around(contact)
            subpoints = offset[:, None] + self._subpoints
            distance = np.linalg.norm(subpoints, axis=2)
            share = hertz_pressure(distance, contact.size).mean(axis=1)
            traction[points] += share[:, None] * (rotation @ contact.force)
        return TractionField(traction, depth_pressure)

    def pressure_variance(self, contacts: list[HertzContact]) -> Array:
        """Compute the variances of the pressure due to the uncertain parameters of the contacts.

        The parameters and their covariance are those of `HertzContact.covariance`.

        Returns:
            Variances (M, 2) in Pa^2 at the M points of the surface: of the pressure on the surface,
            and of the pressure at the depth of the cubes' centres.
        """
        total = np.zeros((len(self.inverse.points), 2))
        for contact in contacts:
            self._add_pressure_variance(total, contact)
        return total

    def _add_pressure_variance(self, total: Array, contact: HertzContact) -> None:
        """Add the variances of the pressure that the covariance of one contact causes.

        Args:
            total: Variances (M, 2) in Pa^2 at the M points of the surface, which are changed: first
                column on the surface, second column at the depth of the cubes' centres.
            contact: Contact with the covariance of its parameters.
        """
        inverse = self.inverse
        points, offset, rotation = self._points_around(contact)
        # A contact with its deviations from a circle (shapes) ends within twice its radius.
        reach = 2 * contact.size + inverse.spacing
        touched = np.linalg.norm(offset, axis=1) < reach
        subpoints = offset[touched][:, None] + self._subpoints

        def surface_pressure(centres: Array, size: float) -> Array:
            """Return the pressure on the surface at n points under K contacts with 1 N each.

            Args:
                centres: Centres (K, 2) in m, from the centre of `contact`.
                size: Radius of each contact in m.

            Returns:
                Pressure (K, n, 3) in Pa/N, for a force along x, y and z of the home cube.
            """
            x, y = np.moveaxis(
                subpoints - centres[:, None, None],
                -1,
                0,
            )
            share = hertz_pressure(np.hypot(x, y), size).mean(axis=2)
            return np.asarray(-share[..., None] * rotation[touched, 2])

        def pressure_at_depth(centres: Array, size: float) -> Array:
            """Return the pressure at the cubes' depth.

            Arguments and result are those of `surface_pressure`, for all points near the contact.
            """
            from_centre = (offset - centres[:, None]).reshape(-1, 2)
            pressure = -inverse.kernels.field(from_centre, size)[:, FIELD.index("zz")]
            return pressure.reshape(len(centres), -1, 3)

        parts = (
            (
                0,
                points[touched],
                surface_pressure,
            ),
            (1, points, pressure_at_depth),
        )
        # Error propagation: var(p) = S C S' with the derivatives S of the pressure p by the
        # parameters of the contact and the parameters' covariance C.
        for column, chosen, respond in parts:
            response = ContactResponse.linearise(
                respond,
                inverse.depth,
                np.zeros(2),
                contact.size,
            )
            slopes = response.by_parameters(contact.force)
            variance = np.einsum("mp,pq,mq->m", slopes, contact.covariance, slopes)
            total[chosen, column] += np.maximum(variance, 0)

    def _points_around(self, contact: HertzContact) -> tuple[Index, Array, Array]:
        """Find the surface points within `_PRESSURE_REACH_DEPTHS` depths of a contact's centre.

        Returns:
            Indices (n,) of the points, their positions (n, 2) from the contact's centre in the
            frame of its home cube in m, and the rotations (n, 3, 3) from the frame of the home cube
            to the frame of each point's cube.
        """
        inverse = self.inverse
        centre = self.centre(contact)
        reach = _PRESSURE_REACH_DEPTHS * inverse.depth
        points = np.array(
            sorted(self._points.query_ball_point(centre, reach)),
            np.intp,
        )

        rotation = inverse.poses.rotation
        home = rotation[contact.home]
        local = (inverse.points[points] - centre) @ home
        to_point = rotation[inverse.cube[points]].swapaxes(1, 2) @ home
        return points, local[:, :2], to_point

    def _cubes_around(self, home: int) -> tuple[Index, Array, Array]:
        """Find the cubes that measure a contact whose nearest cube (home) is given.

        These are the cubes within `REACH_DEPTHS` depths of the home that do not face away from it.

        Args:
            home: Index of the cube nearest to the contact.

        Returns:
            Indices (n,) of the cubes, and their positions (n, 2) in m and rotations (n,) in rad on
            the skin laid flat around the home cube, in the frame of the home cube.
        """
        inverse = self.inverse
        poses = inverse.poses
        reach = REACH_DEPTHS * inverse.depth
        near = self._cubes.query_ball_point(poses.position[home], reach)
        cubes = np.array(sorted(near), np.intp)
        # On a bent skin, cubes that face away from the home cube do not measure its contacts.
        facing = poses.rotation[cubes, :, 2] @ poses.rotation[home, :, 2]
        cubes = cubes[facing > _MIN_FACING]
        return cubes, *inverse.unroll(home, cubes)

    def nearest_cubes(self, contact: HertzContact, count: int) -> Index:
        """Return the indices of the `count` cubes nearest to a contact, the nearest first.

        If the skin has fewer cubes, all of them are returned.
        """
        count = min(count, len(self.inverse.poses.position))
        found = self._cubes.query(self.centre(contact), count)[1]
        return np.asarray(found, dtype=np.intp).reshape(-1)

    def nearest_points(self, positions: Array) -> Index:
        """Return the index (n,) of the surface point nearest to each position.

        Args:
            positions: Positions (n, 3) in m, in the skin's parent frame.
        """
        return np.asarray(self._points.query(positions)[1], dtype=np.intp)
