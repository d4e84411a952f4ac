# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""MCAP files of bags, read and written with the library mcap.

An MCAP file is a sequence of chunks (blocks of messages, each with a checksum), followed by a
summary that lists the topics and the offset of each chunk. A chunk is read as a whole, which needs
one read per chunk instead of several per message. Source of the format: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import BinaryIO, TypeVar
from zlib import crc32

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Chunk, Footer, McapRecord
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer

from ..config.yaml import to_yaml
from ..core.arrays import AnyArray
from .metadata import Connection, FileSummary, make_bag_information, parse_profiles
from .stored_messages import StoredMessages, join, join_in_blocks

MCAP_MAGIC = b"\x89MCAP0\r\n"
"""The bytes with which every complete MCAP file begins and ends."""

RECORD_HEAD = struct.Struct("<BQ")
"""Layout of the 9 bytes in front of each record of an MCAP file: the opcode, which is the record's
type, and the length of the record's content in bytes."""

_MESSAGE_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("recorded_ns", "<i8"),
        ("published_ns", "<i8"),
    ]
)
"""Layout of the 31 bytes in front of the serialised message in a message record of an MCAP file.

Opcode and length are those of `RECORD_HEAD`, the channel is the number of the topic in the file,
and the times are in ns since the Unix epoch.
"""

_N_CHANNELS = 1 << 16
"""Number of different channels that an MCAP file can have. A channel is the number, of 16 bits, by
which a message refers to its topic."""

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


_Record = TypeVar("_Record", bound=McapRecord)


