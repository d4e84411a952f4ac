"""Recordings that were cut off (killed, disk full, power lost) made readable again, where they
stand.

A chunk of an mcap file with its index is complete or it is not; what stands behind the last
complete one is cut off and the summary that readers look for is written anew. An sqlite3 file
undoes by itself what was not committed.
"""

from __future__ import annotations

import shutil
import sqlite3
import struct
from collections import defaultdict
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from rosbags.rosbag2.storage_mcap import (
    Channel,
    McapWriter,
    PendingChunk,
    Schema,
    decompress,
    read_bytes,
    read_string,
)

from ..config.yaml import to_yaml
from ..core.errors import BagError
from .mcap import CHUNK, INDEX, in_summary
from .read import DAMAGE, damage
from .write import METADATA_VERSION, SUFFIXES, describe, describe_file, move_up, write_metadata

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, DATA_END = 1, 2, 3, 4, 15
REST = ".rest"


class Repaired(NamedTuple):
    """What a repair did: messages that can be read, bytes that were cut off, chunks left out as
    damaged."""

    messages: int
    cut: int
    damaged: int


def repair(folder: Path, keep_rest: bool = True) -> Repaired:
    """Make a bag's folder readable. keep_rest: put what is cut off into a file beside it, ending in
    .rest.

    BagError: no folder of a bag, no complete message in it, or it cannot be written.
    """
    if not folder.is_dir():
        raise BagError(f"{folder}: no folder; name the folder of a bag")
    cut = damaged = 0
    with damage(folder):
        # While it is written a file stands in a folder of its own name, whatever the bag's folder
        # is called by now.
        written = [path for suffix in SUFFIXES.values() for path in folder.glob(f"*/*{suffix}")]
        for part in {path.parent for path in written if path.parent.name == path.stem}:
            move_up(part)
        for path in folder.glob("*.mcap"):
            one_cut, one_damaged = _seal(path, keep_rest)
            cut, damaged = cut + one_cut, damaged + one_damaged
        for path in folder.glob("*.db3"):
            with sqlite3.connect(path) as connection:
                connection.execute("SELECT count(*) FROM messages")
            connection.close()
    if not any(path.suffix in SUFFIXES.values() for path in folder.iterdir()):
        raise BagError(
            f"{folder}: no .mcap or .db3 file with a complete message in it; nothing can be read"
        )
    return Repaired(write_metadata(folder), cut, damaged)


def _seal(path: Path, keep_rest: bool) -> tuple[int, int]:
    """Cut an mcap file behind its last complete chunk and write its summary; bytes cut off, chunks
    left out."""
    size = path.stat().st_size
    with path.open("r+b") as bio:
        bio.seek(max(-len(MAGIC), -size), 2)
        complete = bio.read() == MAGIC and size > 2 * len(MAGIC)
        scan = _Scan(bio)
        if complete and not scan.damaged:
            return 0, 0
        if keep_rest and not complete and size > scan.end:
            bio.seek(scan.end)
            with path.with_name(path.name + REST).open("wb") as rest:
                shutil.copyfileobj(bio, rest)
        if scan.storage.chunks:
            bio.seek(scan.end)
            bio.truncate()
            # Its topics rosbag2 takes from the summary; without the other keys it reads nothing.
            storage = scan.storage
            count = sum(storage.channel_stats.values())
            file = describe_file(
                path.name, storage.message_start_time, storage.message_end_time, count
            )
            storage.close(METADATA_VERSION, to_yaml(describe("mcap", [file], [])))
    if not scan.storage.chunks:
        path.unlink()
    return 0 if complete else size - scan.end, scan.damaged


