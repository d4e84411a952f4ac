"""A virtual bench: plates and rods that move the surface of the elastomer, and what the pads feel.

Section of the body with the cube, or without it for the true field. Two materials:

    linear      sigma = lambda tr(eps) 1 + 2 mu eps
    finite      compressible neo-Hookean, W = mu/2 (tr F'F - 3 - 2 ln J) + lambda/2 (ln J)^2,
                so P = mu (F - F^-T) + lambda ln J F^-T, the same lambda and mu at small strain

Newton's method on int P : grad w dV = 0 with prescribed displacements and contact with a rod, in steps of the load.
No step of it may turn an element inside out, and each must lower the energy or the forces out of balance.
Sources: J. Bonet, R. D. Wood, Nonlinear Continuum Mechanics for Finite Element Analysis (2008), 6.4.3; J. Nocedal,
S. J. Wright, Numerical Optimization (2006), 3.1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

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
from .rod import Contact, Rod
from .solid import lame

Array = NDArray[np.float64]

_TOLERANCE = 1e-9  # of Newton's correction over the largest displacement
_ITERATIONS = 30
_LONGEST = 0.3  # correction of any node at once, d0
_SHORTENINGS = 7
_HALVINGS = 5
_STIFF = 1e4  # cube over body: rigid to 1e-4, without spoiling Newton's numbers


@dataclass(frozen=True)
class Step:
    """One step of the load: `prescribed` maps node positions (2, n) in m to displacements (2, n) in m, NaN where a
    component is free; a rod presses into the top. Gripped: displacements along x count from where the body was
    after the last step that was not.
    """

    prescribed: Callable[[Array], Array]
    rod: Rod | None = None
    gripped: bool = False


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

    size: the longest side of an element away from the cube, in d0; below the top it is half of that.
    """

    def __init__(
        self,
        body: Body,
        cube: bool = True,
        finite: bool = False,
        layout: Layout | None = None,
        size: float = 0.5,
    ) -> None:
        self.body, self.cube, self.finite = body, cube, finite
        self.layout = layout or LAYOUTS["planar"]
        d0 = body.side / 2
        half = self.layout.pad_size / 2
        across = np.abs(self.layout.positions - self.layout.normals).max(axis=1)
        stops = np.unique(np.round([across - half, across + half], 9))
        high = body.height / 2 / d0
        quarter = section([body.width / 2 / d0, high], stops, 1, smallest=0.3, largest=size)
        x, z = quarter.p[:, quarter.t].mean(axis=1)
        quarter = quarter.refined(np.flatnonzero((z > high - 0.9) & (x < 6)))  # where rods press
        self.mesh = mirrored(skfem.MeshTri(quarter.p.copy(), quarter.t.copy()))
        inside = np.all(np.abs(self.mesh.p[:, self.mesh.t].mean(axis=1)) < 1.0, axis=0)
        self.basis = skfem.Basis(self.mesh, skfem.ElementVector(skfem.ElementTriP2()), intorder=4)
        if finite and body.plane != "strain":
            raise ElasticError(f"plane is {body.plane!r}; the finite bench knows 'strain' only")
        lam, mu = lame(body.young, body.poisson, body.plane)
        stiff = np.where(inside & cube, _STIFF, 1.0)[:, None] * np.ones(self.basis.X.shape[1])
        self._lame = {"lam": lam * stiff, "mu": mu * stiff}
        self._outside = skfem.Basis(self.mesh, self.basis.elem, elements=np.flatnonzero(~inside), intorder=4)
        self._body_lame = {"lam": lam, "mu": mu}
        top = self.mesh.facets_satisfying(lambda x: x[1] > high - 1e-9, boundaries_only=True)
        self._top = skfem.FacetBasis(self.mesh, self.basis.elem, facets=top, intorder=8)

    def run(self, steps: Sequence[Step]) -> Run:
        """Solve the steps, each starting from the last solution.

        Raises ElasticError when a step is too large for Newton's method.
        """
        d0, x = self.body.side / 2, self.basis.doflocs
        component = np.zeros(self.basis.N, dtype=int)
        component[self.basis.get_dofs(elements=True).all("u^2")] = 1
        u = before = loose = np.zeros(self.basis.N)
        rows, rod = [], None
        for number, step in enumerate(steps, 1):
            prescribed = step.prescribed(d0 * x)[component, np.arange(self.basis.N)] / d0
            if step.gripped:
                prescribed = prescribed + np.where(component == 0, loose, 0.0)
            held = ~np.isnan(prescribed)
            with np.errstate(all="ignore"):  # a failed try passes through inverted elements
                found = self._newton(2 * u - before, held, prescribed, step.rod)  # as the last step went
            if found is None:
                found = self._advance(u, held, prescribed, (rod, step.rod), number)
            u, before, rod = found, u, step.rod
            loose = loose if step.gripped else u
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

    def _advance(
        self,
        u: Array,
        held: NDArray[np.bool_],
        prescribed: Array,
        rods: tuple[Rod | None, Rod | None],
        number: int,
        halvings: int = 0,
    ) -> Array:
        """Newton's method for one step of the load, from the first rod to the second, in halves where it fails."""
        before, rod = rods
        with np.errstate(all="ignore"):  # a failed try passes through inverted elements
            found = self._newton(u, held, prescribed, rod)
        if found is not None:
            return found
        if halvings == _HALVINGS:
            raise ElasticError(f"step {number} of the load is too large even in {2**_HALVINGS} parts; press less")
        half = rod and replace(rod, pressed=(rod.pressed + (before.pressed if before else 0.0)) / 2)
        middle = self._advance(u, held, (u + prescribed) / 2, (before, half), number, halvings + 1)
        return self._advance(middle, held, prescribed, (half, rod), number, halvings + 1)

    def _newton(self, u: Array, held: NDArray[np.bool_], prescribed: Array, rod: Rod | None) -> Array | None:
        free, jump = np.flatnonzero(~held), np.where(held, prescribed - u, 0.0)
        d0 = self.body.side / 2
        contact = Contact(self._top, rod, d0, self.body.young, self.finite) if rod else None
        state = self._balance(u, contact)
        for _ in range(_ITERATIONS):
            if state is None:
                return None
            field = self.basis.interpolate(u)
            tangent = _tangent(self.finite).assemble(self.basis, u0=field, **self._lame)
            tried = None
            for curved in (True, False) if contact else (True,):
                matrix = (tangent + contact.tangent(u, curved) if contact else tangent).tocsc()
                change = jump.copy()
                right = state[0] + matrix @ jump
                change[free] = -splu(matrix[free][:, free], permc_spec="MMD_AT_PLUS_A").solve(right[free])
                if (not self.finite and not contact) or np.abs(change).max() < _TOLERANCE * np.abs(u).max():
                    return np.asarray(u + change)
                if jump.any():  # the prescribed displacements are taken over whole
                    tried = u + change, self._balance(u + change, contact)
                else:
                    tried = self._search(u, change, state, free, contact)
                if tried is not None:
                    break
            if tried is None:
                return None
            (u, state), jump = tried, np.zeros_like(u)
        return None

    def _search(
        self, u: Array, change: Array, state: tuple[Array, float], free: NDArray[np.int64], contact: Contact | None
    ) -> tuple[Array, tuple[Array, float]] | None:
        """As much of a change of u as lowers the energy (by Armijo's rule) or the forces out of balance."""
        force, energy = state
        slope, size = float(force[free] @ change[free]), min(1.0, _LONGEST / np.abs(change).max())
        for _ in range(_SHORTENINGS):
            there = self._balance(u + size * change, contact)
            if there is not None and (
                np.linalg.norm(there[0][free]) < np.linalg.norm(force[free])
                or (slope < 0 and there[1] <= energy + 1e-4 * size * slope)
            ):
                return u + size * change, there
            size /= 2
        return None

    def _balance(self, u: Array, contact: Contact | None) -> tuple[Array, float] | None:
        """Nodal forces out of balance (dofs,) and energy; None when an element is inside out."""
        field = self.basis.interpolate(u)
        f = field.grad + np.eye(2)[:, :, None, None]
        if self.finite and det(f).min() <= 0:
            return None
        force = _force(self.finite).assemble(self.basis, u0=field, **self._lame)
        energy = float((_energy(f, self.finite, **self._lame) * self.basis.dx).sum())
        if contact:
            return force + contact.force(u), energy + contact.energy(u)
        return force, energy

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


