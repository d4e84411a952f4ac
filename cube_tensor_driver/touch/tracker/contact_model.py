"""Hertz contacts on a skin, the response of the cubes to them and their traction on the surface."""

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
"""Number of positions along each side of the square that a point of the surface stands for. The
traction of a contact is averaged over them, because it may be narrower than the square."""

_PRESSURE_REACH_DEPTHS = 6.0
"""Distance, in depths, beyond which the pressure of a contact counts as zero."""

_MIN_FACING = 0.5
"""Smallest cosine between the normals of two cubes of which one responds to contacts on the
other."""


@dataclass
class HertzContact:
    """A Hertz contact in the frame of its home, the cube nearest to it.

    Attributes:
        id: Number that stays the same as long as the contact is tracked.
        home: Index of the home cube.
        place: Position (2,) of the centre in the frame of the home, in m.
        size: Radius in m.
        force: Force (3,) in N on the skin.
        residual_scale: Standard deviation of the pressure of the residual field around it, in Pa.
        place_ambiguity: Variance of the position in m^2 because fits from other starts ended
            elsewhere; infinite before the first fit, 0 if they all agree.
        force_ambiguity: Variance (3,) of the force in N^2 for the same reason.
        covariance: Covariance (9, 9) of force, position, ln(size) and shapes as from
            `ContactFit.covariance`, plus these ambiguities.
        split_tested_at: Residual scale in Pa at the last test whether the contact is two; 0: none.
        was_split: Whether it came from a split (contact_split.py) and is told apart from its
            neighbour by the likelihood alone.
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
        inverse: Inverse of the skin.
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
        """Compute the response (cubes, C) of all cubes to contacts, in Pa."""
        inverse = self.inverse
        total = np.zeros(inverse.observed.shape)
        for contact in contacts:
            # The skin is unrolled around the home, in whose frame the position is given.
            cubes, place, angle = self._cubes_around(contact.home)
            offset = place - contact.place
            variant = inverse.variant[cubes]
            response = inverse.kernels.response(offset, angle, variant, contact.size)
            total[cubes] += response[:, inverse.columns] @ contact.force
        return total

    def depth_pressure(self, contacts: list[HertzContact]) -> Array:
        """Compute the pressure (M,) of contacts below all points at the cubes' depth, in Pa."""
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
            residual: Field that the contacts do not explain.
            depth_pressure: Total pressure (M,) at the cubes' depth, contacts included.
            contacts: Contacts to add.

        Returns:
            Total field. The traction of a contact is the mean over the square of each point, so
            that the sum over all points is the force, however small the contact is.
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
        """Compute the variances (M, 2) of the pressure that the covariances of contacts cause.

        Returns:
            Variances in Pa^2 of the pressure on the surface, and of that at the cubes' depth.
        """
        total = np.zeros((len(self.inverse.points), 2))
        for contact in contacts:
            self._add_pressure_variance(total, contact)
        return total

    def _add_pressure_variance(self, total: Array, contact: HertzContact) -> None:
        """Add the variances of one contact to `total` (M, 2)."""
        inverse = self.inverse
        points, offset, rotation = self._points_around(contact)
        # The shapes of a contact do not extend beyond twice its radius.
        reach = 2 * contact.size + inverse.spacing
        touched = np.linalg.norm(offset, axis=1) < reach
        subpoints = offset[touched][:, None] + self._subpoints

        def surface_pressure(centres: Array, size: float) -> Array:
            """Return the pressure (K, n, 3) at n touched points under 1 N at K centres (K, 2)."""
            x, y = np.moveaxis(
                subpoints - centres[:, None, None],
                -1,
                0,
            )
            share = hertz_pressure(np.hypot(x, y), size).mean(axis=2)
            return np.asarray(-share[..., None] * rotation[touched, 2])

        def pressure_at_depth(centres: Array, size: float) -> Array:
            """Return the pressure (K, n, 3) below n points under 1 N at K centres (K, 2)."""
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
        # var(p) = slopes cov slopes'
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
        """Find the points near a contact.

        Returns:
            Indices (n,) of the points, their positions (n, 2) from the centre in the frame of the
            contact's home, and the rotations (n, 3, 3) from that frame to the points'.
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
        """Find the cubes that respond to contacts of a home.

        Returns:
            Indices (n,) of the cubes, their positions (n, 2) and rotations (n,) on the skin
            unrolled around the home.
        """
        inverse = self.inverse
        poses = inverse.poses
        reach = REACH_DEPTHS * inverse.depth
        near = self._cubes.query_ball_point(poses.position[home], reach)
        cubes = np.array(sorted(near), np.intp)
        # On a bent skin, cubes on the other side do not respond.
        facing = poses.rotation[cubes, :, 2] @ poses.rotation[home, :, 2]
        cubes = cubes[facing > _MIN_FACING]
        return cubes, *inverse.unroll(home, cubes)

    def nearest_cubes(self, contact: HertzContact, count: int) -> Index:
        """Return the indices of the cubes nearest to a contact, at most `count`."""
        count = min(count, len(self.inverse.poses.position))
        found = self._cubes.query(self.centre(contact), count)[1]
        return np.asarray(found, dtype=np.intp).reshape(-1)

    def nearest_points(self, positions: Array) -> Index:
        """Return the index (n,) of the surface point nearest to each position (n, 3)."""
        return np.asarray(self._points.query(positions)[1], dtype=np.intp)
