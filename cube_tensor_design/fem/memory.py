# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A check, before any work, that the solver of a mesh fits into the memory."""

from __future__ import annotations

import resource

import psutil
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
    available = find_available_memory()
    if needed > available:
        raise ElasticError(
            f"this needs about {needed / 1e9:.2g} GB of memory and "
            f"{max(available, 0.0) / 1e9:.2g} GB are available; ask for fewer meshes or wider "
            "pads, or give it more"
        )


def find_available_memory() -> float:
    """Return the bytes that this process may still take, limited by the machine and by ulimit."""
    free = float(psutil.virtual_memory().available)
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return free
    # The limit counts what this process has taken already.
    taken = psutil.Process().memory_info().vms
    return min(free, float(limit - taken))
