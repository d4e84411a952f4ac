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
MOST = 8
"""Discs along a side of a flat contact, at most."""


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
    long as MOST allows it.
    """
    basis = _plane(*normal.tolist())
    middle = points.mean(axis=0)
    flat = (points - middle) @ basis
    pressing = np.maximum(-forces @ normal, 0.0)
    if not pressing.sum() > 0:
        return Discs(points, forces, np.zeros(len(points)))
    hull = _hull(flat, 0.1 * spacing)
    cells = _cells(hull, spacing)
    centroid = cells.mean(axis=0)
    centre = pressing @ flat / pressing.sum()
    distance = -(hull.equations[:, :2] @ np.stack([centre, centroid], 1) + hull.equations[:, 2:])
    shrink = float(np.clip(distance[:, 0] / distance[:, 1], 0.0, 1.0).min())
    arm, part = shrink * (cells - centroid), 1 / len(cells)
    torsion = _torsion(flat - centre, forces @ basis, arm) @ basis.T
    radius = np.full(len(cells), shrink * np.sqrt(part * hull.volume))
    return Discs(middle + (centre + arm) @ basis.T, part * forces.sum(axis=0) + torsion, radius)


def _cells(hull: ConvexHull, spacing: float) -> Array:
    """(L, 2) middles of equal cells of a hull, on a grid along its longest edge."""
    corners = hull.points[hull.vertices]
    edges = np.roll(corners, -1, axis=0) - corners
    along = edges[np.argmax((edges**2).sum(axis=1))]
    along = along / np.linalg.norm(along)
    axes = np.array([along, [-along[1], along[0]]])
    low, high = (getattr(corners @ axes.T, name)(axis=0) for name in ("min", "max"))
    counts = np.clip(np.ceil((high - low) / spacing), 1, MOST).astype(int)
    lines = [
        low[k] + (np.arange(count) + 0.5) / count * (high[k] - low[k])
        for k, count in enumerate(counts.tolist())
    ]
    cells = np.stack(np.meshgrid(*lines), axis=-1).reshape(-1, 2) @ axes
    inside = (cells @ hull.equations[:, :2].T + hull.equations[:, 2] <= 0).all(axis=1)
    return cells[inside] if inside.any() else corners.mean(axis=0, keepdims=True)


def _torsion(from_centre: Array, tangential: Array, arm: Array) -> Array:
    """(L, 2) N on each disc: together the moment about the normal that the points' tangential
    forces have about the centre."""
    moment = from_centre[:, 0] @ tangential[:, 1] - from_centre[:, 1] @ tangential[:, 0]
    polar = (arm**2).sum()
    if not polar > 0:
        return np.zeros_like(arm)
    torsion: Array = moment / polar * np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    return torsion


def _hull(flat: Array, least: float) -> ConvexHull:
    """Of points (K, 2); of squares of half side `least` about them where they are on one line."""
    try:
        return ConvexHull(flat)
    except (QhullError, ValueError):
        square = least * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return ConvexHull((flat[:, None] + square).reshape(-1, 2))


@lru_cache(maxsize=64)
def _plane(x: float, y: float, z: float) -> Array:
    """(3, 2) two axes across the normal (x, y, z); with it they are right-handed. Kept, for a flat
    skin has one normal."""
    normal, axis = np.array([x, y, z]), np.zeros(3)
    axis[np.argmin(np.abs(normal))] = 1.0
    first = np.cross(axis, normal)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)], axis=1)
