# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Tare files: the measured rest frequencies (frequencies without load) of one cube each.

The name of a file is the uid (unique number) of the cube; the file also names the calibration under
which the tare was measured.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import NamedTuple, TypedDict, cast

import numpy as np

from ..core.arrays import Array, Real
from ..core.calibration import Calibration
from ..core.errors import ConfigError
from ..core.health.tare import MAX_REST_CHANGE
from .schema import TEXT, JsonSchema, Schema, make_mapping_schema
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


class _TareContent(TypedDict):
    """Keys of a tare file that `StoredTare` contains, see `_make_tare_schema`."""

    rest_frequency: list[float]
    created: str


def find_tare_path(folder: Path, uid: int) -> Path:
    """Return the path of the tare file (frequencies without load) of the cube with this uid."""
    return folder / f"{uid:016x}.yaml"


def write_tare(
    folder: Path,
    uid: int,
    calibration: Calibration,
    rest_frequency: Real,
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
    write_yaml(find_tare_path(folder, uid), content, _HEADER)


def read_tare(
    folder: Path,
    uid: int,
    calibration: Calibration,
) -> StoredTare | None:
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
    path = find_tare_path(folder, uid)
    if not path.exists():
        return None
    content = read_yaml(path)
    for _, mistake in _make_tare_schema(uid, calibration).find_mistakes(content):
        raise ConfigError(f"{path}: {mistake}; tare again")
    # The schema has checked the types of all values.
    data = cast("_TareContent", content)
    try:
        # Times with and without a zone cannot be compared, so one without is taken as local time.
        created = datetime.fromisoformat(data["created"]).astimezone()
    except (ValueError, OverflowError) as error:
        raise ConfigError(f"{path}: created: {error}; tare again") from None
    return StoredTare(np.array(data["rest_frequency"], float), created)


def remove_tare(folder: Path, uid: int) -> None:
    """Remove the tare file of a cube, if there is one.

    Args:
        folder: Folder of the tare files of all cubes.
        uid: Uid (unique number) of the cube.

    Raises:
        ConfigError: The file cannot be removed.
    """
    path = find_tare_path(folder, uid)
    try:
        # A missing file is no error, so that clearing a tare twice succeeds.
        path.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; remove it by hand") from None


def _make_tare_schema(uid: int, calibration: Calibration) -> Schema:
    """Return the schema of the tare file of a cube.

    The uid in the content differs from that of the cube if somebody has renamed the file, or copied
    it for another cube. Rest frequencies are stored corrected to the reference temperature with the
    coefficients of the calibration, so they are not valid under another one.

    Args:
        uid: Unique number of the cube.
        calibration: Calibration of the cube.
    """
    frequencies: list[JsonSchema] = [
        {
            "type": "number",
            "minimum": (1 - MAX_REST_CHANGE) * calibrated,
            "maximum": (1 + MAX_REST_CHANGE) * calibrated,
            "description": f"within {MAX_REST_CHANGE:.0%} of the calibration's {calibrated:g} Hz",
        }
        for calibrated in calibration.rest_frequency.tolist()
    ]
    n_pads = len(frequencies)
    properties: JsonSchema = {
        "schema": {"const": SCHEMA_VERSION, "description": f"{SCHEMA_VERSION} in this version"},
        "uid": {"const": f"{uid:#x}", "description": f"{uid:#x}, as in the name of the file"},
        "calibration_id": {
            "const": calibration.id,
            "description": f"{calibration.id}, the id of the cube's calibration",
        },
        "created": TEXT,
        "rest_frequency": {
            "type": "array",
            "items": frequencies,
            "minItems": n_pads,
            "maxItems": n_pads,
            "description": f"{n_pads} numbers",
        },
    }
    return Schema(make_mapping_schema(properties, properties))
