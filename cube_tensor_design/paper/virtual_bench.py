# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A virtual bench: plates and rods move the surface of the elastomer, and pads measure the stress.

It is a section of the body with the cube, or without it for the true field, of a linear or a
neo-Hookean material (section.py). Forces balance (newton.py) under prescribed displacements and
contact with a rod (rod.py), in steps of the load. No step may turn an element inside out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.sparse as sp
import skfem

from cube_tensor_driver.core.arrays import Array, Index, Mask
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.layout import LAYOUTS, Layout
from cube_tensor_driver.core.tensor import rotation_from_rpy

from ..fem.body import Body
from ..fem.memory import check_memory
from ..fem.mesh import mesh_quarter, mirror_quarter
from ..fem.pads import compute_pad_weights
from ..fem.solid import compute_lame_constants
from .material import Material
from .newton import Balance, factorise, find_balance
from .rod import Rod, RodContact
from .section import Section

CUBE_REFINEMENTS = 2
"""Number of times that the triangles at the cube are cut in four. P_shear is a small difference of
pad stresses; without a cut it is 2 % off."""
STEP_HALVINGS = 5
"""Maximum number of times that a step of the load is halved, before it counts as too large."""
BYTES_PER_CORNER = 6e4
"""Peak memory of the solver of the bench, in bytes per corner of a triangle, as measured."""
CUBE_STIFFNESS_RATIO = 1e4
"""Ratio of the Young's moduli of cube and body on the bench. With it the cube is rigid to 1e-4, and
the equations of Newton's method stay well conditioned."""
SURFACE_TOLERANCE = 1e-9
"""Distance from a surface, in the unit of the coordinates (d0, half the side of the cube), below
which a point counts as on the surface."""


@dataclass(frozen=True)
class LoadStep:
    """One step of the load on the bench.

    Attributes:
        prescribed: Maps node positions (2, n) in m to displacements (2, n) in m, NaN where a
            component is free.
        rod: Rod that presses into the top; None: no rod does.
        gripped: Whether displacements along x count from where the body was after the last step
            without a grip.
        sliding: Whether the bottom is free along x, except that its mean stays. The force that
            keeps the body in place is spread evenly over the bottom: on one point it would move
            that point the more, the finer the mesh.
    """

    prescribed: Callable[[Array], Array]
    rod: Rod | None = None
    gripped: bool = False
    sliding: bool = False


@dataclass(frozen=True, eq=False)
class BenchRun:
    """Results of a run of the bench, one row per step of the load; tension is positive, gradients
    are times d0 (half the side of the cube).

    Attributes:
        pads: (n, P) mean normal stress of each pad in Pa, along its own normal as the cube rotates.
        state: (n, 7) amplitudes of the modes (linear stress fields) zz, zx, xx, zz_x, zz_z, xx_z,
            xx_x in Pa, fitted to the stress within d0/2 of the centre: the true field if there is
            no cube, and meaningless within a cube.
        rotation: (n,) angle of the cube, in rad.
    """

    pads: Array
    state: Array
    rotation: Array


@dataclass(frozen=True, eq=False)
class Deformation:
    """A deformed section of a body, as plain arrays.

    Attributes:
        points: (2, nodes) positions before the deformation, in d0 (half the side of the cube).
        triangles: (3, elements) numbers of nodes.
        half_side: Half the side of the cube, d0, in m.
        height: Height of the body, in m.
        displacement: (2, nodes) displacements of the nodes, in m.
        stress_zz: (elements,) mean stress sigma_zz of each triangle, in Pa.
    """

    points: Array
    triangles: Index
    half_side: float
    height: float
    displacement: Array
    stress_zz: Array


@dataclass(frozen=True, eq=False)
class _Task:
    """Conditions in one step of the load: prescribed displacements (dofs,), NaN where free; rows
    (k, dofs) of weights with rows @ u = 0; and the rod that presses."""

    prescribed: Array
    rows: Array
    rod: Rod | None


@dataclass(frozen=True, eq=False)
class _Position:
    """A body in balance: displacements u (dofs,) in d0 (half the side of the cube), and the rod
    that presses on the body."""

    u: Array
    rod: Rod | None


