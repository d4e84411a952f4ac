# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Contacts of a physics engine as tractions on a surface.

An engine with rigid bodies gives forces at points. A single point is a round contact, whose radius
is that of Hertz. Several points between the same two bodies are a flat contact: uniform traction on
a polygon. The polygon is the convex hull of the points, moved so that its centroid g becomes the
centre of pressure c, and shrunk by the factor s so that it stays inside the hull (the effective
area of a footing that is loaded off its centre). A corner q of the hull becomes::

    c + s (q - g),     s = min over the hull's edges of  distance(c) / distance(g)

where distance is that of a point from the edge. The force and the moments of this traction are
those of the forces at the points, and the traction nowhere pulls.
The moment about the normal (torsion) becomes a tangential traction that is proportional to the
distance from c.

Source: K. L. Johnson, Contact Mechanics (1985), 4.2 (Hertz); G. G. Meyerhof, Proc. 3rd Int. Conf.
Soil Mechanics (1953), 440 (effective area).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ...core.arrays import Array

_UNIT_SQUARE = np.array(
    [
        [-1, -1],
        [1, -1],
        [1, 1],
        [-1, 1],
    ]
)
"""Corners (4, 2) of a square with half a side of 1, counterclockwise."""


class Polygon(NamedTuple):
    """Uniform traction on a polygon, plus a tangential traction that circulates about its centroid.

    Attributes:
        corners: Corners (K, 3) in m, counterclockwise about the normal.
        centre: Centroid (3,) in m.
        traction: Traction (3,) in Pa on the skin at the centroid.
        twist: Strength in Pa/m of the circulating traction, which at the position q is twist times
            the cross product of the normal and q - centre.
    """

    corners: Array
    centre: Array
    traction: Array
    twist: float


def compute_hertz_radius(
    force: float,
    curvature: float,
    stiffness: float,
) -> float:
    """Return the Hertz contact radius in m of a rigid sphere: a^3 = 3 F / (4 E* curvature).

    Args:
        force: Normal force in N.
        curvature: Curvature of the sphere in 1/m; 0 for a flat body, whose contact at a single
            point is a corner and has the radius 0.
        stiffness: E* = E / (1 - nu^2) of the skin, in Pa.
    """
    if curvature <= 0:
        return 0.0
    cube_of_radius = 3 * force / (4 * stiffness * curvature)
    return float(np.cbrt(cube_of_radius))


def make_flat_contact(
    points: Array,
    forces: Array,
    normal: Array,
    min_width: float,
) -> Polygon:
    """Return the traction on a polygon that represents the contact of a flat body.

    The traction has the force and the moments of the forces at the contact points. The polygon is
    the convex hull of the points, shrunk so that its centroid is the centre of pressure.

    Args:
        points: Positions (K, 3) of the contact points in m.
        forces: Forces (K, 3) in N on the skin; all of them press.
        normal: Unit normal (3,) out of the skin.
        min_width: Smallest width of the polygon in m, for contacts along a line or at a point.
    """
    basis = _make_plane_basis(*normal.tolist())
    origin = points.mean(axis=0)
    flat = (points - origin) @ basis
    tangential = forces @ basis
    # All forces press, so their components along the normal have the same sign.
    pressing = forces @ normal
    centre = pressing @ flat / pressing.sum()
    arm = flat - centre
    arm_x, arm_y = arm.T
    force_x, force_y = tangential.T
    moment = arm_x @ force_y - arm_y @ force_x

    corners = _find_convex_hull(flat)
    area, centroid, polar = _compute_area_moments(corners)
    if area < min_width * np.abs(corners).max():
        # The points lie on a line. Each becomes a square, so that the polygon has an area.
        square = min_width / 2 * _UNIT_SQUARE
        around_points = flat[:, None] + square
        corners = _find_convex_hull(around_points.reshape(-1, 2))
        area, centroid, polar = _compute_area_moments(corners)

    ratios = _compute_edge_distances(corners, centre) / _compute_edge_distances(corners, centroid)
    shrink = max(
        float(ratios.min()),
        min(1.0, min_width / np.sqrt(area)),
    )
    shrunk = centre + shrink * (corners - centroid)
    total = forces.sum(axis=0)
    return Polygon(
        corners=origin + shrunk @ basis.T,
        centre=origin + centre @ basis.T,
        traction=total / (shrink**2 * area),
        twist=float(moment / (shrink**4 * polar)),
    )


def _compute_edge_distances(corners: Array, place: Array) -> Array:
    """Measure the distance of a position from all edges of a polygon.

    Args:
        corners: Corners (K, 2) of the polygon, counterclockwise.
        place: Position (2,) in the same plane.

    Returns:
        Distance (K,) from the line of each edge, positive inside, multiplied by the edge's length.
    """
    edge_x, edge_y = (find_next_corners(corners) - corners).T
    x, y = (place - corners).T
    return np.asarray(edge_x * y - edge_y * x)


def _compute_area_moments(corners: Array) -> tuple[float, Array, float]:
    """Return the area in m², centroid (2,) in m and polar moment of area in m⁴ of a polygon.

    The moment is about the centroid.

    Args:
        corners: Corners (K, 2) in m, counterclockwise.
    """
    x, y = corners.T
    next_x, next_y = find_next_corners(corners).T
    double_area = x * next_y - next_x * y
    area = float(double_area.sum() / 2)
    if not area > 0:
        return 0.0, corners.mean(axis=0), 0.0

    first = np.array(
        [
            double_area @ (x + next_x),
            double_area @ (y + next_y),
        ]
    )
    centroid = first / (6 * area)
    # The polar moment about the origin is the integral of x² + y² over the triangles between the
    # origin and the edges.
    squares = x * x + x * next_x + next_x * next_x
    squares = squares + y * y + y * next_y + next_y * next_y
    polar_about_origin = double_area @ squares / 12
    return area, centroid, float(polar_about_origin - area * centroid @ centroid)


def find_next_corners(corners: Array) -> Array:
    """Return, for each corner (K, 2) of a polygon, the corner that follows it.

    np.roll would take five times as long.
    """
    return np.concatenate([corners[1:], corners[:1]])


def _find_convex_hull(flat: Array) -> Array:
    """Return the corners of the convex hull of points (K, 2), counterclockwise.

    Source: A. M. Andrew, Information Processing Letters 9 (1979) 216. Qhull takes ten times as long
    for a few points.
    """
    points = sorted(map(tuple, flat.tolist()))
    hull: list[tuple[float, float]] = []
    for run in (points, points[::-1]):  # lower, then upper half of the hull
        start = len(hull)
        for x, y in run:
            while len(hull) > start + 1:
                (ax, ay), (bx, by) = hull[-2:]
                left = (bx - ax) * (y - ay)
                right = (by - ay) * (x - ax)
                if left > right:
                    break  # a left turn
                hull.pop()
            hull.append((x, y))
        hull.pop()
    return np.array(hull)


@lru_cache(maxsize=64)
def _make_plane_basis(
    x: float,
    y: float,
    z: float,
) -> Array:
    """Return two unit axes, as columns (3, 2), that span the plane with the normal (x, y, z).

    First axis, second axis and normal are a right-handed frame.

    The result is cached, because all contacts on a flat skin have the same normal.
    """
    normal = np.array([x, y, z])
    axis = np.zeros(3)
    axis[np.argmin(np.abs(normal))] = 1.0  # the axis that is least parallel to the normal
    first = np.cross(axis, normal)
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    return np.stack([first, second], axis=1)
