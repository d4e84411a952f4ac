# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of stress in Parquet or CSV: one row per sample of a cube, units in the columns' names."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.compute
import pyarrow.csv
import pyarrow.parquet

from ..core.arrays import AnyArray
from ..core.errors import BagError, LayoutError
from ..core.modes import GRADIENT, STRESS
from ..core.rows import COLUMN_TYPES, FrequencyRows, StressRows, concatenate

ROWS_PER_GROUP = 1 << 16
"""Number of rows (samples of cubes) that are written together, as one row group (independent block)
of a Parquet file or one chunk (file) of each Zarr array. Fewer, larger groups compress better and
are read faster."""

PARTIAL_PREFIX = ".partial-"
"""Prefix of the name of the folder, beside a result, in which the result is written until it is
complete. After an interruption, an incomplete result is computed again from the start."""

_CUBE_NAME = pyarrow.dictionary(pyarrow.int32(), pyarrow.string())
"""Type of the column with the cubes' names. Dictionary encoding stores each name once, and only a
number in each row."""

_LAST_COLUMNS = ("residual", "status", "observed", "left_out")
"""Names of the last columns of a table of stress, which are attributes of `StressRows`."""

STRESS_SCHEMA = pyarrow.schema(
    pyarrow.field(name, kind, nullable=False)
    for name, kind in (
        ("stamp_ns", pyarrow.int64()),
        ("cube", _CUBE_NAME),
        ("sequence", pyarrow.uint32()),
        *((f"stress_{name}_Pa", pyarrow.float32()) for name in STRESS),
        *((f"gradient_{name}_Pa_per_m", pyarrow.float32()) for name in GRADIENT),
        *((name, pyarrow.from_numpy_dtype(COLUMN_TYPES[name])) for name in _LAST_COLUMNS),
    )
)
"""Names and types of the columns of a table of stress; `StressRows` states what they contain.

Unknown numbers are NaN and never null, and a column without nulls is written faster.
"""


def as_column(values: AnyArray) -> pyarrow.Array:
    """Return an array (N, …) as an Arrow column of N numbers, or of N nested lists of numbers."""
    column = pyarrow.array(np.ascontiguousarray(values).reshape(-1))
    # The innermost lists are made first: each step joins `size` successive numbers or lists to one
    # list.
    for size in reversed(values.shape[1:]):
        n_lists = len(column) // size
        offsets = size * np.arange(n_lists + 1, dtype=np.int32)
        column = pyarrow.ListArray.from_arrays(offsets, column)
    return column


def as_array(column: pyarrow.Array) -> AnyArray:
    """Return an Arrow column of N numbers, or of N nested lists of numbers, as an array (N, …).

    Numbers that are null become NaN; lists that are null are left out.

    Raises:
        LayoutError: The lists have different lengths.
    """
    shape: list[int] = []
    while pyarrow.types.is_nested(column.type):
        column = column.drop_null()
        list_lengths = pyarrow.compute.list_value_length(column)
        lengths = list_lengths.unique().to_pylist()
        if len(lengths) > 1:
            raise LayoutError(
                f"lists of {lengths} numbers in one column; they must be equally long"
            )
        shape += lengths
        column = column.flatten()
    values: AnyArray = column.to_numpy(zero_copy_only=False)
    return values.reshape(-1, *shape)


def make_cube_column(
    rows: FrequencyRows | StressRows,
    cubes: pyarrow.Array,
) -> pyarrow.Array:
    """Return the Arrow column with the name of the cube of each row (sample of a cube).

    Args:
        rows: N rows.
        cubes: Names of the skin's cubes in the order of their indices, and one more name, which all
            rows with a higher index get.
    """
    index = np.minimum(rows.cube, len(cubes) - 1)
    return pyarrow.DictionaryArray.from_arrays(index.astype(np.int32), cubes)


def make_stress_batch(
    rows: StressRows,
    cubes: pyarrow.Array,
) -> pyarrow.RecordBatch:
    """Return rows of stress (samples of cubes) as Arrow columns with `STRESS_SCHEMA`.

    Args:
        rows: N rows.
        cubes: Names of the skin's cubes in the order of their indices, and one more name, which all
            rows with a higher index get.
    """
    columns = [
        pyarrow.array(rows.stamp_ns),
        make_cube_column(rows, cubes),
        pyarrow.array(rows.sequence),
        *map(pyarrow.array, rows.stress.T),
        *map(pyarrow.array, rows.gradient.T),
        *(pyarrow.array(getattr(rows, name)) for name in _LAST_COLUMNS),
    ]
    return pyarrow.RecordBatch.from_arrays(columns, schema=STRESS_SCHEMA)


