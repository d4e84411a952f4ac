"""A rigid rod pressed into the top of the bench's body: smooth, without friction, rounded edges.

The rod's lower side is z = h(x). What lies above it by g = z - h(x) is pushed back with the
pressure k p dp/dg, the derivative of the energy k p² / 2 per length of the undeformed surface. The
penetration p is max(g, 0), rounded off over a short length so that Newton's method can follow it.
The force is along the rod's normal. Lengths in d0.

Source: P. Wriggers, Computational Contact Mechanics (2006), 6.3 (penalty method); the rounding of p
is ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import skfem

from cube_tensor_driver.core.arrays import Array

_STIFFNESS = 300.0
"""k over Young's modulus, per d0: a pressure of three times E pushes in by a hundredth of d0."""
_ONSET = 0.001
"""Length over which the contact sets in, d0."""
_SAME = 1e-9
"""Displacements that differ by less are the same, d0."""


@dataclass(frozen=True)
class Rod:
    """A rod; its flat part ends `edge_radius` before its edges, in parabolas. Lengths in m.

    pressed: how deep its lowest point is below the undeformed top
    position: of its middle along x
    edge_radius: of curvature of the parabolas at their apex

    Sides of elements, as far as they are stretched, must be short beside the radius. Where they are
    not, a node stays on the rod's edge while the surface slides round it, and how far it slides
    depends on the steps of the load.
    """

    pressed: float
    position: float
    width: float = 5e-3
    edge_radius: float = 1e-3

    def lower_side(self, x: Array, top: float, unit: float) -> tuple[Array, Array, Array]:
        """h, dh/dx and d²h/dx² at x; x, top and h are in units of `unit` m."""
        radius = self.edge_radius / unit
        flat = (self.width / 2 - self.edge_radius) / unit
        away = x - self.position / unit
        s = np.maximum(np.abs(away) - flat, 0.0)
        h = top - self.pressed / unit + s**2 / (2 * radius)
        return h, np.sign(away) * s / radius, (s > 0) / radius


class RodContact:
    """Energy, nodal forces and tangent of a rod on the facets of a basis.

    unit: m per unit of length of the basis; young: Young's modulus of the body, Pa
    finite: the rod meets the surface where it has moved to along x; otherwise (linear theory) where
    it was
    """

    def __init__(
        self, facets: skfem.FacetBasis, rod: Rod, unit: float, young: float, finite: bool
    ) -> None:
        self._facets, self._rod, self._unit = facets, rod, unit
        self._stiffness, self._finite = _STIFFNESS * young, float(finite)

    def energy(self, u: Array) -> float:
        p, *_ = self._penetration(u)
        return float((self._stiffness / 2 * p**2 * self._facets.dx).sum())

    def force(self, u: Array) -> Array:
        """Nodal forces (dofs,) at displacements u (dofs,)."""
        p, dp, _, slope, _ = self._penetration(u)
        return _push.assemble(self._facets, pressure=self._stiffness * p * dp, slope=slope)

    def tangent(self, u: Array, curved: bool = True) -> Array:
        """Derivative of the nodal forces, sparse (dofs, dofs).

        curved=False leaves out the rod's curvature, which can make the tangent indefinite.
        """
        p, dp, ddp, slope, curvature = self._penetration(u)
        normal = self._stiffness * (dp**2 + p * ddp)
        bending = -self._stiffness * p * dp * curvature * curved
        return _push_change.assemble(self._facets, normal=normal, slope=slope, bending=bending)

    def secant(self, u: Array, v: Array) -> sp.csr_matrix:
        """Sparse (dofs, dofs) S with S (u - v) = force(u) - force(v), for linear theory."""
        (p, dp, ddp, *_), (q, dq, *_) = self._penetration(u), self._penetration(v)
        change = np.asarray(self._facets.interpolate(u - v))[1]
        moved = np.abs(change) > _SAME
        slope = (p * dp - q * dq) / np.where(moved, change, 1.0)
        normal = self._stiffness * np.where(moved, slope, dp**2 + p * ddp)
        none = np.zeros_like(normal)
        return _push_change.assemble(self._facets, normal=normal, slope=none, bending=none)

    def _penetration(self, u: Array) -> tuple[Array, Array, Array, Array, Array]:
        """p, dp/dg, d²p/dg², dh/dx and d²h/dx² at the quadrature points."""
        x = np.asarray(self._facets.default_parameters()["x"])
        moved = np.asarray(self._facets.interpolate(u))
        at = x[0] + self._finite * moved[0]
        h, slope, curvature = self._rod.lower_side(at, x[1].max(), self._unit)
        g = x[1] + moved[1] - h
        root = np.hypot(g, _ONSET)
        p = (g + root) / 2
        dp, ddp = p / root, _ONSET**2 / (2 * root**3)
        return p, dp, ddp, self._finite * slope, self._finite * curvature


@skfem.LinearForm
def _push(w, p):
    return p.pressure * (w[1] - p.slope * w[0])


@skfem.BilinearForm
def _push_change(u, w, p):
    along_normal = p.normal * (w[1] - p.slope * w[0]) * (u[1] - p.slope * u[0])
    return along_normal + p.bending * w[0] * u[0]
