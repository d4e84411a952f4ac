# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Reads input files of any format, and refuses devices, pipes and files above a maximum size."""

from __future__ import annotations

import errno
import io
import os
import stat
import struct
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import ConfigError

if TYPE_CHECKING:
    from ..core.arrays import AnyArray

MAX_BYTES = 16 << 20
"""Maximum size of a text file that is read as a whole, in bytes.

The skin file of the largest skin, a grid of 65536 cubes, has 9 MB. The limit refuses bags and disk
images that were named by mistake.
"""

_ARCHIVE_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    RuntimeError,
    EOFError,
    ValueError,
    OverflowError,
    MemoryError,
)
"""Errors that zipfile and NumPy raise for a damaged file of arrays (.npz).

zipfile raises `RuntimeError` if damage makes a member look encrypted, or compressed by an unknown
method.
"""


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


def read_bounded(path: Path, purpose: str) -> bytes:
    """Return the bytes of a regular file of at most `MAX_BYTES`.

    Args:
        path: The file.
        purpose: What the file should be, such as "configuration file", for the error message.

    Raises:
        ConfigError: The path leads to no regular file, or the file is larger than the limit.
        OSError: The file does not exist or cannot be read.
    """
    check_regular(path)
    with path.open("rb") as file:
        # stat() states a size of 0 for files below /proc, so the size is checked by reading: one
        # byte more than the limit shows that the file is too large.
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise ConfigError(
            f"{path}: too large, the limit is {MAX_BYTES} bytes: this is no {purpose}"
        )
    return data


def read_arrays(path: Path, limit: int) -> dict[str, AnyArray]:
    """Return the arrays of a file (.npz, a zip archive of NumPy arrays) by their names.

    Args:
        path: The file.
        limit: Maximum size of the file and of its decompressed content, in bytes.

    Raises:
        ConfigError: The file is damaged, too large, or no file of arrays.
        OSError: The file does not exist or cannot be read.
    """
    # Programs that read other files start without numpy, which takes 0.1 s to import.
    import numpy as np

    check_regular(path)
    try:
        with zipfile.ZipFile(path) as archive:
            # A small archive may decompress to any size, so the sizes are checked first.
            size = sum(member.file_size for member in archive.infolist())
            largest = max(size, path.stat().st_size)
            if largest > limit:
                raise ValueError(f"the content has {largest} bytes, the limit is {limit}")
            # Each member is read as a whole before NumPy parses it, because zipfile compares its
            # checksum only at its end. `np.load` would parse damaged bytes.
            return {
                name.removesuffix(".npy"): np.lib.format.read_array(
                    io.BytesIO(archive.read(name)),
                    allow_pickle=False,
                )
                for name in archive.namelist()
            }
    except _ARCHIVE_ERRORS as error:
        raise ConfigError(f"{path}: damaged, or no file of arrays ({error})") from None
