"""A virtual bench: plates and rods move the surface of the elastomer, and pads feel it.

A section of the body with the cube, or without it for the true field, of a linear or a neo-Hookean
material (section.py). Forces balance (newton.py) under prescribed displacements and contact with a
rod (rod.py), in steps of the load. No step may turn an element inside out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.sparse as sp
import skfem
from numpy.typing import NDArray

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.layout import LAYOUTS, Layout

from ..fem.body import Body
from ..fem.memory import check_memory
from ..fem.mesh import mesh_quarter, mirror_quarter
from ..fem.pads import face_weights
from ..fem.solid import lame
from .material import Material
from .newton import Balance, Constraints, factors, find_balance
from .rod import Rod, RodContact
from .section import Section

CUBE_REFINEMENTS = 2
"""How often the triangles that touch the cube are cut in four.

P_shear is a small difference of pad stresses: with no cut it is 2 % off.
"""
STEP_HALVINGS = 5
"""How often a step of the load is halved before it counts as too large."""

_BYTES_PER_CORNER = 6e4
"""Memory at the peak, per corner of a triangle; measured."""
_CUBE_STIFFNESS = 1e4
"""Of the cube over the body: rigid to 1e-4, and Newton's numbers stay well conditioned."""


@dataclass(frozen=True)
class Step:
    """One step of the load.

    prescribed: maps node positions (2, n) in m to displacements (2, n) in m, NaN where a component
    is free
    rod: presses into the top
    gripped: displacements along x count from where the body was after the last step without a grip
    sliding: the bottom is free along x, but its mean stays. What keeps the body in place is spread
    evenly over the bottom: a force on one point would move that point the more, the finer the mesh
    """

    prescribed: Callable[[Array], Array]
    rod: Rod | None = None
    gripped: bool = False
    sliding: bool = False


@dataclass(frozen=True, eq=False)
class BenchRun:
    """Results of a run, a row per step. Stress in Pa, tension positive; gradients times d0.

    pads: (n, P) mean normal stress of each pad, along its own normal as the cube rotates
    state: (n, 7) the modes zz, zx, xx, zz_x, zz_z, xx_z, xx_x fitted to the stress within d0/2 of
    the centre: the true field where there is no cube, meaningless in a cube
    rotation: (n,) angle of the cube, rad; displacement: (n, 2, nodes) of the mesh's corners, m
    """

    pads: Array
    state: Array
    rotation: Array
    displacement: Array


@dataclass(frozen=True, eq=False)
class Deformation:
    """A deformed section, as plain arrays.

    points: (2, nodes) in d0; triangles: (3, elements) numbers of nodes
    half_side: d0 in m; height: of the body, m
    displacement: (2, nodes) m; stress_zz: (elements,) Pa
    """

    points: Array
    triangles: NDArray[np.int64]
    half_side: float
    height: float
    displacement: Array
    stress_zz: Array


@dataclass(frozen=True, eq=False)
class _Task:
    """What a step asks of the unknowns."""

    constraints: Constraints
    rod: Rod | None


@dataclass(frozen=True, eq=False)
class _Position:
    """A body in balance: u (dofs,) in d0, and the rod that presses on it."""

    u: Array
    rod: Rod | None


