# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What a cube in a layer on rigid ground measures of balls on the surface, against the true stress.

A response matrix R is that of a body loaded on all its sides. In a layer the surface and the ground
are near, and the field is curved. So the stress that a cube measures differs from that of the layer
without the cube, even if the pads are exact. With the influence functions g (influence.py) of the
pads in the layer and the traction t of a ball, the stress p of the pads and the measured s are::

    p = int g . t,        s = R^+ p

The traction is Hertz's (K. L. Johnson, Contact Mechanics (1985), 4.2): over a strip for a layout in
a plane, over a disc in space. It acts along z where the ball presses and along x where it rubs. The
true stress is that of layer.py.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.estimator import estimate_modes
from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.core.modes import PLANE
from cube_tensor_driver.core.symmetry import choose_default_modes, find_largest_symmetry
from cube_tensor_driver.mechanics.contact_response import ContactResponse
from cube_tensor_driver.mechanics.influence import Influence
from cube_tensor_driver.mechanics.layer import FIELD, Layer
from cube_tensor_driver.mechanics.measurement_model import CubeMeasurement

from ..fem.body import Body
from ..fem.fem import Progress, compute_response, count_steps
from ..fem.line_load import compute_line_load
from ..fem.reciprocity import compute_influence

WIDTHS = (2e-3, 5e-3, 10e-3, 20e-3)
"""Widths of the contacts, in m. Those that do not fit onto the body are left out."""
COMPONENTS = ("zz", "zx")
"""Names of the stress components that are compared, where the layout of pads observes them."""
LOADS = {"press": (-1, -1.0), "rub": (0, 1.0)}
"""Axis (-1 for the last one, z) and sign of the force by the name of the load: a ball presses
against z and rubs along x."""
POINTS_ACROSS = 41
"""Number of point forces across the diameter of a contact. With this number the stress of the
contact is right to a hundredth."""


class SurfaceRow(NamedTuple):
    """Measured and true stress under one load.

    Attributes:
        load: Name in `LOADS`.
        width: Width of the contact, in m.
        offset: Distance of the contact's centre from the cube's centre along x, in m.
        measured: Stress by component that the cube measures, in Pa under 1 N along the load's axis;
            for a layout in a plane under 1 N/m.
        true: Stress by component at the place of the cube's centre in the layer without the cube,
            in the same unit.
    """

    load: str
    width: float
    offset: float
    measured: dict[str, float]
    true: dict[str, float]


@dataclass(frozen=True, eq=False)
class SurfaceStudy:
    """Influence functions (stress under a unit force anywhere on the surface) of the pads of a cube
    in a layer, and measured and true stress under each load."""

    body: Body
    layout: Layout
    influence: Influence
    rows: tuple[SurfaceRow, ...]

    def to_dict(self) -> dict[str, object]:
        """Return the content of the file of --json."""
        return {
            "body": vars(self.body),
            "layout": self.layout.to_dict(),
            "rows": [row._asdict() for row in self.rows],
            "place": self.influence.place,
            "pads": self.influence.pads,
        }


