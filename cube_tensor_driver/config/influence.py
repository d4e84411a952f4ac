# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Files of influence functions, found by the name that a parameter or an option gives.

An influence function states what a pad measures under a unit force, for many positions of the force
on the skin's surface. The files are tables computed with finite elements.
"""

from __future__ import annotations

from pathlib import Path

from ..core.errors import ConfigError
from .package_data import find_shipped


def find_influence(name: str) -> Path:
    """Return the path of a file (.npz) of influence functions.

    Args:
        name: Name of such a file in the package, without its suffix, or a path.

    Raises:
        ConfigError: The package has no file of this name and the path leads to no file.
    """
    advice = (
        "a file of influence functions that ./cube fem MODEL --load surface -o FILE.npz made, "
        "or one of the shipped"
    )
    return find_shipped(
        "influence/*.npz",
        name,
        Path(),
        advice,
    )


def find_influence_problem(name: str) -> str:
    """Return an error message if there is no file of influence functions of this name; else "".

    Args:
        name: Name of such a file in the package, without its suffix, or a path.
    """
    try:
        find_influence(name)
    except ConfigError as error:
        return str(error)
    return ""
