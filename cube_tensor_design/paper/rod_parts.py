# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Parts of P_shear under the paper's rod, by superposition; linear, in a plane.

Without the cube the rod makes a field u0 in the cube's place. The same body with the cube is in
balance at u = u0 + w. Plates stay where they are, and the rod's contact pushes back as it does
between u0 and u (S, its secant). So w is the displacement that the stiffer cube alone adds to u0::

    (K + S) w = -(K_cube - K_elastomer) u0        matrices of the cube's place on the right

That holds if the rod's displacement is held. If its force is held, the cube drives the rod back by
d along z (e is one there, and zero along x), and the change of the contact's force sums to zero::

    K w + S (w - d e) = -(K_cube - K_elastomer) u0,        e' S (w - d e) = 0

Pads are linear in u, and hence in u0 in the cube's place. There u0 is a sum of polynomials in
balance, one to four for each order, after G. V. Kolosov, with z = x + i y and y along the height::

    2 mu u = k a zⁿ - n z conj(a zⁿ⁻¹) - conj(b zⁿ)        k = (lam + 3 mu) / (lam + mu)

n = 1: uniform stress, of which Im b is shear; 2: gradients; 3: second derivatives of stress.

Sources: N. I. Muskhelishvili, Some Basic Problems of the Mathematical Theory of Elasticity (1953),
32; T. Mura, Micromechanics of Defects in Solids (1987), 22 (equivalent inclusion).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np
import scipy.sparse as sp
from scipy.optimize import newton

from cube_tensor_driver.core.arrays import Array, Index, Mask
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.layout import LAYOUTS

from ..fem.body import Body, strip_layout
from ..fem.fem import Progress, count_steps
from ..fem.solid import compute_lame_constants
from .experiments import SHEAR_SIGNS, make_dent_step
from .newton import factorise
from .rod import ROD_DEPTH, Rod
from .virtual_bench import LoadStep, VirtualBench

Held = Literal["displacement", "force"]
"""Quantity of a pressed rod, displacement or force, that is the same with the cube as without
it."""

PARTS = ("shear", "normal", "gradients", "second", "higher")
"""Names of the parts of the stress field in the cube's place: uniform shear, uniform normal
stresses, gradients, second derivatives, higher derivatives."""
PADS = {
    "strips": LAYOUTS["planar"],
    "half faces": strip_layout(LAYOUTS["planar"], 1.0),
}
"""Layouts of pads, by name, whose signal P_shear is split into parts."""
RADII = {"rounded rod": 1e-3, "sharp rod": 1e-5}
"""Radius of the edges of each rod, by its name, in m."""
P_SHEAR = np.append(SHEAR_SIGNS, np.zeros(4))
"""Signs of the eight pads' stresses in the signal for shear P_shear = -v1 + v2 + v3 - v4 (the
paper's eq. 9)."""
ORDERS = 8
"""Largest order of the polynomials in which the displacement in the cube's place is expanded.
Higher orders make 0.2 % of the signal."""
SAME_DEPTH = 1e-8
"""Difference between two depths of a rod below which the search for the held force ends, in m. The
secant method converges fast, so the force is then much closer to the held one."""


@dataclass(frozen=True, eq=False)
class RodParts:
    """Parts of P_shear, the prototype's signal for shear, by the position of the rod.

    Attributes:
        place: (n,) position of the rod along x, from the cube's centre, in m.
        signal: (n,) P_shear as a sum of pad stresses, in Pa.
        parts: (n, 5) parts of the signal in Pa, in the order of `PARTS`; they sum to the signal.
    """

    place: Array
    signal: Array
    parts: Array


