# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""How far each layout can be trusted under contacts that are not wide compared with the cube.

An indenter of growing width moves over a cube. The stress and gradient recovered from the pads are
compared with the true ones at the cube's centre. The pads feel the true field all over the cube,
not only its value and slope at the centre: the error shown is what the field's higher orders add.

Model: the contact field (mechanics/contact.py) acts as tractions on a box of twice the cube's side
around the rigid cube. The box moves with the cube, so a surface nearer than its top is not part of
the model. Each layout is calibrated with the linear modes on the same box.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.defaults import POISSONS_RATIO
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.estimator import make_estimator
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.modes import COMPONENTS, PLANE, SPACE, to_matrix
from cube_tensor_driver.mechanics import contact

from ..fem.body import Body, make_mesh
from ..fem.fem import (
    Progress,
    compute_pad_stresses,
    count_steps,
    make_mode_loads,
    make_outside_load,
    make_solid,
)
from ..fem.memory import check_memory

MAX_TRUSTED_ERROR = 0.2
"""Largest error of a component with which it counts as trusted, relative to the range that its true
value takes while the indenter passes."""
DEPTH = 5.5e-3
"""Depth of the cube's centre below the surface, in m."""
BOX_RATIO = 2.0
"""Ratio of the side of the computed box of elastomer to the side of the cube in it."""
FRICTION = 0.3
"""Ratio of the indenter's shear force to its normal force. The indenter slides towards +x, so that
there is shear under its centre, too."""
LATERAL_OFFSET = 1e-3
"""Distance along y at which the indenter passes the cube, in m."""
MAX_POINT_SPACING = 4e-3
"""Largest distance between the points of the contact's quadrature, in m: the side of the largest
cube."""
NEGLECTED_MODES = {
    "quad": ("xx", "xx_z", "xx_x"),
    "planar": (),
    "cube": (),
}
"""Names of the modes (linear stress fields) that each layout takes as zero, by its name."""


@dataclass(frozen=True, eq=False)
class LayoutStudy:
    """Error of each component, relative to the range of its true value as the indenter passes.

    Attributes:
        sides: (S,) sides of the cube, in m.
        widths: (W,) widths of the indenter, in m.
        offsets: (X,) positions of the indenter along x, in m.
        error: By layout (S, W, C), the largest |recovered - true| over the offsets divided by
            (max - min) of the true component; NaN where a layout does not observe it. The order is
            that of `COMPONENTS`.
    """

    sides: Array
    widths: Array
    offsets: Array
    error: dict[str, Array]

    def find_trusted_widths(self, layout: str) -> Array:
        """Return the width of the narrowest indenter from which on each error is below the limit.

        Args:
            layout: Name of the layout.

        Returns:
            (S, C) in m; infinite if even the widest indenter is not trusted, NaN where the layout
            does not observe the component.
        """
        error = self.error[layout]
        # Every wider indenter must be trusted, too, so they are counted from the widest one on.
        is_trusted = error[:, ::-1] <= MAX_TRUSTED_ERROR
        n_trusted = np.cumprod(is_trusted, axis=1).sum(axis=1)
        from_widest = np.append(np.inf, self.widths[::-1])
        is_observed = ~np.isnan(error[:, 0])
        return np.where(is_observed, from_widest[n_trusted], np.nan)

    def to_dict(self) -> dict[str, object]:
        """Return the content of the file of --json; NaN becomes null there."""
        return {**vars(self), "depth": DEPTH, "components": COMPONENTS}


@dataclass(frozen=True)
class _Passage:
    """One indenter at one offset along x from the centre of a cube; lengths in m."""

    side: float
    width: float
    offset: float

    def compute_field(self, x: Array) -> tuple[Array, Array]:
        """Return stress (n, 6) and gradient (n, 6, 3) at x (n, 3), in m from the cube's centre."""
        order = 4 + int(np.ceil(self.width / MAX_POINT_SPACING))
        force = [FRICTION, 0.0, -1.0]
        sources, forces = contact.disc(
            self.width / 2,
            force,
            (self.offset, 0.0),
            order,
        )
        points = x + np.array([0.0, LATERAL_OFFSET, -DEPTH])
        return contact.field(points, sources, forces, POISSONS_RATIO)

    def compute_components(self) -> Array:
        """Return true stress and gradient (15,) at the cube's centre, in Pa; the gradient is times
        d0, half the side of the cube."""
        stress, gradient = self.compute_field(np.zeros((1, 3)))
        slopes = self.side / 2 * gradient[0, :3]
        return np.concatenate([stress[0], slopes.ravel()])


