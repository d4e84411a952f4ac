"""mcap storage files as rosbags reads and writes them, but chunk by chunk, so that a message costs
one step instead of ten.

A chunk holds messages one after the other, each behind its HEAD: opcode, length of what follows,
channel, sequence, two times. Chunks carry a checksum, so a flipped byte is detected when the chunk
is read.
"""

from __future__ import annotations

import heapq
import struct
from array import array
from collections import defaultdict
from collections.abc import Collection, Generator, Iterator
from functools import partial
from io import BytesIO
from operator import itemgetter
from pathlib import Path
from types import MappingProxyType
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionMode, Reader, ReaderError

from ..config.input_files import check_regular
from ..config.yaml import read_yaml
from ..core.errors import ConfigError
from .rosbags_storage import (
    ChunkInfo,
    DirectoryReader,
    McapReader,
    McapWriter,
    PendingChunk,
    Sqlite3Reader,
    decompress,
    read_exact,
)
from .unpack import check_size, check_zstd_file, total_limit, unpack_zstd

MESSAGE, CHUNK, INDEX = 5, 6, 7
CHUNK_BYTES = 1 << 18
MAX_MESSAGES = 1 << 18
"""In one chunk."""
MAX_OVERLAPPING = 1 << 29
"""Bytes of chunks whose times overlap: all of them have to be in memory at once."""
KEPT = 4
"""Chunks that a reader keeps, the newest, for another topic that is read at the same time."""
_RECORD = struct.Struct("<BQ")  # opcode, length of what follows
_HEAD = struct.Struct("<BQHIQQ")
HEAD = _HEAD.size
_HEADS = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("times", "<u8", 2),
    ]
)
_CHUNK = struct.Struct(
    "<QQQIIQ"
)  # first and last time, size, checksum, no letters of compression, size again
_CHUNK_BEGIN = struct.Struct("<QQQ")  # first and last time, size
_CRC_AT = _RECORD.size + 24

MessageSpan = tuple[int, int, int, int]
"""A message in a chunk: time, channel, where its data begins and ends."""


