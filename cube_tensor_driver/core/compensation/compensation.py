# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation of weight, creep and temperature: the sum of their effects on the pads' readings.

    v = (f - f0) / (f_highest - f)        pad law: stress on a pad / its stiffness
    v - offset,  offset = sum of effects  what the load contributes

f is the frequency of a pad, f0 its frequency without load, and f_highest the upper limit of its
frequency (`oscillator.py`). The kernel subtracts the offsets from each row
(`kernel.contract.Offsets`). What creep and temperature contribute to them is computed here in steps
that are longer than the interval between rows.

Creep is computed from readings v minus the effect of temperature, because this effect was measured
in place and already contains the creep of the foam under thermal stress. The effect of weight is
not subtracted from these readings, because the foam creeps under weight as under a load.

A row is one sample of one cube, C the number of cubes of the skin, P the largest number of pads of
a cube. Without effects, nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..arrays import Array, Index, Mask, PadMasks, Real
from ..errors import LayoutError
from ..health.health import Health
from ..kernel.contract import Columns, Offsets
from ..pipeline import Pipeline
from ..rows import FrequencyRows, StressRows
from ..status import COMPENSATION, WEIGHT
from .creep import Creep
from .low_pass import STEP_NS
from .thermal import Thermal
from .weight import Weight


