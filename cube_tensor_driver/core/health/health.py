# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Health of pads and cubes: which pads are broken, found from their frequencies alone.

Every row (sample of one cube) is checked when it arrives. A pad whose frequency is impossible
(open, short, out of range) is already left out of the reconstruction of this row. Conditions that
need statistics (stuck, noisy, drifting) are found at the end of windows of `WINDOW_S`, measured by
the time stamps of the rows. All arrays are (cubes, pads); nothing loops over cubes.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from ..arrays import Index, Mask, Single, StatusBits, stack_pad_table
from ..calibration import tabulate_pads
from ..kernel.contract import Columns, Tables
from ..kernel.rows import find_impossible
from ..oscillator import compute_pad_frequency
from ..pipeline import Pipeline
from ..status import OPEN, RANGE, REPORTED, SHORT
from .diagnosis import Conditions, PadDiagnosis, has_high_residual
from .statistics import WINDOW_S, Window, clear_sums, make_state, make_window

WINDOW_NS = round(1e9 * WINDOW_S)
"""Length of a window over which statistics of the pads are formed, in ns: 0.5 s by the time stamps
of the rows."""

MAX_BACKWARD_NS = 2 * WINDOW_NS
"""Longest time, in ns, by which the time stamp of a row may precede the end of the present window
for the row to be counted in this window.

An older row is from another recording, or from a clock that was set, so a new window starts.
"""

HISTORY_WINDOWS = 20
"""Number of ended windows whose statistics are kept for a tare: 10 s of data."""

MIN_STRAIN = -0.8
"""Smallest possible strain of a pad's foam (relative change of its thickness): pressed to a fifth
of the thickness without load.

A frequency that the pad law (frequency to strain and stress) relates to a smaller strain counts as
out of range.
"""

MAX_STRAIN = 1.0
"""Largest possible strain of a pad's foam (relative change of its thickness): stretched to twice
the thickness without load.

A frequency that the pad law (frequency to strain and stress) relates to a larger strain counts as
out of range.
"""

OPEN_STRAIN = 3.0
"""Strain of a pad's foam (relative change of its thickness) from which on the pad counts as
disconnected.

The foam cannot reach it, so a frequency that the pad law relates to this strain or a larger one
shows that the capacitor is disconnected.
"""


