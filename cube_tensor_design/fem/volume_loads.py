# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Stress of the pads of a cube in a layer on rigid ground, under loads in the whole volume.

Such a load has nodal forces f_b in the elastomer and f_c in the cube. With the stiffness K of body
and cube, K_b of the body alone and the weights w of pads.py, the mean normal stress of a pad is::

    K u = f_b + f_c,     stress = w . (K_b u - f_b)

*Temperature*: the elastomer around a cube expands, and the cube does not. The strain alpha T of
free expansion acts like a pressure p. The temperature T depends on the height in the layer alone,
as heat that enters through the ground or the surface makes it. It is a sum of Legendre polynomials,
and so is the stress::

    p = E alpha T / (1 - 2 nu),   E alpha T / (1 - nu) in plane stress
    f_i = int p div w_i dV

*Weight and inertia*: with the specific force s (acceleration minus gravity), a force -rho s per
volume acts in elastomer and cube::

    f_i = -int rho s . w_i dV

Source: B. A. Boley, J. H. Weiner, Theory of Thermal Stresses (1960), 3.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import skfem
from numpy.polynomial.legendre import legvander

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.layout import Layout

from .body import Body, choose_field_axes
from .fem import Load, Progress, solve_meshes
from .solid import Parity, Solid, list_mirror_images

N_PROFILES = 6
"""Number of Legendre polynomials of the height, 1 + the highest degree. The diffusion of heat
damps higher ones within a second in a layer of 11 mm."""


@dataclass(frozen=True, eq=False)
class VolumeResponse:
    """Response of the pads of a cube in a layer on rigid ground to loads in the whole volume.

    Attributes:
        body: The body, with its ground.
        layout: Pads of the cube.
        pads: Stress on each pad (pads, loads). For temperature, the loads are `N_PROFILES` profiles
            P_k(s) of 1 K, in Pa/K: P_k is the Legendre polynomial of degree k, and s grows from -1
            at the ground to 1 at the surface, so that column 0 is for a uniform change. For weight,
            they are specific forces along x, y and z, in Pa per m/s².
        change: Largest change of an entry from the second finest mesh, relative to the largest
            entry; None: there is one mesh.
    """

    body: Body
    layout: Layout
    pads: Array
    change: float | None

    def to_dict(self) -> dict[str, object]:
        """Return the content of the file of --json."""
        return {
            **vars(self),
            "layout": self.layout.to_dict(),
            "body": vars(self.body),
        }


class ThermalStress(VolumeResponse):
    """Response to profiles of the temperature."""

    def to_dict(self) -> dict[str, object]:
        """Return plain types, as the simulator reads them from a file."""
        return {
            "layout": self.layout.name,
            "height": self.body.height,
            "depth": self.body.depth_of_cube,
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
        progress: Called before every solve and at the end.

    Raises:
        ElasticError: Pads overlap, or the mesh does not fit into memory.
    """
    body = replace(body, ground=True, confined=True)
    # Lengths of the solid are in d0, and moduli are relative to that of the elastomer.
    half_height = body.height / body.side
    z = body.z / (body.side / 2)
    # In plane stress, the body is free along y and expands there without stress.
    n_held = 2 if layout.planar and body.plane == "stress" else 3
    expansions = body.expansion, body.cube_expansion

    def make_load(solid: Solid) -> Load:
        parts = []
        for number, (lam, mu) in enumerate(solid.moduli):
            basis = solid.select_elements(in_cube=number == 1)
            x = np.asarray(basis.default_parameters()["x"])
            heights = (x[-1] + z) / half_height
            profiles = legvander(heights, N_PROFILES - 1)
            stiffness = n_held * lam + 2 * mu
            pressures = expansions[number] * stiffness * profiles
            # The work of a pressure in a test function w of component k is p dw/dx_k.
            forces = [
                [
                    skfem.LinearForm(lambda w, at, k=k: at.p * w.grad[k]).assemble(basis, p=p)
                    for p in np.moveaxis(pressures, -1, 0)
                ]
                for k in range(solid.dim)
            ]
            # From (components, profiles, nodes) to (dofs, profiles).
            parts.append(np.transpose(forces, (2, 0, 1)).reshape(-1, N_PROFILES))
        # A field that depends on the height alone is even under each mirror.
        return lambda parity: [part * (min(parity) >= 0) for part in parts]

    results = solve_meshes(body, layout, meshes, make_load, progress)
    finest = results[-1]
    return ThermalStress(
        body,
        layout,
        body.young * finest.pads,
        finest.change,
    )


def compute_weight(
    body: Body,
    layout: Layout,
    meshes: int = 1,
    progress: Progress | None = None,
) -> VolumeResponse:
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
    axes = choose_field_axes(layout)
    densities = body.density, body.cube_density

    def make_load(solid: Solid) -> Load:
        parts = []
        for number, density in enumerate(densities):
            elements = solid.select_elements(in_cube=number == 1)
            volume = skfem.LinearForm(lambda w, _: w).assemble(elements)
            # A force along one axis acts on this component of each node.
            by_component = np.kron(volume[:, None], np.eye(solid.dim))
            parts.append(-density * by_component)

        def select_parity(parity: Parity) -> Sequence[Array]:
            images, weights = list_mirror_images(parity)
            # A uniform force along an axis is odd under the mirror of that axis, and even under the
            # others. So `has_parity` is 1 for the axes along which forces have this parity, else 0.
            has_parity = weights @ images
            return [part * has_parity for part in parts]

        return select_parity

    results = solve_meshes(body, layout, meshes, make_load, progress)
    pads = np.zeros((layout.n_pads, 3))
    # Lengths of the solid are in d0, so stress is force per volume times d0.
    pads[:, axes] = body.side / 2 * results[-1].pads
    return VolumeResponse(body, layout, pads, results[-1].change)
