"""Bags (a rosbag2 folder, or one .mcap or .db3 file) read without ROS.

Whatever is wrong with a bag is reported as a `BagError` of one line.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import zstandard
from mcap.exceptions import McapError
from rosbags.serde import SerdeError
from rosbags.typesys import TypesysError, get_types_from_msg

from ..core.arrays import AnyArray, Times
from ..core.errors import BagError, ConfigError, MessageError
from ..core.rows import FrequencyRows, StressRows
from ..messages.codec import SHAPE_AT, Decoded, MessageCodec, frequency_codec, stress_codec
from ..messages.types import FREQUENCIES, PACKAGE
from .mcap_file import McapReader
from .metadata import SUFFIXES, BagFiles, Connection, merge_connections, read_metadata, typestore
from .sqlite_file import SqliteReader

VERSION = 3
"""Version of this package's messages that can be read: ``SkinInfo.VERSION``."""

MAX_BATCH_MESSAGES = 64
"""Largest number of messages decoded at once. With more, the cost of calling numpy no longer
matters."""
MAX_BATCH_ROWS = 1 << 13
"""Largest number of rows decoded at once, so that they fit the processor's cache (82 bytes per row
of stress). The limit is in rows, so that batches of frequencies and of stress begin and end with
the same samples, and one need not be searched in the other."""

MAX_MESSAGE_BYTES = 64 << 20
"""Largest size of one message after decompression; an image of 4096 x 4096 pixels in colour has
48 MB."""

MAX_TIME_NS = (1 << 63) - 1
"""Largest time that 64 bits can hold, in ns since the epoch: the end where no end is asked for."""

READ_ERRORS = (
    McapError,
    sqlite3.Error,
    zstandard.ZstdError,
    SerdeError,
    TypesysError,
    ConfigError,
    struct.error,
    ValueError,
    KeyError,
    OverflowError,
)
"""What the libraries raise where the bytes of a file are damaged.

`struct.error`, `ValueError` and `OverflowError` come from numbers, texts and lengths that cannot
be, `KeyError` from a channel, schema or type that the file does not define.
"""


def is_bag(path: Path) -> bool:
    """Return whether a path is a folder or has a name like a storage file. It may be damaged."""
    return path.is_dir() or path.suffix in SUFFIXES.values()


@contextmanager
def report_damage(path: Path) -> Iterator[None]:
    """Turn the libraries' errors about the bag `path` into a BagError of one line."""
    try:
        yield
    except OSError as error:
        raise BagError(f"{path}: {error.strerror or error}; name a bag that can be read") from None
    except READ_ERRORS as error:
        # Some texts have several lines, and some quote the damaged bytes.
        text = " ".join(str(error).split()) or type(error).__name__
        raise BagError(
            f"{path}: damaged, or no bag ({text[:200]}); "
            f"./cube bag repair {path} may help if it was cut off"
        ) from None


def open_storage(path: Path) -> McapReader | SqliteReader:
    """Open one storage file for reading.

    Raises:
        BagError: It is missing, damaged, or not a storage file.
    """
    if not path.exists():
        raise BagError(f"{path}: no such file or folder; name a bag")
    if not path.is_file():
        # Opening a pipe would wait for a writer, and a device has no end.
        raise BagError(f"{path}: no regular file; name a bag")
    if path.suffix not in SUFFIXES.values():
        raise BagError(
            f"{path}: no bag; name the folder of a bag, or a file that ends in "
            f"{' or '.join(SUFFIXES.values())}"
        )
    is_mcap = path.suffix == SUFFIXES["mcap"]
    with report_damage(path):
        return McapReader(path) if is_mcap else SqliteReader(path)


def make_message(kind: str, **fields: Any) -> Any:
    """Make a message of the library rosbags from its type and its fields."""
    return typestore().types[kind](**fields)


