"""Layouts by name or from a file, and the calibrations that are shipped for the built-in ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..core.calibration import Calibration
from ..core.layout import LAYOUTS, Layout, find_layout
from .calibration import read_calibration
from .package_data import package_data
from .yaml import read_yaml


def named_layout(name: str) -> Layout:
    """A built-in layout, or the one in a YAML file. LayoutError: neither; ConfigError: no file."""
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        return Layout.from_dict(read_yaml(path))
    return find_layout(name)


def shipped_calibration(layout: Layout) -> Calibration | None:
    """The computed calibration of a built-in layout, with no mode neglected; None for others."""
    known = LAYOUTS.get(layout.name)
    if known is None or not known.same_as(layout):
        return None
    path = package_data() / "config" / "calibration" / f"{layout.name}.yaml"
    return replace(read_calibration(path), neglect=())
