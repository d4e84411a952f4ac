"""The folder of the files that the package brings along: skins, calibrations, launch files."""

from __future__ import annotations

from pathlib import Path

from ..core.errors import ConfigError

_NAME = "cube_tensor_driver"


def package_data() -> Path:
    """Return the folder that holds config/ and launch/.

    In a checkout it is the checkout itself, after an installation share/cube_tensor_driver.

    Raises:
        ConfigError: There is neither, which means that the installation is broken.
    """
    for parent in Path(__file__).parents:
        # config/ alone does not tell: this module lies in a folder of that name.
        for folder in (parent, parent / "share" / _NAME):
            if (folder / "package.xml").is_file() and (folder / "config").is_dir():
                return folder
    raise ConfigError(
        f"the data files of {_NAME} are not next to {Path(__file__).parent}: "
        "install the package again (colcon build, or pip install .)"
    )