class VirtualBench:
    """The body on the bench. Lengths in d0 unless stated otherwise.

    cube: False replaces the cube by elastomer; finite: True is the neo-Hookean body
    layout: of the pads, by default the planar one
    size: the longest side of an element away from the cube, in d0; below the top it is half of that

    section: the finite elements; in_cube: (elements,) those in the cube's place
    """

    def __init__(
        self,
        body: Body,
        cube: bool = True,
        finite: bool = False,
        layout: Layout | None = None,
        size: float = 0.5,
    ) -> None:
        if finite and body.plane != "strain":
            raise ElasticError(f"plane is {body.plane!r}; the finite bench knows 'strain' only")
        self.body, self.finite = body, finite
        self.layout = layout or LAYOUTS["planar"]
        self._half_side = body.side / 2
        mesh = _bench_mesh(body, self.layout, cube, size)
        check_memory(mesh, _BYTES_PER_CORNER)
        self.in_cube = np.all(np.abs(mesh.p[:, mesh.t].mean(axis=1)) < 1.0, axis=0)
        lam, mu = lame(body.young, body.poisson, body.plane)
        stiffness = np.where(self.in_cube & cube, _CUBE_STIFFNESS, 1.0)[:, None]
        self.section = Section(mesh, Material(lam * stiffness, mu * stiffness, finite))
        top = body.height / 2 / self._half_side
        self._top, bottom = self._horizontal(top), self._horizontal(-top)
        self._bottom_mean = _along_x.assemble(bottom) * body.young  # in the size of the stiffness

    def run(self, steps: Sequence[Step], report: Callable[[], None] = lambda: None) -> BenchRun:
        """Solve the steps, each starting from the last solution; report() is called after each.

        Raises ElasticError when a step is too large for Newton's method.
        """
        position = before = _Position(np.zeros(self.section.basis.N), None)
        loose = position.u
        pads, states, rotations, displacements = [], [], [], []
        for number, step in enumerate(steps, 1):
            guess = 2 * position.u - before.u  # as the last step went
            reached = self._advance(position, guess, self._task(step, loose), number)
            before, position = position, reached
            if not step.gripped:
                loose = position.u
            pads.append(self._pad_stresses(position.u))
            states.append(self._state(position.u))
            rotations.append(self._rotation(position.u))
            displacements.append(self._half_side * position.u[self.section.basis.nodal_dofs])
            report()
        return BenchRun(*map(np.array, (pads, states, rotations, displacements)))

    def solve(self, step: Step) -> Array | None:
        """Displacements u (dofs,) under one step from rest; None where Newton's method fails."""
        rest = np.zeros(self.section.basis.N)
        return self._newton(rest, self._task(step, rest))

    def unbalanced_forces(self, u: Array, rod: Rod) -> Array:
        """Nodal forces (dofs,) on the body at u, which plates must hold."""
        balance = self._balance(u, self.rod_contact(rod))
        if balance is None:
            raise ElasticError("an element is inside out; press less")
        return balance.force

    def rod_pressure(self, step: Step) -> tuple[Array, Array]:
        """Places (n,) m along x and forces (n,) N/m with which the rod of a linear step presses."""
        u = self.solve(step)
        if u is None or step.rod is None or self.finite:
            raise ElasticError("give a linear step with a rod, that presses less")
        force = self.rod_contact(step.rod).force(u)
        dofs = np.flatnonzero((force != 0) & (self.section.component == 1))
        return self._half_side * self.section.basis.doflocs[0, dofs], self._half_side * force[dofs]

    def pad_weights(self, layout: Layout, angle: float = 0.0) -> Array:
        """(P, dofs): nodal forces of the elastomer on a cube at an angle to pads' mean stresses.

        layout: its pads end where elements of this bench's mesh end
        """
        c, s = np.cos(angle), np.sin(angle)
        axes = np.array([[c, s], [-s, c]])
        x, component = self.section.basis.doflocs, self.section.component
        half = layout.pad_size / 2
        weights = np.zeros((layout.n_pads, self.section.basis.N))
        positions, normals = layout.positions[:, [0, 2]], layout.normals[:, [0, 2]]
        for pad, (position, normal) in enumerate(zip(positions, normals, strict=True)):
            axis = 0 if normal[0] else 1
            start, stop = position[1 - axis] - half, position[1 - axis] + half
            on_face = np.abs(x[axis] - normal[axis]) < 1e-9
            on_face &= np.abs(x[1 - axis]) < 1 + 1e-9
            for along in (0, 1):
                face = np.flatnonzero(on_face & (component == along))
                face = face[np.argsort(x[1 - axis, face])]
                integral = face_weights(x[1 - axis, face], 2, start, stop)
                weights[pad, face] = axes[axis, along] * normal[axis] * integral / (2 * half)
        return weights

    def without_cube(self) -> VirtualBench:
        """A linear bench of the same mesh, with elastomer in the cube's place."""
        bench = copy(self)
        material = self.section.material
        lam, mu = (np.full_like(one, one.min()) for one in (material.lam, material.mu))
        bench.section = Section(self.section.mesh, Material(lam, mu, False))
        return bench

    def free(self, step: Step) -> NDArray[np.int64]:
        """Numbers of the unknowns that a step from rest does not prescribe."""
        rest = np.zeros(self.section.basis.N)
        return np.flatnonzero(np.isnan(self._task(step, rest).constraints.prescribed))

    def rod_contact(self, rod: Rod) -> RodContact:
        """A rod's contact with the top."""
        return RodContact(self._top, rod, self._half_side, self.body.young, self.finite)

    def loaded(self, stress: Array, gradient: Array) -> Deformation:
        """Linear solution under the outer tractions of sigma_ij = S_ij + G_ijk x_k / d0.

        stress (2, 2) and gradient (2, 2, 2) in Pa, axes x and z. The cube's middle stays where it
        is and its x axis does not rotate.
        """
        section, mesh = self.section, self.section.mesh
        force = section.forces(stress + np.einsum("ijk,epk->epij", gradient, section.points))
        middle, side = section.node(0.0, 0.0), section.node(1.0, 0.0)
        pinned = [*section.basis.nodal_dofs[:, middle], section.basis.nodal_dofs[1, side]]
        free = np.setdiff1d(np.arange(section.basis.N), pinned)
        u = np.zeros(section.basis.N)
        u[free] = factors(section.tangent(u)[free][:, free]).solve(force[free])
        return Deformation(
            points=mesh.p,
            triangles=mesh.t,
            half_side=self._half_side,
            height=self.body.height,
            displacement=self._half_side * u[section.basis.nodal_dofs],
            stress_zz=section.material.stress(section.deformation(u))[..., 1, 1].mean(axis=1),
        )

    def _horizontal(self, z: float) -> skfem.FacetBasis:
        """The surface at this height."""
        mesh = self.section.mesh
        facets = mesh.facets_satisfying(lambda x: np.abs(x[1] - z) < 1e-9, boundaries_only=True)
        return skfem.FacetBasis(mesh, self.section.basis.elem, facets=facets, intorder=8)

    def _task(self, step: Step, loose: Array) -> _Task:
        """A step of the load; loose (dofs,): the last displacement of a body without a grip."""
        basis, component = self.section.basis, self.section.component
        by_component = step.prescribed(self._half_side * basis.doflocs)
        prescribed = by_component[component, np.arange(basis.N)] / self._half_side
        if step.gripped:
            prescribed = prescribed + np.where(component == 0, loose, 0.0)
        row = self._bottom_mean if step.sliding else None
        return _Task(Constraints(prescribed, row), step.rod)

    def _advance(
        self, start: _Position, guess: Array, task: _Task, number: int, halvings: int = 0
    ) -> _Position:
        """Newton's method from a guess for one step of the load; it is halved where that fails."""
        u = self._newton(guess, task)
        if u is not None:
            return _Position(u, task.rod)
        if halvings == STEP_HALVINGS:
            parts = 2**STEP_HALVINGS
            raise ElasticError(
                f"step {number} of the load is too large even in {parts} parts; press less"
            )
        half = self._half_task(start, task)
        guess = (start.u + guess) / 2
        middle = self._advance(start, guess, half, number, halvings + 1)
        return self._advance(middle, 2 * middle.u - start.u, task, number, halvings + 1)

    def _half_task(self, start: _Position, task: _Task) -> _Task:
        """Half of the way from the start to what a task asks for."""
        rod = task.rod
        if rod is not None:
            pressed = start.rod.pressed if start.rod else 0.0
            rod = replace(rod, pressed=(rod.pressed + pressed) / 2)
        halfway = (start.u + task.constraints.prescribed) / 2
        return _Task(replace(task.constraints, prescribed=halfway), rod)

    def _newton(self, u: Array, task: _Task) -> Array | None:
        """Displacements (dofs,) in balance, from the guess u; None where Newton's method fails."""
        contact = self.rod_contact(task.rod) if task.rod else None

        def tangents(u: Array) -> Iterator[sp.csr_matrix]:
            tangent = self.section.tangent(u)
            if contact is None:
                yield tangent
            else:
                yield tangent + contact.tangent(u, curved=True)
                yield tangent + contact.tangent(u, curved=False)

        linear = not self.finite and contact is None
        balance = partial(self._balance, contact=contact)
        with np.errstate(all="ignore"):  # a failed try passes through inverted elements
            return find_balance(u, task.constraints, balance, tangents, linear)

    def _balance(self, u: Array, contact: RodContact | None) -> Balance | None:
        """Nodal forces out of balance and energy; None when an element is inside out."""
        inner = self.section.balance(u)
        if inner is None or contact is None:
            return inner
        return Balance(inner.force + contact.force(u), inner.energy + contact.energy(u))

    def _rotation(self, u: Array) -> float:
        """Angle of the cube in rad, from the line between the middles of its sides."""
        left, right = (u[self.section.basis.nodal_dofs[:, self._side(x)]] for x in (-1.0, 1.0))
        along = right - left
        return float(np.arctan2(along[1], 2.0 + along[0]))

    def _side(self, x: float) -> int:
        """The node in the middle of the cube's left or right side."""
        return self.section.node(x, 0.0)

    def _pad_stresses(self, u: Array) -> Array:
        """Mean normal stress (P,) of the pads, in the rotated frame of the cube, in Pa.

        From the nodal forces of the elastomer on the cube.
        """
        section = self.section
        stress = section.material.stress(section.deformation(u))
        force = -section.forces(stress, ~self.in_cube)
        angle = self._rotation(u) if self.finite else 0.0  # linear: no second-order terms
        return self.pad_weights(self.layout, angle) @ force

    def _state(self, u: Array) -> Array:
        """The seven plane modes fitted to the Cauchy stress within d0/2 of the centre."""
        points, section = self.section.points, self.section
        near = np.all(np.abs(points) < 0.5, axis=-1)
        stress, x = section.material.cauchy(section.deformation(u))[near], points[near]
        design = np.column_stack([np.ones(len(x)), x])
        xx, zz, zx = (
            np.linalg.lstsq(design, stress[:, i, j], rcond=None)[0]
            for i, j in ((0, 0), (1, 1), (0, 1))
        )
        return np.array([zz[0], zx[0], xx[0], zz[1], zz[2], xx[2], xx[1]])