class VirtualBench:
    """A body on the bench. Lengths are in d0 (half the side of the cube) unless stated otherwise.

    Attributes:
        body: The body.
        finite: Whether the material is neo-Hookean.
        layout: Pads of the cube.
        section: The finite elements.
        in_cube: (elements,) whether an element is in the cube's place.
    """

    def __init__(
        self,
        body: Body,
        cube: bool = True,
        finite: bool = False,
        layout: Layout | None = None,
        size: float = 0.5,
    ) -> None:
        """Mesh the body.

        Args:
            body: The body.
            cube: Whether the cube is there; elastomer replaces it otherwise.
            finite: Whether the material is neo-Hookean.
            layout: Pads of the cube, by default the planar layout.
            size: Longest side of an element away from the cube; below the top it is half of that.
        """
        if finite and body.plane != "strain":
            raise ElasticError(f"plane is {body.plane!r}; the finite bench knows 'strain' only")
        self.body = body
        self.finite = finite
        self.layout = layout or LAYOUTS["planar"]
        self._half_side = body.side / 2

        mesh = _make_bench_mesh(body, self.layout, cube, size)
        check_memory(mesh, BYTES_PER_CORNER)
        centres = mesh.p[:, mesh.t].mean(axis=1)
        self.in_cube = np.all(np.abs(centres) < 1.0, axis=0)
        lam, mu = compute_lame_constants(body.young, body.poisson, body.plane)
        ratio = np.where(self.in_cube & cube, CUBE_STIFFNESS_RATIO, 1.0)
        stiffness = ratio[:, None]  # The same at all points of an element.
        material = Material(lam * stiffness, mu * stiffness, finite)
        self.section = Section(mesh, material)

        top = body.height / 2 / self._half_side
        self._top = self._find_horizontal_facets(top)
        along_x = skfem.LinearForm(lambda w, _: w[0])
        bottom_mean = along_x.assemble(self._find_horizontal_facets(-top))
        # Numbers of the size of the stiffness keep the equations well conditioned.
        self._bottom_mean = bottom_mean * body.young

    def run(
        self,
        steps: Sequence[LoadStep],
        report: Callable[[], None] = lambda: None,
    ) -> BenchRun:
        """Solve the steps, each starting from the last solution.

        Args:
            steps: Steps of the load.
            report: Called after each step.

        Raises:
            ElasticError: A step is too large for Newton's method.
        """
        rest = np.zeros(self.section.basis.N)
        position = before = _Position(rest, None)
        loose = position.u
        rows = []
        for number, step in enumerate(steps, 1):
            guess = 2 * position.u - before.u  # As if the body moved on as in the last step.
            task = self._make_task(step, loose)
            reached = self._advance(position, guess, task, number)
            before = position
            position = reached
            u = position.u
            if not step.gripped:
                loose = u
            results = self._compute_pad_stresses(u), self._fit_state(u), self._compute_rotation(u)
            rows.append(results)
            report()
        columns = zip(*rows, strict=True)
        return BenchRun(*map(np.array, columns))

    def solve(self, step: LoadStep) -> Array | None:
        """Return the displacements (dofs,) under one step from rest; None if the step is too
        large."""
        rest = np.zeros(self.section.basis.N)
        return self._run_newton(rest, self._make_task(step, rest))

    def compute_rod_pressure(self, step: LoadStep) -> tuple[Array, Array]:
        """Return the nodal forces with which a rod presses on the body in one step of a linear
        bench.

        Returns:
            Positions of the nodes along x (n,), in m, and forces on them (n,), in N/m.
        """
        u = self.solve(step)
        if u is None or step.rod is None or self.finite:
            raise ElasticError("give a linear step with a rod, that presses less")
        force = self.make_rod_contact(step.rod).compute_force(u)
        is_along_z = self.section.component == 1
        dofs = np.flatnonzero((force != 0) & is_along_z)
        positions = self.section.basis.doflocs[0, dofs]
        return self._half_side * positions, self._half_side * force[dofs]

    def compute_pad_weights(self, layout: Layout, angle: float = 0.0) -> Array:
        """Return weights (P, dofs) from nodal forces on the cube to the mean stresses of the pads.

        Args:
            layout: Pads, whose edges must be ends of elements of this bench's mesh.
            angle: Rotation of the cube, in rad.
        """
        rotation = rotation_from_rpy(0, -angle, 0)[::2, ::2]
        positions = self.section.basis.doflocs
        return compute_pad_weights(positions, 2, layout, (0, 0), rotation)

    def remove_cube(self) -> VirtualBench:
        """Return a linear bench of the same mesh, with elastomer in the cube's place."""
        bench = copy(self)
        material = self.section.material
        # The elastomer has the smaller of the two stiffnesses.
        lam = np.full_like(material.lam, material.lam.min())
        mu = np.full_like(material.mu, material.mu.min())
        elastomer = Material(lam, mu, False)
        bench.section = Section(self.section.mesh, elastomer)
        return bench

    def find_free(self, step: LoadStep) -> Index:
        """Return the numbers of the unknown displacements that a step from rest does not
        prescribe."""
        task = self._make_task(step, np.zeros(self.section.basis.N))
        return np.flatnonzero(np.isnan(task.prescribed))

    def make_rod_contact(self, rod: Rod) -> RodContact:
        """Return the contact of a rod with the top."""
        return RodContact(
            self._top,
            rod,
            self._half_side,
            self.body.young,
            self.finite,
        )

    def solve_field(self, stress: Array, gradient: Array) -> Deformation:
        """Solve for the outer tractions of the field sigma_ij = S_ij + G_ijk x_k / d0, linearly.

        The cube's centre stays where it is and its x axis does not rotate.

        Args:
            stress: S (2, 2) in Pa, axes x and z.
            gradient: G (2, 2, 2) in Pa.
        """
        section = self.section
        mesh = self.section.mesh
        linear_part = np.einsum("ijk,keq->ijeq", gradient, section.points)
        force = section.compute_forces(stress[:, :, None, None] + linear_part)
        # Three unknowns stop the rigid motions; the loads balance, so they bear no force.
        centre = section.find_node(0.0, 0.0)
        side = section.find_node(1.0, 0.0)
        nodal_dofs = section.basis.nodal_dofs
        pinned = [*nodal_dofs[:, centre], nodal_dofs[1, side]]
        free = np.setdiff1d(np.arange(section.basis.N), pinned)
        u = np.zeros(section.basis.N)
        matrix = section.compute_tangent(u)[free][:, free]
        u[free] = factorise(matrix).solve(force[free])
        result = section.material.compute_stress(section.compute_deformation(u))
        return Deformation(
            points=mesh.p,
            triangles=mesh.t,
            half_side=self._half_side,
            height=self.body.height,
            displacement=self._half_side * u[nodal_dofs],
            stress_zz=result[1, 1].mean(axis=1),
        )

    def _find_horizontal_facets(self, z: float) -> skfem.FacetBasis:
        """Return the facets of the surface at the height z."""
        mesh = self.section.mesh

        def is_at_height(x: Array) -> Mask:
            return np.abs(x[1] - z) < SURFACE_TOLERANCE

        facets = mesh.facets_satisfying(is_at_height, boundaries_only=True)
        return skfem.FacetBasis(
            mesh,
            self.section.basis.elem,
            facets=facets,
            intorder=8,
        )

    def _make_task(self, step: LoadStep, loose: Array) -> _Task:
        """Return the constraints and the rod of a step; `loose` (dofs,) are the displacements after
        the last step without a grip."""
        basis = self.section.basis
        component = self.section.component
        by_component = step.prescribed(self._half_side * basis.doflocs)
        dofs = np.arange(basis.N)
        prescribed = by_component[component, dofs] / self._half_side
        if step.gripped:
            prescribed = prescribed + np.where(component == 0, loose, 0.0)
        # The mean displacement of the bottom is held only if the bottom slides.
        rows = self._bottom_mean[None][: int(step.sliding)]
        return _Task(prescribed, rows, step.rod)

    def _advance(
        self,
        start: _Position,
        guess: Array,
        task: _Task,
        number: int,
        halvings: int = 0,
    ) -> _Position:
        """Solve one step of the load from a guess of u; halve the step where Newton's method
        fails."""
        u = self._run_newton(guess, task)
        if u is not None:
            return _Position(u, task.rod)
        if halvings == STEP_HALVINGS:
            parts = 2**STEP_HALVINGS
            raise ElasticError(
                f"step {number} of the load is too large even in {parts} parts; press less"
            )
        # First to the middle of the step, then on from there in the same direction.
        half = self._make_half_task(start, task)
        guess = (start.u + guess) / 2
        middle = self._advance(start, guess, half, number, halvings + 1)
        guess = 2 * middle.u - start.u
        return self._advance(middle, guess, task, number, halvings + 1)

    def _make_half_task(self, start: _Position, task: _Task) -> _Task:
        """Return the task half of the way from the displacements and the rod at the start to a
        task."""
        rod = task.rod
        if rod is not None:
            pressed = start.rod.pressed if start.rod else 0.0
            rod = replace(rod, pressed=(rod.pressed + pressed) / 2)
        prescribed = (start.u + task.prescribed) / 2
        return replace(task, prescribed=prescribed, rod=rod)

    def _run_newton(self, u: Array, task: _Task) -> Array | None:
        """Return displacements (dofs,) in balance, found from the guess u; None if none were
        found."""
        contact = self.make_rod_contact(task.rod) if task.rod else None

        def compute_tangent(u: Array) -> sp.csr_matrix:
            inner = self.section.compute_tangent(u)
            return inner if contact is None else inner + contact.compute_tangent(u)

        # Even a linear body has a contact that is not linear.
        linear = not self.finite and contact is None
        balance = partial(self._balance, contact=contact)
        with np.errstate(all="ignore"):  # A failed attempt has inverted elements.
            return find_balance(
                u,
                task.prescribed,
                task.rows,
                balance,
                compute_tangent,
                linear,
            )

    def _balance(self, u: Array, contact: RodContact | None) -> Balance | None:
        """Return nodal forces out of balance, and energy; None when an element is inside out."""
        inner = self.section.balance(u)
        if inner is None or contact is None:
            return inner
        force = inner.force + contact.compute_force(u)
        energy = inner.energy + contact.compute_energy(u)
        return Balance(force, energy)

    def _compute_rotation(self, u: Array) -> float:
        """Return the rotation, in rad, of the line between the centres of the cube's two sides."""
        section = self.section
        ends = [section.find_node(x, 0.0) for x in (-1.0, 1.0)]
        left, right = u[section.basis.nodal_dofs[:, ends]].T
        # The undeformed line is 2 d0 long.
        along_x, along_z = right - left
        return float(np.arctan2(along_z, 2.0 + along_x))

    def _compute_pad_stresses(self, u: Array) -> Array:
        """Return the mean normal stress (P,) of the pads in the rotated frame of the cube, in Pa.

        The stress is computed from the nodal forces of the elastomer on the cube.
        """
        section = self.section
        stress = section.material.compute_stress(section.compute_deformation(u))
        force = -section.compute_forces(stress, ~self.in_cube)
        angle = self._compute_rotation(u) if self.finite else 0.0  # Linear theory has no rotation.
        return self.compute_pad_weights(self.layout, angle) @ force

    def _fit_state(self, u: Array) -> Array:
        """Return amplitudes (7,) of the plane modes (linear stress fields), in Pa, fitted to the
        true stress within d0/2 of the centre."""
        section = self.section
        is_near = np.all(np.abs(section.points) < 0.5, axis=0)
        f = section.compute_deformation(u)
        stress = section.material.compute_cauchy_stress(f)
        stress = stress[:, :, is_near]
        x = section.points[:, is_near]
        ones = np.ones(x.shape[1])
        design = np.vstack([ones, x]).T
        columns = stress[[0, 1, 0], [0, 1, 1]].T  # xx, zz, zx
        # The fit has the value, the slope along x and the slope along z of each component.
        fit, *_ = np.linalg.lstsq(design, columns, rcond=None)
        (xx, xx_x, xx_z), (zz, zz_x, zz_z), (zx, _, _) = fit.T
        return np.array([zz, zx, xx, zz_x, zz_z, xx_z, xx_x])


