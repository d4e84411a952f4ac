# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Columns of Arrow tables (the Parquet files of a data set, recordings of live touch)."""

from __future__ import annotations

import numpy as np
import pyarrow

from ..core.arrays import AnyArray

_IMAGE = pyarrow.struct(
    [
        ("bytes", pyarrow.binary()),
        ("path", pyarrow.string()),
    ]
)
"""Parquet type of an image as LeRobot stores it: the bytes of the image file, or its path."""


def as_column(values: AnyArray | list[bytes]) -> pyarrow.Array:
    """Convert the values of a feature in n frames to a column of an Arrow table.

    Args:
        values: Contents of n image files, or an array (n, …). An array (n, 1) becomes n numbers,
            one with more dimensions becomes nested lists.
    """
    if isinstance(values, list):
        # LeRobot reads an image from the bytes if it has no path to an image file.
        images = [{"bytes": image, "path": None} for image in values]
        return pyarrow.array(images, _IMAGE)
    flat = np.ascontiguousarray(values).reshape(-1)
    array = pyarrow.array(flat)
    shape = values.shape[1:]
    if shape == (1,):
        return array
    # Lists are nested from the last dimension to the first: each step joins `size` successive
    # numbers or lists to one list.
    for size in reversed(shape):
        lists = len(array) // size
        offsets = size * np.arange(lists + 1, dtype=np.int32)
        array = pyarrow.ListArray.from_arrays(offsets, array)
    return array
