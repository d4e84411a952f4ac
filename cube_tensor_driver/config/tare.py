"""Tare files: the rest frequencies of one cube, named by its uid, with the calibration in use."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array
from ..core.calibration import Calibration
from ..core.errors import ConfigError
from .schema import TEXT, JsonSchema, Schema, mapping
from .yaml import read_yaml, write_yaml

SCHEMA_VERSION = 1
"""Version of the format of tare files."""

_HEADER = "Rest frequencies in Hz that ~/tare measured; ~/clear_tare removes it."


class StoredTare(NamedTuple):
    """The tare of one cube, as it was read from its file.

    Attributes:
        rest_frequency: Frequency of each pad without load, (P,), in Hz.
        created: When it was measured, with time zone.
    """

    rest_frequency: Array
    created: datetime


def tare_path(folder: Path, uid: int) -> Path:
    """Return the path of the tare file of the cube with this uid."""
    return folder / f"{uid:016x}.yaml"


def write_tare(
    folder: Path,
    uid: int,
    calibration: Calibration,
    rest_frequency: NDArray[np.floating[Any]],
    created: datetime,
) -> None:
    """Write the tare of a cube, completely or not at all.

    Args:
        folder: The folder of all tares, which is made if it is missing.
        uid: Uid of the cube.
        calibration: Calibration under which the tare was measured.
        rest_frequency: Frequency of each pad without load, (P,), in Hz.
        created: When it was measured, with time zone.

    Raises:
        ConfigError: The folder cannot be written.
    """
    try:
        # The folder is below the home of ROS, and nobody makes it by hand.
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"{folder}: {error.strerror}; name a folder that can be written"
        ) from None
    content = {
        "schema": SCHEMA_VERSION,
        "uid": f"{uid:#x}",
        "calibration_id": calibration.id,
        "created": created.isoformat(timespec="seconds"),
        "rest_frequency": [float(value) for value in rest_frequency],
    }
    write_yaml(tare_path(folder, uid), content, _HEADER)


def read_tare(folder: Path, uid: int, calibration: Calibration) -> StoredTare | None:
    """Return the tare of a cube, or None if it has none.

    Args:
        folder: The folder of all tares.
        uid: Uid of the cube.
        calibration: Calibration of the cube now.

    Raises:
        ConfigError: The file is damaged, belongs to another cube, or was measured under another
            calibration. The message says which of these it is, and what to do.
    """
    path = tare_path(folder, uid)
    if not path.exists():
        return None
    data = read_yaml(path)
    for _, mistake in _tare_schema(calibration.layout.n_pads).mistakes(data):
        raise ConfigError(f"{path}: {mistake}; tare again")

    # Somebody has renamed or copied the file.
    if int(data["uid"], 16) != uid:
        raise ConfigError(
            f"{path}: uid is {data['uid']!r}, the file's name says {uid:#x}; tare again"
        )
    # Rest frequencies contain what the calibration says about temperature.
    if data["calibration_id"] != calibration.id:
        raise ConfigError(
            f"{path}: measured under calibration {data['calibration_id']!r}, "
            f"the cube now has {calibration.id!r}; tare again"
        )
    rest_frequency = np.array(data["rest_frequency"], float)
    return StoredTare(rest_frequency, _parse_time(path, data["created"]))


def remove_tare(folder: Path, uid: int) -> None:
    """Remove the tare of a cube if it has one. Raises ConfigError if it cannot be removed."""
    path = tare_path(folder, uid)
    try:
        # Clearing a tare twice is no error.
        path.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; remove it by hand") from None


def _tare_schema(n_pads: int) -> Schema:
    frequencies: JsonSchema = {
        "type": "array",
        "items": {
            "type": "number",
            "exclusiveMinimum": 0,
            "description": "a number above 0",
        },
        "minItems": n_pads,
        "maxItems": n_pads,
        "description": f"{n_pads} numbers above 0",
    }
    properties: JsonSchema = {
        "schema": {"const": SCHEMA_VERSION, "description": f"{SCHEMA_VERSION} in this version"},
        "uid": {
            "type": "string",
            "pattern": r"^0x[0-9a-f]{1,16}\Z",
            "description": "a uid in hexadecimal as in 0x1f",
        },
        "calibration_id": TEXT,
        # YAML makes a datetime of it, or leaves a text, depending on how it is written.
        "created": {},
        "rest_frequency": frequencies,
    }
    return Schema(mapping(properties, properties))


def _parse_time(path: Path, value: Any) -> datetime:
    """Return the time when a tare was measured. ConfigError: it is no time with a zone."""
    try:
        time = datetime.fromisoformat(value) if isinstance(value, str) else value
    except ValueError:
        time = None
    if isinstance(time, datetime) and time.tzinfo is not None:
        return time
    raise ConfigError(
        f"{path}: created is {value!r}, it must be a date and time with its zone; tare again"
    )
