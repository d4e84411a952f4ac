# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""MCAP files of bags, read and written with the library mcap.

An MCAP file is a sequence of chunks (blocks of messages, each with a checksum), followed by a
summary that lists the topics and the offset of each chunk. A chunk is read as a whole, which needs
one read per chunk instead of several per message. Source of the format: https://mcap.dev/spec.
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

from ..config.yaml import to_yaml
from .metadata import Connection, FileSummary, QosProfile, bag_information, parse_profiles

MCAP_MAGIC = b"\x89MCAP0\r\n"
"""The bytes with which every complete MCAP file begins and ends."""

RECORD_HEAD = struct.Struct("<BQ")
"""Layout of the 9 bytes in front of each record of an MCAP file: the opcode, which is the record's
type, and the length of the record's content in bytes."""

MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Layout of the 31 bytes in front of the serialised message in a message record of an MCAP file.

The fields are: opcode and length (`RECORD_HEAD`), channel (number of the topic in the file),
sequence number, time of recording and time of publication (both in ns since the Unix epoch).
"""

CHUNK_BYTES = 1 << 18
"""Size, in bytes, at which the writer completes a chunk (block of messages) of an MCAP file.

A chunk of 256 kB fits the processor's cache. If the process is killed, only the messages of the
incomplete chunk are lost, and those are few.
"""

MAX_CHUNK_BYTES = 256 << 20
"""Largest size, in bytes, of a chunk (block of messages) of an MCAP file that is read.

rosbag2 completes a chunk at 0.8 MB, so only a single large message can make a chunk much larger. A
file that states a size beyond this limit is treated as damaged, before memory is allocated.
"""

CACHED_CHUNKS = 8
"""Number of chunks (blocks of messages) of a file that stay in memory after they were read.

