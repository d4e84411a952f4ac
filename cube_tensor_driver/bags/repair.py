# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Repair, in place, of recordings that were cut off (process killed, disk full, power lost).

An MCAP file is a sequence of records. Messages lie in chunk records (blocks of messages). A chunk
record is followed by one index record for each channel (topic) of its messages. A repair cuts off
everything after the last chunk that has all of its index records, and writes the summary, which
readers need, again. An SQLite file needs no such repair: SQLite itself rolls back a transaction
that was not committed.

The StreamReader of the library mcap is not used to find the records: it relies on the lengths
inside a record, so it finds nothing after the first damaged record. Here the start of the next
record follows only from the length that stands in front of each record.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import sqlite3
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple
from zlib import crc32

from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.summary import Summary

from ..core.errors import BagError
from .mcap_file import (
    CHECKSUM_BYTES,
    MCAP_MAGIC,
    RECORD_HEAD,
    ROSBAG2_RECORD,
    McapReader,
    make_rosbag2_metadata,
    parse_record,
    read_chunk,
    summarise,
)
from .metadata import FILE_NAME, SUFFIXES, read_metadata, write_metadata
from .read import DAMAGE_ERRORS, check_storage_path, open_storage, report_damage
from .sqlite_file import execute

_DATED_NAME = re.compile(r"(\d+)_.*_\d{4}(_\d\d){2}-\d\d(_\d\d){2}")
"""Pattern of the name, without suffix, of a storage file that rosbag2 of ROS 2 Lyrical or newer
has written: number of the file, prefix, date and local time."""

REST_SUFFIX = ".rest"
"""Suffix of the file that keeps the bytes that a repair cut off; it is appended to the name of the
storage file."""


METADATA_ROOM = 1 << 16
"""Space, in bytes, that the repair of an MCAP file leaves free on the disk for the bag's
metadata.yaml, which is written afterwards and needs a few kB."""


class Repaired(NamedTuple):
    """Result of the repair of a bag.

    Attributes:
        messages: Number of messages that can be read after the repair.
        cut: Number of bytes that were cut off at the ends of the files.
        damaged: Number of records of MCAP files that were left out because they are damaged, for
            example chunks (blocks of messages).
    """

    messages: int
    cut: int
    damaged: int


def repair(path: Path, keep_rest: bool = True) -> Repaired:
    """Make a bag readable whose recording was cut off or whose files are damaged.

    Args:
        path: Folder of the bag, or one of its files.
        keep_rest: Whether the bytes that are cut off are saved in another file, with the suffix
            `REST_SUFFIX`, in the folder of the storage file.

    Raises:
        BagError: There is no bag, it has no complete message, it is still being recorded, or it
            cannot be written.
    """
    folder = path
    paths = [path]
    if not path.is_dir():
        check_storage_path(path)
        folder = path.parent
    # A file beside a metadata.yaml is part of a bag. Then all files of the bag are repaired, and
    # its metadata.yaml is written again.
    is_folder = path.is_dir() or (folder / FILE_NAME).exists()
    if is_folder:
        # Files that metadata.yaml describes as complete are repaired, too, because the disk may
        # have lost their ends after the recording.
        paths = _find_storage_files(folder)
    repaired = [_repair_file(one, keep_rest) for one in paths]

    # Files without a complete chunk have been removed.
    summaries = []
    for one in filter(Path.exists, paths):
        with closing(open_storage(one)) as file:
            summaries.append(file.summary)
    if not summaries:
        raise BagError(
            f"{path}: no .mcap or .db3 file with a complete message in it; nothing can be read"
        )
    if is_folder:
        suffixes = {Path(summary.name).suffix for summary in summaries}
        storages = [name for name, suffix in SUFFIXES.items() if suffix in suffixes]
        if len(storages) > 1:
            raise BagError(f"{folder}: .mcap beside .db3 files; move one kind to another folder")
        write_metadata(folder, storages[0], summaries)
    return Repaired(
        messages=sum(summary.msgcount for summary in summaries),
        cut=sum(cut for cut, _ in repaired),
        damaged=sum(damaged for _, damaged in repaired),
    )


