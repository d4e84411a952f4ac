"""Files that appear complete or not at all: they are written under another name, then renamed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..core.errors import ConfigError


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Give a temporary file to write to, which replaces `path` when the block ends.

    If the block fails, the temporary file is removed and `path` stays as it was.

    Raises ConfigError if the file cannot be written, or if `path` is a folder or a device.
    """
    with _temporary(path) as temporary:
        yield temporary
        temporary.replace(path)


def check_writable(path: Path) -> None:
    """Raise ConfigError, before any work is done, if `atomic_write` could not write this file.

    It tries to write: permissions alone do not tell this to root, or below /proc.
    """
    with _temporary(path) as temporary:
        temporary.touch()


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """A name in the folder of `path`; no file of that name is left at the end."""
    temporary = path.parent / f"{path.name}.part"
    try:
        if path.exists() and not path.is_file():
            raise OSError(0, "is no file")
        yield temporary
    except OSError as error:
        what = error.strerror or str(error)
        raise ConfigError(f"{path}: {what}; name a file in a folder that can be written") from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