class McapFile(McapReader):
    """A file to read."""

    def __init__(self, path: Any) -> None:
        super().__init__(path)
        self._kept: dict[int, tuple[bytes, list[MessageSpan]]] = {}

    def open(self) -> None:
        """ReaderError: damaged, or beyond the bounds of `unpack.py`."""
        _check_regular(self.path)
        super().open()

    def read_index(self) -> None:
        """As rosbags'. ReaderError: the chunks that it names are too large, or in the file more
        than once."""
        super().read_index()
        if not self.chunks:
            self._check_chunks()
        size = self.path.stat().st_size
        for chunk in self.chunks:
            check_size("a chunk", max(chunk.uncompressed_size, chunk.chunk_length))
        unpacked = sum(chunk.uncompressed_size for chunk in self.chunks)
        check_size("chunks", unpacked, total_limit(size))
        stored = sum(chunk.chunk_length for chunk in self.chunks)
        check_size("stored chunks", stored, size)

    def meta_scan(self) -> None:
        """As rosbags', of a file without an index. ReaderError: its chunks are too large."""
        self._check_chunks()
        super().meta_scan()

    def _check_chunks(self) -> None:
        if self.bio is None:
            raise ReaderError("the bag is closed")
        limit, total, at = total_limit(self.path.stat().st_size), 0, self.data_start
        while at < self.data_end:
            self.bio.seek(at)
            opcode, length = _RECORD.unpack(read_exact(self.bio, _RECORD.size))
            if opcode == CHUNK:
                _, _, size = _CHUNK_BEGIN.unpack(read_exact(self.bio, _CHUNK_BEGIN.size))
                check_size("a chunk", max(size, length))
                total += size
                check_size("chunks", total, limit)
            at += _RECORD.size + length

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Messages of some connections in the order of their times, from start until before stop,
        as rosbags gives them."""
        if not self.chunks:
            yield from super().messages(connections, start, stop)
            return
        wanted = {connection.id: connection for connection in connections}
        begin, end = 0 if start is None else start, 1 << 64 if stop is None else stop
        chunks = [
            chunk
            for chunk in self.chunks
            if begin <= chunk.message_end_time
            and chunk.message_start_time < end
            and any(chunk.channel_count.get(number) for number in wanted)
        ]
        _check_overlap(chunks)
        for together in _overlapping(chunks):
            if len(together) == 1:
                data, placed = self._read(together[0])
                for time, channel, at, behind in placed:
                    if channel in wanted and begin <= time < end:
                        yield wanted[channel], time, data[at:behind]
                continue
            for time, _, channel, data in heapq.merge(
                *map(self._lazily, together), key=itemgetter(0, 1)
            ):
                if channel in wanted and begin <= time < end:
                    yield wanted[channel], time, data

    def _lazily(self, chunk: ChunkInfo) -> Iterator[tuple[int, int, int, bytes]]:
        """Messages of a chunk, and where the chunk is. The first has no channel: it delays reading
        the chunk until its time comes."""
        yield chunk.message_start_time, chunk.chunk_start_offset, -1, b""
        data, placed = self._read(chunk)
        for time, channel, at, behind in placed:
            yield time, chunk.chunk_start_offset, channel, data[at:behind]

    def _read(self, chunk: ChunkInfo) -> tuple[bytes, list[MessageSpan]]:
        """A chunk, and its messages in the order of their times. ReaderError: damaged."""
        kept = self._kept.get(chunk.chunk_start_offset)
        if kept is not None:
            return kept
        if self.bio is None:
            raise ReaderError("the bag is closed")
        self.bio.seek(chunk.chunk_start_offset)
        record = read_exact(self.bio, chunk.chunk_length)
        (crc,) = struct.unpack_from("<I", record, _CRC_AT)
        at = _RECORD.size + _CHUNK.size + len(chunk.compression)
        stored = memoryview(record)[at : at + chunk.compressed_size]
        data = decompress(stored, chunk.compression, chunk.uncompressed_size, crc)  # type: ignore[arg-type]
        if chunk.compression:
            record, at = data, 0
        placed = _message_spans(record, at, at + chunk.uncompressed_size)
        if (
            placed
            and not chunk.message_start_time
            <= placed[0][0]
            <= placed[-1][0]
            <= chunk.message_end_time
        ):
            raise ReaderError("a chunk has messages of other times than its index says")
        if len(self._kept) >= KEPT:
            del self._kept[next(iter(self._kept))]
        self._kept[chunk.chunk_start_offset] = record, placed
        return record, placed


class SqliteFile(Sqlite3Reader):
    """A database to read."""

    def open(self) -> None:
        """ReaderError: damaged, or no file."""
        _check_regular(self.path)
        super().open()


class McapFolder(DirectoryReader):
    """A bag's folder."""

    STORAGE_PLUGINS = MappingProxyType(
        {**DirectoryReader.STORAGE_PLUGINS, "mcap": McapFile, "sqlite3": SqliteFile}
    )

    def open(self) -> None:
        """ReaderError: damaged, or beyond the bounds of `unpack.py`."""
        path = self.path / "metadata.yaml"
        try:
            said = read_yaml(Path(str(path)))
        except ConfigError as error:
            raise ReaderError(str(error)) from None
        about = said.get("rosbag2_bagfile_information") if isinstance(said, dict) else None
        if isinstance(about, dict) and str(about.get("compression_mode")).lower() == "file":
            for name in about.get("relative_file_paths") or ():
                part = self.path / Path(str(name)).name
                _check_regular(part)
                check_zstd_file(Path(str(part)))
        super().open()
        self._is_message_packed = self.metadata.compression_mode == "message"
        if self._is_message_packed:  # unpacked below, within bounds
            self.metadata = self.metadata._replace(compression_mode=None)

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """As rosbags'."""
        for connection, time_ns, data in super().messages(connections, start, stop):
            yield connection, time_ns, unpack_zstd(data) if self._is_message_packed else data


class BagReader(Reader):
    """rosbags' reader of a folder or a file."""

    STORAGE_PLUGINS = MappingProxyType(
        {**Reader.STORAGE_PLUGINS, "dir": McapFolder, ".mcap": McapFile, ".db3": SqliteFile}
    )


