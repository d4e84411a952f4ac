"""Contacts of a physics engine as tractions on a surface.

An engine with rigid bodies gives forces at points. A single point is a round contact, whose radius
Hertz gives. Several points between the same two bodies are a flat contact: uniform traction on the
points' hull, shrunk towards the centre of pressure c until its own centroid g lies there (the
effective area of a footing that is loaded off its middle)::

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

from ...core.arrays import Array


class Polygon(NamedTuple):
    """Traction on a polygon: uniform, and turning about its centroid.

    corners: (K, 3) m, counterclockwise about the normal; centre: (3,) m, their centroid
    traction: (3,) Pa on the skin at the centre; twist: Pa/m, at q it is more by
    twist normal x (q - centre)
    """

    corners: Array
    centre: Array
    traction: Array
    twist: float


def hertz_radius(force: float, curvature: float, stiffness: float) -> float:
    """Radius of the contact of a rigid sphere in m: a^3 = 3 F / (4 E* curvature).

    force: normal, N; curvature: 1 / radius of the sphere, 1/m, 0 for a flat body, whose contact at
    a single point is a corner: radius 0; stiffness: E* = E / (1 - nu^2) of the skin, Pa.
    """
    if curvature <= 0:
        return 0.0
    return float(np.cbrt(3 * force / (4 * stiffness * curvature)))


def flat_contact(points: Array, forces: Array, normal: Array, least: float) -> Polygon:
    """The polygon of a flat contact.

    points: (K, 3) m; forces: (K, 3) N, which all press; normal: (3,) out of the skin; least: width
    of what is a line or a point, m
    """
    basis = _plane(*normal.tolist())
    middle = points.mean(axis=0)
    flat, tangential = (points - middle) @ basis, forces @ basis
    pressing = forces @ normal
    centre = pressing @ flat / pressing.sum()
    arm = flat - centre
    moment = arm[:, 0] @ tangential[:, 1] - arm[:, 1] @ tangential[:, 0]
    corners = _hull(flat)
    area, centroid, polar = _moments(corners)
    if area < least * np.abs(corners).max():
        square = least / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        corners = _hull((flat[:, None] + square).reshape(-1, 2))
        area, centroid, polar = _moments(corners)
    edges = _following(corners) - corners
    of_centre, of_centroid = (
        edges[:, 0] * (place - corners)[:, 1] - edges[:, 1] * (place - corners)[:, 0]
        for place in (centre, centroid)
    )
    shrink = max(float((of_centre / of_centroid).min()), min(1.0, least / np.sqrt(area)))
    return Polygon(
        corners=middle + (centre + shrink * (corners - centroid)) @ basis.T,
        centre=middle + centre @ basis.T,
        traction=forces.sum(axis=0) / (shrink**2 * area),
        twist=float(moment / (shrink**4 * polar)),
    )


def _moments(corners: Array) -> tuple[float, Array, float]:
    """Area, centroid (2,) and polar moment of area about it of a polygon (K, 2)."""
    x, y = corners.T
    next_x, next_y = _following(corners).T
    double = x * next_y - next_x * y
    area = float(double.sum() / 2)
    if not area > 0:
        return 0.0, corners.mean(axis=0), 0.0
    centroid = np.array([double @ (x + next_x), double @ (y + next_y)]) / (6 * area)
    squares = x * x + x * next_x + next_x * next_x + y * y + y * next_y + next_y * next_y
    return area, centroid, float(double @ squares / 12 - area * centroid @ centroid)


def _following(corners: Array) -> Array:
    """(K, 2) the corner after each of them; np.roll takes five times as long."""
    return np.concatenate([corners[1:], corners[:1]])


def _hull(flat: Array) -> Array:
    """Corners of the convex hull of points (K, 2), counterclockwise. A. M. Andrew, Information
    Processing Letters 9 (1979) 216; Qhull takes ten times as long for a few points."""
    points = sorted(map(tuple, flat.tolist()))
    hull: list[tuple[float, float]] = []
    for run in (points, points[::-1]):
        start = len(hull)
        for x, y in run:
            while len(hull) > start + 1:
                (ax, ay), (bx, by) = hull[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                    break
                hull.pop()
            hull.append((x, y))
        hull.pop()
    return np.array(hull)


@lru_cache(maxsize=64)
def _plane(x: float, y: float, z: float) -> Array:
    """(3, 2) two axes across the normal (x, y, z); with it they are right-handed. Kept, for a flat
    skin has one normal."""
    normal, axis = np.array([x, y, z]), np.zeros(3)
    axis[np.argmin(np.abs(normal))] = 1.0
    first = np.cross(axis, normal)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)], axis=1)
