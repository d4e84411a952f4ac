"""Tables of stress rows, Parquet or CSV, with units in the names of the columns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet

from ..core.errors import BagError
from ..core.modes import COMPONENTS, STRESS
from ..core.rows import StressRows

GROUP = 1 << 16
"""Rows at a time: one row group of a Parquet file."""
_SCHEMA = pyarrow.schema(
    [
        ("stamp_ns", pyarrow.int64()),
        ("cube", pyarrow.dictionary(pyarrow.int32(), pyarrow.string())),
        ("sequence", pyarrow.uint32()),
        *((f"stress_{name}_Pa", pyarrow.float32()) for name in STRESS),
        *((f"gradient_{name}_Pa_per_m", pyarrow.float32()) for name in COMPONENTS[len(STRESS) :]),
        ("residual", pyarrow.float32()),
        ("status", pyarrow.uint16()),
        ("observed", pyarrow.uint16()),
        ("left_out", pyarrow.uint32()),
    ]
)


class TableWriter:
    """A table of rows; a context that completes it. NaN: not observed. BagError: cannot be
    written."""

    def __init__(self, path: Path, cubes: list[str]) -> None:
        self._path = path
        self._cubes = pyarrow.array(cubes)
        self._batches: list[Any] = []
        self._rows = 0
        self._csv = path.suffix == ".csv"
        schema = _SCHEMA.set(1, pyarrow.field("cube", pyarrow.string())) if self._csv else _SCHEMA
        self._schema = schema
        make = pyarrow.csv.CSVWriter if self._csv else pyarrow.parquet.ParquetWriter
        try:
            self._writer = make(str(path), schema)
        except OSError as error:
            raise BagError(
                f"{path}: {error.strerror or error}; name a folder that can be written"
            ) from None

    def __enter__(self) -> TableWriter:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._flush()
            self._writer.close()
        except OSError as error:
            raise BagError(
                f"{self._path}: {error.strerror or error}; name a disk with room"
            ) from None

    def write(self, rows: StressRows) -> None:
        """Add rows."""
        # Rows of cubes that the skin does not have get the last name.
        names = pyarrow.DictionaryArray.from_arrays(
            np.minimum(rows.cube, len(self._cubes) - 1).astype(np.int32), self._cubes
        )
        columns = [
            rows.stamp_ns,
            names,
            rows.sequence,
            *rows.stress.T,
            *rows.gradient.T,
            rows.residual,
            rows.status,
            rows.observed,
            rows.left_out,
        ]
        arrays = [
            pyarrow.array(column) if isinstance(column, np.ndarray) else column
            for column in columns
        ]
        if self._csv:
            arrays[1] = names.dictionary_decode()
        self._batches.append(pyarrow.RecordBatch.from_arrays(arrays, schema=self._schema))
        self._rows += len(rows)
        if self._rows >= GROUP:
            try:
                self._flush()
            except OSError as error:
                raise BagError(
                    f"{self._path}: {error.strerror or error}; name a disk with room"
                ) from None

    def _flush(self) -> None:
        if self._batches:
            self._writer.write_table(pyarrow.Table.from_batches(self._batches))
        self._batches, self._rows = [], 0
