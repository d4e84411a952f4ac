# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The folder of the data files that are installed with the package: skins, calibrations, launch
files."""

from __future__ import annotations

from pathlib import Path

from ..core.errors import ConfigError

_NAME = "cube_tensor_driver"
"""Name of the ROS package, and of its folder below share/."""


def package_data() -> Path:
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
