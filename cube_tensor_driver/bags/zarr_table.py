"""Tables of stress rows as a Zarr group: one array per column, chunked along the rows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import zarr

from ..core.errors import BagError
from ..core.modes import GRADIENT, STRESS
from ..core.rows import StressRows, concatenate
from .tables import report_write_errors

ROWS_PER_CHUNK = 1 << 16
"""Number of rows in one chunk of an array."""

_UNITS = {
    "stamp_ns": "ns",
    "stress": "Pa",
    "gradient": "Pa/m",
}
_COMPONENTS = {"stress": STRESS, "gradient": GRADIENT}
_COLUMNS: dict[str, Any] = {
    "stamp_ns": np.int64,
    "cube": np.uint16,
    "sequence": np.uint32,
    "stress": np.float32,
    "gradient": np.float32,
    "residual": np.float32,
    "status": np.uint16,
    "observed": np.uint16,
    "left_out": np.uint32,
}


class ZarrWriter:
    """A new group of columns; a context manager that completes it. NaN stands for not observed."""

    def __init__(self, path: Path, cubes: list[str]) -> None:
        """Create the group.

        Args:
            path: Folder of the group.
            cubes: Names of the cubes, kept in the attributes of the column `cube`, which contains
                their indices. Rows of cubes that the skin does not have get the last index.

        Raises:
            BagError: The library zarr is too old.
        """
        if not hasattr(zarr.Group, "create_array"):
            raise BagError(
                f"{path}: zarr {zarr.__version__} is too old, needed is 3: "
                "pip install 'zarr>=3', with Python 3.11 or newer"
            )
        self._path = path
        self._last_cube = len(cubes) - 1
        self._waiting: list[StressRows] = []
        self._waiting_rows = 0
        group = zarr.open_group(str(path), mode="w")
        self._arrays = {name: _create_column(group, name, cubes) for name in _COLUMNS}

    def __enter__(self) -> ZarrWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._flush()

    def write(self, rows: StressRows) -> None:
        """Add rows.

        Raises:
            BagError: The disk is full or gone.
        """
        self._waiting.append(rows)
        self._waiting_rows += len(rows)
        if self._waiting_rows >= ROWS_PER_CHUNK:
            self._flush()

    def _flush(self) -> None:
        """Write the rows that wait."""
        if not self._waiting:
            return
        # Whole chunks at a time: Zarr would read a chunk that is not full to append to it.
        rows = concatenate(self._waiting)
        columns = {name: getattr(rows, name) for name in self._arrays}
        columns["cube"] = np.minimum(rows.cube, self._last_cube)
        with report_write_errors(self._path):
            for name, array in self._arrays.items():
                array.append(columns[name])
        self._waiting, self._waiting_rows = [], 0


def _create_column(
    group: Any,
    name: str,
    cubes: list[str],
) -> Any:
    """Create the array of one column, with attributes that state what it means."""
    components = _COMPONENTS.get(name, ())
    width = (len(components),) if components else ()
    attributes: dict[str, Any] = {}
    if name in _UNITS:
        attributes["units"] = _UNITS[name]
    if components:
        attributes["components"] = list(components)
    if name == "cube":
        attributes["names"] = cubes
    return group.create_array(
        name,
        shape=(0, *width),
        chunks=(ROWS_PER_CHUNK, *width),
        dtype=np.dtype(_COLUMNS[name]),
        dimension_names=["row", f"{name}_component"] if components else ["row"],
        attributes=attributes,
    )
