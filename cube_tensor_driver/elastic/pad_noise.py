"""Noise of a cube's components from that of its pads and of their gains.

The noise of the components of a cube is that of its pads by B, in units of their deviations. An
error of a gain counts in proportion to the stress u on its pad::

    N = B diag(1 + GAIN_ERROR^2 u^2) B',     u = B' (B B')^-1 y

u are the least stresses of pads, over their noise, that make the values y.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.calibration import Calibration
from ..core.modes import COMPONENTS
from ..core.pipeline import Pipeline

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

GAIN_ERROR = 0.01
"""Standard deviation of a pad's gain against what its calibration says."""


def noise_by_pad(calibrations: Sequence[Calibration]) -> Array:
    """B (cubes, 15, P): what the standard deviation of each pad's noise makes of each component, Pa
    and Pa/m. NaN where a component is not observed; 0 for pads that a cube does not have."""
    pipeline = Pipeline(calibrations)
    by_pad = np.zeros((len(calibrations), len(COMPONENTS), pipeline.n_pads))
    for cube, calibration in enumerate(calibrations):
        own = pipeline.matrix(cube) * calibration.noise
        by_pad[cube, :, : own.shape[1]] = own
    return by_pad


def pad_stresses(by_pad: Array, known: Mask, values: Array) -> Array:
    """u (n, P) from by_pad (n, C, P) and what is known of values (n, C), in the same units."""
    by_pad = np.where(known[:, :, None], by_pad, 0.0)
    of_pad = by_pad.swapaxes(1, 2)
    whole = by_pad @ of_pad + np.eye(known.shape[1]) * ~known[:, None, :]
    weights = np.linalg.solve(whole, np.where(known, values, 0.0)[..., None])
    return np.asarray((of_pad @ weights)[..., 0])
