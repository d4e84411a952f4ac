# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Array types that signatures name, and the padded table of values per pad."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array of real numbers in double precision (float64)."""
Single = NDArray[np.float32]
"""Array of real numbers in single precision (float32), the precision of the ROS messages."""
Real = NDArray[np.floating]
"""Array of float32 or float64, whichever precision the caller chose for the computation of
stress."""
Complex = NDArray[np.complex128]
"""Array of complex numbers in double precision."""
Index = NDArray[np.intp]
"""Array of integers that number or count the entries of another array, from 0 on."""
Mask = NDArray[np.bool_]
"""Array of truth values."""
Times = NDArray[np.int64]
"""Times or durations, in nanoseconds."""
PadMasks = NDArray[np.uint32]
"""Bit masks of pads, one integer per row (sample of one cube); bit p stands for pad p."""
StatusBits = NDArray[np.uint16]
"""Status bits (defined in `status.py`), per row (sample of one cube) or per pad."""
Integers = NDArray[np.integer]
"""Array of integers of any size."""
Records = NDArray[np.void]
"""Structured array, whose fields have names and may have different types."""
AnyArray = NDArray[np.generic]
"""Array whose type is not known here, or of no importance."""
Numbers = TypeVar("Numbers", Single, Array, Real)
"""Array of real numbers; all arguments and the result of a function have the same precision."""


def stack_pad_table(
    values: Sequence[Array | Mask],
    n_pads: int,
    fill: float,
) -> Array:
    """Stack one array per cube into a table (cubes, n_pads).

    Cubes of one skin may have different numbers of pads.

    Args:
        values: Values of the pads of each cube, arrays of different lengths up to `n_pads`.
        n_pads: Number of columns, the largest number of pads of a cube.
        fill: Value of the entries for pads that a cube does not have.
    """
    shape = (len(values), n_pads)
    # The type is stated, because numpy would make a table of integers if `fill` is an integer.
    table = np.full(shape, fill, dtype=float)
    for row, value in zip(table, values, strict=True):
        row[: len(value)] = value
    return table


def index_cubes(cube: AnyArray, n_cubes: int) -> Index | slice:
    """Return an index that selects the cubes of N rows from tables of all cubes of a skin.

    In the usual case, one row of each cube in order, the index is a slice, with which numpy copies
    nothing.

    Args:
        cube: Numbers of the cubes (N,). Numbers that the skin does not have are replaced by the
            nearest number that it has.
        n_cubes: Number of cubes of the skin.
    """
    all_cubes = np.arange(n_cubes)
    if np.array_equal(cube, all_cubes):
        return slice(None)
    nearest = np.clip(cube, 0, n_cubes - 1)
    return nearest.astype(np.intp)


def multiply(left: Numbers, right: Numbers) -> Numbers:
    """Multiply row vectors or matrices (..., n) by matrices (..., n, m), with the same bits on
    every processor.

    The terms are added in their order. The `@` of numpy (BLAS) adds them in an order that depends
    on the processor.
    """
    shape: tuple[int, ...] = np.broadcast_shapes(left.shape[:-1], right.shape[:-2] or (1,))
    product: Numbers = np.zeros((*shape, right.shape[-1]), right.dtype)
    for term in range(left.shape[-1]):
        product += left[..., term, None] * right[..., term, :]
    return product
