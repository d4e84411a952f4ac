"""Recordings that were cut off (killed, disk full, power lost) made readable again, where they
are.

An mcap file is a sequence of records. A chunk record with its index records is complete or it is
not. What follows the last complete one is cut off, and the summary that readers look for is written
again. An sqlite3 file undoes by itself what was not committed.

The records themselves are read and written by the library `mcap`. Its StreamReader is not used: it
trusts the lengths inside a record, so behind the first damaged one it finds nothing any more. Here
the next record begins where the length in front of the record says.
"""

from __future__ import annotations

import shutil
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from ..config.yaml import to_yaml
from ..core.errors import BagError
from .read import DAMAGE, Bag, damage
from .rosbags_storage import decompress
from .unpack import check_size
from .write import SUFFIXES, describe, describe_file, move_up, write_metadata

MAGIC = b"\x89MCAP0\r\n"
REST = ".rest"
SALVAGE_ERRORS = (*DAMAGE, McapError)
"""What the libraries raise where bytes are not what they should be."""
_HEAD = struct.Struct("<BQ")
"""Of a record: its opcode, and the length of what follows."""


class Repaired(NamedTuple):
    """What a repair did: messages that can be read, bytes that were cut off, chunks left out as
    damaged."""

    messages: int
    cut: int
    damaged: int


def repair(path: Path, keep_rest: bool = True) -> Repaired:
    """Make a bag readable: a folder, or one file of it.

    keep_rest: put what is cut off into a file beside it, ending in .rest.

    BagError: no bag, no complete message in it, or it cannot be written.
    """
    if path.is_dir():
        return _repair_folder(path, keep_rest)
    if not path.is_file() or path.suffix not in SUFFIXES.values():
        raise BagError(
            f"{path}: no bag; name the folder of a bag, or a file that ends in "
            f"{' or '.join(SUFFIXES.values())}"
        )
    if (path.parent / "metadata.yaml").exists():
        # It says of each file what the file holds.
        return _repair_folder(path.parent, keep_rest)
    with damage(path):
        cut, damaged = _repair_file(path, keep_rest)
        if not path.exists():
            raise BagError(f"{path}: no complete message in it; nothing can be read")
        with Bag(path) as bag:
            return Repaired(sum(one.msgcount for one in bag.connections), cut, damaged)


def _repair_folder(folder: Path, keep_rest: bool) -> Repaired:
    cut = damaged = 0
    with damage(folder):
        # While it is written a file stands in a folder of its own name, whatever the bag's folder
        # is called by now.
        written = [path for suffix in SUFFIXES.values() for path in folder.glob(f"*/*{suffix}")]
        for part in {path.parent for path in written if path.parent.name == path.stem}:
            move_up(part)
        for path in [path for suffix in SUFFIXES.values() for path in folder.glob(f"*{suffix}")]:
            one_cut, one_damaged = _repair_file(path, keep_rest)
            cut, damaged = cut + one_cut, damaged + one_damaged
    if not any(path.suffix in SUFFIXES.values() for path in folder.iterdir()):
        raise BagError(
            f"{folder}: no .mcap or .db3 file with a complete message in it; nothing can be read"
        )
    return Repaired(write_metadata(folder), cut, damaged)


def _repair_file(path: Path, keep_rest: bool) -> tuple[int, int]:
    """Make one storage file readable; returns bytes cut off and chunks left out."""
    if path.suffix == SUFFIXES["mcap"]:
        return _seal(path, keep_rest)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("SELECT count(*) FROM messages")
    return 0, 0


def _seal(path: Path, keep_rest: bool) -> tuple[int, int]:
    """Cut an mcap file behind its last complete chunk and write its summary; returns bytes cut off
    and chunks left out."""
    size = path.stat().st_size
    with path.open("r+b") as bio:
        bio.seek(max(-len(MAGIC), -size), 2)
        complete = bio.read() == MAGIC and size > 2 * len(MAGIC)
        salvaged = _Salvaged(bio)
        if complete and not salvaged.damaged:
            return 0, 0
        if keep_rest and not complete and size > salvaged.end:
            bio.seek(salvaged.end)
            with path.with_name(path.name + REST).open("wb") as rest:
                shutil.copyfileobj(bio, rest)
        if salvaged.chunks:
            bio.seek(salvaged.end)
            bio.truncate()
            salvaged.write_summary(bio, path.name)
    if not salvaged.chunks:
        path.unlink()
    return 0 if complete else size - salvaged.end, salvaged.damaged


