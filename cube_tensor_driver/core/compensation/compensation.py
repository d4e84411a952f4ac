# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The effects on the pads that are subtracted, because they are no load: the sum of all of them.

    v = (f - f0) / (f_highest - f)        pad law: stress on a pad / its stiffness
    v - offset,  offset = sum of effects  what the load contributes

The kernel subtracts the offsets from each row (`kernel.contract.Offsets`). What creep and
temperature contribute to them is computed here in steps that are longer than the interval between
rows. Creep comes after temperature, whose effect was measured in place and contains the creep of
the foam under thermal stress, and before weight, which strains the foam.

A row is one sample of one cube, C the number of cubes of the skin, P the largest number of pads of
a cube. Without effects, nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..arrays import Array, Mask, PadMasks, Real
from ..errors import LayoutError
from ..kernel.contract import Columns, Offsets
from ..pipeline import Pipeline, Watch
from ..rows import FrequencyRows, StressRows
from ..status import COMPENSATION, WEIGHT
from .creep import Creep
from .low_pass import STEP_NS
from .thermal import Thermal
from .weight import Weight


class Compensation:
    """Subtracts the effects on the pads of one skin that are no load.

    Attributes:
        creep: The compensation of creep, which a tare needs.
        offsets: What is subtracted, and the newest row of each cube.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        n_cubes = len(pipeline.calibrations)
        shape, real = (n_cubes, pipeline.n_pads), pipeline.dtype
        self._weight = Weight(pipeline)
        stiffness = np.where(pipeline.stiffness > 0, pipeline.stiffness, np.inf)
        response = self._weight.response / stiffness[:, None]
        weighing = np.where(self._weight.has_model, WEIGHT, COMPENSATION)
        self.offsets = Offsets(
            step_ns=np.zeros(2, np.int64),
            since_ns=np.zeros(n_cubes, np.int64),
            offset=np.zeros(shape, real),
            slope=np.zeros(shape, real),
            gain=np.zeros(shape, real),
            lasting=np.zeros(n_cubes, np.uint16),
            response=response.astype(real),
            weighing=weighing.astype(np.uint16),
            newest_ns=np.zeros(n_cubes, np.int64),
            reading=np.zeros(shape, real),
            subtracted=np.zeros(shape, real),
            newest_force=np.full((n_cubes, 3), np.nan, real),
        )
        self._thermal = Thermal(pipeline)
        self.creep = Creep(pipeline, self.offsets)
        both = self._thermal, self.creep
        self._lasting = [effect for effect in both if effect.has_model.any()]
        self._has_forces = False

    def process(
        self,
        rows: FrequencyRows,
        left_out: PadMasks | None,
        *,
        watch: Watch | None,
        known: Mask | None,
        out: StressRows,
        offset: Real | None = None,
    ) -> StressRows:
        """Compute the stress of rows without the effects; arguments as `Pipeline.process`."""
        self._has_forces = rows.specific_force is not None
        is_active = self._has_forces or bool(self._lasting)
        if is_active and self.creep.follow_rest():
            self.offsets.step_ns[:] = 0
        self._pipeline.newest_offset = self.offsets.subtracted if is_active else None
        effects = self if is_active else None
        return self._pipeline.process(
            rows,
            left_out,
            watch=watch,
            known=known,
            out=out,
            effects=effects,
            offset=offset,
        )

    def step(self, columns: Columns, row: int) -> None:
        """Advance creep and temperature to the scan that begins with a row; see `STEP_NS`."""
        scan = columns.select(columns.find_scan(row))
        newest_ns = int(scan.stamp_ns.max())
        self.offsets.step_ns[:] = newest_ns - STEP_NS, newest_ns + STEP_NS
        if not self._lasting:
            return
        self.offsets.since_ns[:] = self.offsets.newest_ns
        if self.creep in self._lasting:
            self.creep.advance(self._thermal.offset, newest_ns)
        if self._thermal in self._lasting:
            self._thermal.advance(scan)
        self._fill_offsets()

    def _fill_offsets(self) -> None:
        """Write the sums of the effects for the kernel."""
        self.offsets.offset[:] = self._thermal.offset + self.creep.offset
        # The gain applies to v with the effect of temperature, which is no reading of creep.
        self.offsets.slope[:] = self.creep.slope - self.creep.gain * self._thermal.offset
        self.offsets.gain[:] = self.creep.gain
        self.offsets.lasting[:] = 0
        for effect in self._lasting:
            bits = np.where(effect.is_known, effect.bit, COMPENSATION)
            self.offsets.lasting[:] |= bits.astype(np.uint16)

    def growth(self, cube: int, left_out: int = 0) -> Array | None:
        """Return what the effects add to the covariance (15, 15) of a cube's newest row.

        An effect states patterns (P, k) of one standard deviation each of the stresses on the pads,
        in Pa; the k patterns are independent of each other.

        Args:
            cube: Number of the cube.
            left_out: Bit mask of the pads that are not used.

        Returns:
            Covariance in the units of `Pipeline.covariance`; None: nothing.
        """
        patterns = [effect.deviation(cube) for effect in self._lasting]
        if self._has_forces:
            patterns.append(self._weight.deviation(cube, self.offsets.newest_force[cube]))
        if not any(pattern.any() for pattern in patterns):
            return None
        matrix = self._pipeline.matrix(cube, left_out)
        components = matrix @ np.hstack(patterns)[: matrix.shape[1]]
        growth: Array = components @ components.T
        return growth

    def states(self) -> dict[str, Array]:
        """Return the states that earlier rows left, as flat numbers, by the names of effects.

        From them, later rows give the same bits; effects without a state have none.
        """
        return {
            effect.key: np.concatenate([part.ravel() for part in self._parts(effect)])
            for effect in self._lasting
        }

    def restore(self, states: Mapping[str, Array]) -> None:
        """Continue from recorded states, so that the next rows give the bits of the recording.

        Args:
            states: States of effects by name; the others go on as they are.

        Raises:
            LayoutError: A state is that of another skin.
        """
        restored = [effect for effect in self._lasting if effect.key in states]
        for effect in restored:
            state, parts = states[effect.key], self._parts(effect)
            ends = np.cumsum([part.size for part in parts])
            if len(state) != ends[-1]:
                raise LayoutError(
                    f"a state of {effect.key} has {len(state)} numbers; it must have {ends[-1]}: "
                    "use the skin of the recording"
                )
            for part, values in zip(parts, np.split(state, ends[:-1]), strict=True):
                part[:] = values.reshape(part.shape)
            effect.resume()
        if restored:
            self._fill_offsets()

    def _parts(self, effect: Thermal | Creep) -> list[Array]:
        """Return the arrays of the state of an effect, which are changed in place.

        Times stand there with their bits, because a float would round them.
        """
        offsets = self.offsets
        times = [offsets.step_ns, offsets.since_ns, offsets.newest_ns]
        return [*(time.view(float) for time in times), *effect.parts()]
