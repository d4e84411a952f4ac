"""Triangle meshes of the 3-D view: prisms, arrows and rings as arrays, and squares in colours."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from ..core.arrays import Array, Index
from ..views import scene
from ..views.scene import Quantity

Mesh = tuple[NDArray[Any], NDArray[Any]]
"""Vertices (V, 3) and faces (F, 3), each three indices of vertices."""

NO_MESH: Mesh = (np.zeros((3, 3)), np.array([[0, 1, 2]]))
"""A mesh without area, which is not seen. viser refuses one without faces."""

PRISM_SIDES = 6
"""Number of sides of the prisms that arrows, crosses and rings consist of."""

CUBE: Mesh = (
    np.array(list(product((-1.0, 1.0), repeat=3))),
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
"""A cube with a half side of 1 about the origin."""

CUBE_EDGES = np.array(
    [
        [one, other]
        for number, one in enumerate(CUBE[0])
        for other in CUBE[0][number + 1 :]
        if np.count_nonzero(one != other) == 1
    ]
)
"""(12, 2, 3) edges of `CUBE`, each from corner to corner."""

MIN_ARROW = 0.15
"""Length, in units of the arrow's unit length, below which an arrow is left out."""

HEAD_LENGTH = 0.2
"""Length of the head of an arrow, in units of its unit length."""

SHAFT_RADIUS = 0.025
"""Radius of the shaft of an arrow, in units of its unit length."""

HEAD_RADIUS = 0.075
"""Radius of the head of an arrow at its base, in units of its unit length."""

RING_POINTS = 49
"""Number of points of a ring; the last one is the first one again."""

COLOUR_STEPS = 32
"""Number of colours of a `SquareLayer`. Each is a mesh of its own, so that more cost more time."""

_SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
_SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)


def rods(lines: Array, start_radius: float, end_radius: float | None = None) -> Mesh:
    """Make open prisms along lines.

    Args:
        lines: (N, 2, 3) start and end of each line.
        start_radius: Radius at the start.
        end_radius: Radius at the end, 0 for pyramids; None: as at the start.
    """
    if not len(lines):
        return NO_MESH
    along = lines[:, 1] - lines[:, 0]
    # The axis that is least parallel to the line gives a stable perpendicular direction.
    axis = np.eye(3)[np.abs(along).argmin(axis=1)]
    first = _normalised(np.cross(along, axis))
    second = _normalised(np.cross(along, first))

    angle = 2 * np.pi * np.arange(PRISM_SIDES)[:, None, None] / PRISM_SIDES
    circle = (np.cos(angle) * first + np.sin(angle) * second).swapaxes(0, 1)
    radii = np.array([start_radius, start_radius if end_radius is None else end_radius])
    vertices = lines[:, :, None] + circle[:, None] * radii[:, None, None]

    # Each side is two triangles between its two corners at the start and at the end.
    corner = np.arange(PRISM_SIDES)
    following = (corner + 1) % PRISM_SIDES
    triangles = [
        [corner, following, following + PRISM_SIDES],
        [corner, following + PRISM_SIDES, corner + PRISM_SIDES],
    ]
    prism = np.array(triangles).transpose(0, 2, 1).reshape(-1, 3)
    faces = prism + 2 * PRISM_SIDES * np.arange(len(lines))[:, None, None]
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def _normalised(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-12))


def arrows(lines: Array, unit: float) -> Mesh:
    """Make arrows along lines (N, 2, 3) whose heads are in proportion to the unit length.

    Arrows that would be hardly more than a head are left out.
    """
    along = lines[:, 1] - lines[:, 0]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    is_drawn = length[:, 0] > MIN_ARROW * unit
    lines, length = lines[is_drawn], length[is_drawn]
    tail, tip = lines[:, 0], lines[:, 1]
    neck = tip - (tip - tail) * np.minimum(HEAD_LENGTH * unit / length, 1)
    shafts = rods(np.stack([tail, neck], axis=1), SHAFT_RADIUS * unit)
    heads = rods(np.stack([neck, tip], axis=1), HEAD_RADIUS * unit, 0.0)
    vertices = np.concatenate([shafts[0], heads[0]])
    faces = np.concatenate([shafts[1], heads[1] + len(shafts[0])])
    return vertices, faces


def ring(radius: float, thickness: float) -> Mesh:
    """Make a ring about the origin in the x-y plane from prisms with the radius `thickness`."""
    angle = np.linspace(0, 2 * np.pi, RING_POINTS)
    unit_circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    points = radius * unit_circle
    lines = np.stack([points[:-1], points[1:]], axis=1)
    return rods(lines, thickness)