class McapOutput(McapWriter):
    """A file to write. indexes: of each channel in the chunk that is not closed yet, pairs of time
    and place."""

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(path, compression)
        self.indexes: defaultdict[int, array[int]] = defaultdict(partial(array, "Q"))
        self._parts: list[
            bytes | memoryview
        ] = []  # of the chunk, behind what rosbags writes into its bio
        self._size = 0

    def add_msgtype(self, connection: Connection) -> None:
        """Add a type, before the messages of a chunk."""
        self._close_begun()
        super().add_msgtype(connection)
        self._size = self.chunk.bio.tell()

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        """Add a topic, before the messages of a chunk."""
        self._close_begun()
        super().add_connection(connection, offered_qos_profiles)
        self._size = self.chunk.bio.tell()

    def write(self, connection: Connection, timestamp: int, data: bytes | memoryview) -> None:
        """Add a message."""
        self.indexes[connection.id].extend((timestamp, self._size))
        head = _HEAD.pack(
            MESSAGE, HEAD - _RECORD.size + len(data), connection.id, 0, timestamp, timestamp
        )
        self._parts += head, data
        self._add(connection.id, 1, len(head) + len(data), timestamp, timestamp)

    def write_many(
        self, connection: Connection, times_ns: NDArray[np.int64], records: NDArray[np.uint8]
    ) -> None:
        """Add messages of one length, (B, HEAD + bytes), into one chunk; their heads are filled in
        here."""
        count, size = records.shape
        heads = np.zeros(count, _HEADS)
        heads["opcode"], heads["length"], heads["channel"] = (
            MESSAGE,
            size - _RECORD.size,
            connection.id,
        )
        heads["times"] = times_ns[:, None]
        records[:, :HEAD] = heads.view(np.uint8).reshape(count, -1)
        places = self._size + size * np.arange(count)
        self.indexes[connection.id].frombytes(np.stack([times_ns, places], axis=1).tobytes())
        self._parts.append(records.data.cast("B"))
        self._add(connection.id, count, records.size, int(times_ns.min()), int(times_ns.max()))

    def close_chunk(self) -> None:
        """Into the file, with its indexes behind it; handed to the system."""
        parts = [part for part in (self.chunk.bio.getvalue(), *self._parts) if len(part)]
        data, bio = parts[0] if len(parts) == 1 else b"".join(parts), self.bio
        first, last, begin = self.chunk.message_start_time, self.chunk.message_end_time, bio.tell()
        head = _CHUNK.pack(first, last, len(data), crc32(data), 0, len(data))
        bio.write(_RECORD.pack(CHUNK, len(head) + len(data)) + head)
        bio.write(data)
        behind, places = bio.tell(), {}
        for number, index in self.indexes.items():
            places[number] = bio.tell()
            entries = index.tobytes()
            bio.write(
                _RECORD.pack(INDEX, 6 + len(entries))
                + struct.pack("<HI", number, len(entries))
                + entries
            )
        self.chunks.append(
            in_summary(first, last, begin, behind, bio.tell(), places, "", len(data), len(data))
        )
        # Without its indexes a chunk cannot be repaired.
        bio.flush()
        self.chunk = PendingChunk(2**63 - 1, 0, BytesIO(), defaultdict(list))
        self.indexes.clear()
        self._parts, self._size = [], 0

    def close(self, version: int, metadata: str) -> None:
        """Complete the file."""
        self._close_begun()
        super().close(version, metadata)

    def _close_begun(self) -> None:
        if self.indexes:
            self.close_chunk()

    def _add(self, number: int, count: int, size: int, first_ns: int, last_ns: int) -> None:
        """Count messages of a channel that came into the chunk."""
        self.channel_stats[number] += count
        self._size += size
        for of in (self, self.chunk):
            of.message_start_time = min(first_ns, of.message_start_time)
            of.message_end_time = max(last_ns, of.message_end_time)
        if self._size > CHUNK_BYTES:
            self.close_chunk()


def in_summary(
    first_ns: int,
    last_ns: int,
    begin: int,
    behind: int,
    end: int,
    indexes: dict[int, int],
    compression: str,
    stored: int,
    size: int,
) -> BytesIO:
    """What the summary says of a chunk: its times, where it begins and ends, where its indexes
    begin and end."""
    record = BytesIO()
    record.write(struct.pack("<QQQQI", first_ns, last_ns, begin, behind - begin, 10 * len(indexes)))
    record.write(b"".join(struct.pack("<HQ", channel, at) for channel, at in indexes.items()))
    record.write(struct.pack("<QI", end - behind, len(compression)) + compression.encode())
    record.write(struct.pack("<QQ", stored, size))
    return record


def _message_spans(data: bytes, at: int, end: int) -> list[MessageSpan]:
    """The messages of a chunk between two places, in the order of their times."""
    placed: list[MessageSpan] = []
    unpack = _HEAD.unpack_from
    while at < end:
        if data[at] == MESSAGE:
            _, length, channel, _, time, _ = unpack(data, at)
            placed.append((time, channel, at + HEAD, at + _RECORD.size + length))
            if len(placed) > MAX_MESSAGES:
                raise ReaderError(f"a chunk of more than {MAX_MESSAGES} messages")
        else:
            (length,) = struct.unpack_from("<Q", data, at + 1)
        at += _RECORD.size + length
    if at != end:
        raise ReaderError("the last record of a chunk ends behind it")
    placed.sort(key=itemgetter(0))
    return placed


def _check_regular(path: Any) -> None:
    try:
        check_regular(path)
    except ConfigError as error:
        raise ReaderError(str(error)) from None


def _check_overlap(chunks: list[ChunkInfo]) -> None:
    """ReaderError: too many chunks have messages of the same time."""
    begins = [(chunk.message_start_time, 1, chunk.uncompressed_size) for chunk in chunks]
    ends = [(chunk.message_end_time, 2, -chunk.uncompressed_size) for chunk in chunks]
    size = 0
    for _, _, change in sorted(begins + ends):
        size += change
        check_size("chunks of overlapping times", size, MAX_OVERLAPPING)


def _overlapping(chunks: list[ChunkInfo]) -> Iterator[list[ChunkInfo]]:
    """Chunks in the order of their times, in groups whose times overlap."""
    together: list[ChunkInfo] = []
    end_ns = -1
    for chunk in sorted(
        chunks, key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset)
    ):
        if together and chunk.message_start_time > end_ns:
            yield together
            together = []
        together.append(chunk)
        end_ns = max(end_ns, chunk.message_end_time)
    if together:
        yield together
