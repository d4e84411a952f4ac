"""How far each layout can be trusted: an indenter of growing width is moved over a cube, and the
stress and gradient recovered from the pads are compared with the true ones at the cube's centre.

The pads see the true field all over the cube, not only its value and slope at the centre: what a
field of higher order adds is the error that this study shows. The contact field (elastic.contact)
acts as tractions on a box of twice the cube's side around the rigid cube; the box moves with the
cube, so a surface nearer than its top is not part of the model. Each layout is calibrated with the
linear modes on the same box.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ElasticError
from ..core.estimator import make_estimator
from ..core.layout import LAYOUTS
from ..core.modes import COMPONENTS, PLANE, SPACE, Modes, to_matrix
from ..elastic import contact
from ..elastic.body import Body, check_memory, make_mesh
from ..elastic.fem import Progress, linear_response, make_solid, pad_stresses

Array = NDArray[np.float64]

_BOX = 2.0  # sides of the box over the cube's side
_FRICTION = 0.3  # the indenter slides towards +x, so that there is shear under its middle too
_NEGLECT = {"quad": ("xx", "xx_z", "xx_x"), "planar": (), "cube": ()}


@dataclass(frozen=True, eq=False)
class Study:
    """Error of each component, relative to the range it takes as the indenter passes.

    sides (S,) of the cube, widths (W,) and offsets (X,) of the indenter, depth of the cube's
    centre, m
    truth: (S, W, X, C) components in the order of core.modes.COMPONENTS, gradients times d0, per N
    of force, Pa
    recovered: {layout: (S, W, X, C)}, NaN where a layout does not observe a component
    error: {layout: (S, W, C)} the largest |recovered - truth| over the offsets / (max - min of
    truth)
    """

    sides: Array
    widths: Array
    offsets: Array
    depth: float
    truth: Array
    recovered: dict[str, Array]
    error: dict[str, Array]

    def trusted(self, limit: float = 0.2) -> list[tuple[str, float, str, float | None]]:
        """Rows (layout, side, component, width): from that width on the error stays below limit;
        None: never."""
        rows: list[tuple[str, float, str, float | None]] = []
        for (name, error), (i, side) in itertools.product(
            self.error.items(), enumerate(self.sides)
        ):
            for k, component in enumerate(COMPONENTS):
                if not np.isnan(error[i, 0, k]):
                    bad = np.flatnonzero(error[i, :, k] > limit)
                    first = bad[-1] + 1 if len(bad) else 0
                    width = float(self.widths[first]) if first < len(self.widths) else None
                    rows.append((name, float(side), component, width))
        return rows

    def to_dict(self) -> dict[str, Any]:
        """Plain types for JSON; None where a layout does not see a component."""
        error = {name: _plain(e.tolist()) for name, e in self.error.items()}
        axes = {name: getattr(self, name).tolist() for name in ("sides", "widths", "offsets")}
        return {**axes, "depth": self.depth, "components": list(COMPONENTS), "error": error}


def _plain(value: Any) -> Any:
    """Lists of numbers with None for NaN, which JSON does not know."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if np.isnan(value) else value


def study(
    sides: Sequence[float] = (4e-3, 2e-3, 1e-3),
    widths: Sequence[float] = (1e-3, 2e-3, 5e-3, 10e-3, 15e-3, 20e-3),
    offsets: Sequence[float] = tuple(np.linspace(-12e-3, 12e-3, 9)),
    depth: float = 5.5e-3,
    poisson: float = 0.48,
    progress: Progress | None = None,
) -> Study:
    """Slide a round indenter of each width (its diameter) over a cube of each side, along x at y =
    1 mm.

    It presses with 1 N, spread evenly, and drags with 0.3 N. Raises ElasticError when a cube's box
    would reach the surface.
    """
    if depth <= _BOX * max(sides) / 2:
        raise ElasticError(
            f"the cube's centre is {depth * 1e3:g} mm deep; a cube of {max(sides) * 1e3:g} mm needs more than "
            f"{_BOX * max(sides) / 2 * 1e3:g} mm, or the study's box leaves the skin"
        )
    loads = list(itertools.product(sides, widths, offsets))
    body = Body(
        _BOX, _BOX, _BOX, side=1.0, poisson=poisson, cube_young=np.inf
    )  # lengths in units of the side
    layout = LAYOUTS["cube"]
    grid = make_mesh(body, layout, 0)
    check_memory(grid)
    solid = make_solid(body, layout, grid)
    cache: dict[bytes, Array] = {}
    done = itertools.count()

    def field(x: Array) -> Array:
        if x.tobytes() not in cache:  # every parity asks for the same points
            stresses = [
                _stress(side / 2 * x, width, offset, depth, poisson)[0]
                for side, width, offset in loads
            ]
            cache[x.tobytes()] = to_matrix(np.stack(stresses, axis=1))
        return cache[x.tobytes()]

    def report(what: str) -> None:
        if progress is not None:
            progress(next(done), 16, what)

    matrix = linear_response(solid, layout, report)
    pads = pad_stresses(solid, layout, lambda parity: solid.outer_forces(parity, field), report)
    report("done")
    shape = (len(sides), len(widths), len(offsets), len(COMPONENTS))
    truth = np.concatenate([_components(*load, depth, poisson) for load in loads]).reshape(shape)
    recovered = {
        name: (pads[: LAYOUTS[name].n_pads].T @ _recovery(matrix, name).T).reshape(shape)
        for name in LAYOUTS
    }
    error = {
        name: np.abs(found - truth).max(axis=2) / np.ptp(truth, axis=2)
        for name, found in recovered.items()
    }
    return Study(
        np.asarray(sides), np.asarray(widths), np.asarray(offsets), depth, truth, recovered, error
    )


def _stress(
    x: Array, width: float, offset: float, depth: float, poisson: float
) -> tuple[Array, Array]:
    """Stress (n, 6) and gradient (n, 6, 3) of one indenter at x (n, 3), m from the cube's
    centre."""
    order = 4 + int(np.ceil(width / 4e-3))  # points no further apart than the box is deep
    sources, forces = contact.disc(width / 2, [_FRICTION, 0.0, -1.0], (offset, 0.0), order)
    return contact.field(x + np.array([0.0, 1e-3, -depth]), sources, forces, poisson)


def _components(side: float, width: float, offset: float, depth: float, poisson: float) -> Array:
    """True COMPONENTS (1, 15) at the cube's centre, gradients times d0."""
    stress, gradient = _stress(np.zeros((1, 3)), width, offset, depth, poisson)
    return np.concatenate([stress, side / 2 * gradient[:, :3].reshape(1, 9)], axis=1)


def _recovery(matrix: Array, name: str) -> Array:
    """COMPONENTS (15, pads) from pad stresses; quad and planar are the first pads of the cube, with
    plane modes."""
    layout = LAYOUTS[name]
    modes: Modes = PLANE if layout.planar else SPACE
    plane = SPACE.state(modes.stress, modes.gradient).T
    response = matrix[: layout.n_pads] @ plane
    return make_estimator(response, np.ones(layout.n_pads), modes, neglect=_NEGLECT[name]).matrix
