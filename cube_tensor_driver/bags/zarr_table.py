# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of stress as a Zarr group (folder of arrays): one array per column of the table."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import zarr

from ..core.errors import BagError
from ..core.modes import GRADIENT, STRESS
from ..core.rows import COLUMN_TYPES, StressRows
from .tables import ROWS_PER_GROUP, BufferedTable

_UNITS = {
    "stamp_ns": "ns",
    "stress": "Pa",
    "gradient": "Pa/m",
}
"""Unit of each column that has one, stored as an attribute of the column's array."""

_COMPONENTS = {"stress": STRESS, "gradient": GRADIENT}
"""Names of the components of each column with several numbers per row, such as xx, yy, … of
stress."""

_TYPES: dict[str, type] = {
    "cube": np.uint16,
    "stress": np.float32,
    "gradient": np.float32,
}
"""Type of each column that is not in `COLUMN_TYPES`."""


class ZarrWriter(BufferedTable):
    """A new table of stress as a Zarr group; a context manager that completes the group on exit.

    A component of the stress is NaN where the cube's pads do not determine it.
    """

    def __init__(self, path: Path, cubes: list[str]) -> None:
        """Create the group.

        Args:
            path: Folder of the group, which is created or replaced.
            cubes: Names of the skin's cubes in the order of their indices, and one more name for
                all rows with a higher index. They become an attribute of the column `cube`.

        Raises:
            BagError: The installed library zarr is older than version 3.
        """
        if not hasattr(zarr.Group, "create_array"):
            raise BagError(
                f"{path}: zarr {zarr.__version__} is too old, needed is 3: "
                "pip install 'zarr>=3', with Python 3.11 or newer"
            )
        super().__init__(path)
        self._last_cube = len(cubes) - 1
        group = zarr.open_group(str(path), mode="w")
        names = [field.name for field in fields(StressRows)]
        self._arrays = {name: _create_column(group, name, cubes) for name in names}

    def _append(self, rows: StressRows) -> None:
        columns = {name: getattr(rows, name) for name in self._arrays}
        columns["cube"] = np.minimum(rows.cube, self._last_cube)
        for name, array in self._arrays.items():
            array.append(columns[name])


def _create_column(
    group: zarr.Group,
    name: str,
    cubes: list[str],
) -> zarr.Array:
    """Create the empty array of one column, with its unit and components as attributes.

    Args:
        group: Zarr group of the table.
        name: Name of the column, an attribute of `StressRows`.
        cubes: Names of the cubes, an attribute of the column `cube`.
    """
    components = _COMPONENTS.get(name, ())
    width = (len(components),) if components else ()
    attributes: dict[str, object] = {}
    if name in _UNITS:
        attributes["units"] = _UNITS[name]
    if components:
        attributes["components"] = list(components)
    if name == "cube":
        attributes["names"] = cubes
    return group.create_array(
        name,
        shape=(0, *width),
        chunks=(ROWS_PER_GROUP, *width),
        dtype=np.dtype((COLUMN_TYPES | _TYPES)[name]),
        dimension_names=["row", f"{name}_component"] if components else ["row"],
        attributes=attributes,
    )
