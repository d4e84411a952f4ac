"""Contacts of a physics engine as discs of traction on a surface.

An engine with rigid bodies gives forces at points. A single point is a round contact: one disc,
whose radius Hertz gives. Several points between the same two bodies are a flat contact: uniform
traction on the points' hull, shrunk towards the centre of pressure c until its own centroid g lies
there (the effective area of a footing that is loaded off its middle)::

    q -> c + s (q - g),     s = min over the hull's edges of  distance(c) / distance(g)

So force and moments are those of the points, and nothing pulls. What is left about the normal, the
torsion, is tangential traction in proportion to the distance from c.

Source: K. L. Johnson, Contact Mechanics (1985), 4.2 (Hertz); G. G. Meyerhof, Proc. 3rd Int. Conf.
Soil Mechanics (1953), 440 (effective area).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

Array = NDArray[np.float64]
FINEST = 4
"""Triangles along a side of each triangle of the hull, at most."""


class Discs(NamedTuple):
    """Discs of traction: place (L, 3) m, force (L, 3) N on the skin and radius (L,) m."""

    place: Array
    force: Array
    radius: Array


def hertz_radius(force: float, curvature: float, stiffness: float) -> float:
    """Radius of the contact of a rigid sphere in m: a^3 = 3 F / (4 E* curvature).

    force: normal, N; curvature: 1 / radius of the sphere, 1/m, 0 for a flat body, whose contact at
    a single point is a corner: radius 0; stiffness: E* = E / (1 - nu^2) of the skin, Pa.
    """
    if curvature <= 0:
        return 0.0
    return float(np.cbrt(3 * force / (4 * stiffness * curvature)))


def flat_contact(points: Array, forces: Array, normal: Array, spacing: float) -> Discs:
    """Discs of a flat contact.

    points: (K, 3) m; forces: (K, 3) N; normal: (3,) out of the skin; spacing: of the discs, m, as
    long as FINEST allows it.
    """
    basis = _plane(normal)
    middle = points.mean(axis=0)
    flat = (points - middle) @ basis
    pressing = np.maximum(-forces @ normal, 0.0)
    if not pressing.sum() > 0:
        return Discs(points, forces, np.zeros(len(points)))
    hull = _hull(flat, 0.1 * spacing)
    corners = hull.points[hull.vertices]
    fan = [np.broadcast_to(corners[0], corners[2:].shape), corners[1:-1], corners[2:]]
    triangles = np.stack(fan, axis=1)
    first, second = (triangles[:, k] - triangles[:, 0] for k in (1, 2))
    areas = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    area = areas.sum()
    centroid = areas @ triangles.mean(axis=1) / area
    centre = pressing @ flat / pressing.sum()
    distance = -(hull.equations[:, :2] @ np.stack([centre, centroid], 1) + hull.equations[:, 2:])
    shrink = float(np.clip(distance[:, 0] / distance[:, 1], 0.0, 1.0).min())
    side = shrink * np.linalg.norm(np.ptp(corners, axis=0)) / np.sqrt(2)
    fine = int(np.clip(np.ceil(side / spacing), 1, FINEST))
    inside = np.einsum("pk,tkx->tpx", _barycentric(fine), triangles).reshape(-1, 2)
    part = np.repeat(areas / area, fine**2) / fine**2
    arm = shrink * (inside - centroid)
    discs = (
        part[:, None] * forces.sum(axis=0)
        + part[:, None] * _torsion(flat - centre, forces @ basis, arm, part) @ basis.T
    )
    return Discs(middle + (centre + arm) @ basis.T, discs, shrink * np.sqrt(part * area))


def _torsion(from_centre: Array, tangential: Array, arm: Array, part: Array) -> Array:
    """(L, 2) traction times area over `part` with the moment about the normal of the points' own
    forces, all but that of their sum."""
    moment = from_centre[:, 0] @ tangential[:, 1] - from_centre[:, 1] @ tangential[:, 0]
    polar = part @ (arm**2).sum(axis=1)
    if not polar > 0:
        return np.zeros_like(arm)
    return moment / polar * np.stack([-arm[:, 1], arm[:, 0]], axis=1)


def _hull(flat: Array, least: float) -> ConvexHull:
    """Of points (K, 2); of squares of half side `least` about them where they are on one line."""
    try:
        return ConvexHull(flat)
    except (QhullError, ValueError):
        square = least * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return ConvexHull((flat[:, None] + square).reshape(-1, 2))


def _plane(normal: Array) -> Array:
    """(3, 2) two axes across the normal; with it they are right-handed."""
    axis = np.zeros(3)
    axis[np.argmin(np.abs(normal))] = 1.0
    first = np.cross(axis, normal)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)], axis=1)


@lru_cache(maxsize=FINEST)
def _barycentric(fine: int) -> Array:
    """(fine², 3) the centroids of a triangle's fine² equal parts."""
    corners = []
    for i in range(fine):
        for j in range(fine - i):
            corners.append((i + 1 / 3, j + 1 / 3))
            if i + j < fine - 1:
                corners.append((i + 2 / 3, j + 2 / 3))
    two = np.array(corners) / fine
    return np.column_stack([1 - two.sum(axis=1), two])
