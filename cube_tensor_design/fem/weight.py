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

from .body import Body, check_pads, field_axes, make_mesh
from .fem import Progress, count_steps, make_solid
from .memory import check_memory
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
    check_pads(body, layout)
    axes = field_axes(layout)
    report = count_steps(progress, meshes * len(axes))
    results = []
    for level in range(meshes):
        grid = make_mesh(body, layout, level)
        check_memory(grid)
        solid = make_solid(body, layout, grid)
        pads = np.zeros((layout.n_pads, 3))
        for number, axis in enumerate(axes):
            report(f"mesh {level + 1}, force along {'xyz'[axis]}")
            pads[:, axis] = _solve(solid, body, layout, number)
        results.append(pads)
    report("done")
    change = None
    if meshes > 1:
        fine, coarse = results[-1], results[-2]
        change = float(np.abs(fine - coarse).max() / np.abs(fine).max())
    return WeightResponse(body, layout, results[-1], change)


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
    displacement = solid.solve(parity, (in_body + in_cube)[:, None])[:, 0]
    reactions = solid.body @ displacement - in_body
    # Lengths of the solid are in d0, so stress is force per volume times d0.
    stress: Array = body.side / 2 * (solid.pad_weights(layout, parity) @ reactions)
    return stress
