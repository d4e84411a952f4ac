"""Tare files: the rest frequencies of one cube, by its uid, with the calibration they were measured
under."""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..core.calibration import Calibration
from ..core.errors import ConfigError
from .yaml import read_yaml, write_yaml

SCHEMA = 1
_KEYS = {"schema", "uid", "calibration_id", "created", "rest_frequency"}


class StoredTare(NamedTuple):
    """rest_frequency: (P,) Hz; created: when, with its time zone."""

    rest_frequency: np.ndarray
    created: datetime


def tare_path(folder: Path, uid: int) -> Path:
    """The file of a cube."""
    return folder / f"{uid:016x}.yaml"


def write_tare(
    folder: Path, uid: int, calibration: Calibration, rest_frequency: np.ndarray, created: datetime
) -> None:
    """Write a cube's tare, whole or not at all. ConfigError: the folder cannot be written."""
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
    write_yaml(
        tare_path(folder, uid),
        content,
        "Rest frequencies in Hz that ~/tare measured; ~/clear_tare removes it.",
    )


def read_tare(folder: Path, uid: int, calibration: Calibration) -> StoredTare | None:
    """A cube's tare, None if there is none.

    ConfigError: damaged, of another cube, or measured under another calibration; the text says
    which, and what to do.
    """
    path = tare_path(folder, uid)
    if not path.exists():
        return None
    data = read_yaml(path)
    if not isinstance(data, dict) or set(data) != _KEYS:
        raise ConfigError(
            f"{path}: no tare file: its keys must be {', '.join(sorted(_KEYS))}; tare again"
        )
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
            f"{path}: measured under calibration {data['calibration_id']!r}, the cube now has {calibration.id!r}; "
            "tare again"
        )
    return StoredTare(
        _rest(path, data["rest_frequency"], calibration.layout.n_pads),
        _created(path, data["created"]),
    )


def remove_tare(folder: Path, uid: int) -> None:
    """Remove a cube's tare, if there is one. ConfigError: it cannot be removed."""
    path = tare_path(folder, uid)
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; remove it by hand") from None


def _uid(value: Any) -> int | None:
    known = isinstance(value, str) and re.fullmatch("0x[0-9a-f]{1,16}", value)
    return int(value, 16) if known else None


def _rest(path: Path, value: Any, n_pads: int) -> np.ndarray:
    numbers = isinstance(value, list) and all(type(item) in (int, float) for item in value)
    rest = np.array(value, float) if numbers else np.empty(0)
    if rest.shape != (n_pads,) or not (np.isfinite(rest) & (rest > 0)).all():
        raise ConfigError(
            f"{path}: rest_frequency is {str(value)[:60]}, it must be {n_pads} numbers above 0; tare again"
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
