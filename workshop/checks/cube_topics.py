"""Check of one cube's own topics: their messages against the rows of `stress` of the same stamp."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.status import INVALID
from cube_tensor_driver.core.tensor import contact_wrench

from .record import Tensor, Wrench
from .run import Findings, Run

MAX_RELATIVE_ERROR = 1e-5
"""Largest relative difference: a row of `stress` has float32, a message of one cube float64."""


def check_cube_topics(run: Run) -> Findings:
    """Count the messages, and those that agree with no row of their stamp."""
    record, skin = run.record, run.record.skin
    messages, rows = record.cube_messages, record.stress.rows
    rows = rows.select(np.flatnonzero(rows.cube == messages.cube))
    pipeline = Pipeline([cube.calibration for cube in skin.cubes], np.float64)
    cube = skin.cubes[messages.cube]

    def is_tensor_of(message: Tensor, row: int) -> bool:
        _, values, residual, status, observed, covariance = message
        wanted = pipeline.covariance(messages.cube, int(rows.left_out[row]))
        has_bits = status == rows.status[row] and observed == rows.observed[row]
        components = np.concatenate([rows.stress[row], rows.gradient[row]])
        is_near = _is_near(values, components) and _is_near(residual, rows.residual[row])
        return has_bits and is_near and _is_near(covariance, wanted.ravel())

    def is_wrench_of(message: Wrench, row: int) -> bool:
        one = slice(row, row + 1)
        side = 2 * cube.calibration.half_side
        wanted = contact_wrench(rows.stress[one], rows.gradient[one], side)
        # A row without components gives no wrench.
        is_valid = rows.status[row] & INVALID == 0
        return bool(is_valid) and _is_near(message[1], np.concatenate(wanted, axis=1)[0])

    def find(message: Tensor | Wrench) -> list[int]:
        """Return the rows of a stamp; a row that comes late may have the stamp of another one."""
        places: list[int] = np.flatnonzero(rows.stamp_ns == message[0]).tolist()
        return places

    agrees = [any(is_tensor_of(one, row) for row in find(one)) for one in messages.tensors]
    agrees += [any(is_wrench_of(one, row) for row in find(one)) for one in messages.wrenches]
    wrong = len(messages.frame_ids - {skin.frame(cube)})
    # Where messages of `stress` are missing here, the row of a message may be missing, too.
    if not record.stress.gaps:
        wrong += agrees.count(False)
    return Findings({"cube_messages": len(agrees), "wrong_cube_messages": wrong}, [])


def _is_near(found: ArrayLike, wanted: ArrayLike) -> bool:
    """Compare numbers of different precision."""
    scale = np.nan_to_num(np.abs(np.asarray(wanted, float))).max(initial=0.0)
    tolerance = {"rtol": MAX_RELATIVE_ERROR, "atol": 1e-9 * scale}
    return bool(np.allclose(found, wanted, equal_nan=True, **tolerance))
