"""Input files of any kind, read only if they are regular files and up to a maximum size."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from ..core.errors import ConfigError


def check_regular(path: Path) -> None:
    """Raise ConfigError if the path leads to a device, a pipe or a socket.

    A device such as /dev/zero has no end, and opening a pipe waits for a writer.

    Raises:
        OSError: Nothing is there, it is a folder, or it cannot be looked at.
    """
    mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(mode):
        raise ConfigError(f"{path}: a device, a pipe or a socket; name a regular file")


def read_bounded(path: Path, limit: int, purpose: str) -> bytes:
    """Return the bytes of a regular file.

    Args:
        path: The file.
        limit: Maximum size, in bytes.
        purpose: What the file should be, for the error message.

    Raises:
        ConfigError: The path leads to no regular file, or the file is larger than the limit.
        OSError: Nothing is there, or it cannot be read.
    """
    check_regular(path)
    with path.open("rb") as file:
        # The size that the system states is 0 for files of /proc, so one byte more is asked for.
        data = file.read(limit + 1)
    if len(data) > limit:
        raise ConfigError(f"{path}: too large, the limit is {limit} bytes: this is no {purpose}")
    return data