def _make_bench_mesh(
    body: Body,
    layout: Layout,
    cube: bool,
    size: float,
) -> skfem.MeshTri:
    """Return triangles of the section, refined at the cube and where rods press; lengths in d0
    (half the side of the cube)."""
    half_side = body.side / 2
    half_pad = layout.pad_size / 2
    on_face = np.abs(layout.positions - layout.normals)
    across = on_face.max(axis=1)
    edges = [across - half_pad, across + half_pad]
    stops = np.unique(np.round(edges, 9))
    top = body.height / 2 / half_side
    half = [body.width / 2 / half_side, top]

    def is_near_rods(x: Array, z: Array) -> Mask:
        return (z > top - 0.9) & (x < 6.0)

    def is_below_rods(x: Array, z: Array) -> Mask:
        return (z > top - 0.25) & (x < 2.4)

    def is_at_cube(x: Array, z: Array) -> Mask:
        from_centre = np.maximum(x, z)
        return np.abs(from_centre - 1.15) < 0.15

    # Two rings at the corner of the cube; the cuts below refine its faces.
    quarter = mesh_quarter(half, stops, 1, smallest=0.3, largest=size)
    quarter = _refine(quarter, is_near_rods)
    # Rods stretch the surface most here.
    quarter = _refine(quarter, is_below_rods)
    for _ in range(CUBE_REFINEMENTS if cube else 0):
        # The ring of triangles from the faces of the cube to 0.3 d0 outside of it.
        quarter = _refine(quarter, is_at_cube)
    return mirror_quarter(quarter)


def _refine(
    mesh: skfem.MeshTri,
    where: Callable[[Array, Array], Mask],
) -> skfem.MeshTri:
    """Return the mesh with those triangles cut in four at whose centroids `where` is true."""
    x, z = mesh.p[:, mesh.t].mean(axis=1)
    chosen = np.flatnonzero(where(x, z))
    mesh = mesh.refined(chosen)
    return skfem.MeshTri(mesh.p.copy(), mesh.t.copy())
