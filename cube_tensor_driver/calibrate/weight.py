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
from typing import NamedTuple

import numpy as np

from ..bags.source import open_bag
from ..core.arrays import Array
from ..core.calibration import Calibration
from ..core.compensation.models import WeightModel
from ..core.errors import BagError
from ..core.pipeline import Pipeline
from .recorded_loads import BlockMeans, find_cubes

BLOCK_NS = 500_000_000
"""Length, in ns, of the blocks of time over which the stresses on the pads and the specific forces
are averaged."""

MIN_SPREAD = 3.0
"""Smallest standard deviation of the specific force, in m/s², along the direction in which it
varies least. If it is smaller, the fit raises an error.

Six poses, in which each axis of the cube points upwards and downwards once, yield 5.7. Four poses
are the fewest that suffice (x, y, z upwards, z downwards: 3.5); three poses yield 0.
"""

MIN_BLOCKS = 20
"""Smallest number of blocks (of 0.5 s) with data. With fewer, the fit raises an error.

It is four times the number of unknowns of a pad, which are three responses, a constant and a drift.
"""


class WeightFit(NamedTuple):
    """Response of the pads to specific force (weight and inertia), fitted to a recording.

    Attributes:
        calibration: The calibration that the recording contains, with the response added.
        seconds: Times (N,), in s, of the N blocks (0.5 s each) in which the first cube has data.
        before: Stresses on the pads of the first cube, averaged over each block (N, P), in Pa,
            minus a fitted constant and linear drift.
        after: `before` minus the fitted effect of weight (N, P), in Pa.
    """

    calibration: Calibration
    seconds: Array
    before: Array
    after: Array


def fit_weight(path: Path, name: str | None = None) -> WeightFit:
    """Fit the pads' response to specific force (acceleration minus gravity) to a bag (recording).

    Args:
        path: Path of a bag in which nothing touches the skin.
        name: Name of the cube to fit; None: all cubes, which must have one calibration and get the
            mean of their responses.

    Raises:
        BagError: The bag has no such cube, states no motion of the skin, or is too short; its cubes
            have different calibrations; or the skin was not turned enough.
    """
    with open_bag(path) as source:
        calibrations = source.recording.settings[0].calibrations
        names = source.skin.names
        cubes = find_cubes(source, path, name)
        if len({calibrations[cube].id for cube in cubes}) > 1:
            raise BagError(f"{path}: its cubes have different calibrations; name one with --cube")
        pipeline = Pipeline(calibrations)
        is_absent = np.isnan(pipeline.rest_frequency)
        blocks = BlockMeans(source, BLOCK_NS, pipeline.n_pads + 3)
        for rows in source:
            if rows.specific_force is None:
                raise BagError(
                    f"{path}: it states no motion of the skin; record it while the parameter imu "
                    "or gravity of the reconstruction is set"
                )
            pad_stress = pipeline.pad_stress(rows)
            stress = np.where(is_absent[rows.cube], 0, pad_stress)
            blocks.add(rows, np.hstack([stress, rows.specific_force]))

    responses = []
    variances = []
    shown: list[tuple[Array, Array, Array]] = []
    for cube in cubes:
        number, means = blocks.of_cube(cube)
        label = f"{path}: cube {names[cube]}"
        response, variance, residual = _fit_cube(means, number.astype(float), label)
        gain = calibrations[cube].gain[:, None]
        present = slice(len(gain))
        responses.append(response[present] / gain)
        variances.append(variance[present] / gain**2)
        after = residual[:, present]
        before = after + means[:, -3:] @ response[present].T
        seconds = number.astype(float) * (BLOCK_NS * 1e-9)
        shown.append((seconds, before - before.mean(axis=0), after))

    scatter = np.mean(variances, axis=0)
    # Cubes of one kind differ, so the mean response differs from that of each cube. This variance
    # between cubes is added to the variance of the mean.
    between = np.maximum(np.var(responses, axis=0) - scatter, 0)
    deviation = np.sqrt(scatter / len(responses) + between)
    model = WeightModel(np.mean(responses, axis=0), deviation)
    base = calibrations[cubes[0]]
    source_text = f"{base.source}; weight fitted to {path.name}"
    return WeightFit(replace(base, weight=model, source=source_text), *shown[0])


def _fit_cube(
    means: Array,
    time: Array,
    label: str,
) -> tuple[Array, Array, Array]:
    """Fit the response of the pads of one cube.

    Args:
        means: Averages over n blocks of the stresses on P pads, in Pa, then of the specific force,
            in m/s² (n, P + 3).
        time: Times of the blocks (n,), in any unit.
        label: Bag and cube, for error messages.

    Returns:
        Response (P, 3), in Pa per m/s², including the gains of the pads; its variance (P, 3); and
        the residual of the stresses (n, P), in Pa.

    Raises:
        BagError: The blocks are too few, or the specific force varies too little.
    """
    pads = means[:, :-3]
    force = means[:, -3:]
    if len(means) < MIN_BLOCKS:
        raise BagError(
            f"{label}: {len(means)} blocks of 0.5 s with a known motion; at least {MIN_BLOCKS} are "
            "needed, so record longer"
        )
    change = force - force.mean(axis=0)
    smallest = np.linalg.svd(change, compute_uv=False)[-1]
    spread = smallest / np.sqrt(len(force))
    if spread < MIN_SPREAD:
        raise BagError(
            f"{label}: its specific force varies by {spread:.2g} m/s² along one direction; at "
            f"least {MIN_SPREAD:g} are needed, so turn the arm until each axis has pointed "
            "up and down"
        )

    constant = np.ones(len(time))
    drift = time - time.mean()
    columns = np.column_stack([force, constant, drift])
    solution, *_ = np.linalg.lstsq(columns, pads, rcond=None)
    residual = pads - columns @ solution
    degrees_of_freedom = len(means) - columns.shape[1]
    variance = (residual**2).sum(axis=0) / degrees_of_freedom
    inverse = np.linalg.inv(columns.T @ columns)
    spreads = np.diag(inverse)[:3]
    return solution[:3].T, variance[:, None] * spreads, residual
