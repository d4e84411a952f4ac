# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of the pads' response to specific force, from a recording of an unloaded arm that was turned.

    stress of a pad = gain * response . s + a + b t

The specific force s (acceleration minus gravity, in the frame of the cube) is recorded; the
constant a and the drift b of each pad over the time t are of no interest.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..bags.source import open_bag
from ..core.arrays import Array
from ..core.calibration import Calibration
from ..core.compensation.models import WeightModel
from ..core.errors import BagError
from ..core.pipeline import Pipeline

BLOCK_NS = 500_000_000
"""Length of the blocks over which frequencies and specific forces are averaged, in ns."""

MIN_SPREAD = 3.0
"""Smallest standard deviation of the specific force, in m/s², along the direction in which it
varies least. Three poses with another axis upwards each have 4.6."""

MIN_BLOCKS = 20
"""Smallest number of blocks of `BLOCK_NS`, four times the number of unknowns of a pad."""


def fit_weight(path: Path, name: str | None = None) -> Calibration:
    """Return the recorded calibration with the response to specific force that a bag shows.

    Args:
        path: Path of a bag in which nothing touches the skin.
        name: Name of the cube to fit; None: all cubes, which must have one calibration and get the
            mean of their responses.

    Raises:
        BagError: The bag has no such cube, states no motion, or does not turn it enough.
    """
    with open_bag(path) as source:
        names, calibrations = list(source.skin.names), source.recording.settings[0].calibrations
        if name is not None and name not in names:
            raise BagError(f"{path}: no cube {name!r}; its cubes are {', '.join(names[:20])}")
        cubes = range(len(names)) if name is None else [names.index(name)]
        if len({calibrations[cube].id for cube in cubes}) > 1:
            raise BagError(f"{path}: its cubes have different calibrations; name one with --cube")
        pipeline = Pipeline(calibrations)
        n_blocks = (source.bag.end_ns - source.bag.start_ns) // BLOCK_NS + 1
        sums = np.zeros((len(names), n_blocks, pipeline.n_pads + 3))
        counts = np.zeros((len(names), n_blocks, 1))
        for rows in source:
            if rows.specific_force is None:
                raise BagError(
                    f"{path}: it states no motion of the skin; record it while the parameter imu "
                    "or gravity of the reconstruction is set"
                )
            values = np.hstack([pipeline.pad_stress(rows), rows.specific_force])
            n_pads = np.array([c.layout.n_pads for c in calibrations])[rows.cube]
            is_absent = np.arange(values.shape[1] - 3) >= n_pads[:, None]
            values[:, :-3][is_absent] = 0
            block = (rows.stamp_ns - source.bag.start_ns) // BLOCK_NS
            is_used = np.isfinite(values).all(axis=1) & (block >= 0) & (block < n_blocks)
            place = rows.cube[is_used], block[is_used]
            np.add.at(sums, place, values[is_used])
            np.add.at(counts, place, 1)

    responses, variances = [], []
    for cube in cubes:
        has_rows = np.flatnonzero(counts[cube, :, 0])
        means = sums[cube, has_rows] / counts[cube, has_rows]
        response, variance = _fit_cube(means, has_rows.astype(float), f"{path}: cube {names[cube]}")
        gain = calibrations[cube].gain[:, None]
        responses.append(response[: len(gain)] / gain)
        variances.append(variance[: len(gain)] / gain**2)
    scatter = np.mean(variances, axis=0)
    # Cubes of one kind differ, and the common response is wrong by that for each of them.
    between = np.maximum(np.var(responses, axis=0) - scatter, 0)
    model = WeightModel(np.mean(responses, axis=0), np.sqrt(scatter / len(responses) + between))
    base = calibrations[cubes[0]]
    return replace(base, weight=model, source=f"{base.source}; weight fitted to {path.name}")


def _fit_cube(means: Array, time: Array, label: str) -> tuple[Array, Array]:
    """Return the response of the pads of one cube with gains (P, 3), and its variance (P, 3).

    Args:
        means: Means of the stresses of P pads, then of the specific force, of blocks (n, P + 3).
        time: Times of the blocks (n,), in any unit.
        label: Bag and cube, for error messages.

    Raises:
        BagError: The blocks are too few, or the specific force varies too little.
    """
    pads, force = means[:, :-3], means[:, -3:]
    if len(means) < MIN_BLOCKS:
        raise BagError(
            f"{label}: {len(means)} blocks of 0.5 s with a known motion; at least {MIN_BLOCKS} are "
            "needed, so record longer"
        )
    spread = np.linalg.svd(force - force.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(force))
    if spread < MIN_SPREAD:
        raise BagError(
            f"{label}: its specific force varies by {spread:.2g} m/s² along one direction; at "
            f"least {MIN_SPREAD:g} are needed, so turn the arm until each axis has pointed upwards"
        )
    columns = np.column_stack([force, np.ones(len(time)), time - time.mean()])
    solution, *_ = np.linalg.lstsq(columns, pads, rcond=None)
    residual = pads - columns @ solution
    variance = (residual**2).sum(axis=0) / (len(means) - columns.shape[1])
    inverse = np.linalg.inv(columns.T @ columns)
    return solution[:3].T, variance[:, None] * np.diag(inverse)[:3]
