# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The choice between the kernel in C and the one in numpy."""

from __future__ import annotations

import numpy as np

from . import rows
from .contract import HealthState, Offsets, Task

__all__ = ["native", "run"]

try:
    from ... import _scan as native
except ImportError:
    native = None  # type: ignore[assignment]

_NO_HEALTH = (None,) * len(HealthState._fields)
"""Arguments of the kernel in C instead of a `HealthState`, where health is not assessed."""

_NO_OFFSETS = (None,) * len(Offsets._fields)
"""Arguments of the kernel in C instead of `Offsets`, where nothing is compensated."""


def run(start: int, task: Task) -> tuple[int, int]:
    """Process rows of frequencies, from one row on, until the caller has to do something.

    Args:
        start: Number of the first row to process.
        task: The rows, and all arrays that are read and written.

    Returns:
        Number of the first row that is not processed, and what the caller has to do: `DONE`,
        `NEEDS_WINDOW`, `NEEDS_STEP`, `NEEDS_CONDITION`, `UNKNOWN_CUBE`, or the key (see
        `Tables.keys`) of a matrix that must be added.
    """
    n_residuals, tables, health, offsets, columns, out, offset = task
    # The kernel in C computes in float32, the precision of messages.
    if native is None or columns.frequency.dtype != np.float32:
        return rows.run(start, task)
    state = health or _NO_HEALTH
    subtracted = offsets or _NO_OFFSETS
    written = out.stress, out.gradient, out.residual, out.status, out.observed, out.left_out
    arrays = *tables, *state, *subtracted, *columns, *written, offset
    return native.run(start, n_residuals, *arrays)