def _find_storage_files(folder: Path) -> list[Path]:
    """Return the storage files of a folder in the order in which they were written.

    Files that metadata.yaml names come first, in its order. The other files follow in the order of
    the numbers in their names. Without a readable metadata.yaml, only these numbers count.
    """
    listed: list[Path] = []
    with suppress(BagError):
        listed, _ = read_metadata(folder)
    existing = [path for path in folder.iterdir() if path.suffix in SUFFIXES.values()]
    others = set(existing).difference(listed)
    by_number = sorted(others, key=lambda path: (parse_file_number(path.stem), path.name))
    return [path for path in listed if path in existing] + by_number


def parse_file_number(stem: str) -> int:
    """Return the number that rosbag2 gave a storage file of a bag, counted from 0.

    Args:
        stem: Name of the file without suffix. From ROS 2 Lyrical on, the name consists of number,
            prefix and time, such as ``10_run_2026_05_01-10_30_00``; in older versions, of prefix
            and number, such as ``run_10``. The result for any other name is 0.
    """
    dated = _DATED_NAME.fullmatch(stem)
    digits = dated[1] if dated else stem.rpartition("_")[2]
    return int(digits) if digits.isdecimal() else 0


def _repair_file(path: Path, keep_rest: bool) -> tuple[int, int]:
    """Make one storage file readable; an MCAP file without a complete chunk is removed.

    Args:
        path: The storage file.
        keep_rest: Whether the bytes that are cut off are saved in another file, see `repair`.

    Returns:
        Number of bytes that were cut off, and number of damaged records that were left out.
    """
    with report_damage(path):
        _check_not_recorded(path)
        if path.suffix == SUFFIXES["mcap"]:
            return _repair_mcap(path, keep_rest)
        # SQLite itself rolls back an unfinished transaction at the first read of a database that is
        # opened with write permission.
        with closing(sqlite3.connect(path)) as database:
            execute(database, "SELECT count(*) FROM messages")
        return 0, 0


def _repair_mcap(path: Path, keep_rest: bool) -> tuple[int, int]:
    """Cut off an MCAP file after its last complete chunk and write its summary again.

    A file whose summary and chunks are all intact is not changed.

    Args:
        path: The MCAP file; it is removed if it has no complete chunk.
        keep_rest: Whether the bytes that are cut off are saved in another file, with the suffix
            `REST_SUFFIX`, in the same folder.

    Returns:
        Number of bytes that were cut off, and number of damaged records that were left out.
    """
    size = path.stat().st_size
    is_complete = _has_summary(path)
    # An intact summary does not prove that the chunks are intact, so all of them are read.
    salvaged = _salvage(path)
    if is_complete and not salvaged.damaged:
        return 0, 0
    if keep_rest and not is_complete and size > salvaged.end:
        # The bytes after the last complete chunk are copied before they are cut off, so that they
        # are not lost if the disk is full.
        rest_path = path.with_name(path.name + REST_SUFFIX)
        with path.open("rb") as stream, rest_path.open("wb") as rest:
            stream.seek(salvaged.end)
            shutil.copyfileobj(stream, rest)
    while salvaged.index.chunk_indexes and (missing := _write_summary(path, salvaged)):
        if keep_rest:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        # The disk is full. The last messages are cut off to make room for the summary, because no
        # message can be read without it.
        kept = max(len(MCAP_MAGIC), salvaged.end - missing)
        os.truncate(path, kept)
        salvaged = _salvage(path)
    if not salvaged.index.chunk_indexes:
        path.unlink()
    return 0 if is_complete else size - salvaged.end, salvaged.damaged


