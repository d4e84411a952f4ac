"""Input files of any kind, read with a bound on memory and time."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from ..core.errors import ConfigError


def check_regular(path: Path) -> None:
    """Raise ConfigError if the path leads to something else than a file of a disk.

    A device has no end, and opening a pipe waits for a writer. OSError: nothing is
    there, or it cannot be looked at.
    """
    _check_mode(path, path.stat().st_mode)


def read_bounded(path: Path, limit: int, purpose: str) -> bytes:
    """The bytes of a regular file, never more than `limit` of them, and without waiting.

    purpose: what the file should be, for the message. ConfigError: no regular file, or larger.
    OSError: nothing is there, or it cannot be read.
    """
    # Looked at before it is opened, because opening alone moves some devices, and afterwards too,
    # because another file may have taken its place.
    check_regular(path)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        _check_mode(path, status.st_mode)
        # The size is not enough: files of /proc say 0.
        data = b"" if status.st_size > limit else file.read(limit + 1)
    size = max(len(data), status.st_size)
    if size > limit:
        raise ConfigError(f"{path}: {size} bytes, the limit is {limit}: this is no {purpose}")
    return data


def _check_mode(path: Path, mode: int) -> None:
    if stat.S_ISREG(mode):
        return
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    names = {
        stat.S_IFIFO: "a pipe",
        stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
    }
    found = names.get(stat.S_IFMT(mode), "no file")
    raise ConfigError(f"{path}: {found}, needed is a regular file; name one that can be read")
