# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Arrays that the kernel reads and writes, in the order in which it takes them.

The kernel computes stress from the frequencies of rows (samples of one cube), and adds the rows to
the sums from which the health of the pads is assessed. It exists in C (native/cube_scan.c) and in
numpy (`rows.py`), with the same bits. N is the number of rows, C that of the cubes of the skin, P
the largest number of pads of a cube. "real" is the precision of the computation, float32 or
float64.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Mask, PadMasks, Real, Records, Single, StatusBits, Times
from ..rows import StressRows

BLOCK = 16
"""Number of outputs (15 components of stress and gradient, then residuals) that the kernel in C
computes side by side.

The columns of each matrix from pad stresses to outputs are padded with zeros to a multiple of it.
"""

Numbers = NDArray[np.int32]
"""Numbers, from 0 on, of calibrations or of matrices, which index other arrays."""

DONE = -1
"""Result of the kernel (the loop over rows of frequencies): all rows are processed."""

NEEDS_WINDOW = -2
"""Result of the kernel: the next scan (at most one row of each cube) needs a new window of 0.5 s,
over which the health of pads is assessed.

The newest time stamp of the scan lies outside the present window, so the kernel has stopped before
the scan. The caller ends this window, opens another, and calls the kernel again from this scan on.
"""

NEEDS_CONDITION = -3
"""Result of the kernel (the loop over rows of frequencies): it has stopped before a row.

A pad of this row has an impossible frequency, or the device reports it as broken. The health of
pads is assessed over windows of 0.5 s, so in each window, the kernel stops only at the first such
row of a pad.

The caller finds the condition of the pad (open, short, out of range or reported), and calls the
kernel again from that row on.
"""

UNKNOWN_CUBE = -4
"""Result of the kernel (the loop over rows of frequencies): it has stopped before a row.

The row has the number of a cube that the skin does not have. If the health of pads is updated, the
kernel looks for such rows first, and if there is one, it processes no row at all.
"""

NEEDS_STEP = -5
"""Result of the kernel: the next scan (at most one row of each cube) needs new values of creep and
of the effect of temperature, which are computed for a time step (`Offsets.step_ns`).

The newest time stamp of the scan lies outside this step, so the kernel has stopped before the scan.
The caller computes the values for the next step, and calls the kernel again from this scan on.
"""

MAX_GAP_NS = 5_000_000_000
"""Longest interval between two rows of a cube, in ns, in which load and temperature of the cube
count as known. In a longer one they count as unknown."""

MAX_SPECIFIC_FORCE = 1000.0
"""Upper limit of a credible specific force along one axis, in m/s² (about 100 g). A force that is
not below it counts as missing, because it is an error of the source and would look like a load."""

CUBE_STATE = np.dtype(
    {
        "names": [
            "time_ns",
            "interval_ns",
            "gap_before",
            "gap_within",
            "rows",
            "over_limit",
            "mask",
            "found",
            "temperature",
            "status",
            "is_doubtful",
        ],
        "formats": ["i8"] * 6 + ["u4", "u4", "f4", "u2", "u2"],
    },
    align=True,
)
"""Layout in memory of the state of one cube from which the health of its pads is assessed.

The struct cube_state in C has the same layout. The window is the present window of 0.5 s. Fields:

- time_ns, interval_ns: newest time stamp, and interval between the newest two rows;
- gap_before, gap_within: interval before the first row of the window, and longest interval between
  two rows of the window, in ns; 0 if shorter than `GAP_NS`;
- rows, over_limit: number of rows in the window, and of those with a residual above its limit;
- mask, found: bit masks of the pads that are not used, and of the pads for which a row of the
  window showed a condition;
- temperature: newest temperature, in °C;
- status: conditions of all pads together;
- is_doubtful: whether the newest time stamp is doubtful.
"""

PAD_QUANTITIES = (
    "last",
    "difference",
    "first_squares",
    "second_squares",
    "bounded_squares",
    "sum",
    "lowest",
    "highest",
    "base",
    "bound",
    "low",
    "high",
)
"""Names of the quantities that the kernel keeps of each pad, in their order in memory.

The window is the present window of 0.5 s. Frequencies are in Hz, squares in Hz²:

- last, difference: newest frequency f, and its difference to the frequency before;
- first_squares, second_squares, bounded_squares: sums over the window of squared first differences,
  of squared second differences, and of squared second differences cut to the limit "bound";
- sum: sum over the window of f minus "base";
- lowest, highest: lowest and highest f in the window;
- base: frequency without load at the start of the program;
- bound: limit of squared second differences;
- low, high: limits of the frequencies that are possible.
"""


class Tables(NamedTuple):
    """Arrays from which the stress of a row (sample of one cube) is computed.

    There is one matrix for each of the G calibrations without bad pads, and after these one for
    each pair of a calibration and a set of bad pads that has occurred; T is their number. D is the
    degree of the temperature models, K the number of outputs of a matrix, E the number of places
    for matrices with bad pads.

    Attributes:
        calibration: Number of the calibration of each cube (C,).
        pads: Number of pads of each calibration (G,).
        rest: Frequencies without load (C, P), in Hz; NaN where a cube has no such pad.
        highest: Upper limits of the frequencies by the pad law (C, P), in Hz; NaN where a cube has
            no such pad.
        reference: Reference temperature of each calibration (G,), in °C; NaN without a model.
        coefficients: Coefficients of the temperature models (G, D, P), in 1/K^d, the linear first.
        matrix: Maps (T, P, K) from v (pad stress / stiffness) to outputs: 15 components, then
            residuals whose sum of squares is chi-square / degrees of freedom, then zeros.
        limit: Limits of the residual (T,).
        observed: Bit masks of the components that the pads determine (T,).
        keys: Number of the calibration * 2**32 + bit mask of the bad pads, for each matrix with
            bad pads, in rising order (E,).
        numbers: Number of the matrix of each key (E,).
    """

    calibration: Numbers
    pads: Numbers
    rest: Real
    highest: Real
    reference: Array
    coefficients: Array
    matrix: Real
    limit: Real
    observed: NDArray[np.uint16]
    keys: Times
    numbers: Numbers


