"""The body in which a cube sits, what of it can be computed, and its meshes."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import skfem

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.defaults import HALF_SIDE, POISSONS_RATIO, YOUNGS_MODULUS
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.layout import Layout

from .mesh import block, sections


class BrickSizes(NamedTuple):
    """Size of a brick on a face and at an edge of the cube, in d0, and growth away from it."""

    face: float
    edge: float
    growth: float


BRICK_SIZES = (
    BrickSizes(0.5, 0.2, 3.0),
    BrickSizes(0.25, 0.2, 2.0),
    BrickSizes(0.25, 0.1, 1.5),
)
"""Of the meshes in space, coarse to fine."""
_LARGEST_BRICK = 2.0
"""Of a body on ground, d0: where forces on its surface act, its field is not linear."""
_CLOSEST_EDGES = 1e-3
"""Smallest distance of two pad edges, d0."""


@dataclass(frozen=True)
class Body:
    """A box of elastomer with a cube bonded in it; lengths in m, moduli in Pa.

    width, depth, height: along x, y and z (depth in 3-D only); side: of the cube
    young, poisson: of the body
    cube_young, cube_poisson: of the cube; cube_young = inf makes it rigid
    plane: "strain" or "stress", for layouts in a plane
    x, z: where the cube's middle is, from that of the body
    ground: the lower face is bonded to rigid ground
    Raises ElasticError when no such body can be computed.
    """

    width: float = 60e-3
    depth: float = 60e-3
    height: float = 11e-3
    side: float = 2 * HALF_SIDE
    young: float = YOUNGS_MODULUS
    poisson: float = POISSONS_RATIO
    cube_young: float = 200e9
    cube_poisson: float = 0.30
    plane: str = "strain"
    x: float = 0.0
    z: float = 0.0
    ground: bool = False

    def __post_init__(self) -> None:
        for name in ("width", "depth", "height", "side", "young", "cube_young"):
            value = getattr(self, name)
            if not value > 0 or (np.isinf(value) and name != "cube_young"):
                raise ElasticError(f"{name} is {value}; it must be a positive number in SI units")
        for name in ("poisson", "cube_poisson"):
            value = getattr(self, name)
            if not 0 <= value < 0.5:
                raise ElasticError(
                    f"{name} is {value}; it must lie in [0, 0.5). For rubber take 0.48 to 0.4999: "
                    "the elements do not lock, but at 0.5 pressure is no longer a function of "
                    "strain"
                )
        for name in ("width", "depth", "height"):
            if not getattr(self, name) > 1.1 * self.side:
                raise ElasticError(
                    f"the cube's side is {self.side * 1e3:g} mm but the body's {name} is "
                    f"{getattr(self, name) * 1e3:g} mm; the body must be at least 1.1 times as "
                    "large"
                )
        for name, across in (("x", "width"), ("z", "height")):
            value, most = getattr(self, name), (getattr(self, across) - 1.1 * self.side) / 2
            if not abs(value) <= most:
                raise ElasticError(
                    f"the cube is {value * 1e3:g} mm off the body's middle along {name}; within "
                    f"this {across} it can be {most * 1e3:g} mm off at most"
                )
        if self.plane not in ("strain", "stress"):
            raise ElasticError(f"plane is {self.plane!r}; it must be 'strain' or 'stress'")


def strip_layout(layout: Layout, width: float, centre: float = 0.5) -> Layout:
    """The same layout with pads of another width and distance from the middle of their face, in d0.

    width = 1, centre = 0.5 are the halves of each face. Raises LayoutError when a pad leaves its
    face.
    """
    normals = layout.normals
    across = layout.positions - normals
    length = np.linalg.norm(across, axis=1, keepdims=True)
    directions = across / np.where(length > 0, length, 1.0)
    return Layout(layout.name, normals + centre * directions, normals, width)


def field_axes(layout: Layout) -> tuple[int, ...]:
    """The axes of a layout's problem: x and z in a plane, all in space."""
    return (0, 2) if layout.planar else (0, 1, 2)


def check_pads(body: Body, layout: Layout) -> None:
    """Raise ElasticError when pads of one face share area.

    Square pads overlap when they are less than their side apart along both axes.
    """
    mm = 1e3 * body.side / 2
    size = layout.pad_size
    for i, j in itertools.combinations(range(layout.n_pads), 2):
        gap = np.abs(layout.positions[i] - layout.positions[j]).max()
        same_face = np.array_equal(layout.normals[i], layout.normals[j])
        if same_face and gap < size * (1 - 1e-9):
            raise ElasticError(
                f"pads {layout.pads[i]} and {layout.pads[j]} overlap: {mm * size:g} mm wide, "
                f"{mm * gap:g} mm apart; make them narrower or move them apart"
            )


def make_mesh(body: Body, layout: Layout, level: int) -> skfem.Mesh:
    """Mesh of the body about the cube's middle, lengths in d0; level 0 is the coarsest, 2 the
    finest. Where the body is its own mirror image it is the positive part.

    Raises ElasticError when the edges of pads are too close to each other for it.
    """
    axes = list(field_axes(layout))
    half = np.array([body.width, body.depth, body.height])[axes] / body.side
    place = np.array([body.x, 0.0, body.z])[axes] / (body.side / 2)
    whole = (place != 0) | (body.ground & (np.array(axes) == 2))
    stops = _pad_edges(layout)
    steps = np.diff(np.unique([0.0, *stops[stops < 1], 1.0]))
    if steps.min() < _CLOSEST_EDGES:
        mm = 1e3 * body.side / 2
        raise ElasticError(
            f"pad edges are {mm * steps.min():.2g} mm apart and the mesh resolves "
            f"{mm * _CLOSEST_EDGES:g} mm; make the pads wider, or move their edges together or "
            "apart"
        )
    lower, upper = np.where(whole, half + place, 0.0).tolist(), (half - place).tolist()
    if layout.planar:
        return sections(lower, upper, stops, level)
    sizes = BRICK_SIZES[level]
    largest = _LARGEST_BRICK if body.ground else np.inf
    return block(upper, stops, sizes.face, sizes.edge, sizes.growth, lower, largest)


def _pad_edges(layout: Layout) -> Array:
    """Distances of pad edges from the middle of their faces, d0, sorted."""
    half = layout.pad_size / 2
    edges = [
        abs(float(position[k]) + s)
        for position, normal in zip(layout.positions, layout.normals, strict=True)
        for k in field_axes(layout)
        for s in (-half, half)
        if normal[k] == 0
    ]
    return np.unique(np.round(edges, 9))
