# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation of weight and inertia: the pads' response to the specific force of each row.

A row is one sample of one cube; the specific force is what an accelerometer at the cube measures.
C is the number of cubes of the skin, P the largest number of pads of a cube.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array, Index
from ..calibration import tabulate_pads
from ..pipeline import Pipeline
from .models import tabulate

STANDARD_GRAVITY = 9.80665
"""Standard acceleration of gravity, in m/s² (ISO 80000-3)."""


class Weight:
    """Response of the pads of one skin to specific force (acceleration minus gravity).

    Attributes:
        has_model: Whether the calibration of a cube states its response (C,).
        response: Stress on each pad per specific force (C, P, 3), in Pa per m/s².
    """

    def __init__(self, pipeline: Pipeline) -> None:
        models = [calibration.weight for calibration in pipeline.calibrations]
        self.has_model = np.array([model is not None for model in models])
        n_pads = pipeline.n_pads
        gain = tabulate_pads(pipeline.calibrations, "gain", n_pads, fill=0)[..., None]
        self.response = gain * tabulate(models, "response", (n_pads, 3))
        self._deviation = gain * tabulate(models, "deviation", (n_pads, 3))

    def compute_errors(self, cubes: Index, force: Array) -> Array:
        """Return the errors (n, P, 3) of the compensation of weight by independent causes, in Pa.

        Each axis of the cube is one cause, and each column has the size of one standard deviation.
        An unknown specific force is taken as 0 with a standard deviation of 1 g along each axis.

        Args:
            cubes: Numbers of n cubes.
            force: Their newest specific forces (n, 3), in m/s²; NaN: unknown.
        """
        known = self._deviation[cubes] * force[:, None]
        unknown = self.response[cubes] * STANDARD_GRAVITY
        is_unknown = np.isnan(force.sum(axis=1))
        errors: Array = np.where(is_unknown[:, None, None], unknown, known)
        return errors