def _bench_mesh(body: Body, layout: Layout, cube: bool, size: float) -> skfem.MeshTri:
    """Triangles of the section, in d0, refined at the cube and where rods press."""
    half_side, half_pad = body.side / 2, layout.pad_size / 2
    across = np.abs(layout.positions - layout.normals).max(axis=1)
    stops = np.unique(np.round([across - half_pad, across + half_pad], 9))
    top = body.height / 2 / half_side
    half = [body.width / 2 / half_side, top]
    quarter = mesh_quarter(half, stops, 1, smallest=0.3, largest=size)
    quarter = _refined(quarter, lambda x, z: (z > top - 0.9) & (x < 6.0))
    # Here rods stretch the surface most.
    quarter = _refined(quarter, lambda x, z: (z > top - 0.25) & (x < 2.4))
    for _ in range(CUBE_REFINEMENTS if cube else 0):
        quarter = _refined(quarter, lambda x, z: np.abs(np.maximum(x, z) - 1.15) < 0.15)
    return mirror_quarter(quarter)


def _refined(
    mesh: skfem.MeshTri, where: Callable[[Array, Array], NDArray[np.bool_]]
) -> skfem.MeshTri:
    """The same mesh; triangles whose centroid is `where` are cut in four."""
    x, z = mesh.p[:, mesh.t].mean(axis=1)
    mesh = mesh.refined(np.flatnonzero(where(x, z)))
    return skfem.MeshTri(mesh.p.copy(), mesh.t.copy())


@skfem.LinearForm
def _along_x(w, _):
    return w[0]
