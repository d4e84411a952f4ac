"""How far each layout can be trusted: an indenter of growing width is moved over a cube, and the stress and
gradient recovered from the pads are compared with the true ones at the cube's centre.

The pads see the true field all over the cube, not only its value and slope at the centre: what a field of higher
order adds is the error that this study shows. The contact field (elastic.contact) acts as tractions on a box of
twice the cube's side around the rigid cube; the box moves with the cube, so a surface nearer than its top is not
part of the model. Each layout is calibrated with the linear modes on the same box.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ElasticError
from ..core.estimator import make_estimator
from ..core.layout import LAYOUTS
from ..core.modes import COMPONENTS, PLANE, SPACE, Modes, to_matrix
from . import contact
from .body import Body, make_mesh
from .fem import linear_response, make_solid, pad_stresses

Array = NDArray[np.float64]

_BOX = 2.0  # sides of the box over the cube's side
_FRICTION = 0.3  # the indenter slides towards +x, so that there is shear under its middle too
_NEGLECT = {"quad": ("xx", "xx_z", "xx_x"), "planar": (), "cube": ()}


@dataclass(frozen=True, eq=False)
class Study:
    """Error of each component, relative to the range it takes as the indenter passes.

    widths (W,) and offsets (X,) of the indenter, m; depth of the cube's centre and side of the cube, m
    truth: (W, X, C) true components in the order of core.modes.COMPONENTS, gradients times d0, Pa
    recovered: {layout: (W, X, C)}, NaN where a layout does not observe a component
    error: {layout: (W, C)} the largest |recovered - truth| over the offsets / (max - min of truth)
    """

    widths: Array
    offsets: Array
    depth: float
    side: float
    truth: Array
    recovered: dict[str, Array]
    error: dict[str, Array]

    def to_dict(self) -> dict[str, Any]:
        """Plain types for JSON; None where nothing is known."""
        return {
            "widths": self.widths.tolist(),
            "offsets": self.offsets.tolist(),
            "depth": self.depth,
            "side": self.side,
            "components": list(COMPONENTS),
            "error": {
                name: [[None if np.isnan(e) else float(e) for e in row] for row in rows]
                for name, rows in self.error.items()
            },
        }


def study(
    widths: Sequence[float] = (1e-3, 2e-3, 4e-3, 6e-3, 8e-3, 12e-3, 16e-3, 20e-3),
    offsets: Sequence[float] = tuple(np.linspace(-12e-3, 12e-3, 13)),
    depth: float = 5.5e-3,
    side: float = 4e-3,
    poisson: float = 0.48,
    progress: Callable[[int, int, str], None] | None = None,
) -> Study:
    """Slide a round indenter of each width (its diameter) over the cube along x at y = side / 4.

    It presses with 1 N, spread evenly, and drags with 0.3 N; results do not depend on the force.
    Raises ElasticError when the cube's box would reach the surface.
    """
    if depth <= _BOX * side / 2:
        raise ElasticError(
            f"the cube's centre is {depth * 1e3:g} mm deep; a cube of {side * 1e3:g} mm needs more than "
            f"{_BOX * side / 2 * 1e3:g} mm, or the study's box leaves the skin"
        )
    width, offset, d0 = np.asarray(widths, dtype=float), np.asarray(offsets, dtype=float), side / 2
    loads = [(w, x) for w in width for x in offset]
    body = Body(*(3 * [_BOX * side]), side=side, poisson=poisson, cube_young=np.inf)
    layout = LAYOUTS["cube"]
    solid = make_solid(body, layout, make_mesh(body, layout, 0))
    cache: dict[bytes, Array] = {}

    def field(x: Array) -> Array:
        key = x.tobytes()
        if key not in cache:  # every parity asks for the same points
            cache[key] = np.stack([to_matrix(_stress(d0 * x, load, depth, poisson)[0]) for load in loads], axis=1)
        return cache[key]

    def report(what: str, done: list[int] = []) -> None:  # noqa: B006
        if progress is not None:
            progress(len(done), 16, what)
            done.append(0)

    matrix = linear_response(solid, layout, report)
    pads = pad_stresses(solid, layout, lambda parity: solid.outer_forces(parity, field), report)
    stress, gradient = zip(*(_stress(np.zeros((1, 3)), load, depth, poisson) for load in loads), strict=True)
    truth = _components(np.concatenate(stress), np.concatenate(gradient), d0)
    shape = (len(width), len(offset), len(COMPONENTS))
    truth = truth.reshape(shape)
    recovered = {
        name: (pads[: LAYOUTS[name].n_pads].T @ _recovery(matrix, name).T).reshape(shape) for name in LAYOUTS
    }
    scale = np.ptp(truth, axis=1)
    error = {name: np.abs(found - truth).max(axis=1) / scale for name, found in recovered.items()}
    return Study(width, offset, depth, side, truth, recovered, error)


def _stress(x: Array, load: tuple[float, float], depth: float, poisson: float) -> tuple[Array, Array]:
    """Stress (n, 6) and gradient (n, 6, 3) of one indenter at x (n, 3), m from the cube's centre."""
    width, offset = load
    order = 4 + int(np.ceil(width / 2e-3))  # about a point per mm, finer than the box is deep
    sources, forces = contact.disc(width / 2, [_FRICTION, 0.0, -1.0], (offset, 0.0), order)
    return contact.field(x + [0.0, 1e-3, -depth], sources, forces, poisson)


def _components(stress: Array, gradient: Array, d0: float) -> Array:
    """COMPONENTS (n, 15) of stress (n, 6) and gradient (n, 6, 3), gradients times d0."""
    return np.concatenate([stress, d0 * gradient[:, :3].reshape(len(stress), 9)], axis=1)


def _recovery(matrix: Array, name: str) -> Array:
    """COMPONENTS (15, pads) from pad stresses; quad and planar are the first pads of the cube, with plane modes."""
    layout = LAYOUTS[name]
    modes: Modes = PLANE if layout.planar else SPACE
    plane = SPACE.state(modes.stress, modes.gradient).T
    response = matrix[: layout.n_pads] @ plane
    return make_estimator(response, np.ones(layout.n_pads), modes, neglect=_NEGLECT[name]).matrix
