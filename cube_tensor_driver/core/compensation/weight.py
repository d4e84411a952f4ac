# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation of weight and inertia: the pads' response to the specific force of each row.

A row is one sample of one cube; the specific force is what an accelerometer at the cube measures.
C is the number of cubes of the skin, P the largest number of pads of a cube.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array
from ..pipeline import Pipeline

STANDARD_GRAVITY = 9.80665
"""Standard acceleration of gravity, in m/s² (ISO 80000-3)."""


class Weight:
    """Response of the pads of one skin to specific force.

    Attributes:
        has_model: Whether the calibration of a cube states its response (C,).
        response: Stress on each pad per specific force (C, 3, P), in Pa per m/s².
    """

    key = "weight"

    def __init__(self, pipeline: Pipeline) -> None:
        models = [calibration.weight for calibration in pipeline.calibrations]
        self.has_model = np.array([model is not None for model in models])
        self.response = np.zeros((len(models), 3, pipeline.n_pads))
        self._deviation = np.zeros_like(self.response)
        for number, model in enumerate(models):
            if model is None:
                continue
            gain = pipeline.calibrations[number].gain
            self.response[number, :, : len(gain)] = gain * model.response.T
            if model.deviation is not None:
                self._deviation[number, :, : len(gain)] = gain * model.deviation.T

    def deviation(self, cube: int, force: Array) -> Array:
        """Return patterns (P, 3) of one standard deviation each, as `Compensation.growth` does.

        An unknown specific force is taken as 0 with a standard deviation of 1 g along each axis.

        Args:
            cube: Number of the cube.
            force: Its newest specific force (3,), in m/s²; NaN: unknown.
        """
        patterns: Array = self._deviation[cube].T * force
        if np.isnan(force).any():
            patterns = self.response[cube].T * STANDARD_GRAVITY
        return patterns
