"""Compares messages of one cube's own topics with the rows of `stress` of the same stamp."""

from __future__ import annotations

import numpy as np

from ..core.pipeline import Pipeline
from ..core.status import INVALID
from ..core.tensor import contact_wrench
from .record import Record

RELATIVE = 1e-5
"""float32 on one side, double precision on the other."""


def judge_cube_topics(record: Record) -> dict[str, int]:
    """How many messages were compared, and how many of them are wrong."""
    messages, skin = record.cube_messages, record.skin
    rows = record.stress.rows
    mine = rows.select(np.flatnonzero(rows.cube == messages.cube))
    place = {stamp: number for number, stamp in enumerate(mine.stamp_ns.tolist())}
    pipeline = Pipeline([cube.calibration for cube in skin.cubes], np.float64)
    compared = wrong = 0
    for stamp_ns, values, residual, status, observed, covariance in messages.tensors:
        row = place.get(stamp_ns)
        if row is None:
            wrong += not bool(record.stress.gaps)
            continue
        compared += 1
        wanted = np.concatenate([mine.stress[row], mine.gradient[row]])
        right = (
            _near(values, wanted)
            and _near(residual, mine.residual[row])
            and status == mine.status[row]
            and observed == mine.observed[row]
            and _near(
                covariance,
                pipeline.covariance(messages.cube, int(mine.left_out[row])).ravel(),
            )
        )
        wrong += not right
    side = 2 * skin.cubes[messages.cube].calibration.half_side
    for stamp_ns, wrench in messages.wrenches:
        row = place.get(stamp_ns)
        if row is None:
            wrong += not bool(record.stress.gaps)
            continue
        compared += 1
        one = slice(row, row + 1)
        force, torque = contact_wrench(mine.stress[one], mine.gradient[one], side)
        is_valid = mine.status[row] & INVALID == 0
        wrong += not (is_valid and _near(wrench, np.concatenate([force[0], torque[0]])))
    frame = skin.frame(skin.cubes[messages.cube])
    wrong += len(messages.frame_ids - {frame})
    return {"cube_messages": compared, "wrong_cube_messages": int(wrong)}


def _near(found: object, wanted: object) -> bool:
    one, other = np.asarray(found, float), np.asarray(wanted, float)
    scale = np.nan_to_num(np.abs(other)).max(initial=0.0)
    return bool(np.allclose(one, other, rtol=RELATIVE, atol=1e-9 * scale, equal_nan=True))