class McapReader:
    """An MCAP file open for reading.

    Attributes:
        summary: Topics, times and numbers of messages of the file.
        connections: Topics of the file by their channels (numbers of the topics in the file).
    """

    def __init__(self, path: Path) -> None:
        """Open a file and read its summary (topics, and the offset of each chunk of messages).

        Raises:
            OSError: The file cannot be read.
            McapError: Its summary is damaged, or it has none because the recording was cut off.
        """
        self._stream = path.open("rb")
        # The checksum of the summary is checked first, because it covers every offset and length
        # that is used below.
        try:
            _check_summary(self._stream)
            self._stream.seek(0)
            reader = SeekingReader(
                self._stream,
                validate_crcs=True,
                record_size_limit=MAX_CHUNK_BYTES,
            )
            with report_parse_errors():
                index = reader.get_summary()
            # Only the statistics record of the summary states how many messages the file should
            # have. Without this record, lost messages would not be noticed.
            if index is None or index.statistics is None:
                raise McapError("the file has no summary")
            for chunk in index.chunk_indexes:
                room = path.stat().st_size - chunk.chunk_start_offset
                if not RECORD_HEAD.size <= chunk.chunk_length <= room:
                    raise McapError("a chunk lies outside of the file")
                if chunk.uncompressed_size > MAX_CHUNK_BYTES:
                    raise McapError(
                        f"a chunk of {chunk.uncompressed_size} bytes, the limit is "
                        f"{MAX_CHUNK_BYTES}"
                    )
        except BaseException:
            self._stream.close()
            raise
        self._index = index
        self.connections = read_connections(index)
        # One cache per open file, so that its chunks are freed together with this object.
        self._load_chunk = lru_cache(CACHED_CHUNKS)(self._read_chunk)
        self.summary = summarise(path.name, index)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def read_messages(
        self,
        topics: Collection[str],
        start_ns: int,
        stop_ns: int,
    ) -> Iterator[StoredMessages]:
        """Read messages in the order of their times of recording.

        If the time spans of chunks (blocks of messages) overlap, their messages are merged.

        Args:
            topics: Names of the topics to read.
            start_ns: Earliest time of recording that is read, in ns since the Unix epoch.
            stop_ns: Time of recording, in ns since the Unix epoch, before which messages are read.

        Yields:
            Groups of successive messages.
        """
        # Several channels can stand for the same topic, for example after a recorder was restarted.
        channels = [number for number, one in self.connections.items() if one.topic in topics]
        if not self._index.chunk_indexes:
            yield from self._read_unindexed_messages(topics, start_ns, stop_ns)
            return
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
        is_wanted = np.zeros(_N_CHANNELS, bool)
        is_wanted[channels] = True
        # Messages of the chunks read so far that are not delivered yet, and the byte offsets of
        # their chunks from the start of the file.
        pending: StoredMessages | None = None
        offsets = np.empty(0, int)
        chunks.sort(key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))
        for chunk in chunks:
            loaded = self._load_chunk(chunk.chunk_start_offset, chunk.chunk_length)
            inside = (start_ns <= loaded.time_ns) & (loaded.time_ns < stop_ns)
            loaded = loaded.select(inside & is_wanted[loaded.channel])
            loaded_offsets = np.full(len(loaded), chunk.chunk_start_offset)
            if pending is not None:
                # The chunks are sorted by the times of their first messages, so no message of this
                # chunk or a later one is older than this time. Older pending messages can be
                # delivered.
                ready = int(np.searchsorted(pending.time_ns, chunk.message_start_time))
                yield pending.select(slice(ready))
                late = pending.select(slice(ready, None))
                if len(late):
                    loaded = join([*late, *loaded])
                    loaded_offsets = np.concatenate([offsets[ready:], loaded_offsets])
                    # Messages with equal times stay in the order in which they were written.
                    order = np.lexsort([loaded_offsets, loaded.time_ns])
                    loaded, loaded_offsets = loaded.select(order), loaded_offsets[order]
            pending, offsets = loaded, loaded_offsets
        if pending is not None:
            yield pending

    def _read_chunk(self, offset: int, length: int) -> StoredMessages:
        """Read one chunk (block of messages) of the file.

        Args:
            offset: Byte offset of the chunk record from the start of the file.
            length: Size of the chunk record, in bytes, including its opcode and length.

        Returns:
            All messages of the chunk in the order of their times.
        """
        self._stream.seek(offset + RECORD_HEAD.size)
        _, data = read_chunk(self._stream.read(length - RECORD_HEAD.size))
        # This loop finds where the records of the chunk begin. The library mcap, which could do
        # that, takes many times as long. No message can begin in the last bytes of the chunk, which
        # have no room for the head of a message record, so the search ends before them.
        begins = []
        begin = 0
        n_heads = max(0, len(data) - _MESSAGE_HEAD.itemsize + 1)
        read_head = RECORD_HEAD.unpack_from
        while begin < n_heads:
            begins.append(begin)
            begin += RECORD_HEAD.size + read_head(data, begin)[1]
        # The elements of this array are views of the data: element i is the head of the message
        # record that would begin at byte i. Those at `begins` are the real heads.
        heads: AnyArray = np.ndarray(
            n_heads,
            f"V{_MESSAGE_HEAD.itemsize}",
            data,
            strides=(1,),
        )
        record_begin = np.array(begins, np.intp)
        head = heads[record_begin].view(_MESSAGE_HEAD)
        message_begin = record_begin + _MESSAGE_HEAD.itemsize
        # In a damaged chunk without a checksum, a record can be longer than the chunk.
        length = np.minimum(head["length"], len(data)).astype(np.intp)
        message_end = record_begin + RECORD_HEAD.size + length
        is_whole = (message_begin <= message_end) & (message_end <= len(data))
        is_message = head["opcode"] == Opcode.MESSAGE
        (chosen,) = np.nonzero(is_whole & is_message)
        # Recorders write messages of several topics slightly out of the order of their times.
        chosen = chosen[np.argsort(head["recorded_ns"][chosen], kind="stable")]
        return StoredMessages(
            data,
            message_begin,
            message_end,
            head["recorded_ns"],
            head["channel"],
        ).select(chosen)

    def _read_unindexed_messages(
        self,
        topics: Collection[str],
        start_ns: int,
        stop_ns: int,
    ) -> Iterator[StoredMessages]:
        """Read a file without an index of chunks (rosbag2's preset ``fastwrite``).

        Messages are read in the order of writing, because sorting them requires an index.

        Args:
            topics: Names of the topics to read.
            start_ns: Earliest time of recording that is read, in ns since the Unix epoch.
            stop_ns: Time of recording, in ns since the Unix epoch, before which messages are read.
        """
        self._stream.seek(0)
        reader = NonSeekingReader(
            self._stream,
            validate_crcs=True,
            record_size_limit=MAX_CHUNK_BYTES,
        )

        def read() -> Iterator[tuple[int, int, bytes]]:
            with report_parse_errors():
                for _, channel, message in reader.iter_messages(
                    topics,
                    log_time_order=False,
                    starting_at=start_ns,
                    ending_before=stop_ns,
                ):
                    yield channel.id, message.log_time, message.data

        return join_in_blocks(read())


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

    def add_topic(self, topic: Connection) -> int:
        """Add a topic to the file, which must happen before its first message is written.

        Returns:
            The channel (number of the topic in the file), which `write` takes.
        """
        name = topic.msgtype
        if name not in self._schemas:
            text = topic.definition.encode()
            self._schemas[name] = self._writer.register_schema(
                name,
                "ros2msg",
                text,
            )
        profiles = to_yaml(list(topic.qos)) if topic.qos else ""
        return self._writer.register_channel(
            topic.topic,
            "cdr",
            self._schemas[name],
            {"offered_qos_profiles": profiles},
        )

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
        self._writer.add_metadata(ROSBAG2_RECORD, make_rosbag2_metadata(summary))
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()

    def abort(self) -> None:
        """Close the file without a summary, after writing failed."""
        # Closing tries to write the buffered bytes, which fails again on a full disk.
        with suppress(OSError):
            self._stream.close()


