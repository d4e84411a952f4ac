# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The response matrix of a cube by finite elements: the mean stress of each pad under each mode (a
linear stress field in equilibrium).

The body is a box with the cube bonded in it. The tractions of a mode load its outer faces: without
the cube, the field of the mode would be everywhere in the body.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypedDict

import numpy as np
import skfem

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.calibration import Calibration
from cube_tensor_driver.core.defaults import (
    BETA,
    FOAM_MODULUS,
    FREQUENCY_NOISE,
    REST_FREQUENCY,
)
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.estimator import estimate_modes
from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.core.response import project
from cube_tensor_driver.core.symmetry import (
    Structure,
    choose_default_modes,
    find_structure,
)

from .body import Body, check_pads, choose_field_axes, make_mesh
from .memory import check_memory
from .solid import Parity, Solid, compute_lame_constants

Progress = Callable[[float, float, str], None]
"""Called as progress(done, total, what) before every step of a computation and at its end."""
Load = Callable[[Parity], Sequence[Array]]
"""Function that returns the nodal forces (dofs, n) of n loads, for one parity: that part of the
loads which is even (+1) or odd (-1) under the mirror of each axis (0: without mirror). The first
array of the result is the forces on the elastomer. A second one, if the loads act on the cube, too,
is the forces on the cube."""

MAX_MESHES = 3
"""Largest number of meshes on which one response is computed, from the coarsest to the finest."""
NO_FORCE = 1e-12
"""Ratio of the largest nodal force of one load to that of all loads, up to which it counts as a
rounding error. The load then has no part of this parity (even or odd under each mirror), and is not
solved for it."""
STIFF_CUBE_RATIO = 1e6
"""Ratio of the Young's moduli of cube and elastomer that stands for a rigid cube in a body on
ground. Without ground a rigid cube is held at rest, but on ground it moves relative to the
ground."""


class Convergence(TypedDict):
    """Result on one mesh: number of unknowns, seconds, coefficients by name, and the largest change
    of an entry of the response to the next finer mesh over the largest entry (None for the
    last)."""

    unknowns: int
    seconds: float
    coefficients: dict[str, float]
    change: float | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Response:
    """A computed response matrix: stress of each pad under each mode (linear stress field).

    Attributes:
        body: The body.
        layout: Pads of the cube.
        symmetry: Symmetry group whose coefficients describe the response.
        modes: Names of the modes.
        matrix: (pads, modes) in Pa per Pa, tension positive, gradients times d0.
        coefficients: Coefficients by name of the matrices that `symmetry` allows, by projection.
        structure_residual: Part of the matrix that these do not explain: Frobenius norm of the
            difference over that of the matrix.
        mode_residual: The same ratio for the column of each mode.
        rank: Number of independent states that the pads observe.
        unobservable: Names of the modes that the pads cannot tell from others.
        convergence: One row per mesh.
        seconds: Time of the computation, in s.
    """

    body: Body
    layout: Layout
    symmetry: str
    modes: tuple[str, ...]
    matrix: Array
    coefficients: dict[str, float]
    structure_residual: float
    mode_residual: dict[str, float]
    rank: int
    unobservable: tuple[str, ...]
    convergence: tuple[Convergence, ...]
    seconds: float

    def to_dict(self) -> dict[str, object]:
        """Return the content of the file of --json."""
        return {
            **vars(self),
            "pads": self.layout.pads,
            "layout": self.layout.to_dict(),
            "body": vars(self.body),
        }


def compute_response(
    body: Body,
    layout: Layout,
    symmetry: str = "full",
    meshes: int = MAX_MESHES,
    progress: Progress | None = None,
) -> Response:
    """Compute the response of a layout in a body on 1 to 3 meshes; the finest gives the result.

    Args:
        body: The body.
        layout: Pads of the cube.
        symmetry: Symmetry group whose coefficients are to describe the response.
        meshes: Number of meshes; with more than one, the convergence is known.
        progress: Called before every solve and at the end.

    Raises:
        ElasticError: Pads overlap, or the mesh does not fit into memory.
        SymmetryError: The layout does not have the symmetry.
    """
    structure = find_structure(layout, symmetry)
    results = solve_meshes(
        body,
        layout,
        meshes,
        partial(make_mode_loads, layout=layout),
        progress,
    )
    changes = [result.change for result in results[1:]]
    rows = []
    for result, change in zip(results, [*changes, None], strict=True):
        row = Convergence(
            unknowns=result.unknowns,
            seconds=result.seconds,
            coefficients=project(structure, result.pads)[0],
            change=change,
        )
        rows.append(row)

    matrix = results[-1].pads
    coefficients, residual = project(structure, matrix)
    modes = structure.modes
    estimator = estimate_modes(matrix, modes)
    unobservable = np.array(modes.names)[~estimator.observed]
    return Response(
        body=body,
        layout=layout,
        symmetry=symmetry,
        modes=modes.names,
        matrix=matrix,
        coefficients=coefficients,
        structure_residual=residual,
        mode_residual=_compute_mode_residual(structure, matrix, coefficients),
        rank=estimator.rank,
        unobservable=tuple(unobservable.tolist()),
        convergence=tuple(rows),
        seconds=sum(result.seconds for result in results),
    )


