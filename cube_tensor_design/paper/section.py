# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Finite elements of a plane section: quadratic triangles, a linear or a neo-Hookean material.

    nodal forces = ∫ P(F) : grad w dV,       F = 1 + grad u

Lengths are in units of d0, stresses in Pa.

Source: J. Bonet, R. D. Wood, Nonlinear Continuum Mechanics for Finite Element Analysis (2008), 9.6.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import skfem
from skfem.helpers import det

from cube_tensor_driver.core.arrays import Array, Mask

from ..fem.solid import make_sample_matrix
from .material import IDENTITY, Material
from .newton import Balance


class Section:
    """A meshed section of E elements with Q quadrature points each.

    Attributes:
        mesh: The triangles.
        material: The material; its constants have the shape (E, 1).
        basis: The elements, whose dofs are the unknown displacements u (dofs,), in d0 (half the
            side of the cube).
        component: (dofs,) 0 where an unknown is along x, 1 along z.
        points: (2, E, Q) positions of the quadrature points, in d0 (half the side of the cube).
    """

    def __init__(self, mesh: skfem.MeshTri, material: Material) -> None:
        self.mesh = mesh
        self.material = material
        element = skfem.ElementVector(skfem.ElementTriP2())
        self.basis = skfem.Basis(mesh, element, intorder=4)
        self.points = np.asarray(self.basis.default_parameters()["x"])
        self.component = np.arange(self.basis.N) % 2

        # This sparse matrix computes the gradients d u_i / d x_j (2, 2, E, Q) at all quadrature
        # points from the unknowns u.
        gradients = [shape[0].grad for shape in self.basis.basis]
        slopes = np.stack(gradients)
        self._gradient = make_sample_matrix(self.basis, slopes)
        self._linear_tangent: sp.csr_matrix | None = None
        self._set_up_tangent(slopes)

    def _set_up_tangent(self, slopes: Array) -> None:
        """Prepare what all tangents share.

        Args:
            slopes: Gradients (n, 2, 2, E, Q) of the n shape functions of each element.

        This sets `_slopes` (E, Q, 4, n), these gradients by quadrature point; `_rows` and
        `_columns`, which of the unknowns each entry of the sparse tangent belongs to; and `_entry`
        (E x n x n,), the entry to which a pair of unknowns of an element contributes.
        """
        n, _, _, *points = slopes.shape
        by_component = slopes.reshape(n, 4, *points)
        by_point = by_component.transpose(2, 3, 1, 0)
        self._slopes = np.ascontiguousarray(by_point)
        size = self.basis.N
        dofs = self.basis.element_dofs.T.astype(np.int64)
        rows = np.repeat(dofs, n, axis=1)
        columns = np.tile(dofs, (1, n))
        pairs = rows.ravel() * size + columns.ravel()
        entries, self._entry = np.unique(pairs, return_inverse=True)
        self._rows, self._columns = np.divmod(entries, size)

    def find_node(self, x: float, z: float) -> int:
        """Return the number of the corner of an element that is nearest to this point."""
        node_x, node_z = self.mesh.p
        distance = np.hypot(node_x - x, node_z - z)
        return int(distance.argmin())

    def compute_deformation(self, u: Array) -> Array:
        """Return the gradient of the deformation F = 1 + grad u (2, 2, E, Q) at the quadrature
        points."""
        gradient = self._gradient @ u
        by_component = gradient.reshape(2, 2, *self.basis.dx.shape)
        return by_component + IDENTITY

    def balance(self, u: Array) -> Balance | None:
        """Return nodal forces (dofs,) and energy; None when an element is turned inside out."""
        f = self.compute_deformation(u)
        # Linear theory does not limit the change of volume.
        if self.material.finite and det(f).min() <= 0:
            return None
        density = self.material.compute_energy(f)
        energy = float((density * self.basis.dx).sum())
        forces = self.compute_forces(self.material.compute_stress(f))
        return Balance(forces, energy)

    def compute_forces(self, stress: Array, elements: Mask | bool = True) -> Array:
        """Return the nodal forces (dofs,) of a stress over some of the elements.

        Args:
            stress: (2, 2, E, Q) in Pa.
            elements: (E,) whether an element counts; True: all count.
        """
        is_counted = np.reshape(elements, (-1, 1))
        volume = self.basis.dx * is_counted
        weighted = stress * volume
        return weighted.ravel() @ self._gradient

    def compute_tangent(self, u: Array) -> sp.csr_matrix:
        """Return the derivative of the nodal forces by u, sparse (dofs, dofs).

        The derivative of a linear material does not depend on u, and is assembled once.
        """
        if self._linear_tangent is not None:
            return self._linear_tangent
        volume = self.basis.dx
        n_elements, n_points = volume.shape
        moduli = self.material.compute_moduli(self.compute_deformation(u))
        weighted = moduli * volume
        by_component = weighted.reshape(4, 4, n_elements, n_points)
        by_point = np.moveaxis(by_component, (0, 1), (2, 3))

        # In each element, all quadrature points and components are summed by one product.
        n = self._slopes.shape[-1]
        slopes = self._slopes.reshape(n_elements, -1, n)
        stress_change = by_point @ self._slopes
        stress_change = stress_change.reshape(slopes.shape)
        by_element = slopes.swapaxes(1, 2) @ stress_change

        values = np.bincount(self._entry, by_element.ravel())
        places = self._rows, self._columns
        size = self.basis.N
        matrix = sp.csr_matrix((values, places), (size, size))
        if not self.material.finite:
            self._linear_tangent = matrix
        return matrix