class HealthState(NamedTuple):
    """State from which the health of the pads is assessed; the kernel changes it with each row.

    Attributes:
        words: Memory of `cubes` (C, 8), because numpy passes no structured arrays to C.
        quantities: Quantities of each pad (12, C, P), in the order of `PAD_QUANTITIES`.
        window_ns: Start and end of the present window of 0.5 s, and newest time stamp of the last
            scan (3,), in ns.
    """

    words: Times
    quantities: Single
    window_ns: Times

    @property
    def cubes(self) -> Records:
        """State of each cube (C,), of type `CUBE_STATE`, as a view."""
        return self.words.view(CUBE_STATE)[:, 0]

    def view_pads(self, name: str) -> Single:
        """Return one quantity of all pads (C, P), as a view; `PAD_QUANTITIES` has the names."""
        view: Single = self.quantities[PAD_QUANTITIES.index(name)]
        return view


class Offsets(NamedTuple):
    """Offsets that creep, temperature and weight cause in v (pad stress / stiffness).

    The kernel subtracts them, so that only the effect of the load is left. In a row (sample) of
    cube c at the time t with the specific force s (acceleration minus gravity), the offset is

        offset[c] + (slope[c] + gain[c] * v) * (t - since_ns[c]) + sum_i response[c, i] * s_i

    The last term is the effect of weight, the others are those of creep and temperature. Values for
    pads that a cube does not have are 0. The kernel changes the last four arrays.

    Attributes:
        step_ns: Start and end of the time step in which `offset`, `slope` and `gain` hold (2,), in
            ns.
        since_ns: Time for each cube from which t is counted in the equation (C,), in ns.
        offset: Offsets by creep and temperature at the time `since_ns` (C, P).
        slope: Change of the offset per second (C, P), for v = 0.
        gain: Additional change of the offset per second and per v (C, P).
        lasting: Status bits of creep and temperature (C,), for rows from `since_ns` to `MAX_GAP_NS`
            later. Other rows get COMPENSATION instead, unless the status bits are 0.
        response: Response of the pads to specific force (C, 3, P), per m/s².
        weighing: Status bits of weight (C,), for rows with a known specific force. Other rows get
            COMPENSATION instead.
        newest_ns: Time stamp of the newest row of each cube (C,), in ns; 0: none.
        reading: v of the newest row before the subtraction (C, P); NaN where a pad was not used.
        subtracted: Offset that was subtracted from `reading` (C, P).
        newest_force: Specific force of the newest row for which `Columns.force` was not None
            (C, 3), in m/s²; NaN: unknown.
    """

    step_ns: Times
    since_ns: Times
    offset: Real
    slope: Real
    gain: Real
    lasting: StatusBits
    response: Real
    weighing: StatusBits
    newest_ns: Times
    reading: Real
    subtracted: Real
    newest_force: Real


class Columns(NamedTuple):
    """Columns of N rows (samples of one cube) to process.

    Attributes:
        cube: Numbers of the cubes (N,).
        frequency: Frequencies (N, P), in Hz.
        temperature: Temperatures (N,), in °C.
        pad_fault: Bit masks of the pads that the device reports as broken (N,).
        stamp_ns: Time stamps (N,), in ns.
        doubt: Status bits (N,) of which STAMP (doubtful time stamp) is used.
        known: Whether `left_out` and `status` of the rows to write hold the health of a row before
            the call (N,); None stands for False in all rows.
        force: Specific force (N, 3), in m/s²; None: weight is not compensated.
    """

    cube: NDArray[np.uint16]
    frequency: Real
    temperature: Single
    pad_fault: PadMasks
    stamp_ns: Times
    doubt: StatusBits
    known: Mask | None
    force: Real | None

    def find_scan(self, row: int) -> slice:
        """Return the rows from a given one to the end of its scan.

        The cube numbers rise within a scan. So the scan ends before a row whose cube number is not
        larger than that of the row before it.
        """
        is_end = self.cube[row + 1 :] <= self.cube[row:-1]
        count = int(np.argmax(is_end)) if is_end.any() else len(is_end)
        return slice(row, row + 1 + count)

    def select(self, rows: slice) -> Columns:
        """Return the columns of some successive rows, as views."""
        columns = (None if column is None else column[rows] for column in self)
        return Columns(*columns)  # type: ignore[arg-type]


class Task(NamedTuple):
    """Everything that the kernel reads and writes in one call of `Pipeline.process`.

    Attributes:
        n_residuals: Number of outputs of a matrix (see `Tables.matrix`) that are residuals.
        tables: Tables of the skin.
        health: State of the health, which is changed; None: health is not assessed.
        offsets: What is subtracted, and its state, which is changed; None: nothing is subtracted.
        columns: Rows to process.
        out: Rows to write; its arrays are contiguous. Before the call, `left_out` and `status` hold
            the pads that are not used and the conditions of the pads, for all rows whose health is
            not assessed in this call.
        offset: Array for what is subtracted (N, P), stress / stiffness; None: not wanted.
    """

    n_residuals: int
    tables: Tables
    health: HealthState | None
    offsets: Offsets | None
    columns: Columns
    out: StressRows
    offset: Real | None
