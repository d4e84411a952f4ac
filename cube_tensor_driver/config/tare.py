"""Tare files: the rest frequencies of one cube, named by its uid, with the calibration in use."""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.calibration import Calibration
from ..core.errors import ConfigError
from .yaml import read_yaml, write_yaml

SCHEMA = 1
_KEYS = {"schema", "uid", "calibration_id", "created", "rest_frequency"}
_HEADER = "Rest frequencies in Hz that ~/tare measured; ~/clear_tare removes it."


class StoredTare(NamedTuple):
    """rest_frequency: (P,) Hz. created: when it was measured, with time zone."""

    rest_frequency: NDArray[np.float64]
    created: datetime


def tare_path(folder: Path, uid: int) -> Path:
    """The file of the cube with this uid."""
    return folder / f"{uid:016x}.yaml"


def write_tare(
    folder: Path,
    uid: int,
    calibration: Calibration,
    rest_frequency: NDArray[np.floating],
    created: datetime,
) -> None:
    """Write the tare of a cube, completely or not at all, and make the folder if it is missing.

    Raises ConfigError if the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"{folder}: {error.strerror}; name a folder that can be written"
        ) from None
    content = {
        "schema": SCHEMA,
        "uid": f"{uid:#x}",
        "calibration_id": calibration.id,
        "created": created.isoformat(timespec="seconds"),
        "rest_frequency": [float(value) for value in rest_frequency],
    }
    write_yaml(tare_path(folder, uid), content, _HEADER)


def read_tare(folder: Path, uid: int, calibration: Calibration) -> StoredTare | None:
    """The tare of a cube; None if it has none.

    Raises ConfigError if the file is damaged, belongs to another cube, or was measured under
    another calibration. The text says which of these it is, and what to do.
    """
    path = tare_path(folder, uid)
    if not path.exists():
        return None
    data = read_yaml(path)
    if not isinstance(data, dict) or set(data) != _KEYS:
        keys = ", ".join(sorted(_KEYS))
        raise ConfigError(f"{path}: no tare file: its keys must be {keys}; tare again")
    if data["schema"] != SCHEMA:
        raise ConfigError(
            f"{path}: schema is {data['schema']!r}, this version reads {SCHEMA}; tare again"
        )
    if _uid(data["uid"]) != uid:
        raise ConfigError(
            f"{path}: uid is {data['uid']!r}, the file's name says {uid:#x}; tare again"
        )
    if data["calibration_id"] != calibration.id:
        raise ConfigError(
            f"{path}: measured under calibration {data['calibration_id']!r}, "
            f"the cube now has {calibration.id!r}; tare again"
        )
    rest = _rest_frequency(path, data["rest_frequency"], calibration.layout.n_pads)
    return StoredTare(rest, _created(path, data["created"]))


def remove_tare(folder: Path, uid: int) -> None:
    """Remove the tare of a cube if it has one. Raises ConfigError if it cannot be removed."""
    path = tare_path(folder, uid)
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; remove it by hand") from None


def _uid(value: Any) -> int | None:
    if isinstance(value, str) and re.fullmatch("0x[0-9a-f]{1,16}", value):
        return int(value, 16)
    return None


def _rest_frequency(path: Path, value: Any, n_pads: int) -> NDArray[np.float64]:
    are_numbers = isinstance(value, list) and all(type(item) in (int, float) for item in value)
    rest = np.array(value, float) if are_numbers else np.empty(0)
    if rest.shape != (n_pads,) or not (np.isfinite(rest) & (rest > 0)).all():
        raise ConfigError(
            f"{path}: rest_frequency is {str(value)[:60]}, "
            f"it must be {n_pads} numbers above 0; tare again"
        )
    return rest


def _created(path: Path, value: Any) -> datetime:
    try:
        created = datetime.fromisoformat(value) if isinstance(value, str) else value
        if isinstance(created, datetime) and created.tzinfo is not None:
            return created
    except ValueError:
        pass
    raise ConfigError(
        f"{path}: created is {value!r}, it must be a date and time with its zone; tare again"
    )
