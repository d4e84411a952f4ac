"""Reads input files of any format, and refuses devices, pipes and files above a maximum size."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from ..core.errors import ConfigError


def check_regular(path: Path) -> None:
    """Check that a path leads to a regular file, before it is opened.

    Reading a device such as /dev/zero would never end, and opening a named pipe blocks until
    another process opens it for writing.

    Raises:
        ConfigError: The path leads to a device, a pipe or a socket.
        OSError: The path does not exist, is a folder, or may not be accessed.
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
        purpose: What the file should be, such as "configuration file", for the error message.

    Raises:
        ConfigError: The path leads to no regular file, or the file is larger than the limit.
        OSError: The file does not exist or cannot be read.
    """
    check_regular(path)
    with path.open("rb") as file:
        # stat() states a size of 0 for files below /proc, so the size is checked by reading: one
        # byte more than the limit shows that the file is too large.
        data = file.read(limit + 1)
    if len(data) > limit:
        raise ConfigError(f"{path}: too large, the limit is {limit} bytes: this is no {purpose}")
    return data
