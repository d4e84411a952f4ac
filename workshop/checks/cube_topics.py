"""Compares messages of one cube's own topics with the rows of `stress` of the same stamp."""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.status import INVALID
from cube_tensor_driver.core.tensor import contact_wrench

from .record import Record, Tensor, Wrench

RELATIVE = 1e-5
"""float32 on one side, double precision on the other."""


def judge_cube_topics(record: Record) -> dict[str, int]:
    """How many messages were compared, and how many of them are like no row of their stamp."""
    messages, skin = record.cube_messages, record.skin
    rows = record.stress.rows
    mine = rows.select(np.flatnonzero(rows.cube == messages.cube))
    # Rows that come late may have the stamp of the one before.
    places: dict[int, list[int]] = {}
    for place, stamp_ns in enumerate(mine.stamp_ns.tolist()):
        places.setdefault(stamp_ns, []).append(place)
    pipeline = Pipeline([cube.calibration for cube in skin.cubes], np.float64)
    side = 2 * skin.cubes[messages.cube].calibration.half_side

    def is_tensor_of(message: Tensor, row: int) -> bool:
        _, values, residual, status, observed, covariance = message
        wanted = pipeline.covariance(messages.cube, int(mine.left_out[row])).ravel()
        return (
            _near(values, np.concatenate([mine.stress[row], mine.gradient[row]]))
            and _near(residual, mine.residual[row])
            and status == mine.status[row]
            and observed == mine.observed[row]
            and _near(covariance, wanted)
        )

    def is_wrench_of(message: Wrench, row: int) -> bool:
        one = slice(row, row + 1)
        force, torque = contact_wrench(mine.stress[one], mine.gradient[one], side)
        is_valid = mine.status[row] & INVALID == 0
        return bool(is_valid) and _near(message[1], np.concatenate([force[0], torque[0]]))

    right = [
        any(is_tensor_of(tensor, row) for row in places.get(tensor[0], ()))
        for tensor in messages.tensors
    ]
    right += [
        any(is_wrench_of(wrench, row) for row in places.get(wrench[0], ()))
        for wrench in messages.wrenches
    ]
    wrong = len(messages.frame_ids - {skin.frame(skin.cubes[messages.cube])})
    if not record.stress.gaps:  # else the row of a message may not have come here
        wrong += right.count(False)
    return {"cube_messages": len(right), "wrong_cube_messages": wrong}


def _near(found: object, wanted: object) -> bool:
    one, other = np.asarray(found, float), np.asarray(wanted, float)
    scale = np.nan_to_num(np.abs(other)).max(initial=0.0)
    return bool(np.allclose(one, other, rtol=RELATIVE, atol=1e-9 * scale, equal_nan=True))
