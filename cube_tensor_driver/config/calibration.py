"""Calibration and layout files: `Calibration` and `Layout` of `core` as YAML."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..core.calibration import Calibration
from ..core.errors import CalibrationError, ConfigError
from ..core.layout import LAYOUTS, Layout, find_layout
from .output_files import YAML_SUFFIXES
from .package_data import package_data
from .yaml import read_yaml, to_yaml, write_yaml


def find_calibration(name: str, folder: Path) -> Path:
    """Return the path of the calibration file that a name means.

    Args:
        name: Name of one of the calibrations in the package, or else a path relative to `folder`.
            The shipped name comes first, because a folder may well have a program called cube.
        folder: The folder of the skin file that contains the name.

    Raises:
        ConfigError: There is neither. The message lists the shipped names.
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

    Raises:
        ConfigError: The file cannot be read, or `Calibration.from_dict` refuses its content.
    """
    try:
        return Calibration.from_dict(read_yaml(path))
    except CalibrationError as error:
        raise ConfigError(f"{path}: {error}") from None


def write_calibration(path: Path, calibration: Calibration, header: str = "") -> None:
    """Write a calibration file, completely or not at all.

    Args:
        path: The file, which is replaced if it exists.
        calibration: The calibration.
        header: Lines for a comment at the top of the file.

    Raises:
        ConfigError: The file cannot be written.
    """
    write_yaml(path, calibration.to_dict(), header)


def calibration_text(calibration: Calibration) -> str:
    """Return the text of a calibration file."""
    return to_yaml(calibration.to_dict())


def named_layout(name: str) -> Layout:
    """Return a built-in layout by its name, or the layout in a YAML file.

    Raises:
        LayoutError: There is no built-in layout of this name, or the file holds none.
        ConfigError: The file cannot be read.
    """
    path = Path(name)
    if path.suffix in YAML_SUFFIXES:
        return Layout.from_dict(read_yaml(path))
    return find_layout(name)


def shipped_calibration(layout: Layout) -> Calibration | None:
    """Return the computed calibration of a built-in layout with no mode neglected.

    Other layouts have none, and give None.
    """
    # A file may hold another layout under the name of a built-in one.
    built_in = LAYOUTS.get(layout.name)
    if built_in is None or not built_in.same_as(layout):
        return None
    path = package_data() / "config" / "calibration" / f"{layout.name}.yaml"
    # What a user neglects is a decision about a calibration of his own.
    return replace(read_calibration(path), neglect=())