def split_rod_signals(
    body: Body | None = None,
    places: Sequence[float] = (1e-3, 2e-3, 3e-3, 4e-3, 6e-3, 8e-3),
    progress: Progress | None = None,
    held: Held = "displacement",
) -> dict[str, RodParts]:
    """Split the signal -v1 + v2 + v3 - v4 of the pads for each position of a rod without friction.

    The bottom of the body is bonded.

    Args:
        body: The body, by default that of the paper.
        places: Positions of the rod along x, in m.
        progress: Called before every position.
        held: Quantity of the rod that the cube does not change.

    Returns:
        Parts by "rounded rod, strips" and so on, of `RADII` and `PADS`.
    """
    bench = VirtualBench(body or Body())
    signals = [P_SHEAR @ bench.compute_pad_weights(layout) for layout in PADS.values()]
    found: dict[str, RodParts] = {}
    report = count_steps(progress, len(RADII) * len(places))
    for rod, radius in RADII.items():
        rows = []
        for place in places:
            report(f"{rod} at {1e3 * place:g} mm")
            pressed = Rod(ROD_DEPTH, place, edge_radius=radius)
            step = make_dent_step(bench.body, pressed)
            parts_by_pads = split_signals(bench, step, signals, held)
            rows.append(parts_by_pads)
        by_pads = np.stack(rows, axis=1)  # (pads, places, parts)
        for pads, parts in zip(PADS, by_pads, strict=True):
            signal = parts.sum(axis=1)
            found[f"{rod}, {pads}"] = RodParts(
                np.array(places),
                signal,
                parts,
            )
    return found


def draw_back(bench: VirtualBench, step: LoadStep) -> LoadStep:
    """Return the step with its rod drawn back until its force is that without the cube."""
    rod = step.rod
    if rod is None:
        raise ElasticError("the step has no rod whose force could be held; give it one")

    def step_to(depth: float) -> LoadStep:
        return replace(step, rod=replace(rod, pressed=depth))

    @cache
    def compute_excess(depth: float) -> float:
        """Return the relative excess of the rod's force at this depth over that without the
        cube."""
        _, forces = bench.compute_rod_pressure(step_to(depth))
        return float(forces.sum() / force - 1)

    _, forces_without_cube = bench.remove_cube().compute_rod_pressure(step)
    force = forces_without_cube.sum()
    # The force is nearly proportional to the depth.
    guess = rod.pressed / (1 + compute_excess(rod.pressed))
    depth = newton(compute_excess, rod.pressed, x1=guess, tol=SAME_DEPTH)
    return step_to(depth)


def split_signals(
    bench: VirtualBench,
    step: LoadStep,
    signals: Sequence[Array],
    held: Held = "displacement",
) -> Array:
    """Return the parts (signals, 5) of each signal, by `PARTS`, under a step of a linear bench.

    Args:
        bench: A linear bench with the cube.
        step: A step with a bonded bottom.
        signals: (dofs,) weights of the nodal forces on the cube, from
            `VirtualBench.compute_pad_weights`.
        held: Quantity of the rod that the cube does not change.
    """
    if bench.finite or step.sliding:
        raise ElasticError("fields superpose on a linear bench whose bottom is bonded; take that")
    empty = bench.remove_cube()
    in_cube = bench.in_cube
    with_cube = draw_back(bench, step) if held == "force" else step
    u = bench.solve(with_cube)
    field = empty.solve(step)
    if u is None or field is None:
        raise ElasticError("the load is too large for one step; press less")

    free = bench.find_free(step)
    matrix = _superpose_matrix(bench, step, with_cube, u, field)
    solver = factorise(matrix)
    rows = []
    for own in _split_field(bench, field):
        # The nodal forces of the elastomer in the cube's place, which the cube replaces.
        replaced = _compute_forces(empty, own, in_cube)
        loads = replaced - _compute_forces(bench, own, in_cube)
        # The matrix has one row more if the rod's force is held.
        right = np.zeros(matrix.shape[0])
        right[: len(free)] = loads[free]
        added = np.zeros_like(u)
        added[free] = solver.solve(right)[: len(free)]
        # The field is in balance, so the elastomer around the cube bears `replaced`, too.
        on_cube = replaced - _compute_forces(bench, added, ~in_cube)
        rows.append([weights @ on_cube for weights in signals])
    return np.transpose(rows)


