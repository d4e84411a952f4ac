"""Calibration files: a `core.calibration.Calibration` as YAML."""

from __future__ import annotations

from pathlib import Path

from ..core.calibration import Calibration
from ..core.errors import CalibrationError, ConfigError
from .package_data import package_data
from .yaml import read_yaml, to_yaml, write_yaml


def find_calibration(name: str, folder: Path) -> Path:
    """The calibration file that `name` means.

    That is the name of one of the calibrations in the package, or else a path relative to `folder`
    (where the skin file is). Raises ConfigError if there is neither, and lists these names. A name
    comes first: a folder may well have a program called cube.
    """
    shipped = package_data() / "config" / "calibration"
    for path in (shipped / f"{name}.yaml", folder / name):
        if path.is_file():
            return path
    names = ", ".join(sorted(path.stem for path in shipped.glob("*.yaml")))
    raise ConfigError(
        f"no file {name!r} in {folder}; name a file, or one of the shipped calibrations: {names}"
    )


def read_calibration(path: Path) -> Calibration:
    """Read and check a calibration file.

    Raises ConfigError if it cannot be read, or if `Calibration.from_dict` refuses its content.
    """
    try:
        return Calibration.from_dict(read_yaml(path))
    except CalibrationError as error:
        raise ConfigError(f"{path}: {error}") from None


def write_calibration(path: Path, calibration: Calibration, header: str = "") -> None:
    """Write a calibration file, completely or not at all. Raises ConfigError if it cannot.

    header: comment lines at the top of the file.
    """
    write_yaml(path, calibration.to_dict(), header)


def calibration_text(calibration: Calibration) -> str:
    """The content of the calibration's file."""
    return to_yaml(calibration.to_dict())
