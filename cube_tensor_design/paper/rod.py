# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
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
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import skfem
from skfem.assembly.form.form import FormExtraParams
from skfem.element import DiscreteField

from cube_tensor_driver.core.arrays import Array

STIFFNESS_RATIO = 300.0
"""Stiffness k of the contact of a rod over Young's modulus E of the body, per d0 (half the side of
the cube). A pressure of three times E penetrates a hundredth of d0."""
ONSET_LENGTH = 0.001
"""Length of penetration over which the contact of a rod sets in, in d0 (half the side of the
cube)."""
SAME_DISPLACEMENT = 1e-9
"""Difference below which two displacements count as the same, in d0 (half the side of the cube)."""


ROD_DEPTH = 1e-3
"""Depth to which the rod is pressed where its position varies, in m."""


@dataclass(frozen=True)
class Rod:
    """A rod with a flat lower side whose edges are rounded by parabolas; lengths in m.

    Sides of elements, as far as they are stretched, must be short compared with the radius.
    Otherwise a node stays on the rod's edge while the surface slides around it, and how far it
    slides depends on the steps of the load.

    Attributes:
        pressed: Depth of the rod's lowest point below the undeformed top of the body.
        position: Position of the rod's centre along x, from the cube's centre.
        width: Width of the rod along x.
        edge_radius: Radius of curvature of the parabolas where they begin; they begin at this
            distance from the side of the rod.
    """

    pressed: float
    position: float
    width: float = 5e-3
    edge_radius: float = 1e-3

    def compute_lower_side(
        self,
        x: Array,
        top: float,
        unit: float,
    ) -> tuple[Array, Array, Array]:
        """Return the height h of the rod's lower side, and its derivatives dh/dx and d²h/dx².

        Args:
            x: Positions along x, in units of `unit`, like all lengths that are returned.
            top: Height of the undeformed top of the body, in units of `unit`.
            unit: Unit of these lengths, in m. The attributes of the rod are in m.
        """
        radius = self.edge_radius / unit
        flat = (self.width / 2 - self.edge_radius) / unit
        from_centre = x - self.position / unit
        beyond_flat = np.maximum(np.abs(from_centre) - flat, 0.0)
        height = top - self.pressed / unit + beyond_flat**2 / (2 * radius)
        slope = np.sign(from_centre) * beyond_flat / radius
        return height, slope, (beyond_flat > 0) / radius


class _Penetration(NamedTuple):
    """Penetration p, its derivatives dp/dg and d²p/dg² by the gap g, and dh/dx and d²h/dx² of the
    rod's height h, at the quadrature points."""

    p: Array
    dp: Array
    ddp: Array
    slope: Array
    curvature: Array


class RodContact:
    """Contact of a rod with the top of a meshed body: energy, nodal forces and their derivative."""

    def __init__(
        self,
        facets: skfem.FacetBasis,
        rod: Rod,
        unit: float,
        young: float,
        finite: bool,
    ) -> None:
        """Set up the contact.

        Args:
            facets: The top of the body.
            rod: The rod.
            unit: Unit of length of the mesh, in m.
            young: Young's modulus of the body, in Pa.
            finite: Whether the rod meets points of the surface where these have moved to along x.
                In linear theory it meets them where they were.
        """
        self._facets = facets
        self._rod = rod
        self._unit = unit
        self._stiffness = STIFFNESS_RATIO * young
        self._finite = float(finite)

    def compute_energy(self, u: Array) -> float:
        """Return the energy at displacements u (dofs,)."""
        p = self._compute_penetration(u).p
        density = self._stiffness / 2 * p**2
        return float((density * self._facets.dx).sum())

    def compute_force(self, u: Array) -> Array:
        """Return the nodal forces (dofs,) at displacements u (dofs,)."""
        at = self._compute_penetration(u)
        pressure = self._stiffness * at.p * at.dp
        return _PUSH.assemble(self._facets, pressure=pressure, slope=at.slope)

    def compute_tangent(self, u: Array) -> sp.csr_matrix:
        """Return the derivative of the nodal forces, sparse (dofs, dofs)."""
        at = self._compute_penetration(u)
        # The pressure is k p dp/dg, with the stiffness k, the penetration p and the gap g. `normal`
        # is its derivative by g; `bending` comes from the change of the rod's slope along x.
        normal = self._stiffness * (at.dp**2 + at.p * at.ddp)
        pressure = self._stiffness * at.p * at.dp
        bending = -pressure * at.curvature
        return self._assemble(normal, at.slope, bending)

    def compute_secant(self, u: Array, v: Array) -> sp.csr_matrix:
        """Return S, sparse (dofs, dofs), with S (u - v) = force(u) - force(v); linear theory."""
        at = self._compute_penetration(u)
        other = self._compute_penetration(v)
        moved = np.asarray(self._facets.interpolate(u - v))
        change = moved[1]
        has_moved = np.abs(change) > SAME_DISPLACEMENT
        difference = at.p * at.dp - other.p * other.dp
        quotient = difference / np.where(has_moved, change, 1.0)
        # Where the displacements u and v are equal, the secant is the tangent.
        tangent = at.dp**2 + at.p * at.ddp
        normal = self._stiffness * np.where(has_moved, quotient, tangent)
        zero = np.zeros_like(normal)
        return self._assemble(normal, zero, zero)

    def _assemble(
        self,
        normal: Array,
        slope: Array,
        bending: Array,
    ) -> sp.csr_matrix:
        form = skfem.BilinearForm(_push_change)
        return form.assemble(
            self._facets,
            normal=normal,
            slope=slope,
            bending=bending,
        )

    def _compute_penetration(self, u: Array) -> _Penetration:
        x = np.asarray(self._facets.default_parameters()["x"])
        moved = np.asarray(self._facets.interpolate(u))
        position = x[0] + self._finite * moved[0]
        top = x[1].max()
        height, slope, curvature = self._rod.compute_lower_side(
            position,
            top,
            self._unit,
        )
        g = x[1] + moved[1] - height
        # A smooth form of max(g, 0), which differs within the onset length only.
        root = np.hypot(g, ONSET_LENGTH)
        p = (g + root) / 2
        return _Penetration(
            p=p,
            dp=p / root,
            ddp=ONSET_LENGTH**2 / (2 * root**3),
            # In linear theory the rod presses along z, whatever its slope.
            slope=self._finite * slope,
            curvature=self._finite * curvature,
        )


_PUSH = skfem.LinearForm(lambda w, p: p.pressure * (w[1] - p.slope * w[0]))
"""Linear form: work of the contact pressure along the rod's normal in a test function w."""


def _push_change(u: DiscreteField, w: DiscreteField, p: FormExtraParams) -> Array:
    """Bilinear form: derivative of `_PUSH`, the work of the pressure, by the displacement u, which
    changes the penetration and the normal."""
    normal_w = w[1] - p.slope * w[0]
    normal_u = u[1] - p.slope * u[0]
    along_normal = normal_w * normal_u
    rotation = w[0] * u[0]
    return p.normal * along_normal + p.bending * rotation
