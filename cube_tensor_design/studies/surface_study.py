"""What a cube in a layer on rigid ground says of balls on the surface, against the field there.

A response matrix R is that of a body loaded on all its sides. In a layer the surface and the ground
are near, and the field is curved. So the stress that a cube says differs from that of the layer
without it, even where nothing is measured wrong. With the influence functions g (influence.py) of
the pads in the layer and the traction t of a ball, pads see p = int g . t and the cube says::

    said = R^+ p

Traction is Hertz's (K. L. Johnson, Contact Mechanics (1985), 4.2): in a plane over a strip, in
space over a disc, along z where the ball presses and along x where it rubs. The field without the
cube is that of layer.py.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.core.modes import PLANE
from cube_tensor_driver.core.symmetry import largest_symmetry
from cube_tensor_driver.mechanics.influence import Influence
from cube_tensor_driver.mechanics.kernels import Kernels
from cube_tensor_driver.mechanics.layer import FIELD, Layer

from ..fem.body import Body
from ..fem.fem import compute_response
from ..fem.line_load import line_load
from ..fem.reciprocity import compute_influence

Progress = Callable[[int, int, str], None]

WIDTHS = (2e-3, 5e-3, 10e-3, 20e-3)
"""Of the contacts, m; those that fit onto the body are computed."""
COMPONENTS = ("zz", "zx")
"""What is compared, where the layout sees it."""
LOADS = {"press": (-1, -1.0), "rub": (0, 1.0)}
"""Axis and sign of the force: a ball presses against z and rubs along x."""
_ACROSS = 41
"""Points across a contact: its force is then right to a hundredth."""


class Said(NamedTuple):
    """Of one load.

    load: press or rub; width: of the contact, place: of its middle along x from the cube's, m
    said, there: stress by component, Pa under 1 N along the load's axis; in a plane under 1 N/m
    """

    load: str
    width: float
    place: float
    said: dict[str, float]
    there: dict[str, float]


@dataclass(frozen=True, eq=False)
class SurfaceStudy:
    """influence: of the pads of the cube in the layer; rows: one for each load."""

    body: Body
    layout: Layout
    influence: Influence
    rows: tuple[Said, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain types for JSON."""
        return {
            "body": {
                name: None if value == np.inf else value for name, value in vars(self.body).items()
            },
            "layout": self.layout.to_dict(),
            "rows": [row._asdict() for row in self.rows],
            "place": self.influence.place.tolist(),
            "pads": self.influence.pads.tolist(),
        }


def study_surface(
    body: Body,
    layout: Layout,
    meshes: int = 3,
    neglect: Sequence[str] = (),
    progress: Progress | None = None,
) -> SurfaceStudy:
    """The study for a body, whose lower face is taken as bonded to rigid ground, on the last of
    1 to 3 meshes.

    neglect: modes that the cube takes as zero. progress is called before every stage and at the
    end. Raises ElasticError when no contact of WIDTHS fits onto the body, the layout sees none of
    COMPONENTS, pads overlap, or the mesh does not fit into memory.
    """
    places = (0.0, body.side)
    reach = body.width / 2 - abs(body.x) - places[-1]
    widths = [width for width in WIDTHS if width / 2 <= reach]
    if not widths:
        raise ElasticError(
            f"the body's width is {body.width * 1e3:g} mm; beside a cube of {body.side * 1e3:g} mm "
            f"there must be room for a contact of {min(WIDTHS) * 1e3:g} mm, so make it wider"
        )
    stages = ("response matrix", "influence functions", "done")

    def report(stage: int) -> None:
        if progress is not None:
            progress(stage, len(stages) - 1, stages[stage])

    report(0)
    inverse = _inverse(body, layout, meshes, neglect)
    report(1)
    influence = compute_influence(replace(body, ground=True), layout, meshes - 1)
    rows = []
    for (load, (axis, sign)), width, place in itertools.product(LOADS.items(), widths, places):
        points, parts = hertz(width / 2, 1 if layout.planar else 2)
        points[:, 0] += place
        pads = influence.at(points)[:, :, axis] @ (sign * parts)
        said = {name: float(row @ pads) for name, row in inverse.items()}
        field = _field(body, layout, width, place, points, parts)[:, axis]
        there = {name: sign * float(field[COMPONENTS.index(name)]) for name in inverse}
        rows.append(Said(load, width, place, said, there))
    report(2)
    return SurfaceStudy(body, layout, influence, tuple(rows))


def _inverse(body: Body, layout: Layout, meshes: int, neglect: Sequence[str]) -> dict[str, Array]:
    """The rows (P,) of R^+ of the components that the pads tell from all others, by name."""
    response = compute_response(body, layout, largest_symmetry(layout), meshes)
    names = [name for name in response.modes if name not in neglect]
    matrix = response.matrix[:, [response.modes.index(name) for name in names]]
    inverse = np.linalg.pinv(matrix)
    told = np.abs(np.diag(inverse @ matrix) - 1) < 1e-6
    rows = {name: inverse[k] for k, name in enumerate(names) if told[k] and name in COMPONENTS}
    if not rows:
        raise ElasticError(
            f"layout {layout.name!r} tells none of {', '.join(COMPONENTS)} from the other modes; "
            "take one with more pads, or --neglect modes that are small"
        )
    return {name: rows[name] for name in COMPONENTS if name in rows}


def _field(
    body: Body, layout: Layout, width: float, place: float, points: Array, parts: Array
) -> Array:
    """(COMPONENTS, 2 or 3) stress at the cube's middle without it, under unit force along each
    axis."""
    depth = body.height / 2 - body.z
    if layout.planar:
        # Plane stress is plane strain of another ratio.
        poisson = body.poisson if body.plane == "strain" else body.poisson / (1 + body.poisson)
        modes = line_load(Layer(body.height, poisson), points[:, 0], depth, body.side / 2)
        return np.stack([parts @ modes[PLANE.names.index(name)] for name in COMPONENTS])
    kernels = Kernels(Layer(body.height, body.poisson), depth, body.side / 2)
    field = kernels.field(np.array([[-place, 0.0]]), width / 2)[0]
    return np.stack([field[FIELD.index(name)] for name in COMPONENTS])


def hertz(radius: float, dim: int) -> tuple[Array, Array]:
    """Points (n, dim) m from the middle of a contact and the parts (n,) of its force there.

    dim: 1 a strip, 2 a disc; the pressure falls with the root of 1 - (r / radius)^2.
    """
    line = (2 * np.arange(_ACROSS) + 1) / _ACROSS - 1
    points = np.stack(np.meshgrid(*[line] * dim), axis=-1).reshape(-1, dim)
    inside = 1 - (points**2).sum(axis=1)
    points, pressure = points[inside > 0], np.sqrt(inside[inside > 0])
    return radius * points, pressure / pressure.sum()
