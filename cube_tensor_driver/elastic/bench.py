"""A virtual bench: plates and rods that move the surface of the elastomer, and what the pads feel.

Section of the body with the cube, or without it for the true field. Two materials:

    linear      sigma = lambda tr(eps) 1 + 2 mu eps
    finite      compressible neo-Hookean, W = mu/2 (tr F'F - 3 - 2 ln J) + lambda/2 (ln J)^2,
                so P = mu (F - F^-T) + lambda ln J F^-T, the same lambda and mu at small strain

Newton's method on int P : grad w dV = 0 with prescribed displacements, in steps of the load.
Source: J. Bonet, R. D. Wood, Nonlinear Continuum Mechanics for Finite Element Analysis (2008), 6.4.3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from skfem.helpers import ddot, det, eye, grad, inv, mul, trace, transpose

from ..core.errors import ElasticError
from ..core.layout import LAYOUTS, Layout
from .body import Body
from .mesh import mirrored, section
from .pads import interval_weights
from .solid import lame

Array = NDArray[np.float64]
Prescribed = Callable[[Array, Array], Array]

_TOLERANCE = 1e-9  # of Newton's correction over the largest displacement
_ITERATIONS = 12
_HALVINGS = 5
_STIFF = 1e4  # cube over body: rigid to 1e-4, without spoiling Newton's numbers


@dataclass(frozen=True, eq=False)
class Run:
    """What one run gave, a row per step. Stress in Pa, tension positive; gradients times d0.

    pads: (n, P) mean normal stress of each pad, along its own normal as the cube turns
    state: (n, 7) the modes zz, zx, xx, zz_x, zz_z, xx_z, xx_x fitted to the stress within d0/2 of the centre:
    the true field where there is no cube, meaningless in a cube
    turn: (n,) angle of the cube, rad; moved: (n, 2, nodes) displacement of the mesh's corners, m
    """

    pads: Array
    state: Array
    turn: Array
    moved: Array


class Bench:
    """The body on the bench. cube=False replaces the cube by elastomer; finite=True is the neo-Hookean body.

    size: the longest side of an element away from the cube, in d0.
    """

    def __init__(
        self,
        body: Body,
        cube: bool = True,
        finite: bool = False,
        layout: Layout | None = None,
        size: float = 0.7,
    ) -> None:
        self.body, self.cube, self.finite = body, cube, finite
        self.layout = layout or LAYOUTS["planar"]
        d0 = body.side / 2
        half = self.layout.pad_size / 2
        across = np.abs(self.layout.positions - self.layout.normals).max(axis=1)
        stops = np.unique(np.round([across - half, across + half], 9))
        quarter = section([body.width / 2 / d0, body.height / 2 / d0], stops, 1, smallest=0.3, largest=size)
        self.mesh = mirrored(quarter)
        inside = np.all(np.abs(self.mesh.p[:, self.mesh.t].mean(axis=1)) < 1.0, axis=0)
        self.basis = skfem.Basis(self.mesh, skfem.ElementVector(skfem.ElementTriP2()), intorder=4)
        if finite and body.plane != "strain":
            raise ElasticError(f"plane is {body.plane!r}; the finite bench knows 'strain' only")
        lam, mu = lame(body.young, body.poisson, body.plane)
        stiff = np.where(inside & cube, _STIFF, 1.0)[:, None] * np.ones(self.basis.X.shape[1])
        self._lame = {"lam": lam * stiff, "mu": mu * stiff}
        self._outside = skfem.Basis(self.mesh, self.basis.elem, elements=np.flatnonzero(~inside), intorder=4)
        self._body_lame = {"lam": lam, "mu": mu}
        self._inside = inside

    def run(self, steps: Sequence[Callable[[Array], Array]]) -> Run:
        """Solve for prescribed displacements, one function for each step, each starting from the last solution.

        A step maps node positions (2, n) in m to displacements (2, n) in m, NaN where a component is free.
        Raises ElasticError when a step is too large for Newton's method.
        """
        d0, x = self.body.side / 2, self.basis.doflocs
        component = np.zeros(self.basis.N, dtype=int)
        component[self.basis.get_dofs(elements=True).all("u^2")] = 1
        u, rows = np.zeros(self.basis.N), []
        for number, step in enumerate(steps, 1):
            prescribed = step(d0 * x)[component, np.arange(self.basis.N)] / d0
            held = ~np.isnan(prescribed)
            u = self._advance(u, held, prescribed, number)
            rows.append((self._pads(u), self._state(u), self._turn(u), d0 * u[self.basis.nodal_dofs]))
        return Run(*(np.array(column) for column in zip(*rows, strict=True)))

    def loaded(self, stress: Array, gradient: Array) -> tuple[Array, Array]:
        """Linear solution under the outer tractions of sigma_ij = S_ij + G_ijk x_k / d0, axes x and z.

        Returns displacement (2, nodes) of the mesh's corners in m and sigma_zz (elements,) in Pa. The cube's
        middle stays where it is and its x axis does not turn.
        """
        x = np.asarray(self.basis.default_parameters()["x"])
        sigma = stress[:, :, None, None] + np.einsum("ijk,kep->ijep", gradient, x)
        force = _load.assemble(self.basis, sigma=sigma)
        still = self.basis.interpolate(np.zeros(self.basis.N))
        matrix = _tangent(False).assemble(self.basis, u0=still, **self._lame).tocsc()
        middle, side = (np.argmin(np.hypot(self.mesh.p[0] - s, self.mesh.p[1])) for s in (0, 1))
        pinned = [*self.basis.nodal_dofs[:, middle], self.basis.nodal_dofs[1, side]]
        free = np.setdiff1d(np.arange(self.basis.N), pinned)
        u = np.zeros(self.basis.N)
        u[free] = splu(matrix[free][:, free], permc_spec="MMD_AT_PLUS_A").solve(force[free])
        f = self.basis.interpolate(u).grad + np.eye(2)[:, :, None, None]
        zz = _stress(f, False, self._lame["lam"], self._lame["mu"])[1, 1].mean(axis=1)
        return self.body.side / 2 * u[self.basis.nodal_dofs], zz

    def _advance(self, u: Array, held: NDArray[np.bool_], prescribed: Array, number: int, halvings: int = 0) -> Array:
        """Newton's method for one step of the load, in halves where it fails."""
        with np.errstate(all="ignore"):  # a failed try passes through inverted elements
            found = self._newton(u, held, prescribed)
        if found is not None:
            return found
        if halvings == _HALVINGS:
            raise ElasticError(f"step {number} of the load is too large even in {2**_HALVINGS} parts; press less")
        middle = self._advance(u, held, (u + prescribed) / 2, number, halvings + 1)
        return self._advance(middle, held, prescribed, number, halvings + 1)

    def _newton(self, u: Array, held: NDArray[np.bool_], prescribed: Array) -> Array | None:
        u, free = u.copy(), np.flatnonzero(~held)
        jump = np.where(held, prescribed - u, 0.0)
        for _ in range(_ITERATIONS):
            field = self.basis.interpolate(u)
            matrix = _tangent(self.finite).assemble(self.basis, u0=field, **self._lame).tocsc()
            force = _force(self.finite).assemble(self.basis, u0=field, **self._lame) + matrix @ jump
            if not np.all(np.isfinite(force)):
                return None
            change = jump.copy()
            change[free] = -splu(matrix[free][:, free], permc_spec="MMD_AT_PLUS_A").solve(force[free])
            u, jump = u + change, np.zeros_like(u)
            if not self.finite or np.abs(change).max() < _TOLERANCE * np.abs(u).max():
                return u
        return None

    def _turn(self, u: Array) -> float:
        """Angle by which the cube has turned, from the line between the middles of its sides."""
        ends = [self.basis.nodal_dofs[:, np.argmin(np.hypot(self.mesh.p[0] - s, self.mesh.p[1]))] for s in (-1, 1)]
        along = u[ends[1]] - u[ends[0]]
        return float(np.arctan2(along[1], 2.0 + along[0]))

    def _pads(self, u: Array) -> Array:
        """Mean normal stress (P,) of the pads from the nodal forces on the cube, in the cube's turned frame."""
        field = self._outside.interpolate(u)
        force = -_force(self.finite).assemble(self._outside, u0=field, **self._body_lame)
        x, turn = self.basis.doflocs, self._turn(u) if self.finite else 0.0  # linear: no second-order terms
        c, s = np.cos(turn), np.sin(turn)
        means = np.zeros(self.layout.n_pads)
        for pad, (place, normal) in enumerate(zip(self.layout.positions, self.layout.normals, strict=True)):
            axis = 0 if normal[0] else 1
            sign, centre = normal[[0, 2]][axis], place[[0, 2]][1 - axis]
            face = np.flatnonzero((np.abs(x[axis] - sign) < 1e-9) & (np.abs(x[1 - axis]) < 1 + 1e-9))
            along = np.unique(np.round(x[1 - axis, face], 12))
            forces = np.zeros((2, len(along)))  # of each node along the face, both components
            row = np.searchsorted(along, np.round(x[1 - axis, face], 12))
            second = np.isin(face, self.basis.get_dofs(elements=True).all("u^2"))
            forces[second.astype(int), row] = force[face]
            turned = np.array([[c, s], [-s, c]])[axis] @ forces * sign
            half = self.layout.pad_size / 2
            means[pad] = _face_integral(along, turned, centre - half, centre + half) / (2 * half)
        return means

    def _state(self, u: Array) -> Array:
        """The seven plane modes fitted to the Cauchy stress at the quadrature points within d0/2 of the centre."""
        gradient = self.basis.interpolate(u).grad
        f = gradient + np.eye(2)[:, :, None, None]
        stress = _stress(f, self.finite, self._lame["lam"], self._lame["mu"])
        if self.finite:
            stress = np.einsum("ikep,jkep->ijep", stress, f) / (f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0])
        x = np.asarray(self.basis.default_parameters()["x"])
        near = np.all(np.abs(x) < 0.5, axis=0)
        design = np.stack([np.ones(near.sum()), x[0][near], x[1][near]], axis=1)
        xx, zz, zx = (np.linalg.lstsq(design, stress[i, j][near], rcond=None)[0] for i, j in ((0, 0), (1, 1), (0, 1)))
        return np.array([zz[0], zx[0], xx[0], zz[1], zz[2], xx[2], xx[1]])


