"""The response matrix of a cube by finite elements: the mean stress of each pad under each mode.

The body is a box with the cube bonded in it. The tractions of a mode load its outer faces:
without the cube, the mode's field would be everywhere in the body.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import skfem
from numpy.typing import NDArray

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.calibration import Calibration
from cube_tensor_driver.core.defaults import BETA, FOAM_MODULUS, FREQUENCY_NOISE, REST_FREQUENCY
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.estimator import LEAK_TOLERANCE, RANK_TOLERANCE
from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.core.response import project
from cube_tensor_driver.core.symmetry import Structure, default_modes, find_structure

from .body import Body, check_pads, field_axes, make_mesh
from .memory import check_memory
from .solid import Parity, Solid, lame

Progress = Callable[[float, float, str], None]
"""progress(done, total, what)"""


_STIFF = 1e6
"""Young's modulus of a rigid cube over that of the body, where the cube cannot be held."""


@dataclass(frozen=True, eq=False)
class Response:
    """A computed response matrix.

    matrix: (pads, modes), Pa per Pa, tension positive, gradients times d0
    coefficients: its projection on the matrices that `symmetry` allows
    structure_residual: the relative part that is left; mode_residual: that part for each mode
    rank: number of independent states that the pads see
    unobservable: names of the modes that the pads cannot tell
    convergence: one row per mesh: unknowns, seconds, coefficients, and `change`, the largest change
    of an entry to the next finer mesh over the largest entry (None for the last)
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
    convergence: tuple[dict[str, Any], ...]
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Plain types for JSON."""
        return {
            "matrix": self.matrix.tolist(),
            "coefficients": self.coefficients,
            "structure_residual": self.structure_residual,
            "convergence": list(self.convergence),
            "seconds": self.seconds,
            "pads": list(self.layout.pads),
            "layout": self.layout.to_dict(),
            "modes": list(self.modes),
            "symmetry": self.symmetry,
            "mode_residual": self.mode_residual,
            "rank": self.rank,
            "unobservable": list(self.unobservable),
            "body": {
                name: None if value == np.inf else value for name, value in vars(self.body).items()
            },
        }


def compute_response(
    body: Body,
    layout: Layout,
    symmetry: str = "full",
    meshes: int = 3,
    progress: Progress | None = None,
) -> Response:
    """Response of a layout in a body on 1 to 3 meshes; the last, finest one is the result.

    progress is called before every solve and at the end. Raises ElasticError when pads overlap or
    the mesh does not fit into memory, SymmetryError when the layout does not have the symmetry.
    """
    start = time.perf_counter()
    structure = find_structure(layout, symmetry)
    if not 1 <= meshes <= 3:
        raise ElasticError(f"{meshes} meshes are asked for; 1, 2 or 3 are possible")
    check_pads(body, layout)
    grids = [make_mesh(body, layout, level) for level in range(meshes)]
    check_memory(grids[-1])
    total = sum(2 ** int(np.sum(grid.p.min(axis=1) >= 0)) for grid in grids)
    done = itertools.count()

    def report(what: str) -> None:
        if progress is not None:
            progress(next(done), total, what)

    rows: list[dict[str, Any]] = []
    coarser: Array | None = None
    for number, grid in enumerate(grids, 1):
        began = time.perf_counter()
        matrix, unknowns = _solve(body, layout, grid, number, report)
        if coarser is not None:
            rows[-1]["change"] = float(np.abs(matrix - coarser).max() / np.abs(matrix).max())
        rows.append(
            {
                "unknowns": unknowns,
                "seconds": time.perf_counter() - began,
                "coefficients": project(structure, matrix)[0],
                "change": None,
            }
        )
        coarser = matrix
    report("done")
    names = structure.modes.names
    coefficients, residual = project(structure, matrix)
    rank, unobservable = _observable(matrix, names)
    return Response(
        body=body,
        layout=layout,
        symmetry=symmetry,
        modes=names,
        matrix=matrix,
        coefficients=coefficients,
        structure_residual=residual,
        mode_residual=_mode_residual(structure, matrix, coefficients),
        rank=rank,
        unobservable=unobservable,
        convergence=tuple(rows),
        seconds=time.perf_counter() - start,
    )


def _solve(
    body: Body, layout: Layout, grid: skfem.Mesh, number: int, report: Callable[[str], None]
) -> tuple[Array, int]:
    """Response matrix on the mesh of this number, and its number of unknowns."""
    try:
        solid = make_solid(body, layout, grid)
        matrix = linear_response(solid, layout, lambda what: report(f"mesh {number}, {what}"))
    except MemoryError:  # a limit that check_memory does not know
        raise ElasticError(
            f"the memory ran out on mesh {number}, of {grid.nvertices} corners; "
            "ask for fewer meshes or wider pads"
        ) from None
    return matrix, int(solid.basis.N)


def _mode_residual(
    structure: Structure, matrix: Array, coefficients: dict[str, float]
) -> dict[str, float]:
    """The relative part of each mode's column that the structure does not explain."""
    left = matrix - np.tensordot(list(coefficients.values()), structure.basis, axes=1)
    norms = np.linalg.norm(matrix, axis=0)
    relative = np.linalg.norm(left, axis=0) / np.where(norms > 0, norms, 1.0)
    return dict(zip(structure.modes.names, relative.tolist(), strict=True))


