"""Compressed parts of bags, unpacked within bounds: a few bytes may unpack to any number of them.

What is out of bounds raises rosbags' ReaderError, as damage does.
"""

from __future__ import annotations

from pathlib import Path

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags.rosbag2 import ReaderError

from .rosbags_storage import DECOMPRESSORS, zstd

MAX_UNPACKED = 64 << 20
"""Bytes of one chunk or message. ros2 bag closes a chunk after 0.8 MB, or the message behind."""
MAX_RATIO = 200
"""How many times its size a whole file may unpack to, above MAX_UNPACKED. Frequencies of a skin at
rest become a tenth."""
STEP = 1 << 20


def check_size(what: str, size: int, limit: int = MAX_UNPACKED) -> None:
    """ReaderError: larger than the limit."""
    if size > limit:
        raise ReaderError(f"{what} of {size} bytes, the limit is {limit}")


def total_limit(file_size: int) -> int:
    """Bytes that the compressed parts of a file may unpack to together."""
    return MAX_UNPACKED + MAX_RATIO * file_size


def unpack_zstd(data: bytes, size: int | None = None) -> bytes:
    """The bytes of one zstd frame. size: how many it should have; None: not known."""
    limit = MAX_UNPACKED if size is None else size
    check_size("a compressed part", limit)
    decompressor = zstd.ZstdDecompressor()
    raw = decompressor.decompress(data, max_length=limit + 1)
    return _complete(raw, limit, decompressor.eof, decompressor.unused_data)


def unpack_lz4(data: bytes, size: int) -> bytes:
    """The bytes of one lz4 frame. size: how many it should have."""
    check_size("a compressed part", size)
    decompressor = LZ4FrameDecompressor()
    raw = decompressor.decompress(data, max_length=size + 1)
    return _complete(raw, size, decompressor.eof, decompressor.unused_data)


def check_zstd_file(path: Path) -> None:
    """ReaderError: the file unpacks to more than its size allows."""
    limit, total = total_limit(path.stat().st_size), 0
    with path.open("rb") as file, zstd.open(file, "rb") as unpacked:
        while part := unpacked.read(STEP):
            total += len(part)
            check_size(f"{path.name}: unpacked to a file", total, limit)


def _complete(raw: bytes, limit: int, is_complete: bool, rest: bytes | None) -> bytes:
    if len(raw) > limit:
        raise ReaderError(f"a compressed part unpacks to more than its limit of {limit} bytes")
    if not is_complete:
        raise ReaderError("a compressed part is cut off")
    if rest:
        raise ReaderError(f"{len(rest)} bytes follow a compressed part")
    return raw


# rosbags looks here too, wherever it unpacks chunks itself.
DECOMPRESSORS.update({"zstd": unpack_zstd, "lz4": unpack_lz4})
