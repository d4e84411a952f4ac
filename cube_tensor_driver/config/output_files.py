"""Output files: written completely or not at all, and checked before any work is done."""

from __future__ import annotations

import atexit
import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..core.errors import ConfigError

YAML_SUFFIXES = (".yaml", ".yml")


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Give a temporary file to write to, which replaces `path` when the block ends.

    If the block fails, the temporary file is removed and `path` stays as it was.

    Raises:
        ConfigError: The file cannot be written, or `path` is a folder or a device.
    """
    with _temporary_file(path) as temporary:
        yield temporary
        temporary.replace(path)


def check_writable(path: Path) -> None:
    """Raise ConfigError if `atomic_write` could not write this file.

    It tries to write, because permissions alone do not tell this to root or below /proc.
    """
    with _temporary_file(path) as temporary:
        temporary.touch()


def check_outputs(paths: dict[str, Path | None]) -> None:
    """Check the output files of a command before it does any work.

    Args:
        paths: Option of the command -> the file that it names, or None.

    Raises:
        ConfigError: A file cannot be written, or two options name the same file.
    """
    given = {option: path for option, path in paths.items() if path is not None}
    for option, path in given.items():
        # The file that is written last would replace the other one.
        for other, other_path in given.items():
            if other != option and other_path.resolve() == path.resolve():
                raise ConfigError(f"{option} and {other} both name {path}; name two files")
        try:
            check_writable(path)
        except ConfigError as error:
            raise ConfigError(f"{option} {error}") from None


def check_folder(option: str, path: Path | None) -> None:
    """Raise ConfigError if the folder cannot be made, or no file in it. Nothing is made yet."""
    if path is None:
        return
    # The folder itself may still have to be made.
    existing = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
    problem = "is no folder"
    if existing.is_dir():
        problem = f"{existing} cannot be written"
        if existing == path:
            problem = "no file can be made in it"
        with suppress(ConfigError):
            check_writable(existing / "a file")
            return
    raise ConfigError(f"{option} {path}: {problem}; name a folder that can be made and written")


def check_yaml(option: str, path: Path | None) -> None:
    """Raise ConfigError if a file that is to hold YAML has another suffix."""
    if path is not None and path.suffix not in YAML_SUFFIXES:
        suffixes = " or ".join(YAML_SUFFIXES)
        raise ConfigError(f"{option} {path}: a YAML file ends in {suffixes}; name one")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file. Raises ConfigError if it cannot be written."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")


def temporary_folder(prefix: str) -> Path:
    """Make a folder that is removed, with all that is in it, when this process ends."""
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    # Nodes of a launch use the folder as long as the launch lives.
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@contextmanager
def _temporary_file(path: Path) -> Iterator[Path]:
    """Name a file in the folder of `path`, which does not exist any more when the block ends."""
    # In the same folder, because a file is renamed atomically only within a file system.
    temporary = path.parent / f"{path.name}.part"
    try:
        if path.exists() and not path.is_file():
            raise OSError(0, "is no file")
        yield temporary
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigError(
            f"{path}: {reason}; name a file in a folder that can be written"
        ) from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
