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

from ..core.arrays import Array
from ..core.calibration import Calibration
from ..core.compensation.models import WeightModel
from ..core.errors import BagError
from .block_means import BlockMeans

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
    blocks = BlockMeans(path, name, BLOCK_NS, "specific_force", width=3)
    if not blocks.counts.any():
        raise BagError(
            f"{path}: it states no motion of the skin; record it while the parameter imu "
            "or gravity of the reconstruction is set"
        )
    first, *others = blocks.cubes
    base = blocks.calibrations[first]
    if any(blocks.calibrations[cube].id != base.id for cube in others):
        raise BagError(f"{path}: its cubes have different calibrations; name one with --cube")
    fits = [
        _fit_cube(*blocks.select_cube(cube), f"{path}: cube {blocks.names[cube]}")
        for cube in blocks.cubes
    ]
    gain = base.gain[:, None]
    responses = [fit.response / gain for fit in fits]
    scatter = np.mean([fit.variance for fit in fits], axis=0) / gain**2
    # Cubes of one kind differ, so the mean response differs from that of each cube. This variance
    # between cubes is added to the variance of the mean.
    between = np.maximum(np.var(responses, axis=0) - scatter, 0)
    deviation = np.sqrt(scatter / len(responses) + between)
    model = WeightModel(np.mean(responses, axis=0), deviation)
    source = f"{base.source}; weight fitted to {path.name}"
    fitted = replace(base, weight=model, source=source)
    return WeightFit(fitted, fits[0].seconds, fits[0].before, fits[0].after)


class _CubeFit(NamedTuple):
    """Fit of the response of one cube's pads to specific force.

    Attributes:
        response: Response (P, 3), in Pa per m/s², including the gains of the pads.
        variance: Variance of the response (P, 3).
        seconds, before, after: Times and stresses of this cube, as in `WeightFit`.
    """

    response: Array
    variance: Array
    seconds: Array
    before: Array
    after: Array


def _fit_cube(
    seconds: Array,
    pads: Array,
    force: Array,
    label: str,
) -> _CubeFit:
    """Fit the response of the pads of one cube.

    Args:
        seconds: Times of n blocks (n,), in s.
        pads: Stresses on P pads (n, P), in Pa.
        force: Specific forces (n, 3), in m/s².
        label: Bag and cube, for error messages.

    Raises:
        BagError: The blocks are too few, or the specific force varies too little.
    """
    if len(force) < MIN_BLOCKS:
        raise BagError(
            f"{label}: {len(force)} blocks of 0.5 s with a known motion; at least {MIN_BLOCKS} are "
            "needed, so record longer"
        )
    change = force - force.mean(axis=0)
    spread = np.linalg.svd(change, compute_uv=False)[-1] / np.sqrt(len(force))
    if spread < MIN_SPREAD:
        raise BagError(
            f"{label}: its specific force varies by {spread:.2g} m/s² along one direction; at "
            f"least {MIN_SPREAD:g} are needed, so turn the arm until each axis has pointed "
            "up and down"
        )
    columns = np.column_stack([change, np.ones(len(force)), seconds - seconds.mean()])
    solution, *_ = np.linalg.lstsq(columns, pads, rcond=None)
    after = pads - columns @ solution
    degrees_of_freedom = len(columns) - columns.shape[1]
    variance = (after**2).sum(axis=0) / degrees_of_freedom
    inverse = np.linalg.inv(columns.T @ columns)
    return _CubeFit(
        response=solution[:3].T,
        variance=variance[:, None] * np.diag(inverse)[:3],
        seconds=seconds,
        before=after + change @ solution[:3],
        after=after,
    )
