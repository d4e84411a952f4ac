# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Check of one cube's own topics: their messages against the rows of `stress` of the same stamp."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.status import INVALID
from cube_tensor_driver.core.tensor import contact_wrench

from .record import Tensor, Wrench
from .run import Findings, Run, agree

MAX_RELATIVE_ERROR = 1e-5
"""Largest relative difference between a row of the topic `stress`, which has float32, and a message
of one cube, which has float64."""


def check_cube_topics(run: Run) -> Findings:
    """Count the messages of one cube's topics, and those that agree with no row of their stamp."""
    record = run.record
    skin = record.skin
    messages = record.cube_messages
    rows = record.stress.rows
    of_cube = np.flatnonzero(rows.cube == messages.cube)
    rows = rows.select(of_cube)
    pipeline = Pipeline(skin.calibrations, np.float64)
    cube = skin.cubes[messages.cube]

    def is_tensor_of(message: Tensor, row: int) -> bool:
        _, values, residual, status, observed, covariance = message
        wanted = pipeline.covariance(messages.cube, int(rows.left_out[row]))
        has_bits = status == rows.status[row] and observed == rows.observed[row]
        components = np.concatenate([rows.stress[row], rows.gradient[row]])
        return (
            has_bits
            and _is_near(values, components)
            and _is_near(residual, rows.residual[row])
            and _is_near(covariance, wanted.ravel())
        )

    def is_wrench_of(message: Wrench, row: int) -> bool:
        one = slice(row, row + 1)
        side = 2 * cube.calibration.half_side
        force, torque = contact_wrench(
            rows.stress[one],
            rows.gradient[one],
            side,
        )
        wanted = np.concatenate([force[0], torque[0]])
        # A row without stress gives no wrench.
        is_valid = rows.status[row] & INVALID == 0
        return bool(is_valid) and _is_near(message[1], wanted)

    def has_row(message: Any, is_of: Callable[[Any, int], bool]) -> bool:
        # A row that comes late may have the stamp of another one.
        candidates = np.flatnonzero(rows.stamp_ns == message[0])
        return any(is_of(message, row) for row in candidates.tolist())

    agrees = [has_row(message, is_tensor_of) for message in messages.tensors]
    agrees += [has_row(message, is_wrench_of) for message in messages.wrenches]
    wrong = len(messages.frame_ids - {skin.frame(cube)})
    # Where messages of `stress` did not arrive here, the row of a cube's message may be missing.
    if not record.stress.gaps:
        wrong += agrees.count(False)
    figures = {
        "cube_messages": len(agrees),
        "wrong_cube_messages": wrong,
    }
    return Findings(figures, [])


def _is_near(found: ArrayLike, wanted: ArrayLike) -> bool:
    """Return whether numbers of single precision agree with numbers of double precision."""
    target = np.asarray(wanted, float)
    # Components that are 0 have an error that is small against the largest one.
    size = np.abs(np.nan_to_num(target))
    allowed = MAX_RELATIVE_ERROR * size + 1e-9 * size.max(initial=0.0)
    return bool(agree(np.asarray(found), target, allowed).all())