def serialise(message: Any) -> bytes:
    """Return the bytes (CDR) of a message that `make_message` made or `Bag.decode` read."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


class Entry(NamedTuple):
    """A message of a bag.

    Attributes:
        topic: Name of its topic.
        msgtype: Its type.
        time_ns: Time at which it was recorded, in ns since the epoch.
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
        connections: Topics of the bag; empty until it is open.
        start_ns: Time at which the earliest message was recorded, in ns since the epoch.
        end_ns: Time at which the latest message was recorded.
    """

    def __init__(self, path: Path) -> None:
        """Find the files of a bag without opening them.

        Raises:
            BagError: There is no bag.
        """
        self.path = path
        self.connections: list[Connection] = []
        self.start_ns = self.end_ns = 0
        # A single file is a bag, too: then nobody says that it is compressed.
        self._bag_files = BagFiles([path], "")
        if path.is_dir():
            self._bag_files = read_metadata(path)
        self._files: list[McapReader | SqliteReader] = []
        self._opened = ExitStack()

    def __repr__(self) -> str:
        topics = ", ".join(f"{one.topic} ({one.msgcount})" for one in self.connections)
        return f"Bag({str(self.path)!r}: {topics or 'closed'})"

    def __enter__(self) -> Bag:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        """Open the files.

        Raises:
            BagError: A file is missing or damaged, or has another version of the messages.
        """
        # If one file cannot be opened, those before it are closed again.
        try:
            for path in self._unpacked_paths():
                file = open_storage(path)
                self._opened.callback(file.close)
                self._files.append(file)
            summaries = [file.summary for file in self._files]
            self.connections = merge_connections(summary.connections for summary in summaries)
            self._check_definitions()
        except BaseException:
            self.close()
            raise
        used = [summary for summary in summaries if summary.msgcount]
        if used:
            self.start_ns = min(summary.start_ns for summary in used)
            self.end_ns = max(summary.end_ns for summary in used)

    def close(self) -> None:
        """Close the files; a second time does nothing."""
        self._opened.close()
        self._files.clear()
        self.connections = []

    def topics(self, msgtype: str) -> list[str]:
        """Return the topics of a type, sorted."""
        names = {one.topic for one in self.connections if one.msgtype == msgtype}
        return sorted(names)

    def skin(self) -> str:
        """Return the prefix of the skin's topics, which ends in "/".

        Raises:
            BagError: The bag has no skin, or several.
        """
        names = [topic.removesuffix("frequencies") for topic in self.topics(FREQUENCIES)]
        if not names:
            raise BagError(f"{self.path}: no topic of {FREQUENCIES}; record frequencies and info")
        if len(names) != 1:
            raise BagError(
                f"{self.path}: {len(names)} topics of {FREQUENCIES} "
                f"({', '.join(names)}); needed is one"
            )
        return names[0]

    def entries(
        self,
        topics: set[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[Entry]:
        """Read messages in the order of recording.

        Args:
            topics: Names of the topics; None: all.
            start_ns: Time of the first message; None: from the beginning.
            stop_ns: Time before which the last message was recorded; None: to the end.

        Raises:
            BagError: The bag is damaged.
        """
        for connection, time_ns, data in self._messages(topics, start_ns, stop_ns):
            yield Entry(connection.topic, connection.msgtype, time_ns, data)

    def decode(self, entry: Entry) -> Any:
        """Return the message of an entry.

        Raises:
            BagError: Its bytes do not fit its type.
        """
        with report_damage(self.path):
            return typestore().deserialize_cdr(entry.data, entry.msgtype)

    def fields(self, msgtype: str) -> list[tuple[str, Any]]:
        """Return name and kind (in rosbags' form) of a type's fields; none if it is unknown."""
        constants_and_fields = typestore().fielddefs.get(msgtype, ((), ()))
        return list(constants_and_fields[1])

    def infos(self, topic: str) -> list[Any]:
        """Return the SkinInfo messages of a topic.

        Raises:
            BagError: There is none, or one of another version.
        """
        infos = list(map(self.decode, self.entries({topic})))
        if not infos:
            raise BagError(
                f"{self.path}: no message on {topic}: the bag does not say what its frequencies "
                f"mean; record {topic} too"
            )
        for info in infos:
            # The number also changes where a field has another meaning but the same type.
            if info.version != VERSION:
                self._refuse_version(f"{topic} has version {info.version}")
        return infos

    def frequencies(self, topic: str) -> Iterator[tuple[Decoded[FrequencyRows], Times]]:
        """Read frequencies in the order of recording.

        Messages of the same shape that follow each other come together.

        Yields:
            M messages, and (M,) when each was recorded, in ns.

        Raises:
            BagError: The bag is damaged, or a message contradicts itself.
        """
        return self._decoded(topic, frequency_codec, frequency_codec.decode)

    def stress(self, topic: str) -> Iterator[tuple[Decoded[StressRows], Times]]:
        """Read stress as `frequencies` reads frequencies."""
        return self._decoded(topic, stress_codec, stress_codec.decode)

    def stress_columns(self, topic: str, names: Sequence[str]) -> Iterator[list[AnyArray]]:
        """Read `stamp_ns` and the named columns of stress, which is faster than all of `stress`."""
        decode = partial(stress_codec.decode_columns, names)
        for columns, _ in self._decoded(topic, stress_codec, decode):
            yield columns

    def _messages(
        self,
        topics: set[str] | None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Read messages file by file and count them."""
        wanted = {one.topic for one in self.connections}
        if topics is not None:
            wanted &= topics
        is_packed = self._bag_files.compression == "message"
        begin_ns = 0 if start_ns is None else start_ns
        end_ns = MAX_TIME_NS if stop_ns is None else stop_ns
        count = 0
        with report_damage(self.path):
            # Files follow each other in time, so they need not be merged.
            for file in self._files:
                for connection, time_ns, data in file.messages(wanted, begin_ns, end_ns):
                    count += 1
                    yield connection, time_ns, _decompress(data) if is_packed else data

        # Damage to the name of a topic or to the number of a channel only makes messages disappear.
        promised = sum(one.msgcount for one in self.connections if one.topic in wanted)
        if start_ns is None and stop_ns is None and count != promised:
            raise BagError(
                f"{self.path}: damaged: {count} messages on {', '.join(sorted(wanted))}, the bag "
                f"says {promised}; ./cube bag repair {self.path} may help"
            )

    def _decoded(
        self,
        topic: str,
        codec: MessageCodec[Any],
        decode: Callable[..., Any],
    ) -> Iterator[tuple[Any, Times]]:
        """Decode messages of one shape together, and say when they were recorded."""
        # One call of numpy for many messages takes as long as for one.
        waiting: list[bytes] = []
        times_ns: list[int] = []
        size = limit = 0
        shape = b""
        try:
            for _, time_ns, data in self._messages({topic}):
                has_same_shape = len(data) == size and data.startswith(shape, SHAPE_AT)
                if len(waiting) >= limit or not has_same_shape:
                    if waiting:
                        yield decode(*waiting), np.array(times_ns)
                    waiting, times_ns = [], []
                    size, shape = len(data), codec.shape_bytes(data)
                    # The shape ends with the number of rows.
                    rows = int.from_bytes(shape[-4:], "little")
                    fitting = MAX_BATCH_ROWS // max(1, rows)
                    limit = max(1, min(MAX_BATCH_MESSAGES, fitting))
                waiting.append(data)
                times_ns.append(time_ns)
            if waiting:
                yield decode(*waiting), np.array(times_ns)
        except MessageError as error:
            raise BagError(f"{self.path}: {topic}: {error}") from None

    def _unpacked_paths(self) -> Sequence[Path]:
        """Return the storage files, decompressed into a temporary folder if they are compressed."""
        if self._bag_files.compression != "file":
            return self._bag_files.paths
        folder = Path(self._opened.enter_context(TemporaryDirectory()))
        unpacked = []
        for path in self._bag_files.paths:
            unpacked.append(folder / path.name.removesuffix(".zstd"))
            with (
                # In steps of some kB: a recording need not fit the memory.
                report_damage(path),
                path.open("rb") as source,
                unpacked[-1].open("wb") as destination,
            ):
                zstandard.ZstdDecompressor().copy_stream(source, destination)
        return unpacked

    def _check_definitions(self) -> None:
        """Compare the definitions of this package's messages in the bag with those of today."""
        for one in self.connections:
            if not one.msgtype.startswith(PACKAGE) or not one.definition:
                continue
            with report_damage(self.path):
                definitions = get_types_from_msg(one.definition, one.msgtype)
            # Constants may differ: the bytes of a message do not depend on them.
            for name, (_, fields) in definitions.items():
                if not name.startswith(PACKAGE):
                    continue
                if list(fields) != self.fields(name):
                    self._refuse_version(f"{one.topic} has another definition of {name}")

    def _refuse_version(self, difference: str) -> None:
        raise BagError(
            f"{self.path}: {difference}; this package reads version {VERSION} of its messages: "
            "use the version of the package that recorded the bag"
        )


def _decompress(data: bytes) -> bytes:
    """Decompress a message that rosbag2 compressed.

    Raises:
        zstandard.ZstdError, ValueError: It is damaged, or larger than `MAX_MESSAGE_BYTES`.
    """
    # As a stream, because a frame that states its size would be unpacked to any size.
    with zstandard.ZstdDecompressor().stream_reader(data) as reader:
        message = reader.read(MAX_MESSAGE_BYTES + 1)
    if len(message) > MAX_MESSAGE_BYTES:
        raise ValueError(f"a compressed message has more than {MAX_MESSAGE_BYTES} bytes")
    return bytes(message)
