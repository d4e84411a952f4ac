"""What is used of rosbags although it does not export it: its storage classes.

`mcap.py` and `write.py` derive from them, to read and write whole chunks instead of single
messages. A new version of rosbags may change them without saying so. Therefore pyproject.toml pins
rosbags to a range, nothing else is imported from its inner modules, and
`test/bags/test_bags_rosbags_storage.py` holds what is used of each class.
"""

from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import (
    DECOMPRESSORS,
    ChunkInfo,
    McapReader,
    McapWriter,
    PendingChunk,
    decompress,
    read_exact,
    zstd,
)
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader, Sqlite3Writer, apsw
from rosbags.typesys.store import Typestore

ZstdError = zstd.ZstdError
Sqlite3Error = apsw.Error

__all__ = [
    "DECOMPRESSORS",
    "ChunkInfo",
    "DirectoryReader",
    "McapReader",
    "McapWriter",
    "PendingChunk",
    "Sqlite3Error",
    "Sqlite3Reader",
    "Sqlite3Writer",
    "Typestore",
    "ZstdError",
    "decompress",
    "read_exact",
    "zstd",
]
