"""A rigid rod pressed into the top of the bench's body: smooth, rounded at its edges, free of
friction.

What lies above the rod's lower side z = h(x) by g = z - h(x) is pushed back with the pressure k
p(g) dp/dg, the derivative of the energy k p^2 / 2 per length of the undeformed surface; p is max(g,
0), rounded off over a little so that Newton's method can follow it. The force is along the rod's
normal. Lengths in d0.
Source: P. Wriggers, Computational Contact Mechanics (2006), 6.3 (penalty); the rounding is ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import skfem
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STIFF = 300.0  # k over Young's modulus per d0: three times E pushes in by a hundredth of d0
_ROUND = 0.001  # length over which the contact sets in, d0


@dataclass(frozen=True)
class Rod:
    """A rod whose flat part ends `round` before its edges, in parabolas of that radius at their
    apex; in m.

    Sides of elements must be short beside that radius, as far as they are stretched: where they are
    not, a node stays on the rod's edge as the surface slides round it, and how far it slides
    depends on the steps of the load.

    place: of its middle along x; pressed: how deep its lowest point is below the undeformed top
    """

    pressed: float
    place: float
    width: float = 5e-3
    round: float = 1e-3

    def lower_side(self, x: Array, top: float, unit: float) -> tuple[Array, Array, Array]:
        """h, dh/dx and d2h/dx2 at x; x, top and h in units of `unit` m."""
        radius, flat = self.round / unit, (self.width / 2 - self.round) / unit
        away = x - self.place / unit
        s = np.maximum(np.abs(away) - flat, 0.0)
        return (
            top - self.pressed / unit + s**2 / (2 * radius),
            np.sign(away) * s / radius,
            (s > 0) / radius,
        )


class Contact:
    """Energy, nodal forces and tangent of a rod on facets of a basis; young is that of the body.

    finite: the rod meets the surface where it has moved to along x, otherwise (linear theory) where
    it was
    """

    def __init__(
        self, facets: skfem.FacetBasis, rod: Rod, unit: float, young: float, finite: bool
    ) -> None:
        self._facets, self._rod, self._unit = facets, rod, unit
        self._stiff, self._finite = _STIFF * young, float(finite)

    def energy(self, u: Array) -> float:
        p, *_ = self._at(u)
        return float((self._stiff / 2 * p**2 * self._facets.dx).sum())

    def force(self, u: Array) -> Array:
        p, dp, _, slope, _ = self._at(u)
        return _push.assemble(self._facets, pressure=self._stiff * p * dp, slope=slope)

    def tangent(self, u: Array, curved: bool = True) -> Array:
        """curved=False leaves out the rod's curvature, whose part may turn the tangent
        indefinite."""
        p, dp, ddp, slope, bend = self._at(u)
        stiff, turn = self._stiff * (dp**2 + p * ddp), -self._stiff * p * dp * bend * curved
        return _push_change.assemble(self._facets, stiff=stiff, slope=slope, turn=turn)

    def _at(self, u: Array) -> tuple[Array, Array, Array, Array, Array]:
        """p, dp/dg, d2p/dg2, dh/dx and d2h/dx2 at the quadrature points."""
        x, moved = (
            np.asarray(self._facets.default_parameters()["x"]),
            np.asarray(self._facets.interpolate(u)),
        )
        h, slope, bend = self._rod.lower_side(
            x[0] + self._finite * moved[0], x[1].max(), self._unit
        )
        g = x[1] + moved[1] - h
        root = np.hypot(g, _ROUND)
        p = (g + root) / 2
        return p, p / root, _ROUND**2 / (2 * root**3), self._finite * slope, self._finite * bend


@skfem.LinearForm
def _push(w, p):
    return p.pressure * (w[1] - p.slope * w[0])


@skfem.BilinearForm
def _push_change(u, w, p):
    return p.stiff * (w[1] - p.slope * w[0]) * (u[1] - p.slope * u[0]) + p.turn * w[0] * u[0]