def study_surface(
    body: Body,
    layout: Layout,
    meshes: int = 3,
    neglect: Sequence[str] = (),
    progress: Progress | None = None,
) -> SurfaceStudy:
    """Compare measured and true stress under balls above the cube and beside it.

    Args:
        body: The body; its lower face is taken as bonded to rigid ground.
        layout: Pads of the cube.
        meshes: Number of meshes, 1 to 3; the last one gives the result.
        neglect: Names of modes (linear stress fields) that the cube takes as zero.
        progress: Called before every stage and at the end.

    Raises:
        ElasticError: No contact of `WIDTHS` fits onto the body, the layout observes none of
            `COMPONENTS`, pads overlap, or the mesh does not fit into memory.
    """
    # The contact is above the cube, or its centre is beside it by the side of the cube.
    offsets = (0.0, body.side)
    reach = body.width / 2 - abs(body.x) - offsets[-1]
    widths = [width for width in WIDTHS if width / 2 <= reach]
    if not widths:
        raise ElasticError(
            f"the body's width is {body.width * 1e3:g} mm; beside a cube of {body.side * 1e3:g} mm "
            f"there must be room for a contact of {min(WIDTHS) * 1e3:g} mm, so make it wider"
        )
    report = count_steps(progress, 2)
    report("response matrix")
    inverse = _compute_inverse_rows(body, layout, meshes, neglect)
    report("influence functions")
    influence = compute_influence(
        replace(body, ground=True),
        layout,
        meshes - 1,
    )

    rows = []
    for load, width, offset in itertools.product(LOADS, widths, offsets):
        axis, sign = LOADS[load]
        points, parts = make_hertz_points(width / 2, 1 if layout.planar else 2)
        points[:, 0] += offset
        # The integral of influence functions and traction, by reciprocity.
        pads = influence.interpolate(points)[:, :, axis] @ (sign * parts)
        measured = {name: float(row @ pads) for name, row in inverse.items()}
        if layout.planar:
            field = _compute_stress_in_plane(body, points[:, 0], parts)
        else:
            field = _compute_stress_in_space(body, width, offset)
        true = {name: sign * float(field[name][axis]) for name in inverse}
        rows.append(SurfaceRow(load, width, offset, measured, true))
    report("done")
    return SurfaceStudy(body, layout, influence, tuple(rows))


def _compute_inverse_rows(
    body: Body,
    layout: Layout,
    meshes: int,
    neglect: Sequence[str],
) -> dict[str, Array]:
    """Return, for each component that the pads tell from all other modes, the row (P,) of the
    pseudo-inverse of the response matrix: from pad stresses to the component."""
    response = compute_response(
        body,
        layout,
        find_largest_symmetry(layout),
        meshes,
    )
    modes = choose_default_modes(layout)
    estimator = estimate_modes(response.matrix, modes, neglect)
    rows = {
        name: estimator.matrix[modes.names.index(name)]
        for name in COMPONENTS
        if name in modes.names and estimator.observed[modes.names.index(name)]
    }
    if not rows:
        raise ElasticError(
            f"layout {layout.name!r} tells none of {', '.join(COMPONENTS)} from the other modes; "
            "take one with more pads, or list modes that are small under neglect"
        )
    return rows


def _compute_stress_in_plane(
    body: Body,
    x: Array,
    parts: Array,
) -> dict[str, Array]:
    """Return, by component, the stress (2,) at the cube's centre under unit line loads.

    Args:
        body: The body without the cube.
        x: (n,) positions of the line loads, in m.
        parts: (n,) share of the load on each line; they sum to 1.
    """
    poisson = body.poisson
    if body.plane == "stress":
        # Plane stress is plane strain of a material with this ratio.
        poisson = body.poisson / (1 + body.poisson)
    layer = Layer(body.height, poisson)
    modes = compute_line_load(layer, x, body.depth_of_cube, body.side / 2)
    return {name: parts @ modes[PLANE.names.index(name)] for name in COMPONENTS}


def _compute_stress_in_space(
    body: Body,
    width: float,
    offset: float,
) -> dict[str, Array]:
    """Return, by component, the stress (3,) at the cube's centre under a ball's unit force."""
    layer = Layer(body.height, body.poisson)
    cubes = CubeMeasurement(layer, body.depth_of_cube, body.side / 2)
    from_load = np.array([[-offset, 0.0]])
    field = ContactResponse(cubes).compute_field(from_load, width / 2)[0]
    return {name: field[FIELD.index(name)] for name in COMPONENTS}


def make_hertz_points(radius: float, dim: int) -> tuple[Array, Array]:
    """Return point forces of a Hertzian contact, whose pressure falls as sqrt(1 - (r/radius)^2).

    Args:
        radius: Half width of the strip, or radius of the disc, in m.
        dim: 1 for a strip, 2 for a disc.

    Returns:
        Points (n, dim) in m from the contact's centre, and the share (n,) of the force on each.
    """
    line = (2 * np.arange(POINTS_ACROSS) + 1) / POINTS_ACROSS - 1
    grid = np.meshgrid(*[line] * dim)
    points = np.stack(grid, axis=-1).reshape(-1, dim)
    square = 1 - (points**2).sum(axis=1)
    is_inside = square > 0
    pressure = np.sqrt(square[is_inside])
    return radius * points[is_inside], pressure / pressure.sum()
