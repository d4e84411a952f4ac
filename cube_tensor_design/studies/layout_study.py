"""How far each layout can be trusted under contacts that are not wide beside the cube.

An indenter of growing width moves over a cube. The stress and gradient recovered from the pads are
compared with the true ones at the cube's centre. The pads see the true field all over the cube, not
only its value and slope at the centre: the error shown is what the field's higher orders add.

Model: the contact field (elastic.contact) acts as tractions on a box of twice the cube's side
around the rigid cube. The box moves with the cube, so a surface nearer than its top is not part of
the model. Each layout is calibrated with the linear modes on the same box.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.defaults import POISSONS_RATIO
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.estimator import make_estimator
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.modes import COMPONENTS, PLANE, SPACE, Modes, to_matrix
from cube_tensor_driver.mechanics import contact

from ..fem.body import Body, make_mesh
from ..fem.fem import Progress, linear_response, make_solid, pad_stresses
from ..fem.memory import check_memory

TRUSTED_ERROR = 0.2
"""A component can be trusted while its error is at most this part of its range."""

_BOX = 2.0
"""Sides of the box over the cube's side."""
_FRICTION = 0.3
"""The indenter slides towards +x, so that there is shear under its middle, too."""
_LATERAL_OFFSET = 1e-3
"""The indenter passes the cube at this y, m."""
_NEGLECTED_MODES = {"quad": ("xx", "xx_z", "xx_x"), "planar": (), "cube": ()}


class TrustedWidth(NamedTuple):
    """From this width (m) of the indenter on, the error stays small; None: at no width."""

    layout: str
    side: float
    component: str
    width: float | None


@dataclass(frozen=True, eq=False)
class LayoutStudy:
    """Error of each component, relative to the range that it takes as the indenter passes.

    sides: (S,) of the cube, m; widths: (W,) and offsets: (X,) along x of the indenter, m
    depth: of the cube's centre, m
    truth: (S, W, X, C) components in the order of COMPONENTS, gradients times d0, Pa per N of force
    recovered: {layout: (S, W, X, C)}, NaN where a layout does not observe a component
    error: {layout: (S, W, C)} largest |recovered - truth| over the offsets / (max - min of truth)
    """

    sides: Array
    widths: Array
    offsets: Array
    depth: float
    truth: Array
    recovered: dict[str, Array]
    error: dict[str, Array]

    def trusted(self, limit: float = TRUSTED_ERROR) -> list[TrustedWidth]:
        """The narrowest trusted indenter for each layout, side and component that it observes."""
        rows: list[TrustedWidth] = []
        for (name, error), (i, side) in itertools.product(
            self.error.items(), enumerate(self.sides)
        ):
            for k, component in enumerate(COMPONENTS):
                if np.isnan(error[i, 0, k]):
                    continue
                bad = np.flatnonzero(error[i, :, k] > limit)
                first = bad[-1] + 1 if len(bad) else 0
                width = float(self.widths[first]) if first < len(self.widths) else None
                rows.append(TrustedWidth(name, float(side), component, width))
        return rows

    def to_dict(self) -> dict[str, Any]:
        """Plain types for JSON; None where a layout does not observe a component."""
        return {
            "sides": self.sides.tolist(),
            "widths": self.widths.tolist(),
            "offsets": self.offsets.tolist(),
            "depth": self.depth,
            "components": list(COMPONENTS),
            "error": {name: _none_for_nan(error.tolist()) for name, error in self.error.items()},
        }


def _none_for_nan(value: Any) -> Any:
    """Nested lists of numbers with None for NaN, which JSON does not know."""
    if isinstance(value, list):
        return [_none_for_nan(item) for item in value]
    return None if np.isnan(value) else value


@dataclass(frozen=True)
class _Passage:
    """One indenter at one offset from a cube of one side; lengths in m."""

    side: float
    width: float
    offset: float
    depth: float
    poisson: float

    def field(self, x: Array) -> tuple[Array, Array]:
        """Stress (n, 6) and gradient (n, 6, 3) at x (n, 3), m from the cube's centre."""
        # Points of the quadrature are no further apart than the largest cube's side.
        order = 4 + int(np.ceil(self.width / 4e-3))
        force = [_FRICTION, 0.0, -1.0]
        sources, forces = contact.disc(self.width / 2, force, (self.offset, 0.0), order)
        points = x + np.array([0.0, _LATERAL_OFFSET, -self.depth])
        return contact.field(points, sources, forces, self.poisson)

    def components(self) -> Array:
        """True COMPONENTS (1, 15) at the cube's centre, gradients times d0."""
        stress, gradient = self.field(np.zeros((1, 3)))
        return np.concatenate([stress, self.side / 2 * gradient[:, :3].reshape(1, 9)], axis=1)