class _Scan:
    """All complete chunks of an mcap file.

    storage: a writer that knows them, ready to be closed; end: where the last of them ends;
    damaged: left out.
    """

    def __init__(self, bio: BinaryIO) -> None:
        # Not by its constructor, which begins a new file: only its state is wanted, to write the
        # summary from.
        storage = self.storage = McapWriter.__new__(McapWriter)
        storage.schemas, storage.channels, storage.chunks, storage.channel_stats = [], [], [], {}
        storage.message_start_time, storage.message_end_time = 2**63 - 1, 0
        storage.chunk = PendingChunk(0, 0, BytesIO(), defaultdict(list))
        storage.bio = bio  # type: ignore[assignment]
        self.end = self.damaged = 0
        bio.seek(0)
        if bio.read(len(MAGIC)) != MAGIC:
            raise BagError(
                f"{getattr(bio, 'name', '')}: does not begin as an mcap file does; nothing can be read"
            )
        chunk: _Chunk | None = None
        while (record := _record(bio)) is not None:
            kind, start, content = record
            if kind == HEADER:
                self.end = bio.tell()
            elif kind in (SCHEMA, CHANNEL):
                _learn(storage, kind, content)
            elif kind == CHUNK:
                try:
                    chunk = _Chunk(storage, start, content)
                except DAMAGE:
                    chunk = None
                    self.damaged += 1
            elif kind == INDEX and chunk is not None:
                channel, length = struct.unpack_from("<HI", content)
                chunk.indexes[channel] = start, length // 16
                if chunk.complete():
                    chunk.take(bio.tell())
                    chunk, self.end = None, bio.tell()
            elif kind in (DATA_END, FOOTER):
                break


class _Chunk:
    """A chunk while its indexes, which follow it, are read: of each channel where it stands and its
    messages."""

    def __init__(self, storage: McapWriter, start: int, content: bytes) -> None:
        self.storage, self.start, self.length = storage, start, 9 + len(content)
        self.first, self.last, self.size, crc = struct.unpack_from("<QQQI", content)
        bio = BytesIO(content[28:])
        self.compression = read_string(bio)
        (self.stored,) = struct.unpack("<Q", bio.read(8))
        inside = BytesIO(decompress(bio.read(self.stored), self.compression, self.size, crc))
        self.counts: dict[int, int] = {}
        self.indexes: dict[int, tuple[int, int]] = {}
        while (record := _record(inside)) is not None:
            kind, _, data = record
            if kind in (SCHEMA, CHANNEL):
                _learn(storage, kind, data)
            else:
                (channel,) = struct.unpack_from("<H", data)
                self.counts[channel] = self.counts.get(channel, 0) + 1

    def complete(self) -> bool:
        return {channel: count for channel, (_, count) in self.indexes.items()} == self.counts

    def take(self, end: int) -> None:
        """Into the summary; its last index ends at `end`."""
        storage = self.storage
        for channel, count in self.counts.items():
            storage.channel_stats[channel] = storage.channel_stats.get(channel, 0) + count
        storage.message_start_time = min(storage.message_start_time, self.first)
        storage.message_end_time = max(storage.message_end_time, self.last)
        places = {channel: at for channel, (at, _) in self.indexes.items()}
        storage.chunks.append(
            in_summary(
                self.first,
                self.last,
                self.start,
                self.start + self.length,
                end,
                places,
                self.compression,
                self.stored,
                self.size,
            )
        )


def _record(bio: BinaryIO) -> tuple[int, int, bytes] | None:
    """Kind, place and content of the next record; None where the file ends before the record
    does."""
    start = bio.tell()
    head = bio.read(9)
    if len(head) < 9:
        return None
    kind, length = struct.unpack("<BQ", head)
    left = bio.seek(0, 2) - start - 9
    bio.seek(start + 9)
    return (kind, start, bio.read(length)) if length <= left else None


def _learn(storage: McapWriter, kind: int, content: bytes) -> None:
    """Take a schema or a channel."""
    bio = BytesIO(content)
    (number,) = struct.unpack("<H", bio.read(2))
    if kind == SCHEMA:
        if all(schema.id != number for schema in storage.schemas):
            storage.schemas.append(
                Schema(number, read_string(bio), read_string(bio), read_string(bio))
            )
    elif all(channel.id != number for channel in storage.channels):
        (schema,) = struct.unpack("<H", bio.read(2))
        name = next(known.name for known in storage.schemas if known.id == schema)
        storage.channels.append(
            Channel(number, name, read_string(bio), read_string(bio), read_bytes(bio))
        )