def calibration_from_fem(
    result: Response,
    whole_matrix: bool = False,
    rest_frequency: float = REST_FREQUENCY,
    beta: float = BETA,
    modulus: float = FOAM_MODULUS,
    noise: float | None = None,
    neglect: tuple[str, ...] = (),
    source: str = "",
) -> Calibration:
    """Calibration of a cube with the computed response.

    whole_matrix: store the matrix instead of its symmetric coefficients
    rest_frequency (Hz), beta, modulus (Pa, of the pads' foam): not computed; measure them, or tare
    noise: standard deviation of a pad's stress, Pa; by default that of counting periods for 1 ms
    neglect: modes stated to be zero, so that few pads can tell the others
    """
    content: dict[str, Any] = {"coefficients": result.coefficients}
    if whole_matrix:
        content = {"matrix": result.matrix}
    if noise is None:
        noise = FREQUENCY_NOISE * modulus * (1 + beta)
    return Calibration(
        layout=result.layout,
        symmetry=result.symmetry,
        half_side=result.body.side / 2,
        rest_frequency=np.array(rest_frequency),
        beta=np.array(beta),
        modulus=np.array(modulus),
        noise=np.array(noise),
        neglect=neglect,
        source=source,
        **content,
    )


def make_solid(body: Body, layout: Layout, grid: Any = None) -> Solid:
    """The meshed body, its moduli relative to Young's modulus of the elastomer.

    grid: a mesh from elastic.mesh, by default the finest one of compute_response
    """
    plane = body.plane if layout.planar else "strain"
    cube = None
    if not np.isinf(body.cube_young):
        cube = lame(body.cube_young / body.young, body.cube_poisson, plane)
    elif body.ground:  # it can move, as nothing else in a body without rigid motions
        cube = lame(_STIFF, 0.0, plane)
    mesh = grid or make_mesh(body, layout, 2)
    return Solid(mesh, lame(1.0, body.poisson, plane), cube, body.ground)


def linear_response(
    solid: Solid, layout: Layout, report: Callable[[str], None] = lambda _: None
) -> Array:
    """Response matrix (pads, modes) on one mesh; report(what) is called before every solve."""
    axes, modes = field_axes(layout), default_modes(layout)
    every = range(modes.n_modes)
    stress = modes.stress[np.ix_(every, axes, axes)]
    gradient = modes.gradient[np.ix_(every, axes, axes, axes)]

    def forces(parity: Parity) -> Array:
        parts = zip(_part(stress, parity), _part(gradient, parity), strict=True)
        zero = np.zeros(solid.basis.N)
        return np.stack(
            [solid.linear_forces(s, g) if s.any() or g.any() else zero for s, g in parts], axis=1
        )

    return pad_stresses(solid, layout, forces, report)


def pad_stresses(
    solid: Solid,
    layout: Layout,
    forces: Callable[[Parity], Array],
    report: Callable[[str], None] = lambda _: None,
) -> Array:
    """Mean normal stress (pads, n) under n loads.

    forces(parity): nodal forces (dofs, n) of the loads' parts of this parity
    """
    stresses: Array | float = 0.0
    # Parities that share their factors follow each other.
    for parity in sorted(solid.parities, key=lambda p: solid.with_sorted_axes(p)[0], reverse=True):
        report("parity " + "".join("-0+"[sign + 1] for sign in parity))
        pads = [pad for pad in range(layout.n_pads) if sees(layout, pad, parity)]
        load = forces(parity)
        part = np.zeros((layout.n_pads, load.shape[1]))
        used = np.flatnonzero(np.any(load != 0, axis=0))
        if pads and len(used):
            reactions = solid.reactions(solid.solve(parity, load[:, used]))
            for pad in pads:
                dofs, weights = pad_weights(solid, parity, layout, pad)
                part[pad, used] = weights @ reactions[dofs]
        stresses = stresses + part
    return np.asarray(stresses)


def _part(field: Array, parity: Parity) -> Array:
    """The components of tensors (modes, dim, ..., dim) of one parity: an index k flips axis k."""
    signs = np.array(parity)
    indices = np.indices(field.shape[1:])
    odd = np.stack([np.sum(indices == k, axis=0) % 2 == 1 for k in range(len(parity))], axis=-1)
    return field * np.all((odd == (signs < 0)) | (signs == 0), axis=-1)


def sees(layout: Layout, pad: int, parity: Parity) -> bool:
    """False where a pad's mean stress is zero, because the field is odd about its middle."""
    axes = list(field_axes(layout))
    centre, normal = layout.positions[pad, axes], layout.normals[pad, axes]
    return bool(np.all((np.array(parity) >= 0) | (np.abs(centre) > 1e-9) | (normal != 0)))


def pad_weights(
    solid: Solid, parity: Parity, layout: Layout, pad: int
) -> tuple[NDArray[np.int64], Array]:
    """Dofs (m,) and weights (m,) with weights @ reactions[dofs] = mean normal stress of a pad."""
    axes, half = list(field_axes(layout)), layout.pad_size / 2
    centre, normal = layout.positions[pad, axes], layout.normals[pad, axes]
    axis = int(np.argmax(np.abs(normal)))
    intervals = [
        (max(c - half, -1.0), min(c + half, 1.0)) for k, c in enumerate(centre) if k != axis
    ]
    return solid.pad_weights(parity, axis, float(np.sign(normal[axis])), intervals)


def _observable(matrix: Array, names: tuple[str, ...]) -> tuple[int, tuple[str, ...]]:
    """Rank of a response matrix, and the names of modes with a part in its null space."""
    _, singular, rows = np.linalg.svd(matrix)
    rank = int(np.sum(singular > RANK_TOLERANCE * singular[0]))
    part = np.linalg.norm(rows[rank:], axis=0)
    return rank, tuple(
        name for name, size in zip(names, part, strict=True) if size > LEAK_TOLERANCE
    )
