"""Arrays that the kernel reads and writes, in the order in which it takes them.

The kernel computes stress from the frequencies of rows (samples of one cube), and adds the rows to
the sums from which the health of the pads is found. It exists in C (native/cube_scan.c) and in
numpy (`rows.py`), with the same bits. N is the number of rows, C that of the cubes of the skin, P
the largest number of pads of a cube. "real" is the precision of the computation, float32 or
float64.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import AnyArray, Array, Mask, PadMasks, Real, Single, StatusBits, Times

BLOCK = 16
"""Number to a multiple of which the columns of each matrix are padded with zeros, because the
kernel in C computes this number of outputs side by side."""

Numbers = NDArray[np.int32]
"""Numbers of calibrations or tables."""

DONE = -1
"""Request of the kernel: none, all rows are processed."""

NEEDS_WINDOW = -2
"""Request of the kernel: the next scan lies outside the present window of health; open another."""

NEEDS_CONDITION = -3
"""Request of the kernel: a pad of the next row has an impossible frequency, or the device reports a
fault of it, and no condition of this pad was found in the present window yet; find it."""

UNKNOWN_CUBE = -4
"""Request of the kernel: the next row has the number of a cube that the skin does not have; skip
it. If health is asked for, any such row ends the call before a row is processed."""

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
"""State of the health of one cube: newest time stamp and interval between the newest two rows, in
ns; longest gap before and within the present window, in ns; number of rows in the window, and of
those with a residual above its limit; masks of the pads that are not used, and of those with a
condition that a row of the window showed; temperature in °C; conditions of all pads; and whether
the newest time stamp is doubtful."""

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
"""Quantities in the state of the health of a pad, in their order: newest frequency and difference
to the one before; the sums of `statistics.py` over the present window; lowest and highest frequency
in it; the frequency that is subtracted before summing; the limit of squared second differences; and
the limits of the possible frequencies, in Hz."""


class Tables(NamedTuple):
    """Tables of a skin: what the stress of a row is computed from.

    A table of rows (pad stresses to outputs) belongs to a calibration and a set of bad pads. The
    first G tables are those of the G calibrations without bad pads.

    Attributes:
        calibration: Number of the calibration of each cube (C,).
        pads: Number of pads of each calibration (G,).
        rest: Frequencies without load (C, P), in Hz; NaN where a cube has no such pad.
        highest: Upper limits of the frequencies by the pad law (C, P), in Hz; likewise.
        reference: Reference temperature of each calibration (G,), in °C; NaN without a model.
        coefficients: Coefficients of the temperature models (G, D, P), in 1/K^d, the linear first.
        matrix: Maps (T, P, K) from v (pad stress / stiffness) to outputs: 15 components, then
            residuals whose sum of squares is chi-square / degrees of freedom, then zeros.
        limit: Limits of the residual (T,).
        observed: Bit masks of the components that the pads determine (T,).
        keys: Calibration * 2**32 + mask of the bad pads, of each table with bad pads, rising (E,).
        numbers: Number of the table of each key (E,).
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
    """State of the health of a skin, which the kernel changes with each row.

    Attributes:
        words: Memory of `cubes` (C, 8), because numpy passes no structured arrays to C.
        quantities: Quantities of each pad (12, C, P), in the order of `PAD_QUANTITIES`.
        window_ns: Begin and end of the present window, and newest time stamp of the last scan (3,).
    """

    words: Times
    quantities: Single
    window_ns: Times

    @property
    def cubes(self) -> AnyArray:
        """State of each cube (C,), of type `CUBE_STATE`, as a view."""
        view: AnyArray = self.words.view(CUBE_STATE)[:, 0]
        return view

    def pads(self, name: str) -> Single:
        """Return the quantity of all pads (C, P) with a name of `PAD_QUANTITIES`, as a view."""
        view: Single = self.quantities[PAD_QUANTITIES.index(name)]
        return view


class Columns(NamedTuple):
    """Columns of N rows (samples of one cube) to process.

    Attributes:
        cube: Numbers of the cubes (N,).
        frequency: Frequencies (N, P), in Hz.
        temperature: Temperatures (N,), in °C.
        pad_fault: Bit masks of the pads that the device reports as broken (N,).
        stamp_ns: Time stamps (N,), in ns.
        doubt: Status bits (N,) of which STAMP (doubtful time stamp) is used.
        known: Whether `Results` already hold the mask and conditions of a row (N,); None: no row.
    """

    cube: NDArray[np.uint16]
    frequency: Real
    temperature: Single
    pad_fault: PadMasks
    stamp_ns: Times
    doubt: StatusBits
    known: Mask | None

    def select(self, rows: slice) -> Columns:
        """Return some of the rows."""
        columns = (None if column is None else column[rows] for column in self)
        return Columns(*columns)  # type: ignore[arg-type]


class Results(NamedTuple):
    """Columns of N rows that the kernel writes; `StressRows` defines them.

    Where the health is not found, `left_out` and `status` must hold the mask of pads and the
    conditions before the call.
    """

    stress: Real
    gradient: Real
    residual: Real
    status: StatusBits
    observed: NDArray[np.uint16]
    left_out: PadMasks

    def select(self, rows: slice) -> Results:
        """Return some of the rows, as views."""
        return Results(*(column[rows] for column in self))  # type: ignore[arg-type]
