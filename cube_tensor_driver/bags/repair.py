"""Recordings that were cut off (killed, disk full, power lost) made readable again, where they are.

An MCAP file is a sequence of records. A chunk with the index records behind it is complete or it is
not. What follows the last complete one is cut off, and the summary that readers look for is written
again. An SQLite file undoes by itself what was not committed.

The library's StreamReader is not used to find the records: it trusts the lengths inside a record,
so behind the first damaged record it finds nothing any more. Here the next record begins where the
length in front of the record says.
"""

from __future__ import annotations

import shutil
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

from mcap.data_stream import ReadDataStream, RecordBuilder
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
from mcap.summary import Summary

from ..core.errors import BagError
from .mcap_file import (
    CHECKSUM_BYTES,
    MAGIC,
    RECORD_HEAD,
    ROSBAG2,
    McapReader,
    chunk_records,
    rosbag2_metadata,
    summarise,
    unpack_chunk,
)
from .metadata import FILE_NAME, SUFFIXES, FileSummary, write_metadata
from .read import READ_ERRORS, open_storage, report_damage

REST = ".rest"
"""Suffix of the file that keeps what was cut off."""


class Repaired(NamedTuple):
    """What a repair did.

    Attributes:
        messages: Number of messages that can be read.
        cut: Number of bytes that were cut off.
        damaged: Number of chunks that were left out as damaged.
    """

    messages: int
    cut: int
    damaged: int


def repair(path: Path, keep_rest: bool = True) -> Repaired:
    """Make a bag readable.

    Args:
        path: Folder of the bag, or one of its files.
        keep_rest: Whether to keep what is cut off in a file beside it, ending in `REST`.

    Raises:
        BagError: There is no bag, it has no complete message, or it cannot be written.
    """
    if path.is_dir():
        return _repair_folder(path, keep_rest)
    if not path.is_file() or path.suffix not in SUFFIXES.values():
        raise BagError(
            f"{path}: no bag; name the folder of a bag, or a file that ends in "
            f"{' or '.join(SUFFIXES.values())}"
        )
    if (path.parent / FILE_NAME).exists():
        # metadata.yaml describes each file, so it has to be written again, too.
        return _repair_folder(path.parent, keep_rest)
    cut, damaged = _repair_file(path, keep_rest)
    if not path.exists():
        raise BagError(f"{path}: no complete message in it; nothing can be read")
    return Repaired(_summary(path).msgcount, cut, damaged)


def _repair_folder(folder: Path, keep_rest: bool) -> Repaired:
    """Repair all files of a bag and describe them in metadata.yaml."""
    # Also the files that metadata.yaml names: a disk may have lost their end later.
    cut = damaged = 0
    for path in _storage_files(folder):
        one_cut, one_damaged = _repair_file(path, keep_rest)
        cut, damaged = cut + one_cut, damaged + one_damaged
    paths = _storage_files(folder)  # without those in which nothing was complete
    existing = {path.suffix for path in paths}
    storages = [name for name, suffix in SUFFIXES.items() if suffix in existing]
    if not storages:
        raise BagError(
            f"{folder}: no .mcap or .db3 file with a complete message in it; nothing can be read"
        )
    if len(storages) > 1:
        raise BagError(f"{folder}: .mcap beside .db3 files; move one kind to another folder")
    summaries = [_summary(path) for path in paths]
    write_metadata(folder, storages[0], summaries)
    return Repaired(sum(summary.msgcount for summary in summaries), cut, damaged)


def _storage_files(folder: Path) -> list[Path]:
    """Return the storage files of a folder in the order in which they were written."""

    def number(path: Path) -> tuple[int, str]:
        digits = path.stem.rpartition("_")[2]  # name_2 was written before name_10
        return int(digits) if digits.isdigit() else 0, path.name

    paths = (path for path in folder.iterdir() if path.suffix in SUFFIXES.values())
    return sorted(paths, key=number)


def _summary(path: Path) -> FileSummary:
    with closing(open_storage(path)) as file:
        return file.summary