def _write_summary(path: Path, salvaged: _Salvaged) -> int:
    """Replace everything in an MCAP file after its last complete chunk by a new summary.

    A chunk is a block of messages; the summary lists topics and offsets of chunks.

    Args:
        path: The MCAP file.
        salvaged: Its complete chunks.

    Returns:
        0 if the summary is written. If the disk is full, the space, in bytes, that the summary and
        metadata.yaml require.
    """
    # The stream is unbuffered. Otherwise bytes of a failed write would stay in the buffer and be
    # written again when the stream is closed.
    with path.open("r+b", buffering=0) as stream:
        stream.truncate(salvaged.end)
        stream.seek(salvaged.end)
        summary = _encode_summary(salvaged, path.name)
        needed = len(summary) + METADATA_ROOM
        # Zeros are written after the summary and cut off again. If the disk has room for them, it
        # has room for metadata.yaml.
        with suppress(OSError):
            if stream.write(summary + bytes(METADATA_ROOM)) == needed:
                needed = 0
        written = 0 if needed else len(summary)
        stream.truncate(salvaged.end + written)
    return needed


def _check_not_recorded(path: Path) -> None:
    """Raise BagError if a process has a storage file open for writing, as a recorder has.

    A repair would cut off what that process writes next.
    """
    try:
        import fcntl

        lease = fcntl.F_SETLEASE
    except (ImportError, AttributeError):
        return  # only Linux has leases, which tell whether another process has a file open
    with path.open("rb") as stream:
        # The kernel grants a read lease (fcntl(2)) only if nobody has the file open for writing.
        try:
            fcntl.fcntl(stream, lease, fcntl.F_RDLCK)
        except BlockingIOError:
            raise BagError(
                f"{path}: is being recorded by another process; end that first"
            ) from None
        except OSError:
            return  # this file system, or the owner of the file, does not allow leases
        fcntl.fcntl(stream, lease, fcntl.F_UNLCK)


def _has_summary(path: Path) -> bool:
    """Return whether an MCAP file ends with an intact summary (topics and offsets of chunks)."""
    try:
        McapReader(path).close()
    except DAMAGE_ERRORS:
        return False
    return True


@dataclass
class _Salvaged:
    """The complete chunks (blocks of messages) of an MCAP file that was cut off or damaged.

    Attributes:
        index: Message types (schemas), topics (channels) and positions of the complete chunks, in
            the form of the summary at the end of an MCAP file.
        counts: Number of messages of each channel (number of a topic in the file).
        end: Byte offset from the start of the file at which the last complete chunk ends, including
            the index records that follow it.
        damaged: Number of records that were left out because they are damaged.
    """

    index: Summary = field(default_factory=Summary)
    counts: Counter[int] = field(default_factory=Counter)
    end: int = 0
    damaged: int = 0

    def note_definition(self, opcode: int, content: bytes) -> None:
        """Note the message type (schema) or the topic (channel) that a record defines.

        Definitions can be repeated in a file; the first one with a given number is kept.

        Args:
            opcode: Type of the record; records of other types are ignored.
            content: The record without its opcode and length.
        """
        if opcode == Opcode.SCHEMA:
            schema = parse_record(Schema.read, content)
            self.index.schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel = parse_record(Channel.read, content)
            self.index.channels.setdefault(channel.id, channel)