class Health:
    """Checks the pads of all cubes of a pipeline, and keeps their statistics.

    `Pipeline.process` updates it with the rows whose stress it computes.

    Attributes:
        pipeline: Pipeline with the calibrations and the rest frequencies.
        sums: Sums and times of the present window, which the kernel (the loop over rows of
            frequencies) changes with each row.
        high_residual: Whether the residual of a cube is high by `has_high_residual` (cubes,).
        history: Statistics of the last `HISTORY_WINDOWS` windows that have ended.
        diagnosis: Diagnosis of the pads, with their noise, and with the cubes that are still.
        closed: Number of windows that have ended so far.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline = pipeline
        n_cubes = len(pipeline.calibrations)
        rest = pipeline.rest_frequency
        self.sums = make_state(rest)
        exists = ~np.isnan(rest)
        self._conditions = Conditions(self.sums, exists)
        dummies = [calibration.layout.is_dummy for calibration in pipeline.calibrations]
        is_dummy = stack_pad_table(dummies, pipeline.n_pads, fill=0) > 0
        self.diagnosis = PadDiagnosis(exists, is_dummy)
        self.high_residual = np.zeros(n_cubes, bool)
        self.history: deque[Window] = deque(maxlen=HISTORY_WINDOWS)
        self.closed = 0
        # Number of rows of each cube from the last call of `collect` to the start of the present
        # window; negative if the call was within this window.
        self._uncollected_rows = np.zeros(n_cubes, int)
        # Whether the residual of a cube was high at any time since the last call of `collect`.
        self._had_high_residual = np.zeros(n_cubes, bool)
        self.refresh()
        self._set_bound()

    @property
    def state(self) -> StatusBits:
        """Present conditions (such as open) of each pad (cubes, P), bits of `status.py`."""
        return self._conditions.state

    @property
    def temperature(self) -> Single:
        """Newest temperature of each cube (cubes,), in °C."""
        return self.sums.cubes["temperature"]

    @property
    def newest_ns(self) -> int:
        """Newest time stamp of the last scan, in ns; 0 before the first one."""
        return int(self.sums.window_ns[2])

    def read_window(self) -> Window:
        """Return the statistics of the present window, which has not ended."""
        return make_window(self.sums)

    def refresh(self) -> None:
        """Compute the possible range of each frequency again.

        The caller must do this after a tare or the tracking of drift has changed the rest
        frequencies (frequencies without load) of the pipeline, from which the range follows.
        """
        calibrations = self.pipeline.calibrations
        n_pads = self.pipeline.n_pads
        beta = tabulate_pads(calibrations, "beta", n_pads, fill=1.0)
        modulus = tabulate_pads(calibrations, "modulus", n_pads, fill=1.0)
        noise = tabulate_pads(calibrations, "noise", n_pads, fill=1.0)
        rest = self.pipeline.rest_frequency
        low, high, disconnected = (
            compute_pad_frequency(strain * modulus, rest, beta, modulus)
            for strain in (MIN_STRAIN, MAX_STRAIN, OPEN_STRAIN)
        )
        self.sums.view_pads("low")[:] = low
        self.sums.view_pads("high")[:] = high
        self._open = disconnected.astype(np.float32)
        # The slope of the pad law without load, dv/df = E (1 + beta) / f0, converts noise to Hz.
        slope = modulus * (1 + beta) / rest
        self.diagnosis.set_reference(rest, noise / slope)

    def advance(self) -> None:
        """End the present window, because the next scan lies outside it, and start the next one.

        If time went back, the statistics of the window are discarded and not evaluated.
        """
        _, end_ns, newest_ns = self.sums.window_ns.tolist()
        if end_ns and newest_ns >= end_ns:
            self._close_window()
        self._uncollected_rows += self.sums.cubes["rows"]
        clear_sums(self.sums)
        end_ns = newest_ns + WINDOW_NS
        self.sums.window_ns[:2] = end_ns - MAX_BACKWARD_NS, end_ns

    def find_conditions(self, tables: Tables, columns: Columns, row: int) -> None:
        """Add the conditions OPEN, SHORT, RANGE and REPORTED that rows of one scan show.

        Args:
            tables: Tables of the skin, with the number of pads of each calibration.
            columns: Rows of frequencies.
            row: Number of the first row to check; all rows of its scan after it are checked, too.
        """
        scan = columns.find_scan(row)
        rows = columns.select(scan)
        cube = rows.cube.astype(np.intp)
        f = rows.frequency.astype(np.float32)
        is_impossible, is_reported = find_impossible(
            tables,
            self.sums,
            rows,
            cube,
        )
        causes = np.where(f >= self._open[cube], OPEN, RANGE)
        # The comparison is also false for NaN, which stands for a pad without a frequency.
        causes = np.where(f > 0, causes, SHORT)
        bits = is_impossible * causes + is_reported * REPORTED
        self._conditions.add(cube, bits.astype(np.uint16))

    def collect(self) -> tuple[StatusBits, Mask, Index]:
        """Return what was found and counted since the last call of this method.

        Returns:
            All conditions that a pad had (cubes, P), whether the residual was ever high (cubes,),
            and the number of rows (cubes,).
        """
        had_high_residual: Mask = self._had_high_residual | self.high_residual
        present_rows = self.sums.cubes["rows"].copy()
        rows = self._uncollected_rows + present_rows
        self._uncollected_rows = -present_rows
        self._had_high_residual = np.zeros_like(had_high_residual)
        return self._conditions.collect(), had_high_residual, rows

    def _close_window(self) -> None:
        """Evaluate the statistics of the present window."""
        window = self.read_window()
        self.history.append(window)
        self.closed += 1
        found = self.diagnosis.examine(window, self.state)
        self._set_bound()
        over_limit = self.sums.cubes["over_limit"]
        self.high_residual = has_high_residual(
            self.high_residual,
            over_limit,
            window.rows,
        )
        self._had_high_residual |= self.high_residual
        self._conditions.end_window(found, window.rows > 0)

    def _set_bound(self) -> None:
        """Set the limit to which squared second differences of a frequency are cut from now on."""
        self.sums.view_pads("bound")[:] = np.nan_to_num(self.diagnosis.bound)
