# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Bags (a rosbag2 folder, or one .mcap or .db3 file) read without ROS.

Whatever is wrong with a file of a bag is reported as a `BagError` of one line. A message that
cannot be read is left out, counted and logged: one bad message never makes a bag unreadable.
"""

from __future__ import annotations

import logging
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar

import numpy as np
import zstandard
from mcap.exceptions import McapError
from rosbags.serde import SerdeError
from rosbags.typesys import TypesysError, get_types_from_msg

from ..core.arrays import AnyArray, Integers, Times
from ..core.errors import BagError, MessageError
from ..core.rows import FrequencyRows, StressRows
from ..messages.codec import SECOND, Decoded, MessageCodec, frequency_codec, stress_codec
from ..messages.types import FREQUENCIES_TYPE, PACKAGE
from .mcap_file import McapReader
from .metadata import SUFFIXES, make_typestore, merge_connections, read_metadata
from .sqlite_file import SqliteReader
from .stored_messages import StoredMessages, join_in_blocks

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Fielddefs
    from std_msgs.msg import Header

    from ..msg import SkinInfo

MAX_DISORDER_NS = SECOND
"""Largest difference of stamps, in ns, by which messages and samples in a bag may be out of order.

The search for a message that belongs to a sample ends when a stamp has been read that is later
than the stamp of the sample by this difference. The message then counts as not recorded.
"""

VERSION = 4
"""Version of this package's message definitions that can be read: ``SkinInfo.VERSION``."""

MAX_BATCH_MESSAGES = 1 << 11
"""Largest number of messages decoded by one call of numpy. With more messages, the fixed cost of
the call is already negligible."""

MAX_BATCH_ROWS = 1 << 13
"""Largest number of rows (samples of cubes) decoded by one call of numpy.

This many rows of stress (82 bytes each) fit the processor's cache. The limit is in rows, not in
bytes, so that the n-th batch of frequencies and the n-th batch of stress contain the same samples.
"""

MAX_MESSAGE_BYTES = 64 << 20
"""Largest allowed size, in bytes, of one message after decompression.

An image of 4096 x 4096 pixels in colour has 48 MB. Without a limit, a damaged message could fill
the memory.
"""

MAX_TIME_NS = (1 << 63) - 1
"""Largest time in 64 bits, in ns since the Unix epoch. It stands for the end of the bag where the
caller gives no end."""

WORKING_BLOCK_BYTES = 30 << 20
"""Size, in bytes, of a memory block that is allocated and freed once before a bag is read.

The allocator of glibc keeps freed memory up to twice the size of the largest block freed so far.
Without this block it would return the arrays of every batch to the operating system, which takes
time.
"""

DAMAGE_ERRORS = (
    McapError,
    sqlite3.Error,
    zstandard.ZstdError,
    TypesysError,
)
"""Exceptions of the libraries mcap, sqlite3, zstandard and rosbags for damaged files of a bag."""

_log = logging.getLogger(__name__)

_Batch = TypeVar("_Batch")


def is_bag(path: Path) -> bool:
    """Return whether a path is a folder or ends in .mcap or .db3; the content is not checked."""
    return path.is_dir() or path.suffix in SUFFIXES.values()


@contextmanager
def report_damage(path: Path) -> Iterator[None]:
    """Turn errors of reading in the `with` block into a BagError of one line.

    Args:
        path: Bag or file that the block reads, for the error message.
    """
    try:
        yield
    except OSError as error:
        raise BagError(f"{path}: {error.strerror or error}; name a bag that can be read") from None
    except DAMAGE_ERRORS as error:
        raise BagError(
            f"{path}: damaged, or no bag ({_join_lines(error)}); "
            f"./cube bag repair {path} may help if it was cut off"
        ) from None


def _join_lines(error: Exception) -> str:
    """Return the text of a library's error, joined to one line of at most 200 characters.

    Such texts can have several lines or quote many damaged bytes.
    """
    text = " ".join(str(error).split()) or type(error).__name__
    return text[:200]


def open_storage(path: Path) -> McapReader | SqliteReader:
    """Open one storage file (.mcap or .db3) of a bag for reading.

    Raises:
        BagError: The file is missing, damaged, or not a storage file.
    """
    check_storage_path(path)
    is_mcap = path.suffix == SUFFIXES["mcap"]
    with report_damage(path):
        return McapReader(path) if is_mcap else SqliteReader(path)


