# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The body in which a cube sits, the checks of what can be computed, and its meshes."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import skfem

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.defaults import (
    HALF_SIDE,
    POISSONS_RATIO,
    YOUNGS_MODULUS,
)
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.layout import Layout

from .mesh import mesh_box, mesh_section


class BrickSizes(NamedTuple):
    """Sizes of the bricks (box-shaped elements) of one mesh.

    Attributes:
        face: Size of a brick on a face of the cube, in d0 (half the side of the cube).
        edge: Size of a brick at an edge of the cube, in d0.
        growth: Ratio of the sizes of two neighbouring bricks, away from the cube.
    """

    face: float
    edge: float
    growth: float


BRICK_SIZES = (
    BrickSizes(0.5, 0.2, 3.0),
    BrickSizes(0.25, 0.2, 2.0),
    BrickSizes(0.25, 0.1, 1.5),
)
"""Sizes of the bricks (box-shaped elements) of the three meshes of a body in space, from coarse to
fine."""
MAX_BRICK_ON_GROUND = 2.0
"""Largest brick (box-shaped element) of a body on rigid ground, in d0 (half the side of the cube).
Where forces act on the surface the stress is not linear in the position, so bricks must stay small
far away from the cube, too."""
MIN_EDGE_DISTANCE = 1e-3
"""Smallest distance of two pad edges that a mesh resolves, in d0 (half the side of the cube)."""
MIN_BODY_RATIO = 1.1
"""Smallest ratio of the body's width, depth and height to the cube's side."""


@dataclass(frozen=True, kw_only=True)
class Body:
    """A box of elastomer with a cube bonded in it.

    The schema of a model file (model.py) checks the range of each value.

    Attributes:
        width: Length along x, in m.
        depth: Length along y, in m; for layouts in space only.
        height: Length along z, in m.
        side: Side of the cube, in m.
        young: Young's modulus of the elastomer, in Pa.
        poisson: Poisson's ratio of the elastomer.
        cube_young: Young's modulus of the cube, in Pa; infinity makes it rigid.
        cube_poisson: Poisson's ratio of the cube.
        plane: "strain" or "stress", for layouts in a plane.
        x: Position of the cube's centre along x relative to the body's centre, in m.
        z: Position of the cube's centre along z relative to the body's centre, in m.
        ground: Whether the lower face is bonded to rigid ground.
        confined: Whether the sides slide on walls without friction. By symmetry the body then is
            one cell of a skin without edges, in which the pitch of the cubes is the width.
        expansion: Linear thermal expansion of the elastomer, in 1/K.
        density: Density of the elastomer, in kg/m³. Silicones have 970 to 1150.
        cube_density: Density of the cube, in kg/m³: 7850 for steel, 2500 for glass, 1190 for
            acrylic.
        cube_expansion: Linear thermal expansion of the cube, in 1/K. It is small: 12e-6 for steel.

    Raises:
        ElasticError: The cube does not fit into the body.
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
    confined: bool = False
    expansion: float = 3e-4
    cube_expansion: float = 0.0
    density: float = 1070.0
    cube_density: float = 7850.0

    def __post_init__(self) -> None:
        min_length = MIN_BODY_RATIO * self.side
        for name in ("width", "depth", "height"):
            length = getattr(self, name)
            if not length > min_length:
                raise ElasticError(
                    f"the cube's side is {self.side * 1e3:g} mm but the body's {name} is "
                    f"{length * 1e3:g} mm; the body must be at least {MIN_BODY_RATIO:g} times as "
                    "large"
                )
        for name, across in (("x", "width"), ("z", "height")):
            offset = getattr(self, name)
            max_offset = (getattr(self, across) - min_length) / 2
            if not abs(offset) <= max_offset:
                raise ElasticError(
                    f"the cube is {offset * 1e3:g} mm off the body's centre along {name}; within "
                    f"this {across} it can be {max_offset * 1e3:g} mm off at most"
                )

    @property
    def depth_of_cube(self) -> float:
        """Depth of the cube's centre below the upper face, in m."""
        return self.height / 2 - self.z