@contextmanager
def report_parse_errors() -> Iterator[None]:
    """Turn exceptions of the `with` block, in which the library mcap parses bytes, into McapError.

    For damaged bytes the library also raises exceptions that are not a McapError.
    """
    try:
        yield
    except (
        struct.error,  # too few bytes
        ValueError,  # a wrong checksum, opcode or text
        KeyError,  # a channel without its schema
        OverflowError,  # an impossible length
        MemoryError,  # an impossible length
        RuntimeError,  # damaged data, from lz4
        zstandard.ZstdError,
    ) as error:
        raise McapError(str(error) or type(error).__name__) from None


def parse_record(
    read: Callable[[ReadDataStream], _Record],
    content: bytes,
) -> _Record:
    """Parse an MCAP record.

    Args:
        read: Method `read` of the record's class in the library mcap.
        content: The record without its opcode and length. Reading stops at its end, whatever a
            damaged length inside it says.

    Raises:
        McapError: The record is damaged.
    """
    with report_parse_errors():
        return read(ReadDataStream(BytesIO(content)))


def read_chunk(content: bytes) -> tuple[Chunk, bytes]:
    """Parse a chunk (block of messages) of an MCAP file, decompress it and check its checksum.

    Args:
        content: The chunk record without its opcode and length.

    Returns:
        The chunk, and its records as bytes, one after the other.

    Raises:
        McapError: The chunk is damaged.
    """
    chunk = parse_record(Chunk.read, content)
    with report_parse_errors():
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    return chunk, stream.read(size)


def make_rosbag2_metadata(file: FileSummary) -> dict[str, str]:
    """Return the content of the metadata record that rosbag2 reads if metadata.yaml is missing.

    Args:
        file: Topics, times and numbers of messages of the MCAP file.
    """
    return {"serialized_metadata": to_yaml(make_bag_information("mcap", [file]))}


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
    """Return the topics of an MCAP file by their channels (numbers of the topics in the file).

    Args:
        index: Summary of the file as the library mcap reads it.
    """
    counts = index.statistics.channel_message_counts if index.statistics else {}
    found = {}
    # Sorting by channel gives the topics in the order in which the recorder added them.
    for number, channel in sorted(index.channels.items()):
        schema = index.schemas.get(channel.schema_id)
        has_text = schema is not None and schema.encoding == "ros2msg"
        found[number] = Connection(
            channel.topic,
            schema.name if schema else "",
            schema.data.decode(errors="replace") if schema and has_text else "",
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
    footer = parse_record(Footer.read, tail[RECORD_HEAD.size :])
    if not footer.summary_crc:  # 0 states that the writing program computed no checksum
        return
    # The checksum covers the summary and that part of the footer which precedes the checksum.
    end = size - len(MCAP_MAGIC) - CHECKSUM_BYTES
    start = min(footer.summary_start, end)
    stream.seek(start)
    checked = stream.read(end - start)
    if crc32(checked) != footer.summary_crc:
        raise McapError("the summary does not have its checksum")
