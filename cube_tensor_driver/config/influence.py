"""Names of influence functions in parameters and options: shipped ones, or files."""

from __future__ import annotations

from pathlib import Path

from ..core.errors import ConfigError
from .package_data import package_data


def find_influence(name: str) -> Path:
    """The file of influence functions that `name` means: a shipped one, or a path.

    Raises ConfigError if there is neither, and lists the shipped ones.
    """
    shipped = package_data() / "config" / "influence"
    for path in (shipped / f"{name}.npz", Path(name)):
        if path.is_file():
            return path
    names = ", ".join(sorted(path.stem for path in shipped.glob("*.npz")))
    raise ConfigError(
        f"no influence functions {name!r}; name a file that ./cube fem --surface --3d made, or one "
        f"of the shipped: {names}"
    )


def influence_problem(name: str) -> str:
    """Why `find_influence` finds nothing, in words; empty if it does."""
    try:
        find_influence(name)
    except ConfigError as error:
        return str(error)
    return ""
