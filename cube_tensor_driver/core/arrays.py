"""Array types that signatures name, and the padded table of values per pad."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Real = NDArray[np.floating[Any]]
"""Float32 or float64, whichever the caller chose for the reconstruction."""
Complex = NDArray[np.complex128]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Times = NDArray[np.int64]
"""Times or durations, in nanoseconds."""
PadMasks = NDArray[np.uint32]
"""Bit masks of pads: bit p of a row stands for pad p."""
StatusBits = NDArray[np.uint16]
"""Bits of `status.py`, per row or per pad."""
AnyArray = NDArray[Any]


def pad_table(
    values: Sequence[Array],
    n_pads: int,
    fill: float,
) -> Array:
    """Stack arrays of different lengths (P_i,) into a table (len(values), n_pads).

    Cubes of one skin may have different numbers of pads. The places of pads that a cube does not
    have are set to `fill`.
    """
    shape = (len(values), n_pads)
    # The type is stated, because an integer as fill value would make integers of all values.
    table = np.full(shape, fill, dtype=float)
    for row, value in zip(table, values, strict=True):
        row[: len(value)] = value
    return table
