"""Tables of stress rows as a Zarr group: one array per column, chunked along the rows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import zarr

from ..core.errors import BagError
from ..core.modes import COMPONENTS, STRESS
from ..core.rows import StressRows, concatenate

CHUNK = 1 << 16
"""Rows in a chunk."""
_UNITS = {"stamp_ns": "ns", "stress": "Pa", "gradient": "Pa/m"}
_COMPONENTS = {"stress": COMPONENTS[: len(STRESS)], "gradient": COMPONENTS[len(STRESS) :]}
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
    """A group of columns; a context that completes it. NaN: not observed. BagError: cannot be
    written."""

    def __init__(self, path: Path, cubes: list[str]) -> None:
        """cubes: names, kept in the attributes of `cube`, which has their indices."""
        if not hasattr(zarr.Group, "create_array"):
            raise BagError(
                f"{path}: zarr {zarr.__version__} is too old, needed is 3: "
                "pip install 'zarr>=3', with Python 3.11 or newer"
            )
        self._path, self._last = path, len(cubes) - 1
        self._waiting: list[StressRows] = []
        self._rows = 0
        group = zarr.open_group(str(path), mode="w")
        self._arrays: dict[str, Any] = {}
        for name, kind in _COLUMNS.items():
            components = _COMPONENTS.get(name, ())
            width = (len(components),) if components else ()
            attributes: dict[str, Any] = {"units": _UNITS[name]} if name in _UNITS else {}
            if components:
                attributes["components"] = list(components)
            if name == "cube":
                attributes["names"] = cubes
            self._arrays[name] = group.create_array(
                name,
                shape=(0, *width),
                chunks=(CHUNK, *width),
                dtype=np.dtype(kind),
                dimension_names=["row", f"{name}_component"] if components else ["row"],
                attributes=attributes,
            )

    def __enter__(self) -> ZarrWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._flush()

    def write(self, rows: StressRows) -> None:
        """Add rows."""
        self._waiting.append(rows)
        self._rows += len(rows)
        if self._rows >= CHUNK:
            self._flush()

    def _flush(self) -> None:
        if not self._waiting:
            return
        rows = concatenate(self._waiting)
        # Rows of cubes that the skin does not have get the last name.
        columns = {name: getattr(rows, name) for name in self._arrays}
        columns["cube"] = np.minimum(rows.cube, self._last)
        try:
            for name, array in self._arrays.items():
                array.append(columns[name])
        except OSError as error:
            raise BagError(
                f"{self._path}: {error.strerror or error}; name a disk with room"
            ) from None
        self._waiting, self._rows = [], 0