def strip_layout(
    layout: Layout,
    width: float,
    centre: float = 0.5,
) -> Layout:
    """Return the layout with pads of another width at another distance from their face's centre.

    Args:
        layout: Layout whose pads keep their faces and directions.
        width: Width of the pads, in d0 (half the side of the cube).
        centre: Distance of a pad's centre from the centre of its face, in d0. A width of 1 and a
            distance of 0.5 are the halves of each face.

    Raises:
        LayoutError: A pad leaves its face.
    """
    normals = layout.normals
    across = layout.positions - normals
    length = np.linalg.norm(across, axis=1, keepdims=True)
    # A pad in the middle of its face has no direction and stays there.
    directions = across / np.where(length > 0, length, 1.0)
    return Layout(layout.name, normals + centre * directions, normals, width)


def choose_field_axes(layout: Layout) -> tuple[int, ...]:
    """Return the axes in which a layout is computed: 0 and 2 (x and z) for a layout in a plane, all
    three for one in space."""
    return (0, 2) if layout.planar else (0, 1, 2)


def check_pads(body: Body, layout: Layout) -> None:
    """Raise ElasticError when two pads of one face share area.

    Square pads overlap when they are less than their side apart along both axes.
    """
    mm = 1e3 * body.side / 2
    size = layout.pad_size
    for i, j in itertools.combinations(range(layout.n_pads), 2):
        apart = layout.positions[i] - layout.positions[j]
        distance = np.abs(apart).max()
        is_same_face = np.array_equal(layout.normals[i], layout.normals[j])
        is_same_face &= not layout.is_dummy[i]
        if is_same_face and distance < size * (1 - 1e-9):
            raise ElasticError(
                f"pads {layout.pads[i]} and {layout.pads[j]} overlap: {mm * size:g} mm wide, "
                f"{mm * distance:g} mm apart; make them narrower or move them apart"
            )


def make_mesh(
    body: Body,
    layout: Layout,
    level: int,
) -> skfem.Mesh:
    """Mesh the body, with the origin in the cube's centre.

    Along an axis where the body is its own mirror image, only the positive part is meshed.

    Args:
        body: The body.
        layout: Pads, at whose edges elements end.
        level: 0 is the coarsest mesh, 2 the finest.

    Returns:
        A mesh with lengths in d0 (half the side of the cube).

    Raises:
        ElasticError: Edges of pads are too close to each other.
    """
    axes = list(choose_field_axes(layout))
    stops = _list_pad_edges(layout)
    _check_edges(stops, body.side / 2)

    lengths = np.array([body.width, body.depth, body.height])
    half = lengths[axes] / body.side
    centre = np.array([body.x, 0.0, body.z])
    offset = centre[axes] / (body.side / 2)
    # Ground below the body makes it unequal to its mirror image along z.
    is_vertical = np.array(axes) == 2
    no_mirror = (offset != 0) | (body.ground & is_vertical)
    lower = np.where(no_mirror, half + offset, 0.0).tolist()
    upper = (half - offset).tolist()

    if layout.planar:
        return mesh_section(lower, upper, stops, level)
    sizes = BRICK_SIZES[level]
    return mesh_box(
        lower,
        upper,
        stops,
        size=sizes.face,
        smallest=sizes.edge,
        growth=sizes.growth,
        largest=MAX_BRICK_ON_GROUND if body.ground else np.inf,
    )


def _list_pad_edges(layout: Layout) -> Array:
    """Return the sorted distances of pad edges from the centres of their faces, in d0 (half the
    side of the cube)."""
    half = layout.pad_size / 2
    edges = []
    on_face = ~layout.is_dummy
    for position, normal in zip(layout.positions[on_face], layout.normals[on_face], strict=True):
        for axis in choose_field_axes(layout):
            if normal[axis] == 0:
                edges += [
                    abs(position[axis] - half),
                    abs(position[axis] + half),
                ]
    # Edges of different pads that are equal except for rounding must be one end of elements.
    return np.unique(np.round(edges, 9))


def _check_edges(stops: Array, half_side: float) -> None:
    """Raise ElasticError when two of the pad edges `stops` (in d0, half the side of the cube) are
    closer than `MIN_EDGE_DISTANCE`."""
    # Elements also end at the centre of a face (0) and at its edge (1).
    ends = np.unique([0.0, *stops[stops < 1], 1.0])
    distance = np.diff(ends).min()
    if distance < MIN_EDGE_DISTANCE:
        mm = 1e3 * half_side
        raise ElasticError(
            f"pad edges are {mm * distance:.2g} mm apart and the mesh resolves "
            f"{mm * MIN_EDGE_DISTANCE:g} mm; make the pads wider, or move their edges together or "
            "apart"
        )
