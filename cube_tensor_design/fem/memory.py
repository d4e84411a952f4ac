"""Is there enough memory for a mesh? Asked before any work."""

from __future__ import annotations

import resource
from pathlib import Path

import skfem

from cube_tensor_driver.core.errors import ElasticError

_FIXED_BYTES = 3e8
"""Memory whatever the mesh: with less, SuperLU was seen to hang."""
_BYTES_PER_CORNER = {2: 3e5, 3: 8e5}
"""Memory of the response's solver at the peak, per corner of an element, by dimension; measured."""


def check_memory(grid: skfem.Mesh, bytes_per_corner: float | None = None) -> None:
    """Raise ElasticError when a mesh needs more memory than is available.

    bytes_per_corner: by default what the response's solver needs. SuperLU must not run into a
    limit: it may look for memory for ever.
    """
    per_corner = bytes_per_corner or _BYTES_PER_CORNER[int(grid.dim())]
    need = _FIXED_BYTES + grid.nvertices * per_corner
    have = available_memory()
    if have is not None and need > have:
        raise ElasticError(
            f"this needs about {need / 1e9:.2g} GB of memory and {max(have, 0.0) / 1e9:.2g} GB "
            "are available; ask for fewer meshes or wider pads, or give it more"
        )


def available_memory() -> float | None:
    """Bytes that this process may still take, of the machine and of its own limit.

    None where that is unknown.
    """
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        (available,) = (line for line in lines if line.startswith("MemAvailable"))
        free = 1024.0 * float(available.split()[1])
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit == resource.RLIM_INFINITY:
            return free
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        return min(free, float(limit - resource.getpagesize() * pages))
    except (OSError, ValueError):
        return None  # not Linux: nothing is known, so nothing is refused