def _repair_file(path: Path, keep_rest: bool) -> tuple[int, int]:
    """Make one storage file readable; an MCAP file without a complete chunk is removed.

    Returns:
        Number of bytes cut off, and of chunks left out.
    """
    with report_damage(path):
        if path.suffix == SUFFIXES["mcap"]:
            return _repair_mcap(path, keep_rest)
        # SQLite undoes an unfinished transaction at the first access with write permission.
        with closing(sqlite3.connect(path)) as database:
            database.execute("SELECT count(*) FROM messages")
        return 0, 0


def _repair_mcap(path: Path, keep_rest: bool) -> tuple[int, int]:
    """Cut an MCAP file behind its last complete chunk and write its summary."""
    size = path.stat().st_size
    is_complete = _has_summary(path)
    with path.open("r+b") as stream:
        # Even with a good summary a chunk may be damaged, which only reading it shows.
        salvaged = _Salvaged(stream)
        if is_complete and not salvaged.damaged:
            return 0, 0
        if keep_rest and not is_complete and size > salvaged.end:
            # Before anything is cut: nothing is lost if the disk is full.
            stream.seek(salvaged.end)
            rest_path = path.with_name(path.name + REST)
            with rest_path.open("wb") as rest:
                shutil.copyfileobj(stream, rest)
        if salvaged.index.chunk_indexes:
            stream.seek(salvaged.end)
            stream.truncate()
            _write_summary(stream, path.name, salvaged)
    if not salvaged.index.chunk_indexes:
        path.unlink()
    return 0 if is_complete else size - salvaged.end, salvaged.damaged


def _has_summary(path: Path) -> bool:
    """Return whether an MCAP file has a summary that can be read."""
    try:
        McapReader(path).close()
    except READ_ERRORS:
        return False
    return True


class _Salvaged:
    """All complete chunks of an MCAP file.

    Attributes:
        index: Schemas, channels and chunks, as the summary has them.
        counts: Number of messages of each channel.
        end: Offset at which the last complete chunk ends, with its index records.
        damaged: Number of records that were left out.
    """

    def __init__(self, stream: BinaryIO) -> None:
        """Read all records of a file.

        Raises:
            BagError: The file does not begin as an MCAP file.
        """
        self.index = Summary()
        self.counts: Counter[int] = Counter()
        self.end = self.damaged = 0
        self._open_chunk: ChunkIndex | None = None
        self._open_counts: Counter[int] = Counter()
        stream.seek(0)
        if stream.read(len(MAGIC)) != MAGIC:
            raise BagError(
                f"{stream.name}: does not begin as an MCAP file does; nothing can be read"
            )
        for opcode, start, content in _records(stream):
            if opcode == Opcode.HEADER:
                self.end = stream.tell()
            elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
                break
            # A damaged record is left out; the records behind it count again.
            try:
                self._take(opcode, start, content)
            except READ_ERRORS:
                self._open_chunk = None
                self.damaged += 1

    def _take(
        self,
        opcode: int,
        start: int,
        content: bytes,
    ) -> None:
        """Take in one record of the file.

        Raises:
            READ_ERRORS: It is damaged.
        """
        if opcode == Opcode.CHUNK:
            self._begin_chunk(start, content)
        elif opcode == Opcode.MESSAGE_INDEX and self._open_chunk is not None:
            self._add_message_index(start, content)
        else:
            self._learn(opcode, content)

    def _begin_chunk(self, start: int, content: bytes) -> None:
        """Read a chunk, which is complete only with the index of each of its channels."""
        self._open_chunk = None
        chunk: Chunk = _parse(Chunk.read, content)
        counts: Counter[int] = Counter()
        data = unpack_chunk(chunk)
        for opcode, begin, end in chunk_records(data):
            record = data[begin:end]
            if opcode == Opcode.MESSAGE:
                counts[int.from_bytes(record[:2], "little")] += 1
            else:
                self._learn(opcode, record)
        self._open_counts = counts
        self._open_chunk = ChunkIndex(
            chunk_length=RECORD_HEAD.size + len(content),
            chunk_start_offset=start,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=chunk.message_start_time,
            uncompressed_size=chunk.uncompressed_size,
        )

    def _add_message_index(self, start: int, content: bytes) -> None:
        """Take in the index of one channel of the chunk before it."""
        chunk, counts = self._open_chunk, self._open_counts
        index: MessageIndex = _parse(MessageIndex.read, content)
        if chunk is None or len(index.records) != counts[index.channel_id]:
            raise ValueError("an index has another number of messages than its chunk")
        chunk.message_index_offsets[index.channel_id] = start
        # Readers need the indexes of all channels, so only the last one makes the chunk complete.
        if chunk.message_index_offsets.keys() == counts.keys():
            self.end = start + RECORD_HEAD.size + len(content)
            chunk_end = chunk.chunk_start_offset + chunk.chunk_length
            chunk.message_index_length = self.end - chunk_end
            self.index.chunk_indexes.append(chunk)
            self.counts += counts
            self._open_chunk = None

    def _learn(self, opcode: int, content: bytes) -> None:
        """Take in a schema or a channel; the first of each number counts."""
        if opcode == Opcode.SCHEMA:
            schema: Schema = _parse(Schema.read, content)
            self.index.schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel: Channel = _parse(Channel.read, content)
            self.index.channels.setdefault(channel.id, channel)