def _energy(f: Array, finite: bool, lam: Array, mu: Array) -> Array:
    """Strain energy per volume of the undeformed body (elements, points)."""
    if not finite:
        e = (f + transpose(f)) / 2 - eye(np.ones_like(f[0, 0]), 2)
        return np.asarray(lam / 2 * trace(e) ** 2 + mu * ddot(e, e))
    log = np.log(det(f))
    return np.asarray(mu / 2 * (ddot(f, f) - 2 - 2 * log) + lam / 2 * log**2)


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


# steps of the bench's three experiments


def plates(body: Body, pressed: float, sheared: float = 0.0, bonded: bool = True, gripped: bool = False) -> Step:
    """The top plate pressed down and the bottom plate moved along x, in m; sliding plates leave x free.

    gripped: plates that slid before hold the body from now on, as it stands between them.
    """

    def prescribed(x: Array) -> Array:
        moved = _on_plate(body, x, bonded, sheared)
        top = x[1] > body.height / 2 - 1e-9
        moved[1, top] = -pressed
        if bonded:
            moved[0, top] = 0.0
        return moved

    return Step(prescribed, gripped=gripped)


def dent(body: Body, rod: Rod, bonded: bool = True) -> Step:
    """A rod pressed into the top, the bottom bonded to its plate or sliding on it."""
    return Step(lambda x: _on_plate(body, x, bonded, 0.0), rod)


def _on_plate(body: Body, x: Array, bonded: bool, sheared: float) -> Array:
    """What the bottom plate prescribes; a sliding one holds the middle, for a sliding body to stay in place."""
    moved = np.full(x.shape, np.nan)
    bottom = x[1] < -body.height / 2 + 1e-9
    moved[1, bottom] = 0.0
    moved[0, bottom if bonded else bottom & (np.abs(x[0]) < 1e-9)] = sheared
    return moved
