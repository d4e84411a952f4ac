# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Files of influence functions, found by the name that a parameter or an option gives.

Influence functions state what each pad measures of a unit force at points of the skin's surface;
they are tables computed with finite elements.
"""

from __future__ import annotations

import os
from pathlib import Path

from ..core.errors import ConfigError
from .package_data import package_data


def find_influence(name: str) -> Path:
    """Return the path of a file (.npz) of influence functions.

    Args:
        name: Name of such a file in the package, without its suffix, or a path.

    Raises:
        ConfigError: The package has no file of this name and the path leads to no file. The message
            lists the names in the package.
    """
    # The package is searched before the file system, as for calibrations.
    shipped = package_data() / "config" / "influence"
    for path in (shipped / f"{name}.npz", Path(name)):
        # os.path.isfile, unlike Path.is_file, is false for a name that is too long.
        if os.path.isfile(path):  # noqa: PTH113
            return path
    names = ", ".join(sorted(path.stem for path in shipped.glob("*.npz")))
    raise ConfigError(
        f"no influence functions {name!r}; name a file that ./cube fem MODEL --surface -o FILE.npz "
        f"made, or one of the shipped: {names}"
    )


def influence_problem(name: str) -> str:
    """Return an error message if there is no file of influence functions of this name; else "".

    Args:
        name: Name of such a file in the package, without its suffix, or a path.
    """
    try:
        find_influence(name)
    except ConfigError as error:
        return str(error)
    return ""
