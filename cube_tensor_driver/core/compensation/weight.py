# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation of weight and inertia: the pads' response to the specific force of each row.

A row is one sample of one cube; the specific force is what an accelerometer at the cube measures.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array, Index, Mask, Real, index_cubes
from ..pipeline import Pipeline
from ..rows import FrequencyRows
from ..status import WEIGHT
from .effect import Effect

STANDARD_GRAVITY = 9.80665
"""Standard acceleration of gravity, in m/s² (ISO 80000-3)."""

MAX_SPECIFIC_FORCE = 1000.0
"""Largest credible specific force along one axis, in m/s² (100 g). A larger one counts as missing,
because it is an error of the source and would look like a load."""


class Weight(Effect):
    """Computes what weight and inertia do to the pads of one skin; `Effect` has the attributes."""

    key = "weight"
    bit = WEIGHT
    is_recursive = False

    def __init__(self, pipeline: Pipeline) -> None:
        super().__init__(pipeline)
        models = [calibration.weight for calibration in pipeline.calibrations]
        shape = len(models), pipeline.n_pads, 3
        # Stress on each pad per specific force, in Pa per m/s², and its standard deviation.
        self._response = np.zeros(shape)
        self._deviation = np.zeros(shape)
        for number, model in enumerate(models):
            if model is None:
                continue
            gain = pipeline.calibrations[number].gain[:, None]
            pads = slice(len(gain))
            self._response[number, pads] = gain * model.response
            if model.deviation is not None:
                self._deviation[number, pads] = gain * model.deviation

        # With axes and pads first, numpy multiplies all cubes in one loop.
        stiffness = np.where(pipeline.stiffness > 0, pipeline.stiffness, np.inf)
        table = self._response / stiffness[..., None]
        table = table.transpose(2, 1, 0)
        self._table = np.ascontiguousarray(table, pipeline.dtype)
        self._newest_force = np.full((3, len(models)), np.nan)

    def applies(self, rows: FrequencyRows) -> bool:
        """Return whether the rows have a column of specific forces, known or not."""
        return rows.specific_force is not None

    def add_offset(
        self,
        rows: FrequencyRows,
        cube: Index,
        offset: Real,
    ) -> Mask:
        """Add the effect to the offsets of the pads; see `Effect.add_offset`."""
        if rows.specific_force is None:
            return np.zeros(len(rows), bool)
        given = np.ascontiguousarray(rows.specific_force.T, offset.dtype)
        # NaN, which stands for a force that is not known, fails the comparison.
        is_credible = np.abs(given) < MAX_SPECIFIC_FORCE
        is_known: Mask = is_credible.all(axis=0) & self._has_model[cube]
        newest = np.where(is_known, given, np.nan)
        self._newest_force[:, cube] = newest
        force = np.where(is_known, given, 0)

        chosen = index_cubes(cube, len(self._has_model))
        table = self._table[..., chosen]
        effect = table[0] * force[0]
        effect += table[1] * force[1]
        effect += table[2] * force[2]
        offset += effect.T
        return is_known

    def deviation(self, cube: int) -> Array:
        """Return patterns of one standard deviation of the pads' stresses; see `Effect.deviation`.

        An unknown specific force is taken as 0 with a standard deviation of 1 g along each axis.
        """
        force = self._newest_force[:, cube]
        if np.isnan(force).any():
            pattern: Array = self._response[cube] * STANDARD_GRAVITY
        else:
            pattern = self._deviation[cube] * force
        return pattern
