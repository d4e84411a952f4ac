# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A check, before any work, that the solver of a mesh fits into the memory."""

from __future__ import annotations

import resource
from pathlib import Path

import skfem

from cube_tensor_driver.core.errors import ElasticError

FIXED_BYTES = 3e8
"""Memory, in bytes, that is needed for any mesh, however small. With less, SuperLU (the solver) was
seen to hang."""
BYTES_PER_CORNER = {2: 3e5, 3: 8e5}
"""Peak memory of the solver in bytes per corner of an element, by dimension; measured."""


def check_memory(grid: skfem.Mesh, bytes_per_corner: float | None = None) -> None:
    """Raise ElasticError when the solver needs more memory than is available.

    This is checked before any work, because SuperLU (the solver) may search for memory without end
    near a limit.

    Args:
        grid: The mesh.
        bytes_per_corner: Peak memory per corner of an element, by default `BYTES_PER_CORNER`.
    """
    per_corner = bytes_per_corner or BYTES_PER_CORNER[int(grid.dim())]
    needed = FIXED_BYTES + grid.nvertices * per_corner
    available = available_memory()
    if available is not None and needed > available:
        raise ElasticError(
            f"this needs about {needed / 1e9:.2g} GB of memory and "
            f"{max(available, 0.0) / 1e9:.2g} GB are available; ask for fewer meshes or wider "
            "pads, or give it more"
        )


def available_memory() -> float | None:
    """Return the bytes that this process may still take, limited by the machine and by ulimit.

    Returns:
        None where the number is unknown, on systems other than Linux; then no mesh is refused.
    """
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        # The kernel's estimate of what can be taken without swapping, in kB.
        (line,) = (line for line in lines if line.startswith("MemAvailable"))
        free = 1024.0 * float(line.split()[1])
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit == resource.RLIM_INFINITY:
            return free
        # The limit counts what this process has taken already.
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        return min(free, float(limit - resource.getpagesize() * pages))
    except (OSError, ValueError):
        return None
