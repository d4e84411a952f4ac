"""Reconstructor: the program's one idea, frequencies in, stress out.

It holds what lies between them: the health of pads, the pipeline, the residual, drift, tare and
status. It has no clock, no I/O, no threads and no ROS: time is what the rows say. The node, a bag
that is processed again, the demo's check and a notebook all use it, and all get the same bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from .calibration import Calibration
from .errors import TareError
from .health.drift import DriftTracker
from .health.health import Health
from .health.tare import measure_rest
from .pipeline import Pipeline
from .rows import FrequencyRows, StressRows


class Verdicts(NamedTuple):
    """What was decided about rows when they were recorded.

    known: (N,) bool, whether the recording says so
    left_out: (N,) uint32, bits of the pads that were not used
    status: (N,) uint16, bits of status.py about the pads of the row's cube
    """

    known: NDArray[np.bool_]
    left_out: NDArray[np.uint32]
    status: NDArray[np.uint16]

    def select(self, chosen: Any) -> Verdicts:
        """Those of the rows that an index, a slice or a mask chooses."""
        return Verdicts(self.known[chosen], self.left_out[chosen], self.status[chosen])


class SkinLike(Protocol):
    """A skin, as far as reconstruction goes: a name and a calibration for each cube."""

    @property
    def names(self) -> Sequence[str]: ...

    @property
    def calibrations(self) -> Sequence[Calibration]: ...


class Reconstructor:
    """Makes stress of the frequencies of one skin. Not for two threads at a time.

    pipeline, health: what it is made of, to look at
    names: of the cubes, for messages
    drift_time: s, time constant with which rest frequencies follow slow drift; 0: never
    rest_changes: how often rest frequencies have changed
    """

    def __init__(self, skin: SkinLike | Sequence[Calibration], dtype: type = np.float32) -> None:
        """skin: a skin, or the calibrations of its cubes in order.

        CalibrationError: there are no cubes.
        """
        if isinstance(skin, Sequence):
            calibrations = list(skin)
            self.names = [str(number) for number in range(len(calibrations))]
        else:
            calibrations = list(skin.calibrations)
            self.names = list(skin.names)
        self.pipeline = Pipeline(calibrations, dtype)
        self.health = Health(self.pipeline)
        self.drift_time = 0.0
        self.rest_changes = 0
        self._calibrated = self.pipeline.rest_frequency
        self._drift = DriftTracker(self.pipeline, self.health)

    @property
    def calibrations(self) -> tuple[Calibration, ...]:
        return self.pipeline.calibrations

    @property
    def rest_frequency(self) -> NDArray[np.float64]:
        """(cubes, P) Hz of pads without load; NaN where a cube has no such pad.

        Setting it raises LayoutError or CubeError for what cannot be rest frequencies.
        """
        return self.pipeline.rest_frequency

    @rest_frequency.setter
    def rest_frequency(self, value: NDArray[np.float64]) -> None:
        self.pipeline.rest_frequency = value
        self.health.refresh()
        self.rest_changes += 1

    def process(self, rows: FrequencyRows, recorded: Verdicts | None = None) -> StressRows:
        """Stress of rows: of one scan, or of several scans one after the other.

        recorded: verdicts about pads that replace those made now, where they are known.
        LayoutError: the rows have cubes or pads that the skin does not have. All else that a row
        can hold ends in its status.
        """
        windows = self.health.closed
        left_out, pad_status = self.health.update(rows)
        if recorded is not None:
            left_out = np.where(recorded.known, recorded.left_out, left_out)
            pad_status = np.where(recorded.known, recorded.status, pad_status)
        stress = self.pipeline.process(rows, left_out)
        self.health.count_residuals(rows.cube, stress.status)
        stress.status[:] |= pad_status
        if self.drift_time and self.health.closed != windows and self._drift.step(self.drift_time):
            self.rest_changes += 1
        return stress

    __call__ = process

    def process_known(self, rows: FrequencyRows, recorded: Verdicts) -> StressRows:
        """As `process`, of rows whose verdicts are all known. Health does not see them, which saves
        two fifths of the time of reading and reconstructing a bag."""
        stress = self.pipeline.process(rows, recorded.left_out)
        stress.status[:] |= recorded.status
        return stress

    def covariance(self, cube: int, left_out: int = 0) -> NDArray[np.float64]:
        """(15, 15) of the components of a cube, from the noise of its pads; see Pipeline."""
        return self.pipeline.covariance(cube, left_out)

    def tare(
        self, cubes: Sequence[int] | None = None, duration: float = 1.0
    ) -> NDArray[np.float64]:
        """Take the present load of cubes (None: of all) as no load; returns the rest frequencies.

        duration: s of the newest data to average. TareError: the signal moves, is noisy, too short
        or too far from the calibration; nothing is changed then.
        """
        chosen = range(len(self.names)) if cubes is None else cubes
        self.rest_frequency = self.measure_rest(chosen, duration)
        return self.rest_frequency

    def measure_rest(self, cubes: Sequence[int], duration: float) -> NDArray[np.float64]:
        """What `tare` would set: (cubes, P) Hz. TareError as there."""
        if not len(cubes):
            raise TareError("tare of no cube; name one, or leave the list out for all")
        return measure_rest(self.pipeline, self.health, cubes, duration, self.names)

    def clear_tare(self, cubes: Sequence[int] | None = None) -> None:
        """Use the calibrations' rest frequencies again, of cubes (None: of all)."""
        chosen = slice(None) if cubes is None else list(cubes)
        rest = self.rest_frequency
        rest[chosen] = self._calibrated[chosen]
        self.rest_frequency = rest
