"""Finite elements of a plane section: quadratic triangles, a linear or a neo-Hookean material.

    nodal forces = ∫ P(F) : grad w dV,       F = 1 + grad u

Lengths are in units of d0, stresses in Pa.

Source: J. Bonet, R. D. Wood, Nonlinear Continuum Mechanics for Finite Element Analysis (2008), 9.6.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import skfem

from cube_tensor_driver.core.arrays import Array, Mask

from .material import Material
from .newton import Balance


class Section:
    """A meshed section.

    Attributes:
        mesh: The triangles.
        material: The material; its constants have the shape (elements, 1).
        basis: The elements, whose dofs are the unknown displacements u (dofs,), in d0.
        component: (dofs,) 0 where an unknown is along x, 1 along z.
        points: (elements, points, 2) positions of the quadrature points.
    """

    def __init__(self, mesh: skfem.MeshTri, material: Material) -> None:
        self.mesh = mesh
        self.material = material
        element = skfem.ElementVector(skfem.ElementTriP2())
        self.basis = skfem.Basis(mesh, element, intorder=4)
        points = np.asarray(self.basis.default_parameters()["x"])
        self.points = np.moveaxis(points, 0, -1)
        self.component = np.zeros(self.basis.N, dtype=int)
        all_dofs = self.basis.get_dofs(elements=True)
        self.component[all_dofs.all("u^2")] = 1
        self._dofs = self.basis.element_dofs.T
        self._shape = self.basis.dx.shape  # (elements, points)
        # d u_i / d x_j at the quadrature points is
        # slopes (elements, points, 2 i + j, n) @ u[dofs] (elements, n).
        gradients = [shape[0].grad for shape in self.basis.basis]
        slopes = np.stack(gradients, axis=-1)
        slopes = np.moveaxis(slopes, (0, 1), (2, 3))
        self._slopes = slopes.reshape(*self._shape, 4, -1)
        self._linear_tangent: sp.csr_matrix | None = None

    def node(self, x: float, z: float) -> int:
        """Return the number of the corner of an element that is nearest to this point."""
        nodes_x, nodes_z = self.mesh.p
        distance = np.hypot(nodes_x - x, nodes_z - z)
        return int(np.argmin(distance))

    def deformation(self, u: Array) -> Array:
        """Return F = 1 + grad u (elements, points, 2, 2)."""
        own_dofs = u[self._dofs]  # (elements, n)
        gradient = self._slopes @ own_dofs[:, None, :, None]
        gradient = gradient.reshape(*self._shape, 2, 2)
        return np.asarray(gradient + np.eye(2))

    def balance(self, u: Array) -> Balance | None:
        """Return nodal forces and energy; None when an element is inside out."""
        f = self.deformation(u)
        # A linear material knows no volume, so it has no limit.
        if self.material.finite and np.linalg.det(f).min() <= 0:
            return None
        density = self.material.energy(f)
        energy = float((density * self.basis.dx).sum())
        forces = self.forces(self.material.stress(f))
        return Balance(forces, energy)

    def forces(self, stress: Array, elements: Mask | slice = slice(None)) -> Array:
        """Return the nodal forces (dofs,) of a stress over some of the elements.

        Args:
            stress: (elements, points, 2, 2) in Pa.
            elements: Which elements count.
        """
        weighted = stress * self.basis.dx[..., None, None]
        weighted = weighted.reshape(*self._shape, 4)
        # Forces of each element e: the sum over its points p and stress components i.
        local = np.einsum("epi,epin->en", weighted[elements], self._slopes[elements])
        dofs = self._dofs[elements]
        total = np.bincount(dofs.ravel(), local.ravel(), self.basis.N)
        return np.asarray(total, dtype=float)

    def tangent(self, u: Array) -> sp.csr_matrix:
        """Return the derivative of the nodal forces by u, sparse (dofs, dofs).

        That of a linear material is the same everywhere, and is assembled once.
        """
        if self._linear_tangent is not None:
            return self._linear_tangent
        elements = len(self._dofs)
        n = len(self.basis.basis)
        # The moduli of a linear material are the same at all points of an element.
        own_points = self._shape[1] if self.material.finite else 1
        f = self.deformation(u)
        moduli = self.material.moduli(f)
        moduli = moduli.reshape(-1, own_points, 4, 4)
        # One matrix product per element: points and components are one axis of it.
        weights = self.basis.dx[..., None, None]
        weighted = (moduli * weights) @ self._slopes
        right = weighted.reshape(elements, -1, n)
        left = self._slopes.reshape(elements, -1, n)
        local = np.swapaxes(left, 1, 2) @ right
        rows = np.broadcast_to(self._dofs[:, :, None], local.shape)
        columns = np.broadcast_to(self._dofs[:, None], local.shape)
        size = (self.basis.N, self.basis.N)
        indices = (rows.ravel(), columns.ravel())
        entries = (local.ravel(), indices)
        matrix = sp.coo_matrix(entries, size).tocsr()
        if not self.material.finite:
            self._linear_tangent = matrix
        return matrix
