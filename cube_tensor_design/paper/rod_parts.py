"""What makes P_shear under the paper's rod: its signal split by superposition; linear, plane.

Without the cube the rod makes a field u0 in the cube's place. The same body with the cube is in
balance at u = u0 + w. Plates stay where they are, and the rod's contact pushes back as it does
between u0 and u (S, its secant). So w is what the stiffer cube alone makes of u0::

    (K + S) w = -(K_cube - K_elastomer) u0        matrices of the cube's place on the right

That holds if the rod's displacement is held. If its force is, the cube drives the rod back by d
along z (e is one there, and zero along x), and the change of the contact's force sums to zero::

    K w + S (w - d e) = -(K_cube - K_elastomer) u0,        e' S (w - d e) = 0

Pads are linear in u, and hence in u0 in the cube's place. There u0 is a sum of polynomials in
balance, one to four for each order, after G. V. Kolosov, with z = x + i y and y along the height::

    2 mu u = k a zⁿ - n z conj(a zⁿ⁻¹) - conj(b zⁿ)        k = (lam + 3 mu) / (lam + mu)

n = 1: uniform stress, of which Im b is shear; 2: gradients; 3: second derivatives of stress. The
signal of each follows from one solve with the adjoint.

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
from numpy.typing import NDArray
from scipy.optimize import newton

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.layout import LAYOUTS

from ..fem.body import Body, strip_layout
from ..fem.fem import Progress
from ..fem.solid import lame
from .experiments import dent
from .newton import factors
from .rod import Rod
from .virtual_bench import Step, VirtualBench

Held = Literal["displacement", "force"]
"""What of the rod is the same with the cube as without it."""

PARTS = ("shear", "normal", "gradients", "second", "higher")
"""Uniform shear, uniform normal stresses, gradients, second derivatives of stress, the rest."""
PADS = {"strips": LAYOUTS["planar"], "half faces": strip_layout(LAYOUTS["planar"], 1.0)}
RADII = {"rounded rod": 1e-3, "sharp rod": 1e-5}
"""Of the rod's edges, m."""
P_SHEAR = np.array([-1.0, 1.0, 1.0, -1.0, 0.0, 0.0, 0.0, 0.0])
"""-v1 + v2 + v3 - v4, eq. 9 of the eight pads' stresses."""

_ORDER = 8
"""Of the polynomials; beyond it 0.2 % of the signal is left."""
_SAME_DEPTH = 1e-8
"""Of rods, m; the method of secants is then far closer to the force that is held."""


@dataclass(frozen=True, eq=False)
class RodParts:
    """place: (n,) of the rod, m; signal: (n,) Pa; parts: (n, 5) Pa, which sum to the signal."""

    place: Array
    signal: Array
    parts: Array


def rod_parts(
    body: Body | None = None,
    places: Sequence[float] = (1e-3, 2e-3, 3e-3, 4e-3, 6e-3, 8e-3),
    pressed: float = 1e-3,
    progress: Progress | None = None,
    held: Held = "displacement",
) -> dict[str, RodParts]:
    """Parts of -v1 + v2 + v3 - v4 by the rod's place along x, m; bottom bonded, no friction.

    pressed: how deep the rod is without the cube, m
    Keys: "rounded rod, strips" and so on, of RADII and PADS.
    """
    bench = VirtualBench(body or Body())
    signals = [P_SHEAR @ bench.pad_weights(layout) for layout in PADS.values()]
    found: dict[str, RodParts] = {}
    for number, (rod, radius) in enumerate(RADII.items()):
        rows = []
        for row, place in enumerate(places):
            if progress is not None:
                done, total = number * len(places) + row, len(RADII) * len(places)
                progress(done, total, f"{rod} at {1e3 * place:g} mm")
            step = dent(bench.body, Rod(pressed, place, edge_radius=radius))
            rows.append(split(bench, step, signals, held))
        for pads, parts in zip(PADS, np.moveaxis(np.array(rows), 1, 0), strict=True):
            found[f"{rod}, {pads}"] = RodParts(np.array(places), parts.sum(axis=1), parts)
    return found