def check_storage_path(path: Path) -> None:
    """Check that a path leads to a regular file whose name ends in .mcap or .db3.

    Raises:
        BagError: There is no file, it is a device or pipe, or its name has another ending.
    """
    if not path.exists():
        raise BagError(f"{path}: no such file or folder; name a bag")
    if not path.is_file():
        # A pipe or device is refused, because opening a pipe waits for a writer, and reading a
        # device may never end.
        raise BagError(f"{path}: no regular file; name a bag")
    if path.suffix not in SUFFIXES.values():
        raise BagError(
            f"{path}: no bag; name the folder of a bag, or a file that ends in "
            f"{' or '.join(SUFFIXES.values())}"
        )


class StampedMessage(Protocol):
    """A message with a header, of the library rosbags or of ROS."""

    header: Header


def make_message(kind: str, **fields: object) -> object:
    """Make a message object of the library rosbags.

    Args:
        kind: Name of the message type, such as ``std_msgs/msg/String``.
        fields: Value of each field of the message.
    """
    make: Callable[..., object] = make_typestore().types[kind]
    return make(**fields)


def serialise(kind: str, message: object) -> bytes:
    """Return the bytes (CDR) of a message that `make_message` made or `Bag.read_decoded` read."""
    return bytes(make_typestore().serialize_cdr(message, kind))


def read_stamp_ns(message: StampedMessage) -> int:
    """Return the stamp in a message's header, in ns since the Unix epoch."""
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


class Entry(NamedTuple):
    """A serialised message of a bag.

    Attributes:
        topic: Name of the message's topic.
        msgtype: Type of the message, such as ``std_msgs/msg/String``.
        time_ns: Time at which the message was recorded, in ns since the Unix epoch.
        data: Serialised message (CDR).
    """

    topic: str
    msgtype: str
    time_ns: int
    data: bytes


