"""The body in which a cube sits, what of it can be computed, and its meshes."""

from __future__ import annotations

import itertools
import resource
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import skfem

from ..core.errors import ElasticError
from ..core.layout import Layout
from .mesh import block, section

_SPACE_MESHES = (
    (0.5, 0.2, 3.0),
    (0.25, 0.2, 2.0),
    (0.25, 0.1, 1.5),
)  # brick on a face, at an edge, growth
_FINEST = 1e-3  # distance of two pad edges, d0
_FIRST_BYTES = (
    3e8  # of memory, whatever the mesh: SuperLU hangs where less of it can be had, measured
)
_BYTES = {2: 3e5, 3: 8e5}  # of memory per corner of an element at the peak, measured


@dataclass(frozen=True)
class Body:
    """A box of elastomer with a cube bonded in its middle; lengths in m, moduli in Pa.

    width, depth, height: along x, y and z (depth in 3-D only); side: of the cube
    young, poisson: of the body; cube_young, cube_poisson: of the cube, cube_young = inf makes it
    rigid
    plane: "strain" or "stress", for layouts in a plane
    Raises ElasticError when no such body can be computed.
    """

    width: float = 60e-3
    depth: float = 60e-3
    height: float = 11e-3
    side: float = 4e-3
    young: float = 0.3e6
    poisson: float = 0.48
    cube_young: float = 200e9
    cube_poisson: float = 0.30
    plane: str = "strain"

    def __post_init__(self) -> None:
        for name in ("width", "depth", "height", "side", "young", "cube_young"):
            value = getattr(self, name)
            if not value > 0 or (np.isinf(value) and name != "cube_young"):
                raise ElasticError(f"{name} is {value}; it must be a positive number in SI units")
        for name in ("poisson", "cube_poisson"):
            value = getattr(self, name)
            if not 0 <= value < 0.5:
                raise ElasticError(
                    f"{name} is {value}; it must lie in [0, 0.5). For rubber take 0.48 to 0.4999: the "
                    "elements do not lock, but at 0.5 pressure is no longer a function of strain"
                )
        for name in ("width", "depth", "height"):
            if not getattr(self, name) > 1.1 * self.side:
                raise ElasticError(
                    f"the cube's side is {self.side * 1e3:g} mm but the body's {name} is "
                    f"{getattr(self, name) * 1e3:g} mm; the body must be at least 1.1 times as large"
                )
        if self.plane not in ("strain", "stress"):
            raise ElasticError(f"plane is {self.plane!r}; it must be 'strain' or 'stress'")


def strip_layout(layout: Layout, width: float, centre: float = 0.5) -> Layout:
    """The same layout with pads of another width and distance from the middle of the face, in units
    of d0.

    The halves of each face are width = 1, centre = 0.5. Raises LayoutError when a pad leaves its
    face.
    """
    normals = layout.normals
    across = layout.positions - normals
    length = np.linalg.norm(across, axis=1, keepdims=True)
    return Layout(
        layout.name, normals + centre * across / np.where(length > 0, length, 1.0), normals, width
    )


def field_axes(layout: Layout) -> tuple[int, ...]:
    return (0, 2) if layout.planar else (0, 1, 2)


def check_pads(body: Body, layout: Layout) -> None:
    """Pads of one face must not share area: square ones overlap when both distances are below their
    side."""
    mm = 1e3 * body.side / 2
    for i, j in itertools.combinations(range(layout.n_pads), 2):
        gap = np.abs(layout.positions[i] - layout.positions[j]).max()
        if np.array_equal(layout.normals[i], layout.normals[j]) and gap < layout.pad_size * (
            1 - 1e-9
        ):
            raise ElasticError(
                f"pads {layout.pads[i]} and {layout.pads[j]} overlap: {mm * layout.pad_size:g} mm wide, "
                f"{mm * gap:g} mm apart; make them narrower or move them apart"
            )


def make_mesh(body: Body, layout: Layout, level: int) -> skfem.Mesh:
    """Mesh of the body: level 0 is the coarsest, 2 the finest. ElasticError when the pads are too
    fine for it."""
    axes = field_axes(layout)
    half = [(body.width, body.depth, body.height)[k] / body.side for k in axes]
    edges = [
        abs(float(x[k]) + s)
        for x, n in zip(layout.positions, layout.normals, strict=True)
        for k in axes
        for s in (-layout.pad_size / 2, layout.pad_size / 2)
        if n[k] == 0
    ]
    stops = np.unique(np.round(edges, 9))
    steps = np.diff(np.unique([0.0, *stops[stops < 1], 1.0]))
    if steps.min() < _FINEST:
        mm = 1e3 * body.side / 2
        raise ElasticError(
            f"pad edges are {mm * steps.min():.2g} mm apart and the mesh resolves {mm * _FINEST:g} mm; "
            "make the pads wider, or move their edges together or apart"
        )
    return (
        section(half, stops, level) if layout.planar else block(half, stops, *_SPACE_MESHES[level])
    )


def check_memory(grid: skfem.Mesh, per_corner: float | None = None) -> None:
    """ElasticError, before any work: too little memory. per_corner: bytes, by default of the
    response's solver.

    SuperLU must not run into a limit: it may look for memory for ever.
    """
    need, have = (
        _FIRST_BYTES + grid.nvertices * (per_corner or _BYTES[int(grid.dim())]),
        available_memory(),
    )
    if have is not None and need > have:
        raise ElasticError(
            f"this needs about {need / 1e9:.2g} GB of memory and {max(have, 0.0) / 1e9:.2g} GB are available; "
            "ask for fewer meshes or wider pads, or give it more"
        )


def available_memory() -> float | None:
    """Bytes that this process may still take: of the machine, and of its own limit. None: nothing
    is known."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free = next(
            1024.0 * float(line.split()[1]) for line in lines if line.startswith("MemAvailable")
        )
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit == resource.RLIM_INFINITY:
            return free
        taken = resource.getpagesize() * int(
            Path("/proc/self/statm").read_text(encoding="ascii").split()[0]
        )
        return min(free, float(limit - taken))
    except (OSError, StopIteration):
        return None  # not Linux: nothing is known, so nothing is refused
