# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Reconstructor: from frequencies of pads to stresses of cubes, the central step of the program.

It combines the health of the pads (which of them are broken), the pipeline (the computation of the
stress), the tracking of drift, and tare (taking the present load as the unloaded state). It reads
no clock and no files, and needs no threads and no ROS: times are the time stamps of the rows. The
ROS node, reprocessing of a bag, the check of the demo and a notebook all use it, and all get the
same bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from .arguments import check_skin
from .arrays import Array, Index, Mask, PadMasks, StatusBits
from .calibration import Calibration, tabulate_pads
from .compensation.compensation import Compensation
from .errors import TareError
from .health.drift import DriftTracker
from .health.health import Health
from .health.tare import measure_rest
from .modes import COMPONENTS
from .pipeline import Pipeline
from .rows import FrequencyRows, StressRows


class RecordedHealth(NamedTuple):
    """Results of the health check of the pads, as a recording states them for N rows.

    Attributes:
        known: Whether the recording states the results for this row (N,).
        left_out: Bit masks of the pads that were not used (N,).
        status: Conditions of all pads of the row's cube together (N,), bits of `status.py`.
    """

    known: Mask
    left_out: PadMasks
    status: StatusBits

    def select(self, chosen: Mask | Index | slice) -> RecordedHealth:
        """Return the recorded health of some of the rows.

        Args:
            chosen: Row numbers, a slice or a mask (N,), with which numpy indexes an array.
        """
        return RecordedHealth(
            self.known[chosen],
            self.left_out[chosen],
            self.status[chosen],
        )


class CalibratedSkin(Protocol):
    """A skin that has a name and a calibration for each cube."""

    @property
    def names(self) -> Sequence[str]:
        """Name of each cube."""

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """Calibration of each cube."""


