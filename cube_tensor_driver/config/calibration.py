"""Calibration files: YAML of what `core.calibration.Calibration` holds."""

from __future__ import annotations

from pathlib import Path

from ..core.calibration import Calibration
from ..core.errors import CalibrationError, ConfigError
from .package_data import package_data
from .yaml import read_yaml, to_yaml, write_yaml


def find_calibration(name: str, folder: Path) -> Path:
    """The file that a skin means by `name`: a path, relative to the skin file's folder, or the name
    of a shipped one.

    ConfigError: no such file, with the names of the shipped ones.
    """
    shipped = package_data() / "config" / "calibration"
    for path in (folder / name, shipped / f"{name}.yaml"):
        if path.is_file():
            return path
    names = ", ".join(sorted(path.stem for path in shipped.glob("*.yaml")))
    raise ConfigError(
        f"no file {name!r} in {folder}; name a file, or one of the shipped calibrations: {names}"
    )


def read_calibration(path: Path) -> Calibration:
    """Read and check a calibration file. ConfigError: cannot be read, or what
    `Calibration.from_dict` refuses."""
    try:
        return Calibration.from_dict(read_yaml(path))
    except CalibrationError as error:
        raise ConfigError(f"{path}: {error}") from None


def write_calibration(path: Path, calibration: Calibration, header: str = "") -> None:
    """Write a calibration file, whole or not at all. ConfigError: cannot be written."""
    write_yaml(path, calibration.to_dict(), header)


def calibration_text(calibration: Calibration) -> str:
    """The text of a calibration's file."""
    return to_yaml(calibration.to_dict())