def count_steps(progress: Progress | None, total: int) -> Callable[[str], None]:
    """Return a function that is called with the name of each step of the work when it begins, and
    reports that name, the number of steps done, and their `total`."""
    done = itertools.count()

    def report(what: str) -> None:
        if progress is not None:
            progress(next(done), total, what)

    return report


class MeshResult(NamedTuple):
    """Mean stresses of the pads under n loads, computed on one mesh.

    Attributes:
        unknowns: Number of unknown displacements.
        seconds: Time of the computation, in s.
        pads: (pads, n) stresses.
        change: Largest change of a stress from the mesh before, relative to the largest stress;
            None on the first mesh.
    """

    unknowns: int
    seconds: float
    pads: Array
    change: float | None


def solve_meshes(
    body: Body,
    layout: Layout,
    meshes: int,
    load: Callable[[Solid], Load],
    progress: Progress | None,
) -> list[MeshResult]:
    """Compute the stresses of the pads under loads, on finer and finer meshes.

    Args:
        body: The body.
        layout: Pads of the cube.
        meshes: Number of meshes, 1 to 3.
        load: Returns the loads on a meshed body.
        progress: Called before every solve and at the end.

    Raises:
        ElasticError: The number of meshes is not 1 to 3, pads overlap, or a mesh does not fit into
            memory.
    """
    if not 1 <= meshes <= MAX_MESHES:
        raise ElasticError(f"{meshes} meshes are asked for; 1, 2 or {MAX_MESHES} are possible")
    check_pads(body, layout)
    grids = [make_mesh(body, layout, level) for level in range(meshes)]
    check_memory(grids[-1])
    # Each axis with a mirror has two parities, and each parity is one solve.
    has_mirror = grids[0].p.min(axis=1) >= 0
    n_mirrors = int(np.sum(has_mirror))
    report = count_steps(progress, meshes * 2**n_mirrors)

    results: list[MeshResult] = []

    def report_solve(what: str) -> None:
        report(f"mesh {len(results) + 1}, {what}")

    for number, grid in enumerate(grids, 1):
        start = time.perf_counter()
        try:
            solid = make_solid(body, layout, grid)
            pads = compute_pad_stresses(
                solid,
                layout,
                load(solid),
                report_solve,
            )
        except MemoryError:  # Some limit that check_memory does not know was reached.
            raise ElasticError(
                f"the memory ran out on mesh {number}, of {grid.nvertices} corners; "
                "ask for fewer meshes or wider pads"
            ) from None
        change = None
        if results:
            largest_change = np.abs(pads - results[-1].pads).max()
            change = float(largest_change / np.abs(pads).max())
        seconds = time.perf_counter() - start
        results.append(MeshResult(len(solid.component), seconds, pads, change))
    report("done")
    return results


def _compute_mode_residual(
    structure: Structure,
    matrix: Array,
    coefficients: dict[str, float],
) -> dict[str, float]:
    """Return, by mode, the part of its column of the response that the symmetric coefficients do
    not explain: norm of the difference over norm of the column."""
    explained = np.tensordot(
        list(coefficients.values()),
        structure.basis,
        axes=1,
    )
    left = np.linalg.norm(matrix - explained, axis=0)
    norms = np.linalg.norm(matrix, axis=0)
    relative = left / np.where(norms > 0, norms, 1.0)
    return dict(zip(structure.modes.names, relative.tolist(), strict=True))


