# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration and layout files: `Calibration` and `Layout` of `core` as YAML."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..core.calibration import Calibration
from ..core.errors import CalibrationError, ConfigError
from ..core.layout import LAYOUTS, Layout, find_layout
from .output_files import YAML_SUFFIXES
from .package_data import find_package_data, find_shipped
from .yaml import read_yaml, to_yaml, write_yaml


def find_calibration(name: str, folder: Path) -> Path:
    """Return the path of the calibration file that a skin file names.

    Args:
        name: Name of a calibration in the package such as "cube", or a path relative to `folder`.
        folder: The folder of the skin file that contains the name.

    Raises:
        ConfigError: The package has no calibration of this name and the path leads to no file.
    """
    advice = "a file, or one of the shipped calibrations"
    return find_shipped(
        "calibration/*.yaml",
        name,
        folder,
        advice,
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


def write_calibration(
    path: Path,
    calibration: Calibration,
    header: str = "",
) -> None:
    """Write a calibration file, completely or not at all.

    Args:
        path: The file, which is replaced if it exists.
        calibration: The calibration.
        header: Lines of text that are written as a YAML comment at the top of the file.

    Raises:
        ConfigError: The file cannot be written.
    """
    write_yaml(path, calibration.to_dict(), header)


def format_calibration(calibration: Calibration) -> str:
    """Return a calibration as YAML text, with the same keys as a calibration file."""
    return to_yaml(calibration.to_dict())


def find_named_layout(name: str) -> Layout:
    """Return a layout (number, faces and shapes of the pads of a cube).

    Args:
        name: Name of a built-in layout, or path of a YAML file if it ends in .yaml or .yml.

    Raises:
        LayoutError: There is no built-in layout of this name, or the file holds no valid layout.
        ConfigError: The file cannot be read.
    """
    path = Path(name)
    if path.suffix in YAML_SUFFIXES:
        return Layout.from_dict(read_yaml(path))
    return find_layout(name)


def find_shipped_calibration(layout: Layout) -> Calibration | None:
    """Return the calibration that the package contains for a built-in layout.

    The calibration was computed with finite elements, not measured. Its list of neglected modes
    (components of stress or gradient) is emptied: which ones may be neglected depends on the
    application, so users state them in their own files. The result is None for any other layout.
    """
    # A layout that was read from a file may have the name of a built-in one but other pads.
    built_in = LAYOUTS.get(layout.name)
    if built_in is None or not built_in.has_same_pads(layout):
        return None
    path = find_package_data() / "config" / "calibration" / f"{layout.name}.yaml"
    return replace(read_calibration(path), neglect=())