def _write_summary(
    stream: BinaryIO,
    name: str,
    salvaged: _Salvaged,
) -> None:
    """Write everything that follows the chunks of a complete file."""
    index, chunks = salvaged.index, salvaged.index.chunk_indexes
    index.statistics = statistics = Statistics(
        attachment_count=0,
        channel_count=len(index.channels),
        channel_message_counts=dict(sorted(salvaged.counts.items())),
        chunk_count=len(chunks),
        message_count=salvaged.counts.total(),
        message_end_time=max(chunk.message_end_time for chunk in chunks),
        message_start_time=min(chunk.message_start_time for chunk in chunks),
        metadata_count=1,
        schema_count=len(index.schemas),
    )
    # rosbag2 takes its topics from the summary, but reads nothing without this record.
    about = rosbag2_metadata(summarise(name, index))
    metadata = Metadata(ROSBAG2, about)
    metadata_length = len(_bytes_of([metadata]))
    metadata_index = MetadataIndex(stream.tell(), metadata_length, ROSBAG2)
    stream.write(_bytes_of([metadata, DataEnd(0)]))

    summary_start = stream.tell()
    groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
        (Opcode.SCHEMA, list(index.schemas.values())),
        (Opcode.CHANNEL, list(index.channels.values())),
        (Opcode.CHUNK_INDEX, chunks),
        (Opcode.METADATA_INDEX, [metadata_index]),
        (Opcode.STATISTICS, [statistics]),
    ]
    # The offsets let a reader find one group without reading the others.
    summary = b""
    offsets: list[McapRecord] = []
    for opcode, records in groups:
        group = _bytes_of(records)
        group_start = summary_start + len(summary)
        offsets.append(SummaryOffset(opcode, group_start, len(group)))
        summary += group
    offsets_start = summary_start + len(summary)
    summary += _bytes_of(offsets)
    # The checksum covers the summary and the footer up to the checksum itself.
    footer = _bytes_of([Footer(summary_start, offsets_start, 0)])
    footer = footer[:-CHECKSUM_BYTES]
    checksum = struct.pack("<I", crc32(summary + footer))
    stream.write(summary + footer + checksum + MAGIC)


def _records(stream: BinaryIO) -> Iterator[tuple[int, int, bytes]]:
    """Yield opcode, offset and content of each record, until the file ends before a record does."""
    start = stream.tell()
    size = stream.seek(0, 2)
    stream.seek(start)
    while size - start >= RECORD_HEAD.size:
        opcode, length = RECORD_HEAD.unpack(stream.read(RECORD_HEAD.size))
        if length > size - start - RECORD_HEAD.size:
            return  # the record was cut off, or its length is damaged
        yield opcode, start, stream.read(length)
        start += RECORD_HEAD.size + length


def _parse(read: Callable[[ReadDataStream], Any], content: bytes) -> Any:
    """Parse the content of a record."""
    return read(ReadDataStream(BytesIO(content)))


def _bytes_of(records: Sequence[McapRecord]) -> bytes:
    """Return records as bytes, one after the other."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