def layout_study(
    sides: Sequence[float] = (4e-3, 2e-3, 1e-3),
    widths: Sequence[float] = (1e-3, 2e-3, 5e-3, 10e-3, 15e-3, 20e-3),
    offsets: Sequence[float] = tuple(np.linspace(-12e-3, 12e-3, 9)),
    depth: float = 5.5e-3,
    poisson: float = POISSONS_RATIO,
    progress: Progress | None = None,
) -> LayoutStudy:
    """Slide a round indenter of each width (its diameter) over a cube of each side, along x.

    The indenter passes at y = 1 mm. It presses with 1 N, spread evenly, and drags with 0.3 N.
    Raises ElasticError when a cube's box would reach the surface.
    """
    if depth <= _BOX * max(sides) / 2:
        raise ElasticError(
            f"the cube's centre is {depth * 1e3:g} mm deep; a cube of {max(sides) * 1e3:g} mm "
            f"needs more than {_BOX * max(sides) / 2 * 1e3:g} mm, or the study's box leaves the "
            "skin"
        )
    passages = [
        _Passage(side, width, offset, depth, poisson)
        for side, width, offset in itertools.product(sides, widths, offsets)
    ]
    matrix, pads = _pad_stresses(passages, poisson, progress)
    shape = (len(sides), len(widths), len(offsets), len(COMPONENTS))
    truth = np.concatenate([passage.components() for passage in passages]).reshape(shape)
    recovered = {
        name: (pads[: LAYOUTS[name].n_pads].T @ _recovery(matrix, name).T).reshape(shape)
        for name in LAYOUTS
    }
    error = {
        name: np.abs(found - truth).max(axis=2) / np.ptp(truth, axis=2)
        for name, found in recovered.items()
    }
    return LayoutStudy(
        sides=np.asarray(sides),
        widths=np.asarray(widths),
        offsets=np.asarray(offsets),
        depth=depth,
        truth=truth,
        recovered=recovered,
        error=error,
    )


def _pad_stresses(
    passages: Sequence[_Passage], poisson: float, progress: Progress | None
) -> tuple[Array, Array]:
    """Response (pads, modes) of the 24-pad cube in its box, and its pads (pads, passages), Pa."""
    # A rigid cube; lengths are in units of its side.
    body = Body(_BOX, _BOX, _BOX, side=1.0, poisson=poisson, cube_young=np.inf)
    layout = LAYOUTS["cube"]
    grid = make_mesh(body, layout, 0)
    check_memory(grid)
    solid = make_solid(body, layout, grid)
    fields: dict[bytes, Array] = {}

    def field(x: Array) -> Array:
        if x.tobytes() not in fields:  # every parity asks for the same points
            stresses = [passage.field(passage.side / 2 * x)[0] for passage in passages]
            fields[x.tobytes()] = to_matrix(np.stack(stresses, axis=1))
        return fields[x.tobytes()]

    steps = itertools.count()
    total = 2 * 2**solid.dim  # all parities, of the modes and of the passages

    def report(what: str) -> None:
        if progress is not None:
            progress(next(steps), total, what)

    matrix = linear_response(solid, layout, report)
    pads = pad_stresses(solid, layout, lambda parity: solid.outer_forces(parity, field), report)
    report("done")
    return matrix, pads


def _recovery(matrix: Array, name: str) -> Array:
    """COMPONENTS (15, pads) from pad stresses (pads,).

    The pads of quad and planar are the first ones of the cube; these layouts know plane modes only.
    """
    layout = LAYOUTS[name]
    modes: Modes = PLANE if layout.planar else SPACE
    plane = SPACE.state(modes.stress, modes.gradient).T
    response = matrix[: layout.n_pads] @ plane
    noise = np.ones(layout.n_pads)
    return make_estimator(response, noise, modes, neglect=_NEGLECTED_MODES[name]).matrix