def _face_integral(along: Array, force: Array, start: float, stop: float) -> float:
    """Integral of the traction over part of a whole face from the nodal forces along it, split by parity."""
    half = len(along) // 2
    right, left = force[half:], force[half::-1]
    even, odd = (right + left) / 2, (right - left) / 2
    even[0] /= 2  # the middle node belongs to both halves
    return float(
        interval_weights(along[half:], 2, 1, start, stop) @ even
        + interval_weights(along[half:], 2, -1, start, stop) @ odd
    )


def _stress(f: Array, finite: bool, lam: Array, mu: Array) -> Array:
    """First Piola-Kirchhoff stress for a deformation gradient (2, 2, elements, points)."""
    if not finite:
        e = (f + transpose(f)) / 2 - eye(np.ones_like(f[0, 0]), 2)
        return np.asarray(lam * eye(trace(e), 2) + 2 * mu * e)
    to = transpose(inv(f))
    return np.asarray(mu * (f - to) + lam * np.log(det(f)) * to)


@skfem.LinearForm
def _load(w, p):
    return ddot(p.sigma, grad(w))


def _force(finite: bool) -> skfem.LinearForm:
    def form(w, p):
        f = grad(p.u0) + eye(np.ones_like(p.u0.grad[0, 0]), 2)
        return ddot(_stress(f, finite, p.lam, p.mu), grad(w))

    return skfem.LinearForm(form)


