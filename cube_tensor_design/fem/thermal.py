# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Thermal stress of the pads: the elastomer around a cube expands, and the cube does not.

The strain alpha T of free expansion acts like a pressure p in the elastomer. With the stiffness K
of body and cube, K_b of the body alone and the weights w of pads.py, the mean normal stress of a
pad is::

    p = E alpha T / (1 - 2 nu),   E alpha T / (1 - nu) in plane stress
    f_i = int p div w_i dV,       K u = f,     stress = w . (K_b u - f)

The temperature T depends on the height in the layer alone, as heat that enters through the ground
or the surface makes it. It is a sum of Legendre polynomials, and so is the stress.

Source: B. A. Boley, J. H. Weiner, Theory of Thermal Stresses (1960), 3.3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.layout import Layout

from .body import Body
from .fem import Progress, count_steps, solve_meshes
from .solid import Solid

N_PROFILES = 6
"""Number of Legendre polynomials of the height, 1 + the highest degree. The diffusion of heat
damps higher ones within a second in a layer of 11 mm."""


@dataclass(frozen=True, eq=False)
class ThermalStress:
    """Thermal stress of the pads of a cube in a layer on rigid ground.

    Attributes:
        body: The body, with its ground.
        layout: Pads of the cube.
        pads: Stress on each pad (pads, `N_PROFILES`), in Pa per K of the temperature P_k(s). P_k is
            the Legendre polynomial of degree k, and s grows from -1 at the ground to 1 at the
            surface; so column 0 is for a uniform change of the temperature.
        change: Largest change of an entry from the second finest mesh, relative to the largest
            entry; None: there is one mesh.
    """

    body: Body
    layout: Layout
    pads: Array
    change: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return plain types, as the simulator reads them from a file."""
        return {
            "layout": self.layout.name,
            "height": self.body.height,
            "depth": self.body.height / 2 - self.body.z,
            "side": self.body.side,
            "pads": np.round(self.pads, 3).tolist(),
        }


def compute_thermal_stress(
    body: Body,
    layout: Layout,
    meshes: int = 1,
    progress: Progress | None = None,
) -> ThermalStress:
    """Compute the thermal stress of a cube in a layer whose sides do not move.

    Args:
        body: The body; its lower face is taken as bonded to rigid ground, and its sides as those of
            a cell in a skin without edges, so that its width is the pitch of the cubes.
        layout: Pads of the cube.
        meshes: Number of meshes, 1 to 3; the last one gives the result.
        progress: Called before every mesh and at the end.

    Raises:
        ElasticError: Pads overlap, or the mesh does not fit into memory.
    """
    body = replace(body, ground=True, confined=True)
    report = count_steps(progress, meshes)

    def solve(solid: Solid, number: int) -> Array:
        report(f"mesh {number}")
        return _solve(solid, body, layout)

    pads, change = solve_meshes(body, layout, meshes, solve)
    report("done")
    return ThermalStress(body, layout, pads, change)


def _solve(solid: Solid, body: Body, layout: Layout) -> Array:
    """Return the stress (pads, profiles) under each profile of the temperature, in Pa/K."""
    # Lengths of the solid are in d0, and moduli are relative to that of the elastomer.
    half = body.height / body.side
    z = body.z / (body.side / 2)

    def profiles(x: Array) -> Array:
        heights = (x[-1] + z) / half
        return np.moveaxis(legvander(heights, N_PROFILES - 1), -1, 0)

    # In plane stress, the body is free along y and expands there without stress.
    n_held = 2 if layout.planar and body.plane == "stress" else 3
    parts = []
    expansions = body.expansion, body.cube_expansion
    for number, expansion in enumerate(expansions):
        lam, mu = solid.moduli[number] or (0.0, 0.0)
        pressure = expansion * (n_held * lam + 2 * mu)
        forces = solid.expansion_forces(profiles, in_cube=number == 1)
        parts.append(pressure * forces)
    # A field that depends on the height alone is even under each mirror.
    parity = next(parity for parity in solid.parities if min(parity) >= 0)
    displacement = solid.solve(parity, parts[0] + parts[1])
    reactions = solid.body @ displacement - parts[0]
    weights = solid.pad_weights(layout, parity)
    stress: Array = body.young * (weights @ reactions)
    return stress