class Compensation:
    """Subtracts weight, creep and the effect of temperature from the readings of one skin's pads.

    Attributes:
        creep: Compensation of creep, which a tare needs.
        is_active: Whether an effect was subtracted from the newest rows.
        offsets: Values that are subtracted, and the newest row of each cube.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        n_cubes = len(pipeline.calibrations)
        shape = n_cubes, pipeline.n_pads
        real = pipeline.dtype
        self._weight = Weight(pipeline)
        stiffness = pipeline.stiffness[..., None]
        # For a pad that the cube does not have, the quotient is 0.
        stiffness = np.where(stiffness > 0, stiffness, np.inf)
        response = (self._weight.response / stiffness).swapaxes(1, 2)
        weighing = np.where(self._weight.has_model, WEIGHT, COMPENSATION)
        self.offsets = Offsets(
            step_ns=np.zeros(2, np.int64),
            since_ns=np.zeros(n_cubes, np.int64),
            offset=np.zeros(shape, real),
            slope=np.zeros(shape, real),
            gain=np.zeros(shape, real),
            lasting=np.zeros(n_cubes, np.uint16),
            response=np.ascontiguousarray(response, real),
            weighing=weighing.astype(np.uint16),
            newest_ns=np.zeros(n_cubes, np.int64),
            reading=np.zeros(shape, real),
            subtracted=np.zeros(shape, real),
            newest_force=np.full((n_cubes, 3), np.nan, real),
        )
        self._thermal = Thermal(pipeline, self.offsets)
        self.creep = Creep(pipeline, self.offsets)
        # Effects that depend on earlier rows. Weight depends on the row itself only.
        with_history = self._thermal, self.creep
        self._lasting = [effect for effect in with_history if effect.has_model.any()]
        self._has_forces = False
        self.is_active = False

    def process(
        self,
        rows: FrequencyRows,
        left_out: PadMasks | None,
        *,
        watch: Health | None,
        known: Mask | None,
        out: StressRows,
        offset: Real | None = None,
    ) -> StressRows:
        """Compute the stress of rows, from which weight, creep and temperature are subtracted.

        The arguments are those of `Pipeline.process`.
        """
        self._has_forces = rows.specific_force is not None
        is_active = self.is_active = self._has_forces or bool(self._lasting)
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
        """Compute creep and the effect of temperature for a step (`STEP_NS`) that begins at a scan.

        Args:
            columns: Rows of frequencies.
            row: Number of the first row of the scan.
        """
        scan = columns.select(columns.find_scan(row))
        newest_ns = int(scan.stamp_ns.max())
        self.offsets.step_ns[0] = newest_ns - STEP_NS
        self.offsets.step_ns[1] = newest_ns + STEP_NS
        if not self._lasting:
            return
        self.offsets.since_ns[:] = self.offsets.newest_ns
        if self.creep in self._lasting:
            self.creep.advance(self._thermal.offset, newest_ns)
        if self._thermal in self._lasting:
            self._thermal.advance(scan)
        self._fill_offsets()

    def _fill_offsets(self) -> None:
        """Write creep plus the effect of temperature on each pad into `offsets`.

        The kernel, the loop over rows, subtracts them from the readings of the pads (pad stress
        divided by stiffness).
        """
        thermal = self._thermal.offset
        np.add(thermal, self.creep.offset, out=self.offsets.offset)
        # The kernel multiplies the gain by the whole reading of a pad, but creep depends only on
        # the reading minus the effect of temperature. The slope contains the difference.
        np.subtract(
            self.creep.slope,
            self.creep.gain * thermal,
            out=self.offsets.slope,
        )
        self.offsets.gain[:] = self.creep.gain
        self.offsets.lasting[:] = 0
        for effect in self._lasting:
            bits = np.where(effect.is_known, effect.bit, COMPENSATION)
            self.offsets.lasting[:] |= bits.astype(np.uint16)

    def compute_pad_errors(self, cubes: Index) -> Array:
        """Return the errors (n, P, k) of the compensation in the newest rows of n cubes, in Pa.

        Each of the k columns is the error of the stress on the pads, of one standard deviation, by
        one of k independent causes. k is 0 while nothing is compensated.

        Args:
            cubes: Numbers (n,) of the cubes.
        """
        errors = [np.zeros((len(cubes), self._pipeline.n_pads, 0))]
        errors += [effect.compute_errors(cubes) for effect in self._lasting]
        if self._has_forces:
            force = self.offsets.newest_force[cubes].astype(float)
            errors.append(self._weight.compute_errors(cubes, force))
        # The stiffness of a pad that a cube does not have is NaN.
        found: Array = np.nan_to_num(np.concatenate(errors, axis=2))
        return found

    def collect_states(self) -> dict[str, Array]:
        """Return the states of creep and of the effect of temperature (n,), by name of the effect.

        A state holds all that later rows need of the earlier ones: after `restore` has set it, the
        later rows give the same bits.
        """
        states: dict[str, Array] = {}
        for effect in self._lasting:
            parts = [part.ravel() for part in self._collect_parts(effect)]
            states[effect.key] = np.concatenate(parts)
        return states

    def restore(self, states: Mapping[str, Array]) -> None:
        """Continue from recorded states, so that the next rows give the bits of the recording.

        Args:
            states: States by name, as `collect_states` returns them. An effect that is missing
                keeps its present state.

        Raises:
            LayoutError: A state has another size, because it is that of another skin.
        """
        restored = [effect for effect in self._lasting if effect.key in states]
        for effect in restored:
            state = states[effect.key]
            parts = self._collect_parts(effect)
            ends = np.cumsum([part.size for part in parts])
            if len(state) != ends[-1]:
                raise LayoutError(
                    f"a state of {effect.key} has {len(state)} numbers; it must have {ends[-1]}: "
                    "use the skin of the recording"
                )
            pieces = np.split(state, ends[:-1])
            for part, values in zip(parts, pieces, strict=True):
                part[:] = values.reshape(part.shape)
            effect.resume()
        if restored:
            self._fill_offsets()

    def _collect_parts(self, effect: Thermal | Creep) -> list[Array]:
        """Return the arrays that hold the state of an effect, which later rows need.

        Writing into them changes the state. Times (int64) are returned as views of type float64
        with the same bits, because a conversion would round them.
        """
        offsets = self.offsets
        return [
            offsets.step_ns.view(float),
            offsets.since_ns.view(float),
            offsets.newest_ns.view(float),
            *effect.collect_parts(),
        ]