class _Salvaged:
    """All complete chunks of an mcap file.

    schemas, channels: by id; chunks: as the summary has them; counts: messages of each channel
    end: where the last complete chunk ends; damaged: how many were left out
    """

    def __init__(self, bio: BinaryIO) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[ChunkIndex] = []
        self.counts: Counter[int] = Counter()
        self.end = self.damaged = 0
        bio.seek(0)
        if bio.read(len(MAGIC)) != MAGIC:
            name = getattr(bio, "name", "")
            raise BagError(f"{name}: does not begin as an mcap file does; nothing can be read")
        self._open: tuple[ChunkIndex, Counter[int]] | None = None
        for opcode, start, content in _records(bio):
            if opcode == Opcode.HEADER:
                self.end = bio.tell()
            elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
                break
            try:
                self._take(opcode, start, content)
            except SALVAGE_ERRORS:
                self._open = None
                self.damaged += 1

    def _take(self, opcode: int, start: int, content: bytes) -> None:
        """A record of the file. SALVAGE_ERRORS: it is damaged."""
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._learn(opcode, content)
        elif opcode == Opcode.CHUNK:
            self._open = self._read_chunk(start, content)
        elif opcode == Opcode.MESSAGE_INDEX and self._open is not None:
            chunk, counts = self._open
            index: MessageIndex = _parse(MessageIndex.read, content)
            if len(index.records) != counts[index.channel_id]:
                raise ValueError("an index has another number of messages than its chunk")
            chunk.message_index_offsets[index.channel_id] = start
            if chunk.message_index_offsets.keys() == counts.keys():
                self.end = start + _HEAD.size + len(content)
                begin = chunk.chunk_start_offset + chunk.chunk_length
                chunk.message_index_length = self.end - begin
                self.chunks.append(chunk)
                self.counts += counts
                self._open = None

    def _read_chunk(self, start: int, content: bytes) -> tuple[ChunkIndex, Counter[int]]:
        """A chunk without its indexes, and its messages per channel. SALVAGE_ERRORS: its checksum
        is wrong, or what is in it is not records."""
        chunk: Chunk = _parse(Chunk.read, content)
        check_size("a chunk", max(chunk.uncompressed_size, len(content)))
        inside = decompress(
            chunk.data, chunk.compression, chunk.uncompressed_size, chunk.uncompressed_crc
        )
        counts: Counter[int] = Counter()
        for opcode, _, data in _records(BytesIO(inside)):
            if opcode == Opcode.MESSAGE:
                counts[int.from_bytes(data[:2], "little")] += 1
            else:
                self._learn(opcode, data)
        index = ChunkIndex(
            chunk_length=_HEAD.size + len(content),
            chunk_start_offset=start,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=chunk.message_start_time,
            uncompressed_size=chunk.uncompressed_size,
        )
        return index, counts

    def _learn(self, opcode: int, content: bytes) -> None:
        """A schema or a channel; the first of each id counts."""
        if opcode == Opcode.SCHEMA:
            schema: Schema = _parse(Schema.read, content)
            self.schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel: Channel = _parse(Channel.read, content)
            self.channels.setdefault(channel.id, channel)

    def write_summary(self, bio: BinaryIO, name: str) -> None:
        """Everything that follows the data of a complete file."""
        begin_ns = min(chunk.message_start_time for chunk in self.chunks)
        end_ns = max(chunk.message_end_time for chunk in self.chunks)
        messages = self.counts.total()
        # rosbag2 takes its topics from the summary; without the other keys it reads nothing.
        said = describe("mcap", [describe_file(name, begin_ns, end_ns, messages)], [])
        metadata = _bytes_of(Metadata("rosbag2", {"serialized_metadata": to_yaml(said)}))
        metadata_index = MetadataIndex(bio.tell(), len(metadata), "rosbag2")
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self.channels),
            channel_message_counts=dict(sorted(self.counts.items())),
            chunk_count=len(self.chunks),
            message_count=messages,
            message_end_time=end_ns,
            message_start_time=begin_ns,
            metadata_count=1,
            schema_count=len(self.schemas),
        )
        bio.write(metadata)
        bio.write(_bytes_of(DataEnd(0)))
        summary_start = bio.tell()
        offsets = []
        groups: list[tuple[Opcode, list[Any]]] = [
            (Opcode.SCHEMA, list(self.schemas.values())),
            (Opcode.CHANNEL, list(self.channels.values())),
            (Opcode.CHUNK_INDEX, self.chunks),
            (Opcode.METADATA_INDEX, [metadata_index]),
            (Opcode.STATISTICS, [statistics]),
        ]
        for opcode, records in groups:
            group = b"".join(map(_bytes_of, records))
            offsets.append(SummaryOffset(opcode, bio.tell(), len(group)))
            bio.write(group)
        offsets_start = bio.tell()
        bio.write(b"".join(map(_bytes_of, offsets)))
        bio.write(_bytes_of(Footer(summary_start, offsets_start, 0)))
        bio.write(MAGIC)


def _records(bio: BinaryIO) -> Iterator[tuple[int, int, bytes]]:
    """Opcode, place and content of each record, until the file ends before a record does."""
    start = bio.tell()
    size = bio.seek(0, 2)
    bio.seek(start)
    while size - start >= _HEAD.size:
        opcode, length = _HEAD.unpack(bio.read(_HEAD.size))
        if length > size - start - _HEAD.size:
            return
        yield opcode, start, bio.read(length)
        start += _HEAD.size + length


def _parse(read: Callable[[ReadDataStream], Any], content: bytes) -> Any:
    return read(ReadDataStream(BytesIO(content)))


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
