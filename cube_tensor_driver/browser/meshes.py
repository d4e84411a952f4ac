"""Triangle meshes of the 3-D view as plain arrays, and which cube a ray meets."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array

Mesh = tuple[NDArray[Any], NDArray[Any]]
"""Vertices (V, 3) and faces (F, 3), each three indices of vertices."""

NOTHING: Mesh = (np.zeros((3, 3)), np.array([[0, 1, 2]]))
"""A mesh that is not seen; viser refuses one without faces."""
SIDES = 6
"""Of the prisms that arrows, crosses and rings are made of."""
CUBE: Mesh = (
    np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float),
    np.array(
        [
            *([0, 1, 3], [0, 3, 2]),
            *([4, 6, 7], [4, 7, 5]),
            *([0, 4, 5], [0, 5, 1]),
            *([2, 3, 7], [2, 7, 6]),
            *([0, 2, 6], [0, 6, 4]),
            *([1, 5, 7], [1, 7, 3]),
        ]
    ),
)
"""A cube of half side 1 about the origin."""
CUBE_EDGES = np.array(
    [
        [one, other]
        for number, one in enumerate(CUBE[0])
        for other in CUBE[0][number + 1 :]
        if np.count_nonzero(one != other) == 1
    ]
)
"""(12, 2, 3) its edges."""

LEAST_ARROW, NECK = 0.15, 0.2
"""Parts of an arrow's unit length: arrows below the first are left out, heads are the second."""
SHAFT_RADIUS, HEAD_RADIUS = 0.025, 0.075
RING_POINTS = 49


def rods(lines: Array, start: float, end: float | None = None) -> Mesh:
    """Open prisms along lines (N, 2, 3), with a radius that goes from `start` to `end`.

    end: None: as `start`; 0 makes pyramids.
    """
    if not len(lines):
        return NOTHING
    along = lines[:, 1] - lines[:, 0]
    # Perpendicular to the line and to the axis that the line is least parallel to.
    first = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(along, first)
    second /= np.maximum(np.linalg.norm(second, axis=1, keepdims=True), 1e-12)

    angle = 2 * np.pi * np.arange(SIDES)[:, None, None] / SIDES
    circle = (np.cos(angle) * first + np.sin(angle) * second).swapaxes(0, 1)
    radii = np.array([start, start if end is None else end])
    vertices = lines[:, :, None] + circle[:, None] * radii[:, None, None]

    corner = np.arange(SIDES)
    following = (corner + 1) % SIDES
    triangles = [
        [corner, following, following + SIDES],
        [corner, following + SIDES, corner + SIDES],
    ]
    faces_of_one = np.array(triangles).transpose(0, 2, 1).reshape(-1, 3)
    faces = faces_of_one + 2 * SIDES * np.arange(len(lines))[:, None, None]
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def arrows(lines: Array, unit: float) -> Mesh:
    """Arrows from lines[:, 0] to lines[:, 1] with heads in proportion to `unit`.

    Arrows that would be hardly more than a head are left out.
    """
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1, keepdims=True)
    long_enough = length[:, 0] > LEAST_ARROW * unit
    lines, length = lines[long_enough], length[long_enough]
    tail, tip = lines[:, 0], lines[:, 1]
    neck = tip - (tip - tail) * np.minimum(NECK * unit / length, 1)
    shafts = rods(np.stack([tail, neck], axis=1), SHAFT_RADIUS * unit)
    heads = rods(np.stack([neck, tip], axis=1), HEAD_RADIUS * unit, 0.0)
    return joined(shafts, heads)


def ring(radius: float, thickness: float) -> Mesh:
    """A ring about the origin in the x-y plane; thickness: the radius of its prisms."""
    angle = np.linspace(0, 2 * np.pi, RING_POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) * radius
    return rods(np.stack([circle[:-1], circle[1:]], axis=1), thickness)


def joined(one: Mesh, other: Mesh) -> Mesh:
    """Two meshes as one."""
    vertices = np.concatenate([one[0], other[0]])
    faces = np.concatenate([one[1], other[1] + len(one[0])])
    return vertices, faces


def hit(position: Array, pitch: float, start: Array, direction: Array) -> int | None:
    """Which of the cubes at `position` (N, 3), `pitch` apart, a ray meets; None if it meets none.

    Cubes on the far side of a skin, behind another one, do not count.
    """
    direction = direction / np.linalg.norm(direction)
    depth = (position - start) @ direction
    distance = np.linalg.norm(position - start - depth[:, None] * direction, axis=1)
    near = distance < pitch
    if not near.any():
        return None
    in_front = near & (depth < depth[near].min() + 2 * pitch)
    return int(np.where(in_front, distance, np.inf).argmin())