class Bag:
    """A bag open for reading; a context manager.

    Attributes:
        path: Folder or file of the bag.
        connections: Topics of the bag, with types and numbers of messages; empty after `close`.
        start_ns: Time at which the earliest message was recorded, in ns since the Unix epoch; 0
            without messages.
        end_ns: Time at which the latest message was recorded, in ns since the Unix epoch; 0
            without messages.
        skipped: Topic -> number of its messages that were left out because they are damaged. A
            message counts each time that it is read.
    """

    def __init__(self, path: Path) -> None:
        """Open all storage files of a bag.

        Args:
            path: Folder of the bag with its metadata.yaml, or one storage file.

        Raises:
            BagError: The folder has no readable metadata.yaml, a file is missing or damaged, or was
                recorded with another version of this package's messages.
        """
        self.path = path
        self.start_ns = self.end_ns = 0
        self.skipped: Counter[str] = Counter()
        # A single storage file is also a bag. Only metadata.yaml could state that it is compressed.
        paths, compression = [path], ""
        if path.is_dir():
            paths, compression = read_metadata(path)
        self._is_packed = compression == "message"
        self._files: list[McapReader | SqliteReader] = []
        self._opened = ExitStack()
        # Freeing this block makes the allocator reuse the memory of each batch for the next one.
        np.empty(WORKING_BLOCK_BYTES, np.uint8)
        # If one file cannot be opened, the files that were opened before are closed again.
        try:
            if compression == "file":
                paths = self._unpack_files(paths)
            for one in paths:
                file = open_storage(one)
                self._opened.callback(file.close)
                self._files.append(file)
            summaries = [file.summary for file in self._files]
            self.connections = merge_connections(summary.connections for summary in summaries)
            self._check_definitions()
        except BaseException:
            self._opened.close()
            raise
        used = [summary for summary in summaries if summary.msgcount]
        if used:
            self.start_ns = min(summary.start_ns for summary in used)
            self.end_ns = max(summary.end_ns for summary in used)

    def __repr__(self) -> str:
        topics = ", ".join(f"{one.topic} ({one.msgcount})" for one in self.connections)
        return f"Bag({str(self.path)!r}: {topics or 'closed'})"

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all storage files; calling it again does nothing."""
        self._opened.close()
        self._files.clear()
        self.connections = []

    def list_topics(self, msgtype: str) -> list[str]:
        """Return the sorted names of all topics with a message type."""
        names = {one.topic for one in self.connections if one.msgtype == msgtype}
        return sorted(names)

    def find_skin_prefix(self) -> str:
        """Return the prefix, ending in "/", of the topics of the only skin in the bag.

        Raises:
            BagError: The bag has no topic of frequencies, or has topics of several skins.
        """
        names = [topic.removesuffix("frequencies") for topic in self.list_topics(FREQUENCIES_TYPE)]
        if not names:
            raise BagError(
                f"{self.path}: no topic of {FREQUENCIES_TYPE}; record frequencies and info"
            )
        if len(names) != 1:
            raise BagError(
                f"{self.path}: {len(names)} topics of {FREQUENCIES_TYPE} "
                f"({', '.join(names)}); needed is one"
            )
        return names[0]

    def read_entries(
        self,
        topics: set[str] | None = None,
        start_ns: int = 0,
        stop_ns: int = MAX_TIME_NS,
    ) -> Iterator[Entry]:
        """Read messages in the order of recording.

        Args:
            topics: Names of the topics; None: all topics.
            start_ns: Earliest time of recording that is read, in ns since the Unix epoch.
            stop_ns: Time of recording, in ns since the Unix epoch, before which messages are read.

        Raises:
            BagError: A file of the bag is damaged, or has another number of messages than its
                summary states.
        """
        for file, messages in self._read_stored(topics, start_ns, stop_ns):
            for channel, time_ns, data in messages:
                connection = file.connections[channel]
                yield Entry(
                    connection.topic,
                    connection.msgtype,
                    time_ns,
                    data,
                )

    def _read_stored(
        self,
        topics: set[str] | None,
        start_ns: int = 0,
        stop_ns: int = MAX_TIME_NS,
    ) -> Iterator[tuple[McapReader | SqliteReader, StoredMessages]]:
        """Yield groups of successive messages, and the file in which they are.

        Arguments and errors are those of `read_entries`.
        """
        wanted = {one.topic for one in self.connections}
        if topics is not None:
            wanted &= topics
        count = 0
        with report_damage(self.path):
            # A recorder begins a new file after the last message of the one before, so messages of
            # different files need not be merged by time.
            for file in self._files:
                for messages in file.read_messages(wanted, start_ns, stop_ns):
                    count += len(messages)
                    groups: Iterable[StoredMessages] = [messages]
                    if self._is_packed:
                        groups = join_in_blocks(self._unpack(file, messages))
                    for group in groups:
                        yield file, group

        # A damaged topic name or channel number raises no error in the libraries, but its messages
        # are missing. Therefore the number of messages is compared with the one in the summary.
        promised = sum(one.msgcount for one in self.connections if one.topic in wanted)
        if (start_ns, stop_ns) == (0, MAX_TIME_NS) and count != promised:
            raise BagError(
                f"{self.path}: damaged: {count} messages on {', '.join(sorted(wanted))}, the bag "
                f"says {promised}; ./cube bag repair {self.path} may help"
            )

    def _unpack(
        self,
        file: McapReader | SqliteReader,
        messages: StoredMessages,
    ) -> Iterator[tuple[int, int, bytes]]:
        """Decompress messages that rosbag2 compressed one by one; damaged ones are left out.

        Args:
            file: The storage file of the messages, which knows their topics.
            messages: The compressed messages.
        """
        for channel, time_ns, data in messages:
            try:
                yield channel, time_ns, _decompress(data)
            except (zstandard.ZstdError, MessageError) as error:
                self.skip(file.connections[channel].topic, time_ns, error)

    def read_decoded(self, topics: set[str]) -> Iterator[tuple[int, object]]:
        """Read messages as objects, in the order of recording; damaged ones are left out.

        Yields:
            The time of recording, in ns since the Unix epoch, and the message.

        Raises:
            BagError: A file of the bag is damaged.
        """
        store = make_typestore()
        for entry in self.read_entries(topics):
            try:
                if entry.msgtype not in store.fielddefs:
                    raise SerdeError(f"the type {entry.msgtype} is not known")
                message = store.deserialize_cdr(entry.data, entry.msgtype)
            except SerdeError as error:
                self.skip(entry.topic, entry.time_ns, error)
            else:
                yield entry.time_ns, message

    def skip(
        self,
        topic: str,
        time_ns: int,
        error: Exception,
        count: int = 1,
    ) -> None:
        """Count messages that are left out because they are damaged, and log the first of a topic.

        Args:
            topic: Topic of the messages.
            time_ns: Time at which the first of them was recorded, in ns since the Unix epoch.
            error: Why they cannot be used.
            count: Number of messages.
        """
        if topic not in self.skipped:
            seconds = (time_ns - self.start_ns) * 1e-9
            _log.warning(
                "%s: %s: a message at %.3f s is left out (%s)",
                self.path,
                topic,
                seconds,
                _join_lines(error),
            )
        self.skipped[topic] += count

    def read_infos(self, topic: str) -> list[SkinInfo]:
        """Return the SkinInfo messages (cubes, calibrations, rest frequencies) of a topic.

        Messages that are damaged are left out.

        Raises:
            BagError: No message can be read, or all have another version than `VERSION`.
        """
        read: list[tuple[int, SkinInfo]] = list(self.read_decoded({topic}))
        if not read:
            raise BagError(
                f"{self.path}: no message on {topic} that can be read: the bag does not say what "
                f"its frequencies mean; record {topic} too"
            )
        # Equal message definitions are not sufficient: the version also changes when a field gets
        # another meaning but keeps its type.
        others = {time_ns: info.version for time_ns, info in read if info.version != VERSION}
        if len(others) == len(read):
            self._refuse_version(f"{topic} has version {read[0][1].version}")
        for time_ns, version in others.items():
            self.skip(
                topic,
                time_ns,
                MessageError(f"version {version}, not {VERSION}"),
            )
        return [info for _, info in read if info.version == VERSION]

    def read_frequencies(self, topic: str) -> Iterator[tuple[Decoded[FrequencyRows], Times]]:
        """Read the frequencies on a topic in the order of recording.

        Successive messages with the same number of rows and the same frame id are decoded together.

        Yields:
            M messages, and an array (M,) of the times at which they were recorded, in ns since the
            Unix epoch.

        Raises:
            BagError: A file of the bag is damaged.
        """
        return self._decode_batches(
            topic,
            frequency_codec,
            frequency_codec.decode,
        )

    def read_stress(self, topic: str) -> Iterator[tuple[Decoded[StressRows], Times]]:
        """Read the recorded stress on a topic in the order of recording.

        Successive messages with the same number of rows and the same frame id are decoded together.

        Yields:
            M messages, and an array (M,) of the times at which they were recorded, in ns since the
            Unix epoch.
        """
        return self._decode_batches(topic, stress_codec, stress_codec.decode)

    def read_columns(
        self,
        topic: str,
        codec: MessageCodec[FrequencyRows] | MessageCodec[StressRows],
        names: Sequence[str],
    ) -> Iterator[list[Integers]]:
        """Read some columns of frequencies or stress, which is faster than reading all.

        Args:
            topic: Topic of the messages.
            codec: Codec of the message type.
            names: Names of the columns, which are attributes of the rows.

        Yields:
            For each batch of N rows: `stamp_ns` (N,), then the named columns in their order.
        """
        for columns, _ in self._decode_batches(topic, codec, partial(codec.decode_columns, names)):
            yield columns

    def _decode_batches(
        self,
        topic: str,
        codec: MessageCodec[FrequencyRows] | MessageCodec[StressRows],
        decode: Callable[[AnyArray], _Batch],
    ) -> Iterator[tuple[_Batch, Times]]:
        """Decode successive messages of equal shape (frame id, number of rows) in batches.

        Args:
            topic: Topic of the messages.
            codec: Codec of the message type, which determines the shape of a message.
            decode: Function that decodes M serialised messages, given as bytes (M, length).

        Yields:
            The result of `decode` for M messages, and an array (M,) of the times at which they were
            recorded, in ns since the Unix epoch.
        """
        for messages, times_ns in self._read_batches(topic, codec):
            try:
                yield decode(messages), times_ns
            except MessageError:
                # One message is damaged, but the others are not, so each is decoded alone.
                for number, time_ns in enumerate(times_ns.tolist()):
                    one = slice(number, number + 1)
                    try:
                        yield decode(messages[one]), times_ns[one]
                    except MessageError as error:
                        self.skip(topic, time_ns, error)

    def _read_batches(
        self,
        topic: str,
        codec: MessageCodec[FrequencyRows] | MessageCodec[StressRows],
    ) -> Iterator[tuple[AnyArray, Times]]:
        """Join successive messages of equal shape (frame id, number of rows) into batches.

        Decoding many messages with one call of numpy takes hardly longer than decoding one.

        Args:
            topic: Topic of the messages.
            codec: Codec of the message type, which determines the shape of a message.

        Yields:
            The bytes (M, length) of M serialised messages, and an array (M,) of the times at which
            they were recorded, in ns since the Unix epoch.
        """
        waiting: list[tuple[AnyArray, Times]] = []
        shape: tuple[int, bytes] = 0, b""
        room = 0
        for _, stored in self._read_stored({topic}):
            for times_ns, messages in stored.group_by_length():
                first = messages[0].tobytes()
                new_shape = len(first), codec.read_shape_bytes(first)
                begin = 0
                while begin < len(messages):
                    if new_shape != shape or not room:
                        yield from _join_batch(waiting)
                        waiting, shape = [], new_shape
                        # The last 4 bytes of the shape are the number of rows in the message.
                        rows = int.from_bytes(shape[1][-4:], "little")
                        fitting = MAX_BATCH_ROWS // max(1, rows)
                        room = max(1, min(MAX_BATCH_MESSAGES, fitting))
                    part = slice(begin, begin + room)
                    waiting.append((messages[part], times_ns[part]))
                    n_taken = len(messages[part])
                    begin += n_taken
                    room -= n_taken
        yield from _join_batch(waiting)

    def _unpack_files(self, paths: Sequence[Path]) -> list[Path]:
        """Decompress storage files that rosbag2 compressed as a whole.

        The results are in a temporary folder, which is removed when the bag is closed.
        """
        folder = Path(self._opened.enter_context(TemporaryDirectory()))
        unpacked: list[Path] = []
        for path in paths:
            unpacked.append(folder / path.name.removesuffix(".zstd"))
            with (
                # `copy_stream` decompresses in steps of some kB, because a recording can be larger
                # than the memory.
                report_damage(path),
                path.open("rb") as source,
                unpacked[-1].open("wb") as destination,
            ):
                zstandard.ZstdDecompressor().copy_stream(source, destination)
        return unpacked

    def _check_definitions(self) -> None:
        """Check that this package's messages have the same fields in the bag as in this version.

        Raises:
            BagError: The definition of a message in the bag differs.
        """
        for one in self.connections:
            if not one.msgtype.startswith(PACKAGE) or not one.definition:
                continue
            with report_damage(self.path):
                different = _find_differing_type(one.msgtype, one.definition)
            if different:
                self._refuse_version(f"{one.topic} has another definition of {different}")

    def _refuse_version(self, difference: str) -> None:
        """Raise a BagError for a bag that was recorded with another version of the messages.

        Args:
            difference: How its messages differ, as part of the error message.
        """
        raise BagError(
            f"{self.path}: {difference}; this package reads version {VERSION} of its messages: "
            "use the version of the package that recorded the bag"
        )


def _join_batch(parts: Sequence[tuple[AnyArray, Times]]) -> Iterator[tuple[AnyArray, Times]]:
    """Yield the parts of a batch (bytes and times of recording) as one part, if there are any."""
    if parts:
        messages, times_ns = zip(*parts, strict=True)
        yield np.concatenate(messages), np.concatenate(times_ns)


def list_message_fields(msgtype: str) -> Fielddefs:
    """Return name and kind of each field of a message type, as the library rosbags states them.

    The list is empty if the type is unknown.
    """
    constants_and_fields = make_typestore().fielddefs.get(msgtype, ((), ()))
    return list(constants_and_fields[1])


@lru_cache
def _find_differing_type(msgtype: str, definition: str) -> str:
    """Return the first type of this package that a bag defines with other fields; "" if none is.

    Parsing a definition takes longer than reading a bag of a few seconds. Bags of the same version
    have the same definition, so the result is cached.

    Args:
        msgtype: Type of the messages of a topic.
        definition: Text of the type's definition in the bag, with the definitions of the types of
            its fields.
    """
    # Only fields are compared; constants of a definition do not change a message's bytes.
    for name, (_, fields) in get_types_from_msg(definition, msgtype).items():
        if name.startswith(PACKAGE) and list(fields) != list_message_fields(name):
            return name
    return ""


def _decompress(data: bytes) -> bytes:
    """Decompress a message that rosbag2 compressed with zstd.

    Raises:
        zstandard.ZstdError: The message is damaged.
        MessageError: It has more than `MAX_MESSAGE_BYTES` after decompression.
    """
    # A stream is read up to the limit. Decompression in one step would allocate whatever size the
    # compressed data states.
    with zstandard.ZstdDecompressor().stream_reader(data) as reader:
        message = reader.read(MAX_MESSAGE_BYTES + 1)
    if len(message) > MAX_MESSAGE_BYTES:
        raise MessageError(f"a compressed message has more than {MAX_MESSAGE_BYTES} bytes")
    return bytes(message)