Frequencies and stress are read alternately by two iterators, but their messages lie in the same
chunks. Without this cache each chunk would be read and decompressed twice. One batch of messages
that are decoded together (`read.MAX_BATCH_ROWS`) lies in up to five chunks.
"""

ROSBAG2_RECORD = "rosbag2"
"""Name of the MCAP metadata record from which rosbag2 reads the description of a file (topics,
times, numbers of messages) if there is no metadata.yaml."""

_FOOTER_BYTES = RECORD_HEAD.size + 20
"""Size, in bytes, of the footer record of an MCAP file with its opcode and length. The footer
stands just before the closing `MCAP_MAGIC` bytes and states where the summary begins."""

CHECKSUM_BYTES = 4
"""Size, in bytes, of the checksum (CRC-32) at the end of an MCAP file's footer record. It covers
the summary (topics and offsets of chunks)."""

StoredMessage = tuple[int, int, int, bytes]
"""A message of an MCAP file: time of recording in ns since the Unix epoch, byte offset of its chunk
from the start of the file, channel (number of its topic), and its serialised bytes."""


class McapReader:
    """An MCAP file open for reading.

    Attributes:
        summary: Topics, times and numbers of messages of the file.
    """

    def __init__(self, path: Path) -> None:
        """Open a file and read its summary (topics, and the offset of each chunk of messages).

        Raises:
            OSError, McapError, ValueError, struct.error: The file cannot be read, its summary is
                damaged, or it has no summary because the recording was cut off.
        """
        self._stream = path.open("rb")
        # The checksum is checked first, because it covers every offset and length used below.
        try:
            _check_summary(self._stream)
            self._stream.seek(0)
            index = SeekingReader(
                self._stream,
                validate_crcs=True,
                record_size_limit=MAX_CHUNK_BYTES,
            ).get_summary()
            # Only the statistics state how many messages the file should have. Without them, lost
            # messages would not be noticed.
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
        self._connections = read_connections(index)
        # One cache per open file, so that its chunks are freed together with this object.
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
        """Read messages in the order of their times of recording.

        Args:
            topics: Names of the topics to read.
            start_ns: Earliest time of recording that is read, in ns since the Unix epoch.
            stop_ns: Time of recording, in ns since the Unix epoch, before which messages are read.

        Yields:
            The topic, the time of recording in ns, and the serialised message.
        """
        # Several channels can stand for the same topic, for example after a recorder was restarted.
        channels = {
            number: connection
            for number, connection in self._connections.items()
            if connection.topic in topics
        }
        if not self._index.chunk_indexes:
            yield from self._unindexed_messages(channels, start_ns, stop_ns)
            return
        for stored in self._read_sorted(channels, start_ns, stop_ns):
            for time_ns, _, channel, data in stored:
                # A chunk also contains messages of other topics, and of times outside the span.
                if channel in channels and start_ns <= time_ns < stop_ns:
                    yield channels[channel], time_ns, data

    def _read_sorted(
        self,
        channels: Collection[int],
        start_ns: int,
        stop_ns: int,
    ) -> Iterator[Sequence[StoredMessage]]:
        """Read the chunks (blocks of messages) that can contain wanted messages, sorted by time.

        If the time spans of chunks overlap, their messages are merged.

        Args:
            channels: Wanted channels (numbers of topics in the file).
            start_ns: Begin of the wanted span of time, in ns since the Unix epoch.
            stop_ns: End of the wanted span of time, in ns since the Unix epoch.

        Yields:
            Groups of successive messages, which include the unwanted messages of these chunks.
        """
        chunks = [
            chunk
            for chunk in self._index.chunk_indexes
            if start_ns <= chunk.message_end_time
            and chunk.message_start_time < stop_ns
            # A chunk without message indexes may contain any channel, so it must be read.
            and not (
                chunk.message_index_offsets
                and chunk.message_index_offsets.keys().isdisjoint(channels)
            )
        ]
        pending: Sequence[StoredMessage] = ()
        chunks.sort(key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))
        for chunk in chunks:
            # The chunks are sorted by the times of their first messages, so waiting messages that
            # are older than this chunk are delivered: no message that follows is older.
            ready = bisect_left(pending, chunk.message_start_time, key=itemgetter(0))
            yield pending[:ready]
            loaded = self._load_chunk(chunk.chunk_start_offset, chunk.chunk_length)
            waiting = pending[ready:]
            if not waiting:
                pending = loaded
                continue
            # Messages with equal times stay in the order in which they were written to the file.
            pending = sorted([*waiting, *loaded], key=itemgetter(0, 1))
        yield pending

    def _read_chunk(self, offset: int, length: int) -> Sequence[StoredMessage]:
        """Read one chunk (block of messages) of the file.

        Args:
            offset: Byte offset of the chunk record from the start of the file.
            length: Size of the chunk record, in bytes, including its opcode and length.

        Returns:
            All messages of the chunk in the order of their times.
        """
        self._stream.seek(offset + RECORD_HEAD.size)
        # Parsing a copy of the record limits what a damaged length inside it can request: reading
        # stops at the end of the record instead of allocating any amount of memory.
        record = BytesIO(self._stream.read(length - RECORD_HEAD.size))
        data = unpack_chunk(Chunk.read(ReadDataStream(record)))
        # The records are parsed here, because the library mcap takes several times as long. Zeros
        # are appended so that the head of a message can be unpacked from short records, too.
        padded = data + bytes(MESSAGE_HEAD.size)
        messages = []
        begin = 0
        while begin < len(data):
            opcode, size, channel, _, time_ns, _ = MESSAGE_HEAD.unpack_from(padded, begin)
            end = begin + RECORD_HEAD.size + size
            if opcode == Opcode.MESSAGE:
                content = data[begin + MESSAGE_HEAD.size : end]
                messages.append((time_ns, offset, channel, content))
            begin = end
        # Recorders write messages of several topics slightly out of the order of their times.
        messages.sort(key=itemgetter(0))
        return messages

    def _unindexed_messages(
        self,
        channels: dict[int, Connection],
        start_ns: int,
        stop_ns: int,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Read a file without an index of chunks (rosbag2's preset ``fastwrite``).

        Messages are read in the order of writing, because sorting them requires an index.

        Args:
            channels: Topic of each channel (number of a topic in the file) that is read.
            start_ns: Earliest time of recording that is read, in ns since the Unix epoch.
            stop_ns: Time of recording, in ns since the Unix epoch, before which messages are read.
        """
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
    """A new MCAP file of a bag, open for writing."""

    def __init__(self, path: Path) -> None:
        """Create the file.

        Raises:
            OSError: The file exists already, or cannot be created.
        """
        # Chunks are not compressed: while recording, compression would take processor time from
        # the ROS nodes on the same machine.
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
        """Add a topic to the file, which must happen before its first message is written.

        Args:
            topic: Name of the topic.
            msgtype: Type of its messages, such as ``std_msgs/msg/String``.
            definition: Text of the type's definition, with the definitions of the types of its
                fields.
            qos: Quality of service profiles that its publishers offered.

        Returns:
            The channel (number of the topic in the file), which `write` takes.
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
        """Add a message.

        Args:
            channel: Number of the topic that `add_topic` returned.
            time_ns: Time at which the message was received, in ns since the Unix epoch.
            data: Serialised message (CDR).
        """
        self._writer.add_message(channel, time_ns, data, time_ns)

    def flush(self) -> None:
        """Complete the current chunk and hand it to the operating system.

        If the process is killed later, `repair` can read all messages written up to this call.
        """
        self._writer.flush()  # type: ignore[no-untyped-call]

    def finish(self, summary: FileSummary) -> None:
        """Write the summary at the end of the file and close it.

        Args:
            summary: Topics, times and numbers of messages of the file.
        """
        # MCAP allows no metadata record within a chunk, so the current chunk is completed first.
        self.flush()
        self._writer.add_metadata(ROSBAG2_RECORD, rosbag2_metadata(summary))
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()

    def abort(self) -> None:
        """Close the file without a summary, after writing failed."""
        # Closing tries to write the buffered bytes, which fails again on a full disk.
        with suppress(OSError):
            self._stream.close()


def unpack_chunk(chunk: Chunk) -> bytes:
    """Decompress a chunk (block of messages) of an MCAP file and check its checksum.

    Returns:
        The records of the chunk as bytes, one after the other.

    Raises:
        McapError, ValueError, zstandard.ZstdError: The chunk is damaged.
    """
    try:
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        return stream.read(size)
    except RuntimeError as error:  # the library lz4 raises it for damaged data
        raise McapError(str(error)) from None


def rosbag2_metadata(file: FileSummary) -> dict[str, str]:
    """Return the content of the metadata record that rosbag2 reads if metadata.yaml is missing."""
    return {"serialized_metadata": to_yaml(bag_information("mcap", [file]))}


def summarise(name: str, index: Summary) -> FileSummary:
    """Describe an MCAP file by the summary at its end.

    Args:
        name: Name of the file in the bag's folder.
        index: Summary of the file as the library mcap reads it.
    """
    times = index.statistics
    return FileSummary(
        name,
        list(read_connections(index).values()),
        times.message_start_time if times else 0,
        times.message_end_time if times else 0,
    )


def read_connections(index: Summary) -> dict[int, Connection]:
    """Return the topics of an MCAP file by their channels (numbers of the topics in the file)."""
    counts = index.statistics.channel_message_counts if index.statistics else {}
    found = {}
    # Sorting by channel gives the topics in the order in which the recorder added them.
    for number, channel in sorted(index.channels.items()):
        schema = index.schemas.get(channel.schema_id)
        has_text = schema is not None and schema.encoding == "ros2msg"
        found[number] = Connection(
            channel.topic,
            schema.name if schema else "",
            schema.data.decode() if schema and has_text else "",
            parse_profiles(channel.metadata.get("offered_qos_profiles", ""), channel.topic),
            counts.get(number, 0),
        )
    return found


def _check_summary(stream: BinaryIO) -> None:
    """Check the checksum of an MCAP file's summary, which the library mcap does not check.

    Args:
        stream: The file, open for reading.

    Raises:
        McapError: The file is cut off, or its summary is damaged.
    """
    size = stream.seek(0, SEEK_END)
    tail_start = size - len(MCAP_MAGIC) - _FOOTER_BYTES
    stream.seek(max(0, tail_start))
    tail = stream.read()
    if tail_start < 0 or not tail.endswith(MCAP_MAGIC):
        raise McapError("the file does not end as an MCAP file does")
    footer = Footer.read(ReadDataStream(BytesIO(tail[RECORD_HEAD.size :])))
    if not footer.summary_crc:  # 0 states that the writing program computed no checksum
        return
    # The checksum covers the summary and that part of the footer which precedes the checksum.
    end = size - len(MCAP_MAGIC) - CHECKSUM_BYTES
    stream.seek(footer.summary_start)
    checked = stream.read(max(0, end - footer.summary_start))
    if crc32(checked) != footer.summary_crc:
        raise McapError("the summary does not have its checksum")