def eased(bench: VirtualBench, step: Step) -> Step:
    """The step with its rod drawn back until its force is that on the body without the cube."""
    rod = step.rod
    if rod is None:
        raise ElasticError("the step has no rod whose force could be held; give it one")

    def at(depth: float) -> Step:
        return replace(step, rod=replace(rod, pressed=depth))

    @cache
    def excess(depth: float) -> float:
        return float(bench.rod_pressure(at(depth))[1].sum() / force - 1)

    force = bench.without_cube().rod_pressure(step)[1].sum()
    guess = rod.pressed / (1 + excess(rod.pressed))
    return at(newton(excess, rod.pressed, x1=guess, tol=_SAME_DEPTH))


def split(
    bench: VirtualBench, step: Step, signals: Sequence[Array], held: Held = "displacement"
) -> Array:
    """(signals, 5) parts of each signal under a step of a linear bench.

    signals: (dofs,) weights of the nodal forces on the cube, as bench.pad_weights gives them
    """
    if bench.finite or step.sliding:
        raise ElasticError("fields superpose on a linear bench whose bottom is bonded; take that")
    empty = bench.without_cube()
    with_cube = eased(bench, step) if held == "force" else step
    u, field = bench.solve(with_cube), empty.solve(step)
    if u is None or field is None:
        raise ElasticError("the load is too large for one step; press less")
    free, inside = bench.free(step), bench.in_cube
    matrix = bench.section.tangent(u)[free][:, free]
    if step.rod is not None and with_cube.rod is not None:
        up = (bench.section.component == 1).astype(float)
        back = (step.rod.pressed - with_cube.rod.pressed) / (bench.body.side / 2)
        springs = bench.rod_contact(step.rod).secant(u - back * up, field)
        matrix = matrix + springs[free][:, free]
        if held == "force":
            push = sp.csr_matrix((springs @ up)[free])
            matrix = sp.bmat([[matrix, push.T], [push, [[up @ springs @ up]]]])
    solver = factors(matrix)
    dofs = np.unique(bench.section.basis.element_dofs[:, inside])
    polynomials, part = _polynomials(bench)
    polynomials = polynomials[:, dofs]
    size = np.linalg.norm(polynomials, axis=1)
    amplitude = np.linalg.lstsq((polynomials / size[:, None]).T, field[dofs], rcond=None)[0] / size

    rows = []
    for weights in signals:
        adjoint = np.zeros_like(u)
        right = np.zeros(matrix.shape[0])
        right[: len(free)] = -_forces(bench, weights, ~inside)[free]
        adjoint[free] = solver.solve(right)[: len(free)]
        response = _forces(empty, weights + adjoint, inside) - _forces(bench, adjoint, inside)
        each = (polynomials @ response[dofs]) * amplitude
        parts = np.bincount(part, each, len(PARTS))
        parts[-1] += response @ field - each.sum()
        rows.append(parts)
    return np.array(rows)


def _forces(bench: VirtualBench, u: Array, elements: NDArray[np.bool_]) -> Array:
    """Nodal forces (dofs,) of some elements at displacements u: their stiffness times u."""
    section = bench.section
    return section.forces(section.material.stress(section.deformation(u)), elements)


def _polynomials(bench: VirtualBench) -> tuple[Array, NDArray[np.int64]]:
    """(n, dofs) displacements in balance without a cube, and the number (n,) of each one's part."""
    body, section = bench.body, bench.section
    lam, mu = lame(body.young, body.poisson, body.plane)
    ratio = (lam + 3 * mu) / (lam + mu)
    z = section.basis.doflocs[0] + 1j * section.basis.doflocs[1]
    fields = [1.0 + 0 * z, 1j + 0 * z, 1j * z]  # rigid motions, which no pad feels
    part = [PARTS.index("higher")] * 3
    for order in range(1, _ORDER + 1):
        for a, b in ((1, 0), (1j, 0), (0, 1), (0, 1j)):
            if order == 1 and a == 1j:  # a rotation
                continue
            slope = order * z * np.conj(a * z ** (order - 1))
            fields.append(ratio * a * z**order - slope - np.conj(b * z**order))
            part.append(min(order, 4) if (order, b) != (1, 1j) else PARTS.index("shear"))
    values = np.array(fields)
    return np.where(section.component == 0, values.real, values.imag), np.array(part)
