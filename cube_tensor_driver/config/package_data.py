# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The folder of the data files that are installed with the package: skins, calibrations, launch
files."""

from __future__ import annotations

import os
from pathlib import Path

from ..core.errors import ConfigError

_NAME = "cube_tensor_driver"
"""Name of the ROS package, and of its folder below share/."""


def find_package_data() -> Path:
    """Return the folder that holds config/ and launch/.

    In a checkout of the repository it is the top folder of the checkout, after an installation it
    is share/cube_tensor_driver below the prefix of the installation.

    Raises:
        ConfigError: Neither folder exists, which means that the installation is incomplete.
    """
    for parent in Path(__file__).parents:
        # The search also passes the folder cube_tensor_driver, whose subfolder config/ holds this
        # module and not the data. Only the folder of the data contains package.xml, too.
        for folder in (parent, parent / "share" / _NAME):
            if (folder / "package.xml").is_file() and (folder / "config").is_dir():
                return folder
    raise ConfigError(
        f"the data files of {_NAME} are not next to {Path(__file__).parent}: "
        "install the package again (colcon build, or pip install .)"
    )


def find_shipped(
    pattern: str,
    name: str,
    folder: Path,
    advice: str,
) -> Path:
    """Return the path of a file that the package contains, or that the user names.

    Args:
        pattern: Path of such files below config/ in the package, with * for the name.
        name: Name of a file in the package, or a path relative to `folder`. The package is searched
            first, because the folder can contain an unrelated file of that name: "cube", for
            example, is also the program ./cube of a checkout.
        folder: Folder to which a relative path refers.
        advice: Description of the files that can be named, for the error message.

    Raises:
        ConfigError: The package has no file of this name and the path leads to none. The message
            lists the names in the package.
    """
    shipped = find_package_data() / "config"
    for path in (shipped / pattern.replace("*", name), folder / name):
        # os.path.isfile, unlike Path.is_file, is false for a name that is too long.
        if os.path.isfile(path):  # noqa: PTH113
            return path
    names = ", ".join(sorted(path.stem for path in shipped.glob(pattern)))
    raise ConfigError(f"no file {name!r} in {folder}; name {advice}: {names}")