class Reconstructor:
    """Computes stress from the frequencies of one skin. It is not safe to use in two threads.

    Attributes:
        pipeline: Pipeline from frequencies to stress.
        health: Health of the pads.
        compensation: Effects on the pads that are no load, which are subtracted.
        names: Names of the cubes, for messages.
        drift_time: Time constant of the tracking of slow drift of the rest frequencies (frequencies
            without load), in s. 0 turns the tracking off.
    """

    def __init__(
        self,
        skin: CalibratedSkin | Sequence[Calibration],
        dtype: type = np.float32,
    ) -> None:
        """Prepare the reconstruction of a skin.

        Args:
            skin: The skin, or the calibrations of its cubes in order.
            dtype: Precision of the computation, np.float32 or np.float64.

        Raises:
            CalibrationError: There are no cubes.
            ConfigError: The argument is no skin, such as the path of a skin file.
        """
        if isinstance(skin, Sequence) and not isinstance(skin, str):
            calibrations = list(skin)
            self.names = [str(number) for number in range(len(calibrations))]
        else:
            check_skin(skin, "calibrations")
            calibrations = list(skin.calibrations)
            self.names = list(skin.names)
        self.pipeline = Pipeline(calibrations, dtype)
        self.health = Health(self.pipeline)
        self.compensation = Compensation(self.pipeline)
        self.drift_time = 0.0
        self._calibrated_rest = self.pipeline.rest_frequency
        self._drift = DriftTracker(self.health)
        modulus, beta = (
            tabulate_pads(calibrations, name, self.pipeline.n_pads, fill=0.0)
            for name in ("modulus", "beta")
        )
        # Stress on each pad (cubes, P), in Pa, per relative change of its rest frequency.
        self._stress_per_drift = modulus * (1 + beta)
        # Standard deviations of the common drift of each cube's pads that the calibrations state.
        self._stated_drift = np.array([calibration.drift or 0.0 for calibration in calibrations])

    def __repr__(self) -> str:
        changes = f"{self.rest_changes} changes of rest frequencies"
        return f"<Reconstructor: {len(self.names)} cubes, {self.pipeline.dtype}, {changes}>"

    @property
    def calibrations(self) -> tuple[Calibration, ...]:
        """Calibration of each cube."""
        return self.pipeline.calibrations

    @property
    def rest_frequency(self) -> Array:
        """Frequencies of the pads without load (cubes, P), in Hz; NaN where a cube has no such pad.

        Setting the frequencies raises LayoutError for a wrong shape, and CubeError for values that
        are not finite and above 0.
        """
        return self.pipeline.rest_frequency

    @rest_frequency.setter
    def rest_frequency(self, value: Array) -> None:
        self.pipeline.rest_frequency = value
        self.health.refresh()

    @property
    def has_errors(self) -> bool:
        """Whether stress may have other errors than noise (see `errors`)."""
        is_drifting = self.drift_time > 0 or bool(self._stated_drift.any())
        return self.compensation.is_active or is_drifting

    @property
    def rest_changes(self) -> int:
        """Number of changes of the rest frequencies so far, by tare or drift."""
        return self.pipeline.rest_changes

    def process(
        self,
        rows: FrequencyRows,
        recorded: RecordedHealth | None = None,
        out: StressRows | None = None,
    ) -> StressRows:
        """Reconstruct the stress of rows.

        Args:
            rows: Rows of one scan, or of several scans one after the other.
            recorded: Health of the pads from a recording. For the rows for which it is known, it
                replaces the health that is found now.
            out: Rows to write into, such as the memory of a message; None makes new ones.

        Raises:
            LayoutError: The rows have cubes or pads that the skin does not have. Every other
                problem of a row becomes a bit of its status.
        """
        windows = self.health.closed
        # The health of the pads is updated with each row before its stress is computed, so that a
        # broken pad is left out of the very row (sample of one cube) that shows it.
        stress = self._process(rows, recorded, out, self.health)
        # Drift is tracked after the rows are computed, so that the same rest frequencies hold for
        # all of them.
        has_closed_window = self.health.closed != windows
        if self.drift_time and has_closed_window:
            self._drift.step(self.drift_time)
        return stress

    __call__ = process

    def process_known(
        self,
        rows: FrequencyRows,
        recorded: RecordedHealth,
    ) -> StressRows:
        """Reconstruct the stress of rows from a recording that states the health of their pads.

        The pads are not examined again, which saves time.

        Args:
            rows: Rows of one scan, or of several scans one after the other.
            recorded: Recorded health, known for every row.
        """
        return self._process(rows, recorded, None, None)

    def _process(
        self,
        rows: FrequencyRows,
        recorded: RecordedHealth | None,
        out: StressRows | None,
        health: Health | None,
    ) -> StressRows:
        """Compute the stress of rows, and update the health of the pads if it is given.

        Args:
            rows: Rows of one scan, or of several scans one after the other.
            recorded: Health of the pads from a recording; None: none is known.
            out: Rows to write into; None makes new ones.
            health: Health of the pads to update with each row; None: the pads are not examined.
        """
        out = self.pipeline.make_rows(rows) if out is None else out
        left_out = known = None
        if recorded is not None:
            left_out = recorded.left_out
            known = recorded.known
            out.status[:] = recorded.status
        return self.compensation.process(rows, left_out, watch=health, known=known, out=out)

    def compute_covariance(self, cube: int, left_out: int = 0) -> Array:
        """Return the covariance (15, 15) of the components of a cube's newest row.

        It is caused by the noise of the pads, by errors of the compensation, and by drift that
        could not be tracked. `Pipeline.compute_covariance` states arguments and units.
        """
        covariance = self.pipeline.compute_covariance(cube, left_out)
        errors = self.errors(np.array([cube]), np.array([left_out]))[0]
        return covariance + errors @ errors.T if errors.any() else covariance

    def errors(self, cubes: Index, left_out: PadMasks) -> Array:
        """Return the errors (n, 15, k) of the newest rows of n cubes by k causes other than noise.

        The causes are errors of the compensation, and drift that could not be tracked. They are
        independent, and each column has the size of one standard deviation. In one column, the
        errors of different cubes are almost fully correlated, because all cubes have about the same
        temperature and motion.

        Args:
            cubes: Numbers (n,) of the cubes.
            left_out: Bit masks (n,) of the pads that are not used.

        Returns:
            Errors of 6 stresses in Pa and 9 gradients in Pa/m; NaN for components that the pads do
            not determine.
        """
        # The frequencies of all pads of a cube drift by about the same fraction, so the error looks
        # like a pressure from all sides, unless the cube has a dummy pad.
        drift = np.hypot(self._drift.deviation, self._stated_drift)[cubes, None]
        on_pads = np.dstack(
            [self.compensation.compute_pad_errors(cubes), drift * self._stress_per_drift[cubes]]
        )
        matrices = np.zeros((len(cubes), len(COMPONENTS), on_pads.shape[1]))
        chosen = zip(cubes.tolist(), left_out.tolist(), strict=True)
        for number, (cube, mask) in enumerate(chosen):
            matrix = self.pipeline.find_matrix(cube, mask)
            matrices[number, :, : matrix.shape[1]] = matrix
        errors: Array = matrices @ on_pads
        return errors

    def tare(
        self,
        cubes: Sequence[int] | None = None,
        duration: float = 1.0,
    ) -> Array:
        """Take the present load of cubes as their unloaded state.

        The mean frequencies of the newest data become the frequencies without load.

        Args:
            cubes: Numbers of the cubes; None means all.
            duration: Duration of the newest data to average, in s.

        Returns:
            The new rest frequencies of all cubes (cubes, P), in Hz.

        Raises:
            TareError: The frequencies of a cube moved, are noisy, are too far from its calibration,
                or were received for a shorter time than `duration`. Nothing is changed then.
        """
        chosen = range(len(self.names)) if cubes is None else cubes
        self.rest_frequency = self.measure_rest(chosen, duration)
        return self.rest_frequency

    def measure_rest(self, cubes: Sequence[int], duration: float) -> Array:
        """Return the rest frequencies of all cubes (cubes, P), in Hz, that `tare` would set.

        Cubes that are not tared keep their present rest frequencies.

        Args:
            cubes: Numbers of the cubes to tare.
            duration: Duration of the newest data to average, in s.

        Raises:
            TareError: No cube is given, or for the reasons that `tare` states.
        """
        if not len(cubes):
            raise TareError("tare of no cube; name one, or leave the list out for all")
        self._check_cubes(cubes)
        present = self.rest_frequency
        measured = measure_rest(
            self.health,
            cubes,
            duration,
            self.names,
        )
        # The compensation of creep hides a part of a constant error of the rest frequencies, so
        # the measured difference is smaller than the error.
        visible_share = self.compensation.creep.find_visible_share()
        return present + (measured - present) / visible_share

    def clear_tare(self, cubes: Sequence[int] | None = None) -> None:
        """Use the rest frequencies of the calibrations again, as before any tare.

        Args:
            cubes: Numbers of the cubes; None means all.
        """
        self._check_cubes(cubes or ())
        chosen = slice(None) if cubes is None else list(cubes)
        rest = self.rest_frequency
        rest[chosen] = self._calibrated_rest[chosen]
        self.rest_frequency = rest

    def _check_cubes(self, cubes: Sequence[int]) -> None:
        """Raise TareError for an entry that is not the number of a cube."""
        numbers = range(len(self.names))
        for cube in cubes:
            if cube not in numbers:
                raise TareError(
                    f"no cube {cube!r}; cubes are numbers from 0 to {numbers[-1]}, "
                    "as names.index(NAME) gives them"
                )
