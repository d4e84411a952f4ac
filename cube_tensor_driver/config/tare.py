# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Tare files: the measured rest frequencies (frequencies without load) of one cube each.

The name of a file is the uid (unique number) of the cube; the file also names the calibration under
which the tare was measured.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array
from ..core.calibration import Calibration
from ..core.errors import ConfigError
from ..core.health.tare import MAX_REST_CHANGE
from .schema import TEXT, JsonSchema, Schema, mapping
from .yaml import read_yaml, write_yaml

SCHEMA_VERSION = 1
"""Version of the format of tare files (a cube's frequencies without load). Files with another
version are refused."""

_HEADER = "Rest frequencies in Hz that ~/tare measured; ~/clear_tare removes it."
"""Comment in the first line of a tare file, for people who open it."""


class StoredTare(NamedTuple):
    """The content of a tare file.

    Attributes:
        rest_frequency: Frequency of each pad without load, (pads,), in Hz.
        created: Date and time at which the tare was measured, with time zone.
    """

    rest_frequency: Array
    created: datetime


def tare_path(folder: Path, uid: int) -> Path:
    """Return the path of the tare file (frequencies without load) of the cube with this uid."""
    return folder / f"{uid:016x}.yaml"


def write_tare(
    folder: Path,
    uid: int,
    calibration: Calibration,
    rest_frequency: NDArray[np.floating[Any]],
    created: datetime,
) -> None:
    """Write the tare file (frequencies without load) of a cube, completely or not at all.

    Args:
        folder: Folder of the tare files of all cubes. It is made if it does not exist.
        uid: Uid (unique number) of the cube.
        calibration: Calibration under which the tare was measured.
        rest_frequency: Frequency of each pad without load, (pads,), in Hz.
        created: Date and time at which the tare was measured, with time zone.

    Raises:
        ConfigError: The folder cannot be made, or the file in it cannot be written.
    """
    try:
        # The folder is made, because the default below ~/.ros does not exist at first.
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
    """Return the stored tare (frequencies without load) of a cube; None if there is no file for it.

    Args:
        folder: Folder of the tare files of all cubes.
        uid: Uid (unique number) of the cube.
        calibration: Calibration that the cube has now.

    Raises:
        ConfigError: The file is damaged, belongs to another cube, was measured under another
            calibration, or has frequencies that the tare service would refuse. The message states
            which of these it is, and asks for a new tare.
    """
    path = tare_path(folder, uid)
    if not path.exists():
        return None
    data = read_yaml(path)
    for _, mistake in _tare_schema(calibration.layout.n_pads).mistakes(data):
        raise ConfigError(f"{path}: {mistake}; tare again")

    # The uid in the content differs from the uid in the file name if somebody has renamed the file
    # or copied it for another cube.
    if int(data["uid"], 16) != uid:
        raise ConfigError(
            f"{path}: uid is {data['uid']!r}, the file's name says {uid:#x}; tare again"
        )
    # Rest frequencies are stored corrected to the reference temperature with the coefficients of
    # the calibration, so they are not valid under another one.
    if data["calibration_id"] != calibration.id:
        raise ConfigError(
            f"{path}: measured under calibration {data['calibration_id']!r}, "
            f"the cube now has {calibration.id!r}; tare again"
        )
    rest_frequency = np.array(data["rest_frequency"], float)
    change = np.abs(rest_frequency / calibration.rest_frequency - 1)
    pad = int(change.argmax())
    if change[pad] > MAX_REST_CHANGE:
        raise ConfigError(
            f"{path}: pad {pad} has {rest_frequency[pad]:g} Hz, which is more than "
            f"{MAX_REST_CHANGE:.0%} from the {calibration.rest_frequency[pad]:g} Hz of the "
            "calibration; tare again"
        )
    return StoredTare(rest_frequency, _parse_time(path, data["created"]))


def remove_tare(folder: Path, uid: int) -> None:
    """Remove the tare file of a cube, if there is one.

    Args:
        folder: Folder of the tare files of all cubes.
        uid: Uid (unique number) of the cube.

    Raises:
        ConfigError: The file cannot be removed.
    """
    path = tare_path(folder, uid)
    try:
        # A missing file is no error, so that clearing a tare twice succeeds.
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
        # The schema allows any value, because YAML reads a time as a datetime or as a text. Both
        # are checked by `_parse_time`.
        "created": {},
        "rest_frequency": frequencies,
    }
    return Schema(mapping(properties, properties))


def _parse_time(path: Path, value: Any) -> datetime:
    """Return the value of the key `created` of a tare file as a datetime.

    Raises:
        ConfigError: The value is no date and time, or has no time zone.
    """
    try:
        time = datetime.fromisoformat(value) if isinstance(value, str) else value
    except ValueError:
        time = None
    if isinstance(time, datetime) and time.tzinfo is not None:
        return time
    raise ConfigError(
        f"{path}: created is {value!r}, it must be a date and time with its zone; tare again"
    )
