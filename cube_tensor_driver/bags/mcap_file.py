"""MCAP files of bags, read and written with the library mcap.

An MCAP file is a sequence of chunks, each with a checksum, and a summary at the end that says which
topics there are and where each chunk is. A chunk is read as a whole: this costs one step per chunk
instead of several per message. Source of the format: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
from bisect import bisect_left
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from io import SEEK_END, BytesIO
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO
from zlib import crc32

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Chunk, Footer
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer

from ..config.yaml import parse_yaml, to_yaml
from .metadata import Connection, FileSummary, QosProfile, bag_information

MAGIC = b"\x89MCAP0\r\n"
"""The first and last bytes of a complete file."""

RECORD_HEAD = struct.Struct("<BQ")
"""Bytes in front of each record of an MCAP file: its opcode, and the length of the record."""

_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Bytes in front of the content of a message record: channel, sequence number, and the times of
recording and of publication in ns."""

CHUNK_BYTES = 1 << 18
"""Size at which the writer closes a chunk. At 256 kB a chunk fits the processor's cache, and little
is lost with the last one when the process is killed."""

MAX_CHUNK_BYTES = 256 << 20
"""Largest size, in bytes, of a chunk that is read.

rosbag2 closes a chunk when it has 0.8 MB, so only a single message can make it much larger. A size
beyond this limit is damage, and no memory is requested for it.
"""

CACHED_CHUNKS = 4
"""Number of chunks kept in memory. Frequencies and stress are read side by side, each by an
iterator of its own, from the same chunks."""

ROSBAG2 = "rosbag2"
"""Name of the metadata record in which rosbag2 looks for the description of a file."""

_FOOTER_BYTES = RECORD_HEAD.size + 20
"""Size of the footer record, which stands in front of the last `MAGIC`."""

CHECKSUM_BYTES = 4
"""Size of the checksum (CRC-32) at the end of the footer record."""

StoredMessage = tuple[int, int, int, bytes]
"""Time in ns, offset of the chunk in the file, channel, serialised message."""


