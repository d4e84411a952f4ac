"""A virtual bench: plates and rods that move the surface of the elastomer, and what the pads feel.

Section of the body with the cube, or without it for the true field, of a linear or a neo-Hookean
material (material.py). Forces int P : grad w dV balance (newton.py) under prescribed displacements
and contact with a rod, in steps of the load, none of which may turn an element inside out.
Source: J. Bonet, R. D. Wood, Nonlinear Continuum Mechanics for Finite Element Analysis (2008), 9.6.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
import skfem
from numpy.typing import NDArray

from ..core.errors import ElasticError
from ..core.layout import LAYOUTS, Layout
from ..elastic.body import Body, check_memory
from ..elastic.mesh import mirrored, section
from ..elastic.pads import face_integral
from ..elastic.solid import lame
from .material import Material, determinant
from .newton import factors, find_balance
from .rod import Contact, Rod

Array = NDArray[np.float64]

_HALVINGS = 5
_CUTS = 2  # of the triangles that touch the cube: P_shear is a small difference of pad stresses, 2 % off with none
_BYTES = 6e4  # of memory per corner of a triangle at the peak, measured
_STIFF = 1e4  # cube over body: rigid to 1e-4, without spoiling Newton's numbers


@dataclass(frozen=True)
class Step:
    """One step of the load.

    prescribed: maps node positions (2, n) in m to displacements (2, n) in m, NaN where a component
    is free
    rod: presses into the top
    gripped: displacements along x count from where the body was after the last step that was not
    sliding: the bottom is free along x, but for its mean, which stays: what keeps the body in place
    is spread evenly over the bottom, since a force on one point would move that point the further
    the finer the mesh
    """

    prescribed: Callable[[Array], Array]
    rod: Rod | None = None
    gripped: bool = False
    sliding: bool = False


@dataclass(frozen=True, eq=False)
class Run:
    """What one run gave, a row per step. Stress in Pa, tension positive; gradients times d0.

    pads: (n, P) mean normal stress of each pad, along its own normal as the cube turns
    state: (n, 7) the modes zz, zx, xx, zz_x, zz_z, xx_z, xx_x fitted to the stress within d0/2 of
    the centre: the true field where there is no cube, meaningless in a cube
    turn: (n,) angle of the cube, rad; moved: (n, 2, nodes) displacement of the mesh's corners, m
    """

    pads: Array
    state: Array
    turn: Array
    moved: Array


@dataclass(frozen=True, eq=False)
class _Task:
    """What a step asks of the unknowns: values (dofs,) in d0, NaN where free; a row (dofs,) whose
    product is zero."""

    prescribed: Array
    rod: Rod | None
    row: Array | None


class Bench:
    """The body on the bench. cube=False replaces the cube by elastomer; finite=True is the
    neo-Hookean body.

    size: the longest side of an element away from the cube, in d0; below the top it is half of that
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
        quarter = _refined(quarter, lambda x, z: (z > high - 0.9) & (x < 6.0))  # where rods press
        quarter = _refined(
            quarter, lambda x, z: (z > high - 0.25) & (x < 2.4)
        )  # and stretch the surface most
        for _ in range(_CUTS if cube else 0):
            quarter = _refined(quarter, lambda x, z: np.abs(np.maximum(x, z) - 1.15) < 0.15)
        self.mesh = mirrored(quarter)
        check_memory(self.mesh, _BYTES)
        self._inside = np.all(np.abs(self.mesh.p[:, self.mesh.t].mean(axis=1)) < 1.0, axis=0)
        self.basis = skfem.Basis(self.mesh, skfem.ElementVector(skfem.ElementTriP2()), intorder=4)
        if finite and body.plane != "strain":
            raise ElasticError(f"plane is {body.plane!r}; the finite bench knows 'strain' only")
        lam, mu = lame(body.young, body.poisson, body.plane)
        stiff = np.where(self._inside & cube, _STIFF, 1.0)[:, None]
        self._material = Material(lam * stiff, mu * stiff, finite)
        self._kept: sp.csr_matrix | None = None
        # d u_i / d x_j at the quadrature points is slopes (elements, points, 2 i + j, n) @ u[dofs]
        # (elements, n)
        self._dofs = self.basis.element_dofs.T
        slopes = np.stack([shape[0].grad for shape in self.basis.basis], axis=-1)
        self._slopes = np.moveaxis(slopes, (0, 1), (2, 3)).reshape(*self.basis.dx.shape, 4, -1)
        self._x = np.moveaxis(
            np.asarray(self.basis.default_parameters()["x"]), 0, -1
        )  # (elements, points, 2)
        self._component = np.zeros(self.basis.N, dtype=int)
        self._component[self.basis.get_dofs(elements=True).all("u^2")] = 1
        self._top, bottom = (
            skfem.FacetBasis(self.mesh, self.basis.elem, facets=self._horizontal(z), intorder=8)
            for z in (high, -high)
        )
        self._mean = _along_x.assemble(bottom) * body.young  # in the size of the stiffness

    def run(self, steps: Sequence[Step], report: Callable[[], None] = lambda: None) -> Run:
        """Solve the steps, each starting from the last solution; report() is called after each.

        Raises ElasticError when a step is too large for Newton's method.
        """
        d0 = self.body.side / 2
        u = before = loose = np.zeros(self.basis.N)
        rows, rod = [], None
        for number, step in enumerate(steps, 1):
            task = self._task(step, loose)
            found = self._advance(u, 2 * u - before, rod, task, number)  # as the last step went
            u, before, rod = found, u, step.rod
            loose = loose if step.gripped else u
            rows.append(
                (self._pads(u), self._state(u), self._turn(u), d0 * u[self.basis.nodal_dofs])
            )
            report()
        return Run(*(np.array(column) for column in zip(*rows, strict=True)))

    def loaded(self, stress: Array, gradient: Array) -> tuple[Array, Array]:
        """Linear solution under the outer tractions of sigma_ij = S_ij + G_ijk x_k / d0, axes x and
        z.

        Returns displacement (2, nodes) of the mesh's corners in m and sigma_zz (elements,) in Pa.
        The cube's middle stays where it is and its x axis does not turn.
        """
        force = self._forces(stress + np.einsum("ijk,epk->epij", gradient, self._x))
        middle, side = (np.argmin(np.hypot(self.mesh.p[0] - s, self.mesh.p[1])) for s in (0, 1))
        pinned = [*self.basis.nodal_dofs[:, middle], self.basis.nodal_dofs[1, side]]
        free = np.setdiff1d(np.arange(self.basis.N), pinned)
        u = np.zeros(self.basis.N)
        u[free] = factors(self._tangent(self._deformation(u))[free][:, free]).solve(force[free])
        zz = self._material.stress(self._deformation(u))[..., 1, 1].mean(axis=1)
        return self.body.side / 2 * u[self.basis.nodal_dofs], zz

    def _horizontal(self, z: float) -> NDArray[np.int64]:
        return np.asarray(
            self.mesh.facets_satisfying(lambda x: np.abs(x[1] - z) < 1e-9, boundaries_only=True)
        )

    def _task(self, step: Step, loose: Array) -> _Task:
        """A step of the load, after `loose` (dofs,), the last displacement of a body that was not
        gripped."""
        d0, dofs = self.body.side / 2, np.arange(self.basis.N)
        prescribed = step.prescribed(d0 * self.basis.doflocs)[self._component, dofs] / d0
        if step.gripped:
            prescribed = prescribed + np.where(self._component == 0, loose, 0.0)
        return _Task(prescribed, step.rod, self._mean if step.sliding else None)

    def _advance(
        self,
        u: Array,
        guess: Array,
        before: Rod | None,
        task: _Task,
        number: int,
        halvings: int = 0,
    ) -> Array:
        """Newton's method from a guess for one step of the load after u and the rod `before`;
        halves where it fails."""
        found = self._newton(guess, task)
        if found is not None:
            return found
        if halvings == _HALVINGS:
            raise ElasticError(
                f"step {number} of the load is too large even in {2**_HALVINGS} parts; press less"
            )
        rod = task.rod and replace(
            task.rod, pressed=(task.rod.pressed + (before.pressed if before else 0.0)) / 2
        )
        half = replace(task, prescribed=(u + task.prescribed) / 2, rod=rod)
        middle = self._advance(u, (u + guess) / 2, before, half, number, halvings + 1)
        return self._advance(middle, 2 * middle - u, rod, task, number, halvings + 1)

    def _newton(self, u: Array, task: _Task) -> Array | None:
        """Displacements (dofs,) that balance, from the guess u; None where Newton's method does not
        get there."""
        contact = (
            Contact(self._top, task.rod, self.body.side / 2, self.body.young, self.finite)
            if task.rod
            else None
        )

        def tangents(u: Array) -> Iterator[sp.csr_matrix]:
            tangent = self._tangent(self._deformation(u))
            yield from (
                (tangent + contact.tangent(u, curved) for curved in (True, False))
                if contact
                else (tangent,)
            )

        linear = not self.finite and contact is None
        with np.errstate(all="ignore"):  # a failed try passes through inverted elements
            return find_balance(
                u, task.prescribed, task.row, lambda u: self._balance(u, contact), tangents, linear
            )

    def _balance(self, u: Array, contact: Contact | None) -> tuple[Array, float] | None:
        """Nodal forces out of balance (dofs,) and energy; None when an element is inside out."""
        f = self._deformation(u)
        if self.finite and determinant(f).min() <= 0:
            return None
        force = self._forces(self._material.stress(f))
        energy = float((self._material.energy(f) * self.basis.dx).sum())
        if contact:
            return force + contact.force(u), energy + contact.energy(u)
        return force, energy

    def _deformation(self, u: Array) -> Array:
        """F = 1 + grad u (elements, points, 2, 2)."""
        gradient = self._slopes @ u[self._dofs][:, None, :, None]
        return np.asarray(gradient.reshape(*self.basis.dx.shape, 2, 2) + np.eye(2))

    def _forces(self, stress: Array, elements: NDArray[np.bool_] | slice = slice(None)) -> Array:
        """Nodal forces (dofs,) int P : grad w dV of a stress (elements, points, 2, 2) over some
        elements."""
        weighted = (stress * self.basis.dx[..., None, None]).reshape(*self.basis.dx.shape, 4)
        local = np.einsum("epi,epin->en", weighted[elements], self._slopes[elements])
        return np.asarray(
            np.bincount(self._dofs[elements].ravel(), local.ravel(), self.basis.N), dtype=float
        )

    def _tangent(self, f: Array) -> sp.csr_matrix:
        """Derivative of the nodal forces by the displacements (dofs, dofs); the linear one is made
        once."""
        if not self.finite and self._kept is not None:
            return self._kept
        n = len(self.basis.basis)
        moduli = self._material.moduli(f).reshape(
            -1, *([1] if not self.finite else [self.basis.dx.shape[1]]), 4, 4
        )
        weighted = (moduli * self.basis.dx[..., None, None]) @ self._slopes
        local = np.swapaxes(self._slopes.reshape(len(f), -1, n), 1, 2) @ weighted.reshape(
            len(f), -1, n
        )
        rows, columns = (
            np.broadcast_to(x, local.shape).ravel()
            for x in (self._dofs[:, :, None], self._dofs[:, None])
        )
        self._kept = sp.coo_matrix((local.ravel(), (rows, columns)), (self.basis.N,) * 2).tocsr()
        return self._kept

    def _turn(self, u: Array) -> float:
        """Angle by which the cube has turned, from the line between the middles of its sides."""
        ends = [
            self.basis.nodal_dofs[:, np.argmin(np.hypot(self.mesh.p[0] - s, self.mesh.p[1]))]
            for s in (-1, 1)
        ]
        along = u[ends[1]] - u[ends[0]]
        return float(np.arctan2(along[1], 2.0 + along[0]))

    def _pads(self, u: Array) -> Array:
        """Mean normal stress (P,) of the pads from the nodal forces on the cube, in the cube's
        turned frame."""
        force = -self._forces(self._material.stress(self._deformation(u)), ~self._inside)
        x, turn = (
            self.basis.doflocs,
            self._turn(u) if self.finite else 0.0,
        )  # linear: no second-order terms
        c, s = np.cos(turn), np.sin(turn)
        means = np.zeros(self.layout.n_pads)
        for pad, (place, normal) in enumerate(
            zip(self.layout.positions, self.layout.normals, strict=True)
        ):
            axis = 0 if normal[0] else 1
            sign, centre = normal[[0, 2]][axis], place[[0, 2]][1 - axis]
            face = np.flatnonzero(
                (np.abs(x[axis] - sign) < 1e-9) & (np.abs(x[1 - axis]) < 1 + 1e-9)
            )
            along = np.unique(np.round(x[1 - axis, face], 12))
            forces = np.zeros((2, len(along)))  # of each node along the face, both components
            forces[
                self._component[face], np.searchsorted(along, np.round(x[1 - axis, face], 12))
            ] = force[face]
            turned = np.array([[c, s], [-s, c]])[axis] @ forces * sign
            half = self.layout.pad_size / 2
            means[pad] = face_integral(along, turned, 2, centre - half, centre + half) / (2 * half)
        return means

    def _state(self, u: Array) -> Array:
        """The seven plane modes fitted to the Cauchy stress at the quadrature points within d0/2 of
        the centre."""
        near = np.all(np.abs(self._x) < 0.5, axis=-1)
        stress, x = self._material.cauchy(self._deformation(u))[near], self._x[near]
        design = np.column_stack([np.ones(len(x)), x])
        xx, zz, zx = (
            np.linalg.lstsq(design, stress[:, i, j], rcond=None)[0]
            for i, j in ((0, 0), (1, 1), (0, 1))
        )
        return np.array([zz[0], zx[0], xx[0], zz[1], zz[2], xx[2], xx[1]])


def _refined(
    mesh: skfem.MeshTri, where: Callable[[Array, Array], NDArray[np.bool_]]
) -> skfem.MeshTri:
    """The triangles whose centroid is `where`, cut in four."""
    x, z = mesh.p[:, mesh.t].mean(axis=1)
    mesh = mesh.refined(np.flatnonzero(where(x, z)))
    return skfem.MeshTri(mesh.p.copy(), mesh.t.copy())


@skfem.LinearForm
def _along_x(w, _):
    return w[0]
