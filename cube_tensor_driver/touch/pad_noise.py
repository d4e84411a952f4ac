"""Noise of a cube's components from that of its pads and of their gains.

The noise of the components of a cube is that of its pads by B, in units of their deviations. An
error of a gain counts in proportion to the stress u on its pad::

    N = B diag(1 + GAIN_ERROR^2 u^2) B',     u = B' (B B')^-1 y

u are the least stresses of pads, over their noise, that make the values y.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..core.arrays import Array, Index, Mask, PadMasks
from ..core.calibration import Calibration
from ..core.modes import COMPONENTS
from ..core.pipeline import Pipeline

GAIN_ERROR = 0.01
"""Standard deviation of a pad's gain against what its calibration says."""


def noise_by_pad(pipeline: Pipeline, cubes: Index, left_out: PadMasks) -> Array:
    """B (n, 15, P) of some cubes: what the standard deviation of each pad's noise makes of each
    component, Pa and Pa/m.

    left_out: (n,) bits of pads that are left out. NaN where a component is not observed; 0 for pads
    that are left out or that a cube does not have.
    """
    by_pad = np.zeros((len(cubes), len(COMPONENTS), pipeline.n_pads))
    for row, (cube, mask) in enumerate(zip(cubes.tolist(), left_out.tolist(), strict=True)):
        own = pipeline.matrix(cube, mask) * pipeline.calibrations[cube].noise
        by_pad[row, :, : own.shape[1]] = own
    return by_pad


def noise_of_all_pads(calibrations: Sequence[Calibration]) -> Array:
    """The same (cubes, 15, P) of cubes with these calibrations and with all of their pads."""
    n = len(calibrations)
    return noise_by_pad(Pipeline(calibrations), np.arange(n), np.zeros(n, np.uint32))


def pad_stresses(by_pad: Array, known: Mask, values: Array) -> Array:
    """u (n, P) from by_pad (n, C, P) and what is known of values (n, C), in the same units."""
    by_pad = np.where(known[:, :, None], by_pad, 0.0)
    of_pad = by_pad.swapaxes(1, 2)
    whole = by_pad @ of_pad + np.eye(known.shape[1]) * ~known[:, None, :]
    weights = np.linalg.solve(whole, np.where(known, values, 0.0)[..., None])
    return np.asarray((of_pad @ weights)[..., 0])
