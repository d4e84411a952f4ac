"""Where the package's own data files are, in a checkout as in an install space."""

from __future__ import annotations

from pathlib import Path

from ..core.errors import ConfigError

_NAME = "cube_tensor_driver"


def package_data() -> Path:
    """The folder with config/ and launch/: the checkout, or share/cube_tensor_driver of the install
    space.

    ConfigError: neither is there, the installation is broken.
    """
    for parent in Path(__file__).parents:
        for folder in (parent, parent / "share" / _NAME):
            if (folder / "package.xml").is_file() and (folder / "config").is_dir():
                return folder
    raise ConfigError(
        f"the data files of {_NAME} are not beside {Path(__file__).parent}: install the package again (colcon build)"
    )