def _tangent(finite: bool) -> skfem.BilinearForm:
    def form(u, w, p):
        du, dw = grad(u), grad(w)
        if not finite:
            return p.lam * trace(du) * trace(dw) + p.mu * ddot(du + transpose(du), dw)
        f = grad(p.u0) + eye(np.ones_like(p.u0.grad[0, 0]), 2)
        g = inv(f)
        to = transpose(g)
        change = mul(to, mul(transpose(du), to))
        return ddot(p.mu * du + (p.mu - p.lam * np.log(det(f))) * change + p.lam * ddot(to, du) * to, dw)

    return skfem.BilinearForm(form)


# prescribed displacements of the bench's three experiments


def plates(body: Body, pressed: float, sheared: float = 0.0, bonded: bool = True) -> Callable[[Array], Array]:
    """The top plate pressed down and the bottom plate moved along x, in m; sliding plates leave x free."""

    def step(x: Array) -> Array:
        moved = np.full(x.shape, np.nan)
        top, bottom = _surfaces(body, x)
        moved[1, top], moved[1, bottom] = -pressed, 0.0
        held = (top | bottom) if bonded else bottom & (np.abs(x[0]) < 1e-9)
        moved[0, held] = np.where(bottom[held], sheared, 0.0)
        return moved

    return step


def rod(
    body: Body, pressed: float, place: float, width: float = 5e-3, bonded: bool = False
) -> Callable[[Array], Array]:
    """A flat rod of `width` pressed into the top at x = place, in m; the bottom is bonded to its plate."""

    def step(x: Array) -> Array:
        moved = np.full(x.shape, np.nan)
        top, bottom = _surfaces(body, x)
        under = top & (np.abs(x[0] - place) <= width / 2 + 1e-9)
        moved[:, bottom] = 0.0
        moved[1, under] = -pressed
        if bonded:
            moved[0, under] = 0.0
        return moved

    return step


def _surfaces(body: Body, x: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    return x[1] > body.height / 2 - 1e-9, x[1] < -body.height / 2 + 1e-9
