"""Names of influence functions in parameters and options: shipped ones, or files."""

from __future__ import annotations

from pathlib import Path

from ..core.errors import ConfigError
from .package_data import package_data


def find_influence(name: str) -> Path:
    """Return the path of the influence functions that a name means.

    Args:
        name: Name of a shipped file, or else a path.

    Raises:
        ConfigError: There is neither. The message lists the shipped names.
    """
    # A shipped name comes first, as for calibrations.
    shipped = package_data() / "config" / "influence"
    for path in (shipped / f"{name}.npz", Path(name)):
        if path.is_file():
            return path
    names = ", ".join(sorted(path.stem for path in shipped.glob("*.npz")))
    raise ConfigError(
        f"no influence functions {name!r}; name a file that ./cube fem MODEL --surface -o FILE.npz "
        f"made, or one of the shipped: {names}"
    )


def influence_problem(name: str) -> str:
    """Return why `find_influence` finds nothing for a name, or an empty text if it does."""
    try:
        find_influence(name)
    except ConfigError as error:
        return str(error)
    return ""
