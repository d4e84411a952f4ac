"""Discs on a skin: Hertz contacts, what cubes see of them and what they do to the surface."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from ...core.arrays import Array, Index
from ...mechanics.kernels import REACH_DEPTHS, hertz_pressure
from ...mechanics.layer import FIELD
from ..inverse import SurfaceInverse, TractionField
from ..surface import square
from .disc_fit import Parts

FINER = 8
"""Places along the side of a point's square over which a disc's traction is averaged."""
_NEAR = 6.0
"""Depths beyond which the pressure of a contact counts as zero."""


@dataclass
class Disc:
    """A Hertz contact in the frame of its home, the nearest cube.

    id: the same as long as it is followed
    place: (2,) m; size: radius, m; force: (3,) N; alpha: Pa, of what is left around it
    doubt: m^2, variance of the place because it may lie elsewhere, inf before the first fit
    force_doubt: (3,) N^2, that of the force for the same reason
    covariance: (9, 9) of force, place, ln size and shapes, see `Fitted.covariance`, and the doubts
    asked: Pa, what was left around it when it was asked last whether it is two
    told_apart: from its neighbour, by likelihood (disc_split.py)
    """

    id: int
    home: int
    place: Array
    size: float
    force: Array
    alpha: float
    doubt: float = np.inf
    force_doubt: Array = field(default_factory=lambda: np.zeros(3))
    covariance: Array = field(default_factory=lambda: np.zeros((9, 9)))
    asked: float = 0.0
    told_apart: bool = False


class DiscModel:
    """What discs make on the skin of an inverse. Places are in the skin's parent frame, m."""

    def __init__(self, inverse: SurfaceInverse) -> None:
        self.inverse = inverse
        self._cubes = cKDTree(inverse.poses.position)
        self._points = cKDTree(inverse.points)

    def middle(self, disc: Disc) -> Array:
        """(3,) m on the surface."""
        poses = self.inverse.poses
        local = np.array([*disc.place, self.inverse.depth])
        return poses.position[disc.home] + poses.rotation[disc.home] @ local

    def seen(self, discs: list[Disc]) -> Array:
        """(cubes, C) what all cubes see of these contacts."""
        inverse = self.inverse
        seen = np.zeros((len(inverse.poses.position), len(inverse.columns)))
        for disc in discs:
            cubes, place, angle = self.cubes_around(disc.home)
            response = inverse.kernels.response(
                place - disc.place, angle, inverse.reading[cubes], disc.size
            )
            seen[cubes] += response[:, inverse.columns] @ disc.force
        return seen

    def below(self, discs: list[Disc]) -> Array:
        """(M,) pressure of these contacts at the cubes' depth."""
        below = np.zeros(len(self.inverse.points))
        for disc in discs:
            points, place, _ = self.points_around(disc)
            below[points] += self.inverse.kernels.disc_pressure(place, disc.size, disc.force)
        return below

    def with_discs(self, rest: TractionField, below: Array, discs: list[Disc]) -> TractionField:
        """What is left and the discs, these as the mean over the square of each point: so the sum
        over the points is the force, however narrow a contact is."""
        traction = rest.traction.copy()
        within = square(self.inverse.spacing / FINER, FINER)
        for disc in discs:
            points, place, turn = self.points_around(disc)
            distance = np.linalg.norm(place[:, None] + within, axis=2)
            share = hertz_pressure(distance, disc.size).mean(axis=1)
            traction[points] += share[:, None] * (turn @ disc.force)
        return rest._replace(traction=traction, below=below)

    def variance(self, discs: list[Disc]) -> Array:
        """(M, 2) of the pressure on the surface and of that below: what the covariances of the
        discs make of them."""
        total = np.zeros((len(self.inverse.points), 2))
        for disc in discs:
            self._add_variance(total, disc)
        return total

    def _add_variance(self, total: Array, disc: Disc) -> None:
        inverse = self.inverse
        points, place, turn = self.points_around(disc)
        # Its shapes reach no farther.
        touched = np.linalg.norm(place, axis=1) < 2 * disc.size + inverse.spacing
        within = square(inverse.spacing / FINER, FINER)

        def on_surface(middles: Array, size: float) -> Array:
            """(K, n, 3) pressure at the n points touched, under 1 N at K places (K, 2)."""
            from_middle = place[touched][:, None] + within - middles[:, None, None]
            share = hertz_pressure(np.hypot(from_middle[..., 0], from_middle[..., 1]), size)
            return np.asarray(-share.mean(axis=2)[..., None] * turn[touched, 2])

        def below(middles: Array, size: float) -> Array:
            """(K, n, 3) that below all points."""
            from_middle = (place - middles[:, None]).reshape(-1, 2)
            pressure = -inverse.kernels.field(from_middle, size)[:, FIELD.index("zz")]
            return pressure.reshape(len(middles), -1, 3)

        for part, which, responses in ((0, points[touched], on_surface), (1, points, below)):
            parts = Parts.of(responses, inverse.depth, np.zeros(2), disc.size)
            slopes = parts.by_parameters(disc.force)
            own = np.einsum("mp,pq,mq->m", slopes, disc.covariance, slopes)
            total[which, part] += np.maximum(own, 0)

    def points_around(self, disc: Disc) -> tuple[Index, Array, Array]:
        """Points near a contact: which, their places (n, 2) from its middle in its home's frame,
        and rotations (n, 3, 3) from that frame to the point's."""
        inverse = self.inverse
        reach = _NEAR * inverse.depth
        points = np.sort(self._points.query_ball_point(self.middle(disc), reach))
        points = np.asarray(points, dtype=np.intp)
        rotation = inverse.poses.rotation
        local = (inverse.points[points] - self.middle(disc)) @ rotation[disc.home]
        turn = rotation[inverse.cube[points]].swapaxes(1, 2) @ rotation[disc.home]
        return points, local[:, :2], turn

    def cubes_around(self, home: int) -> tuple[Index, Array, Array]:
        """Cubes that see contacts of this home: which, places and angles laid flat."""
        inverse = self.inverse
        reach = REACH_DEPTHS * inverse.depth
        cubes = np.sort(self._cubes.query_ball_point(inverse.poses.position[home], reach))
        cubes = np.asarray(cubes, dtype=np.intp)
        facing = inverse.poses.rotation[cubes, :, 2] @ inverse.poses.rotation[home, :, 2] > 0.5
        cubes = cubes[facing]
        return cubes, *inverse.flattened(home, cubes)

    def nearest_cubes(self, disc: Disc, count: int) -> Index:
        """Which cubes are the nearest to a disc, at most `count`."""
        count = min(count, len(self.inverse.poses.position))
        found = self._cubes.query(self.middle(disc), count)[1]
        return np.asarray(found, dtype=np.intp).reshape(-1)

    def nearest_points(self, places: Array) -> Index:
        """(n,) the point nearest to each place (n, 3)."""
        return np.asarray(self._points.query(places)[1], dtype=np.intp)
