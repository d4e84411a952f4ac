"""Files that are whole or not there at all: written beside their place, then moved onto it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..core.errors import ConfigError


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """What to write in place of `path`, whose place it takes at the end; after an error neither is
    left behind.

    ConfigError: cannot be written, or `path` is a folder or a device.
    """
    with _beside(path) as partial:
        yield partial
        partial.replace(path)


def check_writable(path: Path) -> None:
    """ConfigError, before any work: `whole` could not write this. Permissions say little to root or
    in /proc."""
    with _beside(path) as partial:
        partial.touch()


def check_outputs(paths: dict[str, Path | None]) -> None:
    """ConfigError, before any work: a file that cannot be written, or one for two outputs."""
    given = {option: path for option, path in paths.items() if path is not None}
    for option, path in given.items():
        for other in given:
            if other != option and given[other].resolve() == path.resolve():
                raise ConfigError(f"{option} and {other} both name {path}; name two files")
        try:
            check_writable(path)
        except ConfigError as error:
            raise ConfigError(f"{option} {error}") from None


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """A name beside `path`, where nothing is left in the end; its errors as ConfigError."""
    partial = path.parent / f"{path.name}.part"
    try:
        if path.exists() and not path.is_file():
            raise OSError(0, "is no file")
        yield partial
    except OSError as error:
        what = error.strerror or str(error)
        raise ConfigError(f"{path}: {what}; name a file in a folder that can be written") from None
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