def _split_field(bench: VirtualBench, field: Array) -> Array:
    """Return the parts (5, dofs), by `PARTS`, of the displacements (dofs,) in the cube's place.

    Outside of this place they mean nothing.
    """
    dofs = np.unique(bench.section.basis.element_dofs[:, bench.in_cube])
    polynomials, part = _make_polynomials(bench)
    # Columns of equal norm keep the fit well conditioned.
    polynomials /= np.linalg.norm(polynomials[:, dofs], axis=1, keepdims=True)
    amplitude, *_ = np.linalg.lstsq(
        polynomials[:, dofs].T,
        field[dofs],
        rcond=None,
    )
    parts = np.zeros((len(PARTS), len(field)))
    for number in range(len(PARTS) - 1):
        chosen = part == number
        parts[number] = amplitude[chosen] @ polynomials[chosen]
    # What the polynomials leave out belongs to the higher derivatives.
    parts[-1] = field - parts.sum(axis=0)
    return parts


def _superpose_matrix(
    bench: VirtualBench,
    step: LoadStep,
    with_cube: LoadStep,
    u: Array,
    field: Array,
) -> sp.spmatrix:
    """Return the matrix of the equations for w, the displacement that the cube adds.

    It is K + S (stiffness of the bench and secant of the rod's contact) of the free unknowns. If
    the force of the rod is held, a last row and column are added for the way d by which the cube
    drives the rod back.

    Args:
        bench: The bench with the cube.
        step: The step without the cube.
        with_cube: The step with it, in which the rod may be drawn back.
        u: (dofs,) displacements with the cube.
        field: (dofs,) displacements without it.
    """
    free = bench.find_free(step)
    matrix = bench.section.compute_tangent(u)[free][:, free]
    if step.rod is None or with_cube.rod is None:
        return matrix
    along_z = (bench.section.component == 1).astype(float)
    half_side = bench.body.side / 2
    drawn_back = (step.rod.pressed - with_cube.rod.pressed) / half_side
    contact = bench.make_rod_contact(step.rod)
    springs = contact.compute_secant(u - drawn_back * along_z, field)
    matrix = matrix + springs[free][:, free]
    if with_cube is step:
        return matrix
    # Drawing the rod back by d acts on its contact as moving the body by -d along z does. So the
    # column of the unknown -d is the contact's force under a unit displacement along z.
    push = sp.csr_matrix((springs @ along_z)[free])
    total_push = [[along_z @ springs @ along_z]]
    blocks = [[matrix, push.T], [push, total_push]]
    return sp.bmat(blocks)


def _compute_forces(
    bench: VirtualBench,
    u: Array,
    elements: Mask,
) -> Array:
    """Return the nodal forces (dofs,) of some elements at displacements u (dofs,)."""
    section = bench.section
    stress = section.material.compute_stress(section.compute_deformation(u))
    return section.compute_forces(stress, elements)


def _make_polynomials(bench: VirtualBench) -> tuple[Array, Index]:
    """Return n polynomial displacements (n, dofs) that are in balance without a cube, and the
    number in `PARTS` of the part (n,) to which each belongs."""
    body = bench.body
    section = bench.section
    lam, mu = compute_lame_constants(body.young, body.poisson, body.plane)
    ratio = (lam + 3 * mu) / (lam + mu)
    x, y = section.basis.doflocs
    z = x + 1j * y
    # No pad feels the rigid motions, which come first.
    fields = [1.0 + 0 * z, 1j + 0 * z, 1j * z]
    part = [PARTS.index("higher")] * 3
    for order in range(1, ORDERS + 1):
        # The real and imaginary parts of Kolosov's coefficients a and b are independent amplitudes.
        for a, b in ((1, 0), (1j, 0), (0, 1), (0, 1j)):
            if order == 1 and a == 1j:  # A rotation gives no stress.
                continue
            derivative = a * z ** (order - 1)
            slope = order * z * np.conj(derivative)
            power = z**order
            fields.append(ratio * a * power - slope - np.conj(b * power))
            is_shear = order == 1 and b == 1j
            # These are indices in `PARTS`. All orders from the fourth on are "higher".
            part.append(0 if is_shear else min(order, 4))
    values = np.array(fields)
    is_along_x = section.component == 0
    displacements = np.where(is_along_x, values.real, values.imag)
    return displacements, np.array(part)
