"""Output files of commands: checks before any work is done, and JSON files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..core.errors import ConfigError
from .atomic_write import atomic_write, check_writable

YAML = (".yaml", ".yml")


def check_outputs(paths: dict[str, Path | None]) -> None:
    """Check the output files of a command, by the option that names each, before any work is done.

    Raises ConfigError if a file cannot be written, or if two options name the same file.
    """
    given = {option: path for option, path in paths.items() if path is not None}
    for option, path in given.items():
        for other in given:
            if other != option and given[other].resolve() == path.resolve():
                raise ConfigError(f"{option} and {other} both name {path}; name two files")
        try:
            check_writable(path)
        except ConfigError as error:
            raise ConfigError(f"{option} {error}") from None


def check_folder(option: str, path: Path | None) -> None:
    """Raise ConfigError if the folder cannot be made, or no file in it. Nothing is made yet."""
    if path is None:
        return
    there = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
    problem = "is no folder"
    if there.is_dir():
        problem = "no file can be made in it" if there == path else f"{there} cannot be written"
        try:
            check_writable(there / "a file")
            return
        except ConfigError:
            pass
    raise ConfigError(f"{option} {path}: {problem}; name a folder that can be made and written")


def check_yaml(option: str, path: Path | None) -> None:
    """Raise ConfigError if a file that is to hold YAML has another suffix."""
    if path is not None and path.suffix not in YAML:
        raise ConfigError(f"{option} {path}: a YAML file ends in {' or '.join(YAML)}; name one")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file. Raises ConfigError if it cannot be written."""
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")
