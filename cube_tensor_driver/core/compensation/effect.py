# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What every effect on the pads that is compensated has to provide.

A row is one sample of one cube, P the largest number of pads of a cube.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from ..arrays import Array, Index, Mask, PadMasks, Real
from ..pipeline import Pipeline
from ..rows import FrequencyRows


class Effect(ABC):
    """One effect on the pads that is no load, such as weight or creep.

    Attributes:
        key: Name of the effect, that of its block in a calibration.
        bit: Status bit of rows from which the effect is subtracted.
        is_recursive: Whether the effect depends on the stresses of earlier rows. Scans are then
            processed one by one, and `update` is called after each.
    """

    key: str
    bit: int
    is_recursive: bool

    def __init__(self, pipeline: Pipeline) -> None:
        """Find the cubes whose calibration has a model of the effect.

        Args:
            pipeline: Pipeline with the calibrations and the pads' stiffness.
        """
        models = [getattr(calibration, self.key) for calibration in pipeline.calibrations]
        self._has_model = np.array([model is not None for model in models])

    def applies(self, rows: FrequencyRows) -> bool:
        """Return whether the effect is to be subtracted from rows of this source."""
        return bool(self._has_model.any())

    @abstractmethod
    def add_offset(self, rows: FrequencyRows, cube: Index, offset: Real) -> Mask:
        """Add the effect to offsets (N, P), as far as it is known.

        Args:
            rows: N rows of frequencies; of one scan if an effect is recursive.
            cube: Numbers of their cubes, to index with.
            offset: Offsets, stress / stiffness, which are changed. They must stay finite, and 0 for
                pads that a cube does not have.

        Returns:
            Whether the effect is known, so that it is subtracted, and not too uncertain (N,).
        """

    def update(self, rows: FrequencyRows, cube: Index, v: Real, bad: PadMasks) -> None:
        """Take the stresses on the pads of one scan; an effect that is not recursive does nothing.

        Args:
            rows: N rows of frequencies of one scan.
            cube: Numbers of their cubes, to index with.
            v: Stress / stiffness without the effects that are listed before this one (N, P).
            bad: Bit masks of the pads that are not used (N,).
        """
        return

    @abstractmethod
    def deviation(self, cube: int) -> Array:
        """Return what is not known about the effect on a cube's newest row.

        Args:
            cube: Number of the cube.

        Returns:
            Patterns (P, k) of one standard deviation each of the stresses on the pads, in Pa; the
            k patterns are independent of each other.
        """

    def state(self) -> Array:
        """Return the state that earlier rows left, as flat numbers; an effect without has none."""
        return np.zeros(0)

    def restore(self, state: Array) -> None:
        """Continue from a state that `state` returned, so that the next rows give the same bits.

        Raises:
            LayoutError: The state is that of another skin.
        """
        return