@contextmanager
def report_write_errors(path: Path) -> Iterator[None]:
    """Turn an error of the file system in the `with` block into a BagError that names `path`."""
    try:
        yield
    except OSError as error:
        raise BagError(
            f"{path}: {error.strerror or error}; name a folder that can be written, on a disk "
            "with room"
        ) from None


@contextmanager
def complete_output(output: Path) -> Iterator[Path]:
    """Give a file or folder its final name when the `with` block has completed it.

    Args:
        output: File or folder that the block makes.

    Yields:
        Path to which the block writes it.

    Raises:
        BagError: Writing to the disk failed.
    """
    # Renaming requires that both names are in the same file system. Each output has a folder of its
    # own, because other processes create and remove theirs meanwhile.
    final = output.absolute()
    folder = final.with_name(f"{PARTIAL_PREFIX}{final.name}")
    with report_write_errors(output):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        try:
            yield folder / final.name
            (folder / final.name).replace(final)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


class BufferedTable:
    """Base class of tables of stress; it collects rows (samples of cubes) until a part is large."""

    def __init__(self, path: Path) -> None:
        """Begin an empty table of stress; `path` is the file or folder for error messages."""
        self._path = path
        self._waiting: list[StressRows] = []
        self._waiting_rows = 0

    def __enter__(self) -> BufferedTable:
        return self

    def __exit__(self, *_: object) -> None:
        self._flush()

    def write(self, rows: StressRows) -> None:
        """Add rows to the table.

        Raises:
            BagError: Writing to the disk failed.
        """
        # Rows are collected until they fill a part, because large parts compress better, and
        # because Zarr would read and rewrite a part that is not full.
        self._waiting.append(rows)
        self._waiting_rows += len(rows)
        if self._waiting_rows >= ROWS_PER_GROUP:
            self._flush()

    def _flush(self) -> None:
        """Write all collected rows (samples of cubes) as one part of the table."""
        if self._waiting:
            with report_write_errors(self._path):
                self._append(concatenate(self._waiting))
        self._waiting, self._waiting_rows = [], 0

    def _append(self, rows: StressRows) -> None:
        """Write rows (samples of cubes) as one part of the table; subclasses override it."""
        raise NotImplementedError


class TableWriter(BufferedTable):
    """A new table of stress; a context manager that completes the file on exit.

    A component of the stress is NaN where the cube's pads do not determine it.
    """

    def __init__(self, path: Path, cubes: list[str]) -> None:
        """Create the file.

        Args:
            path: File to create; the format is CSV if its suffix is ``.csv``, otherwise Parquet.
            cubes: Names of the skin's cubes in the order of their indices, and one more name, which
                all rows with a higher index get.

        Raises:
            BagError: The file cannot be written.
        """
        super().__init__(path)
        self._cubes = pyarrow.array(cubes)
        self._schema = STRESS_SCHEMA
        with report_write_errors(path):
            if path.suffix == ".csv":
                # CSV has no dictionary encoding, so every row contains the name of its cube.
                plain = pyarrow.field(
                    "cube",
                    pyarrow.string(),
                    nullable=False,
                )
                self._schema = STRESS_SCHEMA.set(1, plain)
                self._writer = pyarrow.csv.CSVWriter(str(path), self._schema)
            else:
                # Measured values rarely repeat, so encoding them as a dictionary of distinct values
                # would cost time and space.
                self._writer = pyarrow.parquet.ParquetWriter(
                    str(path),
                    self._schema,
                    use_dictionary=["cube"],
                    write_batch_size=ROWS_PER_GROUP,
                )

    def __exit__(self, *_: object) -> None:
        self._flush()
        with report_write_errors(self._path):
            self._writer.close()

    def _append(self, rows: StressRows) -> None:
        self._writer.write_batch(make_stress_batch(rows, self._cubes).cast(self._schema))