def study_layouts(
    sides: Sequence[float] = (4e-3, 2e-3, 1e-3),
    widths: Sequence[float] = (1e-3, 2e-3, 5e-3, 10e-3, 15e-3, 20e-3),
    offsets: Sequence[float] = tuple(np.linspace(-12e-3, 12e-3, 9)),
    progress: Progress | None = None,
) -> LayoutStudy:
    """Slide a round indenter of each width over a cube of each side, along x.

    The indenter presses with 1 N, spread evenly, and drags with `FRICTION` N.

    Args:
        sides: Sides of the cube, in m.
        widths: Diameters of the indenter, in m.
        offsets: Positions of the indenter along x, in m.
        progress: Called before every solve and at the end.

    Raises:
        ElasticError: The box of a cube would reach the surface.
    """
    box_height = BOX_RATIO * max(sides) / 2
    if box_height >= DEPTH:
        raise ElasticError(
            f"the cube's centre is {DEPTH * 1e3:g} mm deep; a cube of {max(sides) * 1e3:g} mm "
            f"needs more than {box_height * 1e3:g} mm, or the study's box leaves the skin"
        )
    passages = list(itertools.starmap(_Passage, itertools.product(sides, widths, offsets)))
    matrix, pads = _solve_box(passages, progress)

    shape = (len(sides), len(widths), len(offsets), len(COMPONENTS))
    components = [passage.compute_components() for passage in passages]
    truth = np.array(components).reshape(shape)
    error = {}
    for name, layout in LAYOUTS.items():
        # The pads of quad and planar are the first ones of the cube.
        estimate = pads[: layout.n_pads].T @ _compute_recovery_matrix(matrix, name).T
        difference = estimate.reshape(shape) - truth
        largest = np.abs(difference).max(axis=2)
        error[name] = largest / np.ptp(truth, axis=2)
    return LayoutStudy(
        sides=np.asarray(sides),
        widths=np.asarray(widths),
        offsets=np.asarray(offsets),
        error=error,
    )


def _solve_box(
    passages: Sequence[_Passage],
    progress: Progress | None,
) -> tuple[Array, Array]:
    """Return response (pads, modes) and pad stresses (pads, passages) of a cube in its box."""
    # The cube is rigid; lengths are in units of its side.
    body = Body(
        width=BOX_RATIO,
        depth=BOX_RATIO,
        height=BOX_RATIO,
        side=1.0,
        poisson=POISSONS_RATIO,
        cube_young=np.inf,
    )
    layout = LAYOUTS["cube"]
    grid = make_mesh(body, layout, 0)
    check_memory(grid)
    solid = make_solid(body, layout, grid)

    known_fields: dict[bytes, Array] = {}

    def compute_field(x: Array) -> Array:
        key = x.tobytes()
        if key not in known_fields:  # every parity asks for the same points
            stresses = [passage.compute_field(passage.side / 2 * x)[0] for passage in passages]
            known_fields[key] = to_matrix(np.stack(stresses, axis=1))
        return known_fields[key]

    # All parities are solved for the modes and for the passages.
    report = count_steps(progress, 2 * len(solid.parities))
    matrix = compute_pad_stresses(
        solid,
        layout,
        make_mode_loads(solid, layout),
        report,
    )
    pads = compute_pad_stresses(
        solid,
        layout,
        make_outside_load(solid, compute_field),
        report,
    )
    report("done")
    return matrix, pads


def _compute_recovery_matrix(matrix: Array, name: str) -> Array:
    """Return the matrix (15, pads) from the pad stresses of a layout to `COMPONENTS`."""
    layout = LAYOUTS[name]
    modes = PLANE if layout.planar else SPACE
    # A layout in a plane has plane modes only. `amplitudes` has those of the modes in
    # space that each mode of the layout stands for.
    amplitudes = SPACE.compute_amplitudes(modes.stress, modes.gradient).T
    response = matrix[: layout.n_pads] @ amplitudes
    noise = np.ones(layout.n_pads)
    return make_estimator(response, noise, modes, neglect=NEGLECTED_MODES[name]).matrix