def make_calibration_from_fem(
    result: Response,
    whole_matrix: bool = False,
    neglect: tuple[str, ...] = (),
    source: str = "",
) -> Calibration:
    """Return a calibration with the computed response.

    Rest frequency f0, beta and modulus of the pad law are placeholders, which tare and fit replace.
    The noise is that of counting periods of the pad's oscillator for 1 ms.

    Args:
        result: The computed response.
        whole_matrix: Whether to store the matrix instead of its symmetric coefficients.
        neglect: Names of modes that are assumed to be zero, so that few pads can tell the others.
        source: Text about the origin of the calibration, which the calibration stores.
    """
    return Calibration(
        layout=result.layout,
        symmetry=result.symmetry,
        # A calibration holds either coefficients or the whole matrix.
        coefficients=None if whole_matrix else result.coefficients,
        matrix=result.matrix if whole_matrix else None,
        half_side=result.body.side / 2,
        rest_frequency=np.array(REST_FREQUENCY),
        beta=np.array(BETA),
        modulus=np.array(FOAM_MODULUS),
        noise=np.array(FREQUENCY_NOISE * FOAM_MODULUS * (1 + BETA)),
        neglect=neglect,
        source=source,
    )


def make_solid(
    body: Body,
    layout: Layout,
    grid: skfem.Mesh,
) -> Solid:
    """Return the meshed body; its moduli are relative to Young's modulus of the elastomer.

    Args:
        body: The body.
        layout: Pads of the cube.
        grid: A mesh from mesh.py.
    """
    plane = body.plane if layout.planar else "strain"
    cube = None
    if not np.isinf(body.cube_young):
        cube = compute_lame_constants(
            body.cube_young / body.young,
            body.cube_poisson,
            plane,
        )
    elif body.ground:
        # A rigid cube moves with a body on ground, so it is a very stiff elastic one here.
        cube = compute_lame_constants(STIFF_CUBE_RATIO, 0.0, plane)
    elastomer = compute_lame_constants(1.0, body.poisson, plane)
    return Solid(grid, elastomer, cube, body.ground, body.confined)


def make_mode_loads(solid: Solid, layout: Layout) -> Load:
    """Return the tractions of all modes of a layout on the outer faces of a body.

    The stresses of the pads under a unit amplitude of each mode are the columns of the response
    matrix.
    """
    axes = choose_field_axes(layout)
    modes = choose_default_modes(layout)
    numbers = range(modes.n_modes)
    stress = modes.stress[np.ix_(numbers, axes, axes)]
    gradient = modes.gradient[np.ix_(numbers, axes, axes, axes)]

    def compute_field(x: Array) -> Array:
        return stress + np.einsum("mijk,qk->qmij", gradient, x)

    return make_outside_load(solid, compute_field)


def make_outside_load(solid: Solid, field: Callable[[Array], Array]) -> Load:
    """Return the tractions of a field on the outer faces of a body, see
    `Solid.compute_outer_forces`."""
    return lambda parity: [solid.compute_outer_forces(parity, field)]


def compute_pad_stresses(
    solid: Solid,
    layout: Layout,
    load: Load,
    report: Callable[[str], None] = lambda _: None,
) -> Array:
    """Return the mean normal stresses (pads, n) under n loads, as sums over all parities.

    Args:
        solid: The meshed body.
        layout: Pads of the cube.
        load: The loads.
        report: Called as report(what) before every solve.
    """
    parts = []
    for parity in iterate_parities(solid, report):
        in_body, *in_cube = load(parity)
        forces = sum(in_cube, in_body)
        part = np.zeros((layout.n_pads, forces.shape[1]))
        # Most loads have no part of this parity and need no solve.
        largest = np.abs(forces).max(axis=0)
        used = np.flatnonzero(largest > NO_FORCE * largest.max())
        weights = solid.compute_pad_weights(layout, parity)
        if len(used) and weights.any():
            # At the faces of the cube, the nodal forces of the stress in the elastomer exceed the
            # loads on the elastomer by the forces with which the cube acts on it.
            displacement = solid.solve(parity, forces[:, used])
            reactions = solid.body @ displacement - in_body[:, used]
            part[:, used] = weights @ reactions
        parts.append(part)
    return np.sum(parts, axis=0)


def iterate_parities(
    solid: Solid,
    report: Callable[[str], None] = lambda _: None,
) -> Iterator[Parity]:
    """Yield the parities of a body and report each. Parities that share a factorisation of the
    stiffness matrix follow one another."""

    def find_shared_axes(parity: Parity) -> Parity:
        return solid.sort_axes(parity)[0]

    for parity in sorted(solid.parities, key=find_shared_axes, reverse=True):
        report("parity " + "".join("-0+"[sign + 1] for sign in parity))
        yield parity