def hit(
    position: Array,
    pitch: float,
    start: Array,
    direction: Array,
) -> int | None:
    """Return which cube a ray meets, None if it meets none.

    Cubes on the far side of a curved skin, behind another cube, do not count.

    Args:
        position: (N, 3) centres of the cubes.
        pitch: Their distance from each other.
        start: (3,) origin of the ray.
        direction: (3,) its direction, of any length.
    """
    direction = direction / np.linalg.norm(direction)
    depth = (position - start) @ direction
    distance = np.linalg.norm(position - start - depth[:, None] * direction, axis=1)
    near = distance < pitch
    if not near.any():
        return None
    in_front = near & (depth < depth[near].min() + 2 * pitch)
    return int(np.where(in_front, distance, np.inf).argmin())


class SquareLayer:
    """Squares whose colours change: the field of a skin, or the cubes of a large skin.

    The squares of one colour are one mesh, so that a skin is a few objects, which a computer
    without a graphics card can draw often. An image would be less to send, but browsers decode
    images apart from everything else, and a slow one would show the field of another instant than
    the cubes.
    """

    def __init__(
        self, api: viser.SceneApi, name: str, points: Array, rotation: Array, side: float
    ) -> None:
        """Make the layer, without colours.

        Args:
            api: The scene.
            name: Name of the layer in the scene.
            points: (M, 3) centres of the squares.
            rotation: (M, 3, 3) frames of the squares, which lie in x and y.
            side: Length of their sides.
        """
        corners = np.einsum("mij,qj->mqi", rotation[:, :, :2], side * _SQUARE)
        self._corners = (points[:, None] + corners).astype(np.float32)
        self._frame = api.add_frame(f"/{name}", show_axes=False)
        self._meshes = [
            api.add_mesh_simple(
                f"/{name}/{step}",
                *NO_MESH,
                flat_shading=True,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
            for step in range(COLOUR_STEPS + 1)
        ]
        self._is_drawn = np.zeros(COLOUR_STEPS + 1, bool)
        self._quantity: Quantity | None = None

    def hide(self) -> None:
        self._frame.visible = False

    def paint(
        self,
        quantity: Quantity,
        values: Array,
        top: float,
    ) -> None:
        """Colour the squares by values (M,) of a quantity, on a range up to `top`, in SI units."""
        # The colours of the steps depend on whether the quantity is signed.
        if quantity is not self._quantity:
            self._quantity = quantity
            for mesh, colour in zip(self._meshes, step_colours(quantity).tolist(), strict=True):
                mesh.color = tuple(colour)
        self._frame.visible = True
        steps = colour_steps(quantity, values, top)
        for step, mesh in enumerate(self._meshes):
            chosen = np.flatnonzero(steps == step)
            # A mesh that was empty and stays empty is not sent again.
            if len(chosen) or self._is_drawn[step]:
                mesh.vertices, mesh.faces = self._squares(chosen)
                self._is_drawn[step] = bool(len(chosen))

    def _squares(self, chosen: Index) -> Mesh:
        if not len(chosen):
            return NO_MESH
        first_vertex = 4 * np.arange(len(chosen), dtype=np.uint32)
        faces = first_vertex[:, None, None] + _SQUARE_FACES
        return self._corners[chosen].reshape(-1, 3), faces.reshape(-1, 3)


def colour_steps(quantity: Quantity, values: Array, top: float) -> Index:
    """Return the step of the colour scale (M,) of each value; `COLOUR_STEPS` where it is NaN."""
    bottom = -top if quantity.signed else 0.0
    share = (np.nan_to_num(values) - bottom) / (top - bottom)
    step = np.clip(share * COLOUR_STEPS, 0, COLOUR_STEPS - 1).astype(int)
    return np.where(np.isfinite(values), step, COLOUR_STEPS)


def step_colours(quantity: Quantity) -> NDArray[np.uint8]:
    """Return the sRGB colours (COLOUR_STEPS + 1, 3) of the steps; the last one is for NaN."""
    middle = (np.arange(COLOUR_STEPS) + 0.5) / COLOUR_STEPS
    values = np.append(2 * middle - 1 if quantity.signed else middle, np.nan)
    return np.round(255 * scene.colours(quantity, values, 1.0)).astype(np.uint8)
