# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A rigid round punch on an elastic layer, by finite elements: an independent check of layer.py.

The punch is flat and has no friction; the layer is bonded to rigid ground. Everything is symmetric
about the axis, so the displacements u_r and u_z depend on r and z, and hoop strain is u_r / r::

    int (lambda tr(eps) tr(eps') + 2 mu eps : eps') r dr dz = 0,    u_z = -1 under the punch

Source: T. J. R. Hughes, The Finite Element Method (1987), 2.11 (axisymmetric).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import skfem
from skfem.helpers import ddot, sym_grad

from cube_tensor_design.fem.solid import lame
from cube_tensor_driver.core.arrays import Array


@dataclass(frozen=True, eq=False)
class PressedLayer:
    """A layer under a punch with a force of 1 N.

    Attributes:
        radius: (n,) radii of the rings under the punch, in m.
        force: (n,) force on each ring, in N.
        basis: The elements.
        displacement: (dofs,) displacement per N, in 1 / (Pa m).
        moduli: Lame's lambda and mu, over Young's modulus.
    """

    radius: Array
    force: Array
    basis: Any
    displacement: Array
    moduli: tuple[float, float]

    def stress(self, r: Array, depth: float) -> Array:
        """Return rr, tt, zz and rz (m, 4) in Pa at radii r (m,) above 0, at one depth in m."""
        points = np.stack([r, np.full(len(r), -depth)])
        return np.array([self._stress_at(point[:, None]) for point in points.T])

    def _stress_at(self, point: Array) -> Array:
        """Return the stress (4,) from the displacement of the element that holds the point."""
        mesh, element = self.basis.mesh, self.basis.elem
        cell = mesh.element_finder()(*point)
        local = mesh.mapping().invF(point[:, :, None], tind=cell)
        u, gradient = np.zeros(2), np.zeros((2, 2))
        for i, dof in enumerate(self.basis.element_dofs[:, cell[0]]):
            shape = element.gbasis(mesh.mapping(), local, i, tind=cell)[0]
            u += self.displacement[dof] * np.asarray(shape)[:, 0, 0]
            gradient += self.displacement[dof] * shape.grad[:, :, 0, 0]
        lam, mu = self.moduli
        hoop = u[0] / point[0, 0]
        spread = lam * (gradient[0, 0] + gradient[1, 1] + hoop)
        return np.array(
            [
                spread + 2 * mu * gradient[0, 0],
                spread + 2 * mu * hoop,
                spread + 2 * mu * gradient[1, 1],
                mu * (gradient[0, 1] + gradient[1, 0]),
            ]
        )


def press_layer(
    thickness: float, radius: float, poisson: float, width: float, cells: int = 24
) -> PressedLayer:
    """Press a flat punch on a layer.

    Args:
        thickness: Thickness of the layer, in m.
        radius: Radius of the punch, in m.
        poisson: Poisson's ratio of the layer.
        width: Radius to which the layer is meshed, in m.
        cells: Number of elements across the punch's radius and across the thickness.
    """
    # Elements shrink towards the edge of the punch, where the pressure is infinite.
    r = np.unique(
        np.concatenate(
            [
                radius * (1 - np.geomspace(1, 1e-3, cells) + 1e-3),
                radius + (width - radius) * np.geomspace(1e-4, 1, 2 * cells),
                [0.0, radius],
            ]
        ).round(9)
    )
    z = -thickness * (np.geomspace(1e-3, 1, 2 * cells) - 1e-3) / (1 - 1e-3)
    mesh = skfem.MeshQuad.init_tensor(r, np.sort(z))
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementQuad2()), intorder=6)
    moduli = lame(1.0, poisson)
    matrix = _work.assemble(basis, lam=moduli[0], mu=moduli[1])
    x, y = basis.doflocs
    along_z = np.zeros(basis.N, bool)
    along_z[basis.get_dofs(elements=True).all("u^2")] = True
    top = np.abs(y) < 1e-12
    pressed = np.flatnonzero(top & along_z & (x <= radius * (1 + 1e-9)))
    held = (np.abs(y + thickness) < 1e-12) | ((np.abs(x) < 1e-12) & ~along_z)
    displacement = np.zeros(basis.N)
    displacement[pressed] = -1.0
    fixed = np.union1d(pressed, np.flatnonzero(held))
    displacement = skfem.solve(*skfem.condense(matrix, x=displacement, D=fixed))
    force = -2 * np.pi * (matrix @ displacement)[pressed]
    total = force.sum()
    return PressedLayer(x[pressed], force / total, basis, displacement / total, moduli)


@skfem.BilinearForm
def _work(u, v, p):
    r = p.x[0]
    e, d = sym_grad(u), sym_grad(v)
    spread = e[0, 0] + e[1, 1] + u[0] / r
    spread_v = d[0, 0] + d[1, 1] + v[0] / r
    return (p.lam * spread * spread_v + 2 * p.mu * (ddot(e, d) + u[0] * v[0] / r**2)) * r
