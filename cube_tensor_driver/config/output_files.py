# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Output files: written completely or not at all, and checked before a command starts its work."""

from __future__ import annotations

import atexit
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from ..core.errors import ConfigError

YAML_SUFFIXES = (".yaml", ".yml")
"""Suffixes of the names of YAML files."""


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file, which replaces `path` when the `with` block ends.

    If the block raises an error, the temporary file is removed and `path` stays as it was. Several
    processes may write the same file: each has its own temporary file, and the last one remains.

    Raises:
        ConfigError: The file cannot be written, or `path` is a folder or a device.
    """
    with _make_temporary_file(path) as temporary:
        yield temporary
        # Without this call, a loss of power after the renaming can leave an empty file, because a
        # file system may store the new name before the content.
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)


def check_writable(path: Path) -> None:
    """Raise ConfigError if `write_atomically` could not write this file.

    A temporary file is made in the same folder and removed. Checking permissions is not sufficient:
    the user root passes every such check, even for /proc and for read-only file systems.
    """
    with _make_temporary_file(path):
        pass


def check_outputs(paths: dict[str, Path]) -> None:
    """Check that all output files of a command can be written, before it starts its work.

    Args:
        paths: Option of the command -> the file that the option names.

    Raises:
        ConfigError: A file cannot be written, or two options name the same file.
    """
    for option, path in paths.items():
        # If two options named one file, the output written last would replace the other.
        for other, other_path in paths.items():
            if other != option and other_path.resolve() == path.resolve():
                raise ConfigError(f"{option} and {other} both name {path}; name two files")
        try:
            check_writable(path)
        except ConfigError as error:
            raise ConfigError(f"{option} {error}") from None


def check_folder(option: str, path: Path) -> None:
    """Check that a folder can be made and files be made in it, without making the folder.

    Args:
        option: Option of the command that names the folder, for the error message.
        path: The folder, which need not exist.

    Raises:
        ConfigError: The folder cannot be made, or no file can be made in it.
    """
    # The test file is made in the closest parent that exists.
    candidates = (path, *path.absolute().parents)
    existing = next(folder for folder in candidates if folder.exists())
    problem = "is no folder"
    if existing.is_dir():
        problem = f"{existing} cannot be written"
        if existing == path:
            problem = "no file can be made in it"
        with suppress(ConfigError):
            check_writable(existing / "a file")
            return
    raise ConfigError(f"{option} {path}: {problem}; name a folder that can be made and written")


def check_yaml(option: str, path: Path) -> None:
    """Check that an output file that is written as YAML has a suffix of YAML files.

    Args:
        option: Option of the command that names the file, for the error message.
        path: The file.

    Raises:
        ConfigError: The file has another suffix.
    """
    if path.suffix not in YAML_SUFFIXES:
        suffixes = " or ".join(YAML_SUFFIXES)
        raise ConfigError(f"{option} {path}: a YAML file ends in {suffixes}; name one")


def to_json(value: object, indent: int | None = None) -> str:
    """Return plain values as JSON text. NaN and infinity, which JSON lacks, become null.

    Args:
        value: Numbers, texts, arrays of numpy, lists and mappings.
        indent: Number of spaces per level of nesting; None: the text is one line.
    """
    return json.dumps(_replace_nan(value), indent=indent, allow_nan=False)


def _replace_nan(value: object) -> object:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: _replace_nan(one) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_replace_nan(one) for one in value]
    return value


def write_json(path: Path, value: object) -> None:
    """Write plain values as a JSON file, completely or not at all.

    Raises:
        ConfigError: The file cannot be written.
    """
    with write_atomically(path) as temporary:
        temporary.write_text(to_json(value, indent=2) + "\n", encoding="utf-8")


def make_temporary_folder(prefix: str) -> Path:
    """Make a temporary folder that is removed, with its content, when this process exits.

    Args:
        prefix: Text with which the name of the folder begins.
    """
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    # The folder is kept until this process exits, because the nodes that it starts read its files.
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@contextmanager
def _make_temporary_file(path: Path) -> Iterator[Path]:
    """Yield the path of a new file in the folder of `path`; it is removed when the block ends.

    Raises:
        ConfigError: An OSError was raised in the block, or `path` is a folder or a device.
    """
    # A rename is atomic only within one file system, so the file lies in the same folder. Its name
    # is random, because several processes may write `path` at the same time.
    temporary = path.parent / f".{uuid4().hex}.part"
    try:
        if path.exists() and not path.is_file():
            raise OSError(0, "is no file")
        # The call fails if the name exists, so no link that somebody has put there is followed.
        temporary.touch(exist_ok=False)
        yield temporary
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigError(
            f"{path}: {reason}; name a file in a folder that can be written"
        ) from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