class McapReader:
    """An MCAP file open for reading.

    Attributes:
        summary: What the file holds.
    """

    def __init__(self, path: Path) -> None:
        """Open a file and read its summary.

        Raises:
            OSError, McapError, ValueError, struct.error: The file cannot be read, or is damaged.
        """
        self._stream = path.open("rb")
        # The checksum comes first: it covers every offset and length that is used afterwards.
        try:
            _check_summary(self._stream)
            self._stream.seek(0)
            index = SeekingReader(
                self._stream,
                validate_crcs=True,
                record_size_limit=MAX_CHUNK_BYTES,
            ).get_summary()
            # Without statistics nobody knows how many messages there should be.
            if index is None or index.statistics is None:
                raise McapError("the file has no summary")
            sizes = [chunk.uncompressed_size for chunk in index.chunk_indexes]
            largest = max(sizes, default=0)
            if largest > MAX_CHUNK_BYTES:
                raise McapError(f"a chunk of {largest} bytes, the limit is {MAX_CHUNK_BYTES}")
        except BaseException:
            self._stream.close()
            raise
        self._index = index
        self._connections = _connections(index)
        # The cache belongs to this file, and goes with it.
        self._load_chunk = lru_cache(CACHED_CHUNKS)(self._read_chunk)
        self.summary = summarise(path.name, index)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def messages(
        self,
        topics: Collection[str],
        start_ns: int,
        stop_ns: int,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Read messages in the order of their times.

        Args:
            topics: Names of the topics.
            start_ns: Time of the first message, in ns.
            stop_ns: Time before which the last message lies.

        Yields:
            The topic, the time in ns and the serialised message.
        """
        # A topic may have several channels, for example after a recorder was restarted.
        channels = {
            number: connection
            for number, connection in self._connections.items()
            if connection.topic in topics
        }
        if not self._index.chunk_indexes:
            yield from self._unindexed_messages(channels, start_ns, stop_ns)
            return
        stored = self._in_order(channels, start_ns, stop_ns)
        for time_ns, _, channel, data in stored:
            # A chunk has messages of all topics, and its times reach beyond those wanted.
            if channel in channels and start_ns <= time_ns < stop_ns:
                yield channels[channel], time_ns, data

    def _in_order(
        self,
        channels: Collection[int],
        start_ns: int,
        stop_ns: int,
    ) -> Iterator[StoredMessage]:
        """Read the chunks that matter and merge messages of chunks whose times overlap."""
        chunks = [
            chunk
            for chunk in self._index.chunk_indexes
            if start_ns <= chunk.message_end_time
            and chunk.message_start_time < stop_ns
            # Without message indexes a chunk does not say which channels it has.
            and not (
                chunk.message_index_offsets
                and chunk.message_index_offsets.keys().isdisjoint(channels)
            )
        ]
        pending: Sequence[StoredMessage] = ()
        chunks.sort(key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))
        for chunk in chunks:
            # No later chunk has a message before this chunk's first.
            ready = bisect_left(pending, chunk.message_start_time, key=itemgetter(0))
            yield from pending[:ready]
            loaded = self._load_chunk(chunk.chunk_start_offset, chunk.chunk_length)
            waiting = pending[ready:]
            if not waiting:
                pending = loaded
                continue
            # Of messages of the same time, the one that was written first comes first.
            pending = sorted([*waiting, *loaded], key=itemgetter(0, 1))
        yield from pending

    def _read_chunk(self, offset: int, length: int) -> Sequence[StoredMessage]:
        """Read one chunk.

        Returns:
            Its messages in the order of their times.
        """
        self._stream.seek(offset + RECORD_HEAD.size)
        # A length inside the record may be damaged: then it ends with the record, not the memory.
        record = BytesIO(self._stream.read(length - RECORD_HEAD.size))
        chunk = Chunk.read(ReadDataStream(record))
        messages = [
            (time_ns, offset, channel, data)
            for channel, time_ns, data in _chunk_messages(unpack_chunk(chunk))
        ]
        # Messages of several topics may stand a little out of order.
        messages.sort(key=itemgetter(0))
        return messages

    def _unindexed_messages(
        self,
        channels: dict[int, Connection],
        start_ns: int,
        stop_ns: int,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Read a file without index (rosbag2's preset ``fastwrite``) in the order of writing."""
        self._stream.seek(0)
        reader = NonSeekingReader(
            self._stream,
            validate_crcs=True,
            record_size_limit=MAX_CHUNK_BYTES,
        )
        for _, channel, message in reader.iter_messages(log_time_order=False):
            if channel.id in channels and start_ns <= message.log_time < stop_ns:
                yield channels[channel.id], message.log_time, message.data


class McapWriter:
    """A new MCAP file of a bag."""

    def __init__(self, path: Path) -> None:
        """Create the file.

        Raises:
            OSError: It exists, or cannot be created.
        """
        # Chunks are not compressed: compression would take processor time from the nodes.
        self._stream = path.open("xb")
        self._writer = Writer(self._stream, CHUNK_BYTES, CompressionType.NONE)
        self._writer.start("ros2", library="cube_tensor_driver")
        self._schemas: dict[str, int] = {}

    def add_topic(
        self,
        topic: str,
        msgtype: str,
        definition: str,
        qos: Sequence[QosProfile],
    ) -> int:
        """Add a topic.

        Returns:
            The number by which `write` knows it.
        """
        if msgtype not in self._schemas:
            text = definition.encode()
            number = self._writer.register_schema(msgtype, "ros2msg", text)
            self._schemas[msgtype] = number
        schema = self._schemas[msgtype]
        profiles = to_yaml(list(qos)) if qos else ""
        about = {"offered_qos_profiles": profiles}
        return self._writer.register_channel(topic, "cdr", schema, about)

    def write(
        self,
        channel: int,
        time_ns: int,
        data: bytes,
    ) -> None:
        """Add a serialised message that was received at a time, in ns."""
        self._writer.add_message(channel, time_ns, data, time_ns)

    def flush(self) -> None:
        """Hand all messages to the system: a chunk can be repaired once it is complete."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def finish(self, summary: FileSummary) -> None:
        """Complete the file.

        Args:
            summary: What the file holds.
        """
        # The record must not stand within a chunk.
        self.flush()
        self._writer.add_metadata(ROSBAG2, rosbag2_metadata(summary))
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()

    def abort(self) -> None:
        """Close the file as it is."""
        # Bytes that did not fit the disk would fail again.
        with suppress(OSError):
            self._stream.close()


def unpack_chunk(chunk: Chunk) -> bytes:
    """Decompress a chunk and compare it with its checksum.

    Raises:
        McapError, ValueError, zstandard.ZstdError: The chunk is damaged.
    """
    try:
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        return stream.read(size)
    except RuntimeError as error:  # lz4 reports damage so
        raise McapError(str(error)) from None


def chunk_records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, begin and end of each record in a chunk."""
    begin = 0
    while begin < len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, begin)
        begin += RECORD_HEAD.size
        yield opcode, begin, begin + length
        begin += length


