# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The sum of all effects that are subtracted from the stresses on the pads.

    v = (f - f0) / (f_highest - f)        pad law: stress on a pad / its stiffness
    v - offset,  offset = sum of effects  what the load contributes

A row is one sample of one cube, P the largest number of pads of a cube. Without effects, nothing is
computed here.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from ..arrays import Array, Mask, PadMasks, index_cubes
from ..pipeline import Pipeline, Watch
from ..rows import FrequencyRows, StressRows
from ..status import COMPENSATION
from .creep import Creep
from .effect import Effect
from .thermal import Thermal
from .weight import Weight


class Compensation:
    """Subtracts the effects on the pads of one skin that are no load.

    Attributes:
        creep: The compensation of creep, which a tare needs.
        effects: The effects, in the order in which they are subtracted. Creep comes after the
            effect of temperature, whose model was measured in place and contains the creep of the
            foam under thermal stress, and before weight, which strains the foam.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self.creep = Creep(pipeline)
        self.effects: list[Effect] = [Thermal(pipeline), self.creep, Weight(pipeline)]
        self._active: list[Effect] = []

    def process(
        self,
        rows: FrequencyRows,
        left_out: PadMasks | None,
        *,
        watch: Watch | None,
        known: Mask | None,
        out: StressRows,
    ) -> StressRows:
        """Compute the stress of rows without the effects; arguments as `Pipeline.process`."""
        self._active = [effect for effect in self.effects if effect.applies(rows)]
        if not self._active:
            self._pipeline.newest_offset = None
            return self._pipeline.process(rows, left_out, watch=watch, known=known, out=out)
        parts = self._split(rows)
        if len(parts) == 1:
            # Selecting takes 18 us.
            self._process_part(rows, left_out, watch, known, out)
            return out
        for part in parts:
            self._process_part(
                rows.select(part),
                None if left_out is None else left_out[part],
                watch,
                None if known is None else known[part],
                out.select(part),
            )
        return out

    def growth(self, cube: int, left_out: int = 0) -> Array | None:
        """Return what the effects add to the covariance (15, 15) of a cube's newest row.

        Args:
            cube: Number of the cube.
            left_out: Bit mask of the pads that are not used.

        Returns:
            Covariance in the units of `Pipeline.covariance`; None: nothing.
        """
        patterns = [effect.deviation(cube) for effect in self._active]
        if not any(pattern.any() for pattern in patterns):
            return None
        matrix = self._pipeline.matrix(cube, left_out)
        n_pads = matrix.shape[1]
        components = matrix @ np.hstack(patterns)[:n_pads]
        growth: Array = components @ components.T
        return growth

    def states(self) -> dict[str, Array]:
        """Return the states that earlier rows left, by the names of the effects that have one."""
        states = {}
        for effect in self.effects:
            state = effect.state()
            if len(state):
                states[effect.key] = state
        return states

    def restore(self, states: Mapping[str, Array]) -> None:
        """Continue from recorded states, so that the next rows give the bits of the recording.

        Args:
            states: States of effects by name; the others go on as they are.

        Raises:
            LayoutError: A state is that of another skin.
        """
        for effect in self.effects:
            if effect.key in states:
                effect.restore(states[effect.key])

    def _split(self, rows: FrequencyRows) -> list[slice]:
        """Return the parts of rows that are processed at once: all, or single scans."""
        if not any(effect.is_recursive for effect in self._active):
            return [slice(None)]
        # A scan begins where the cube number does not rise.
        begins = np.flatnonzero(rows.cube[1:] <= rows.cube[:-1]) + 1
        bounds = [0, *begins.tolist(), len(rows)]
        return [slice(*ends) for ends in pairwise(bounds)]

    def _process_part(
        self,
        rows: FrequencyRows,
        left_out: PadMasks | None,
        watch: Watch | None,
        known: Mask | None,
        out: StressRows,
    ) -> None:
        """Compute the stress of rows without the effects.

        Args:
            rows: Rows of frequencies, of one scan if an effect is recursive.
            left_out, watch, known, out: As for `Pipeline.process`.
        """
        pipeline = self._pipeline
        # Cube numbers that the skin does not have are refused or marked by the pipeline.
        n_cubes = len(pipeline.calibrations)
        cube = np.clip(rows.cube, 0, n_cubes - 1).astype(np.intp)
        shape = len(rows), pipeline.n_pads
        offset = np.zeros(shape, pipeline.dtype)
        # Sum of the effects that come before each recursive one.
        before = {}
        bits = np.zeros(len(rows), np.uint16)
        for effect in self._active:
            if effect.is_recursive:
                before[effect] = offset.copy()
            is_known = effect.add_offset(rows, cube, offset)
            bit = np.where(is_known, effect.bit, COMPENSATION)
            bits |= bit.astype(np.uint16)

        v = np.empty_like(offset) if before else None
        pipeline.process(
            rows,
            left_out,
            watch=watch,
            known=known,
            out=out,
            offset=offset,
            v=v,
        )
        out.status[:] |= bits
        for effect, earlier in before.items():
            effect.update(rows, cube, v - earlier, out.left_out)

        if pipeline.newest_offset is None:
            pipeline.newest_offset = np.zeros((n_cubes, pipeline.n_pads))
        pipeline.newest_offset[index_cubes(cube, n_cubes)] = offset
