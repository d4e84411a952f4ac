# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Stress of the pads of a cube under its own weight and inertia, and under those of the elastomer.

With the specific force s (acceleration minus gravity), a force -rho s per volume acts in elastomer
and cube. With the stiffness K of body and cube, K_b of the body alone, the part f_b of the nodal
forces that acts in the body and the weights w of pads.py, the mean normal stress of a pad is::

    f_i = -int rho s . w_i dV,   K u = f,   stress = w . (K_b u - f_b)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.layout import Layout

from .body import Body, field_axes
from .fem import Progress, count_steps, solve_meshes
from .solid import Solid


@dataclass(frozen=True, eq=False)
class WeightResponse:
    """Response of the pads of a cube in a layer on rigid ground to specific force.

    Attributes:
        body: The body, with its ground.
        layout: Pads of the cube.
        pads: Stress on each pad (pads, 3), in Pa per m/s² of the specific force along x, y and z.
        change: Largest change of an entry from the second finest mesh, relative to the largest
            entry; None: there is one mesh.
    """

    body: Body
    layout: Layout
    pads: Array
    change: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return plain types for JSON."""
        return {
            "layout": self.layout.to_dict(),
            "body": self.body.to_dict(),
            "pads": self.pads.tolist(),
            "change": self.change,
        }


def compute_weight(
    body: Body,
    layout: Layout,
    meshes: int = 1,
    progress: Progress | None = None,
) -> WeightResponse:
    """Compute the response to specific force of a cube in a skin without edges.

    Args:
        body: The body; its lower face is taken as bonded to rigid ground, and its width as the
            pitch of the cubes.
        layout: Pads of the cube.
        meshes: Number of meshes, 1 to 3; the last one gives the result.
        progress: Called before every solve and at the end.

    Raises:
        ElasticError: Pads overlap, or the mesh does not fit into memory.
    """
    # In a skin of equal cells it does not matter where the cells are cut along x.
    body = replace(body, ground=True, confined=True, x=0.0)
    axes = field_axes(layout)
    report = count_steps(progress, meshes * len(axes))

    def solve(solid: Solid, mesh: int) -> Array:
        pads = np.zeros((layout.n_pads, 3))
        for number, axis in enumerate(axes):
            report(f"mesh {mesh}, force along {'xyz'[axis]}")
            pads[:, axis] = _solve(solid, body, layout, number)
        return pads

    pads, change = solve_meshes(body, layout, meshes, solve)
    report("done")
    return WeightResponse(body, layout, pads, change)


def _solve(solid: Solid, body: Body, layout: Layout, axis: int) -> Array:
    """Return the stress of the pads (P,) under a specific force along one axis of the solid, in Pa
    per m/s²."""
    in_body = -body.density * solid.body_forces(axis, in_cube=False)
    in_cube = -body.cube_density * solid.body_forces(axis, in_cube=True)
    # A uniform force along an axis is odd under the mirror of this axis, and even under the others.
    wanted = [-1 if k == axis else 1 for k in range(solid.dim)]
    parity = next(
        parity
        for parity in solid.parities
        if all(sign in (0, want) for sign, want in zip(parity, wanted, strict=True))
    )
    force = in_body + in_cube
    displacement = solid.solve(parity, force[:, None])[:, 0]
    reactions = solid.body @ displacement - in_body
    # Lengths of the solid are in d0, so stress is force per volume times d0.
    weights = solid.pad_weights(layout, parity)
    stress: Array = body.side / 2 * (weights @ reactions)
    return stress