def _chunk_messages(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield channel, time and content of each message in a chunk.

    The library's reader would take several times as long, as it reads field by field.
    """
    for opcode, begin, end in chunk_records(data):
        if opcode == Opcode.MESSAGE:
            channel, _, time_ns, _ = _MESSAGE_HEAD.unpack_from(data, begin)
            yield channel, time_ns, data[begin + _MESSAGE_HEAD.size : end]


def rosbag2_metadata(file: FileSummary) -> dict[str, str]:
    """Describe a file in the words of rosbag2, which looks for this where metadata.yaml is lost."""
    return {"serialized_metadata": to_yaml(bag_information("mcap", [file]))}


def summarise(name: str, index: Summary) -> FileSummary:
    """Describe the file `name` by its summary section."""
    times = index.statistics
    return FileSummary(
        name,
        list(_connections(index).values()),
        times.message_start_time if times else 0,
        times.message_end_time if times else 0,
    )


def _connections(index: Summary) -> dict[int, Connection]:
    """Return the topics of a file by the numbers of their channels."""
    counts = index.statistics.channel_message_counts if index.statistics else {}
    found = {}
    # In the order of their numbers, which is that in which topics were added.
    for number, channel in sorted(index.channels.items()):
        schema = index.schemas.get(channel.schema_id)
        has_text = schema is not None and schema.encoding == "ros2msg"
        found[number] = Connection(
            channel.topic,
            schema.name if schema else "",
            schema.data.decode() if schema and has_text else "",
            parse_yaml(channel.metadata.get("offered_qos_profiles") or "[]", channel.topic),
            counts.get(number, 0),
        )
    return found


def _check_summary(stream: BinaryIO) -> None:
    """Compare the summary with its checksum, which the library does not check.

    Raises:
        McapError: The file is cut off, or its summary is damaged.
    """
    size = stream.seek(0, SEEK_END)
    tail_start = size - len(MAGIC) - _FOOTER_BYTES
    stream.seek(max(0, tail_start))
    tail = stream.read()
    if tail_start < 0 or not tail.endswith(MAGIC):
        raise McapError("the file does not end as an MCAP file does")
    footer = Footer.read(ReadDataStream(BytesIO(tail[RECORD_HEAD.size :])))
    if not footer.summary_crc:  # the program that wrote the file made none
        return
    # The checksum covers the summary and the footer up to the checksum itself.
    end = size - len(MAGIC) - CHECKSUM_BYTES
    stream.seek(footer.summary_start)
    checked = stream.read(max(0, end - footer.summary_start))
    if crc32(checked) != footer.summary_crc:
        raise McapError("the summary does not have its checksum")
