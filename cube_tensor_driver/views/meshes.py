# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Shapes of the 3-D view as arrays: cubes, marks and coloured squares."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import AnyArray, Array, Index, Mask
from . import scene
from .scene import Quantity

Mesh = tuple[AnyArray, AnyArray]
"""A triangle mesh: positions of V vertices (V, 3), and three vertex indices per triangle (F, 3)."""

NO_MESH: Mesh = (np.zeros((3, 3)), np.array([[0, 1, 2]]))
"""An invisible mesh: one triangle without area, because viser refuses a mesh without triangles."""

_CORNERS = product((-1.0, 1.0), repeat=3)
"""Corners of a cube with its centre at the origin and half a side of 1."""
_CORNER_PAIRS = np.array(list(combinations(_CORNERS, 2)))
"""All pairs (28, 2, 3) of corners of the cube, of which 12 are the ends of its edges."""
_N_DIFFERENT = np.count_nonzero(_CORNER_PAIRS[:, 0] != _CORNER_PAIRS[:, 1], axis=1)
"""Number (28,) of coordinates in which the corners of each pair differ: 1 along an edge."""
CUBE_EDGES = _CORNER_PAIRS[_N_DIFFERENT == 1]
"""Edges (12, 2, 3) of a cube with its centre at the origin and half a side of 1: the positions of
both ends of each edge."""

COLOUR_STEPS = 32
"""Number of colours in which the coloured squares of a skin are drawn.

The squares of each colour are a mesh of their own, so more colours take the browser more time.
"""

_SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
"""Corners (4, 2) of a square with sides of 1 around the origin."""
_SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
"""Indices (2, 3) of the corners of the two triangles of `_SQUARE`."""


def join_squares(corners: AnyArray) -> Mesh:
    """Return one mesh of N squares, from their corners (N, 4, 3)."""
    first_vertex = 4 * np.arange(len(corners), dtype=np.uint32)
    faces = first_vertex[:, None, None] + _SQUARE_FACES
    return corners.reshape(-1, 3), faces.reshape(-1, 3)


def make_cube() -> Mesh:
    """Return the mesh of a cube with its centre at the origin and half a side of 1."""
    # The corners of each face follow each other counterclockwise, seen from outside. Exchanging the
    # axes cyclically keeps this direction. A reflection in the centre reverses it, so the lower
    # face lists the reflected corners in reverse order.
    upper = np.column_stack([2 * _SQUARE, np.ones(4)])
    lower = -upper[::-1]
    faces = []
    for face in (upper, lower):
        for axis in range(3):
            faces.append(np.roll(face, axis, axis=1))
    return join_squares(np.array(faces))


def make_corner_lines(rotation: Array, side: float) -> Array:
    """Return the lines (8, 2, 3) that mark the four corners of a square around the origin.

    Args:
        rotation: (3, 3) rotation whose first two columns are the directions of the sides.
        side: Length of the sides of the square.
    """
    corners = side * _SQUARE
    # From each corner, lines go towards both neighbouring corners, each a quarter of the side long.
    lines = []
    for step in (1, -1):
        neighbours = np.roll(corners, step, axis=0)
        ends = corners + 0.25 * (neighbours - corners)
        lines.append(np.stack([corners, ends], axis=1))
    in_plane = np.concatenate(lines)
    return np.asarray(in_plane @ rotation[:, :2].T)


def find_hit_cube(
    position: Array,
    pitch: float,
    start: Array,
    direction: Array,
) -> int | None:
    """Return the index of the cube that a ray hits, or None if it hits none.

    A ray hits a cube if its distance from the cube's centre is below one pitch. Of several cubes,
    the one with the centre closest to the ray is taken. Cubes more than two pitches behind the
    first one are ignored, because they lie on the far side of a curved skin.

    Args:
        position: (N, 3) centres of the cubes.
        pitch: Distance of neighbouring cubes, in the unit of the positions.
        start: (3,) origin of the ray.
        direction: (3,) direction of the ray, of any length.
    """
    direction = direction / np.linalg.norm(direction)
    depth = (position - start) @ direction
    closest = start + depth[:, None] * direction
    distance = np.linalg.norm(position - closest, axis=1)
    near = distance < pitch
    if not near.any():
        return None
    max_depth = depth[near].min() + 2 * pitch
    in_front = near & (depth < max_depth)
    distance = np.where(in_front, distance, np.inf)
    return int(distance.argmin())


def compute_square_corners(
    points: Array,
    rotation: Array,
    side: Array,
) -> AnyArray:
    """Return the corners (M, 4, 3) of M squares, in units of the scene.

    Args:
        points: (M, 3) centres of the squares, in units of the scene.
        rotation: (M, 3, 3) rotations from the frame of each square, in whose x-y plane it lies, to
            the scene.
        side: (M,) length of the sides of each square, in units of the scene.
    """
    offset = side[:, None, None] * _SQUARE
    rotated: Array = np.einsum("mij,mqj->mqi", rotation[:, :, :2], offset)
    corners = points[:, None] + rotated
    return corners.astype(np.float32)


def paint_squares(
    corners: AnyArray,
    quantity: Quantity,
    values: Array,
    top: float,
    visible: Mask,
) -> list[Mesh]:
    """Return one mesh for each colour of `compute_step_colours`, with the squares of this colour.

    The squares show the field (values between the cubes) of a skin, and in a large skin also the
    cubes. With one mesh for each colour, a skin consists of few objects, and a computer without a
    graphics card can draw it often enough. An image would be less data, but browsers decode images
    asynchronously: a slow browser would show the field of one instant together with the cubes of a
    later one.

    Args:
        corners: (M, 4, 3) corners of the squares.
        quantity: The quantity that the colours show.
        values: (M,) its values at the squares, in SI units.
        top: Value at the upper end of the colour scale, in SI units.
        visible: (M,) whether each square is drawn.
    """
    steps = find_colour_steps(quantity, values, top)
    meshes = []
    for step in range(COLOUR_STEPS + 1):
        chosen = np.flatnonzero(visible & (steps == step))
        meshes.append(join_squares(corners[chosen]) if len(chosen) else NO_MESH)
    return meshes


def find_colour_steps(
    quantity: Quantity,
    values: Array,
    top: float,
) -> Index:
    """Return the index (M,) of the colour of each value; `COLOUR_STEPS` for NaN.

    Args:
        quantity: The quantity, which may be signed.
        values: (M,) its values, in SI units.
        top: Value at the upper end of the colour scale, in SI units.
    """
    bottom = -top if quantity.signed else 0.0
    above_bottom = np.nan_to_num(values) - bottom
    share = above_bottom / (top - bottom)
    step = np.clip(share * COLOUR_STEPS, 0, COLOUR_STEPS - 1)
    is_known = np.isfinite(values)
    return np.where(is_known, step.astype(int), COLOUR_STEPS)


def compute_step_colours(quantity: Quantity) -> NDArray[np.uint8]:
    """Return the colours of `paint_squares` (COLOUR_STEPS + 1, 3) in sRGB; the last is for NaN."""
    values = (np.arange(COLOUR_STEPS) + 0.5) / COLOUR_STEPS
    if quantity.signed:
        values = 2 * values - 1
    with_unknown = np.append(values, np.nan)
    colours = scene.choose_colours(quantity, with_unknown, 1.0)
    return np.round(255 * colours).astype(np.uint8)