def _salvage(path: Path) -> _Salvaged:
    """Find the complete chunks of an MCAP file.

    Raises:
        BagError: The file does not begin with the bytes of an MCAP file.
    """
    salvaged = _Salvaged()
    # `chunk` is the last chunk that was read, and `counts` its number of messages of each channel.
    # When the index records of all these channels have been read, `chunk` becomes None.
    chunk: ChunkIndex | None = None
    counts: Counter[int] = Counter()
    with path.open("rb") as stream:
        if stream.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise BagError(f"{path}: does not begin as an MCAP file does; nothing can be read")
        for opcode, start, content in _read_records(stream):
            end = start + RECORD_HEAD.size + len(content)
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                break
            # A damaged record is left out. The records after it can still be read, because the
            # length in front of its content states where the next record begins.
            try:
                if opcode == Opcode.HEADER:
                    salvaged.end = end
                elif opcode == Opcode.CHUNK:
                    chunk = None
                    read, data = read_chunk(content)
                    counts = Counter()
                    for kind, _, record in _read_records(BytesIO(data)):
                        if kind == Opcode.MESSAGE:
                            counts[int.from_bytes(record[:2], "little")] += 1
                        salvaged.note_definition(kind, record)
                    chunk = ChunkIndex(
                        chunk_length=end - start,
                        chunk_start_offset=start,
                        compression=read.compression,
                        compressed_size=len(read.data),
                        message_end_time=read.message_end_time,
                        message_index_length=0,
                        message_index_offsets={},
                        message_start_time=read.message_start_time,
                        uncompressed_size=read.uncompressed_size,
                    )
                elif opcode == Opcode.MESSAGE_INDEX and chunk is not None:
                    index = parse_record(MessageIndex.read, content)
                    if len(index.records) != counts[index.channel_id]:
                        raise McapError("an index has another number of messages than its chunk")
                    chunk.message_index_offsets[index.channel_id] = start
                    if chunk.message_index_offsets.keys() == counts.keys():
                        salvaged.end = end
                        chunk_end = chunk.chunk_start_offset + chunk.chunk_length
                        chunk.message_index_length = end - chunk_end
                        salvaged.index.chunk_indexes.append(chunk)
                        salvaged.counts += counts
                        chunk = None
                else:
                    salvaged.note_definition(opcode, content)
            except McapError:
                chunk = None
                salvaged.damaged += 1
    return salvaged


def _encode_summary(salvaged: _Salvaged, name: str) -> bytes:
    """Return the records that follow the chunks of a complete MCAP file, up to its end.

    Args:
        salvaged: The complete chunks (blocks of messages) of the file.
        name: Name of the file in the bag's folder.
    """
    index = salvaged.index
    chunks = index.chunk_indexes
    statistics = Statistics(
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
    index.statistics = statistics
    # rosbag2 reads no messages from a file without this metadata record, although it takes the
    # topics from the summary.
    about = make_rosbag2_metadata(summarise(name, index))
    metadata = Metadata(ROSBAG2_RECORD, about)
    metadata_length = len(_encode_record([metadata]))
    metadata_index = MetadataIndex(
        salvaged.end,
        metadata_length,
        ROSBAG2_RECORD,
    )
    data_end = _encode_record([metadata, DataEnd(0)])

    summary_start = salvaged.end + len(data_end)
    summary = _encode_record(
        [
            *index.schemas.values(),
            *index.channels.values(),
            *chunks,
            metadata_index,
            statistics,
        ]
    )
    # The checksum covers the summary and that part of the footer which precedes the checksum.
    # The offsets of groups of records, which may stand between summary and footer, are left out
    # (0), because readers find these records without them.
    footer = _encode_record([Footer(summary_start, 0, 0)])
    footer = footer[:-CHECKSUM_BYTES]
    checksum = struct.pack("<I", crc32(summary + footer))
    return data_end + summary + footer + checksum + MCAP_MAGIC


def _read_records(stream: BinaryIO) -> Iterator[tuple[int, int, bytes]]:
    """Yield the complete records of an MCAP file, beginning at the stream's position.

    Reading stops at a record whose length exceeds the rest of the file.

    Yields:
        Opcode (type of the record), byte offset of the record from the start of the file, and its
        content without opcode and length.
    """
    start = stream.tell()
    size = stream.seek(0, 2)
    stream.seek(start)
    while size - start >= RECORD_HEAD.size:
        opcode, length = RECORD_HEAD.unpack(stream.read(RECORD_HEAD.size))
        if length > size - start - RECORD_HEAD.size:
            return  # the file was cut off within this record, or the record's length is damaged
        yield opcode, start, stream.read(length)
        start += RECORD_HEAD.size + length


def _encode_record(records: Sequence[McapRecord]) -> bytes:
    """Return MCAP records as bytes, one after the other, each with its opcode and length."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
