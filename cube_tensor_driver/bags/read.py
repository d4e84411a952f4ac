"""Bags (rosbag2 folders, or one .mcap or .db3 file) read without ROS. Whatever is wrong with a bag
is a `BagError`."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag2 import ReaderError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from ..config.package_data import package_data
from ..core.errors import BagError, CubeError, MessageError
from ..core.rows import FrequencyRows, StressRows
from ..messages.codec import (
    SHAPE_AT,
    Decoded,
    MessageCodec,
    frequency_codec,
    frequency_codec_2,
    stress_codec,
    stress_codec_1,
)
from ..messages.types import FREQUENCIES, PACKAGE, STRESS
from .mcap import BagReader
from .rosbags_storage import Sqlite3Error, Typestore, ZstdError

VERSIONS = (1, 2, 3)
"""Versions of SkinInfo that this package reads."""
TOGETHER, TOGETHER_BYTES = 64, 1 << 19
"""Most messages that are decoded at once: the cost of calling numpy no longer counts, and they fit
the cache."""
# What rosbags and the libraries below it let through where bytes are not what they should be.
DAMAGE = (
    ReaderError,
    SerdeError,
    TypesysError,
    Sqlite3Error,
    ZstdError,
    struct.error,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    AssertionError,
    ArithmeticError,
    MemoryError,
    EOFError,
    RuntimeError,
)


def is_bag(path: Path) -> bool:
    """Whether a path is a folder, or named like the file of a bag; it may be damaged."""
    return path.is_dir() or path.suffix in (".mcap", ".db3")


@contextmanager
def damage(path: Path) -> Iterator[None]:
    """Turns what libraries raise about the bag `path` into a BagError; a CubeError passes."""
    try:
        yield
    except CubeError:
        raise
    except FileNotFoundError as error:
        if path.is_dir() and not (path / "metadata.yaml").exists():
            raise BagError(
                f"{path}: no metadata.yaml: no bag, or a recording that was cut off; "
                f"./cube bag repair {path} makes the latter readable"
            ) from None
        raise BagError(
            f"{path}: {error.strerror or 'no such file or folder'}; name a bag"
        ) from None
    except OSError as error:
        raise BagError(f"{path}: {error.strerror or error}; name a bag that can be read") from None
    except DAMAGE as error:
        if path.is_file() and path.suffix not in (".mcap", ".db3"):
            raise BagError(
                f"{path}: no bag; name the folder of a bag, or a file that ends in .mcap or .db3"
            ) from None
        text = " ".join(str(error).split()) or type(error).__name__
        raise BagError(
            f"{path}: damaged, or no bag ({text[:200]}); "
            f"./cube bag repair {path} may help if it was cut off"
        ) from None


@lru_cache
def typestore() -> Typestore:
    """The message types of ROS 2 Jazzy and of this package, as they are today."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for path in sorted((package_data() / "msg").glob("*.msg")):
        types |= get_types_from_msg(path.read_text(), f"{PACKAGE}/msg/{path.stem}")
    store.register(types)
    return store


def make_message(kind: str, **fields: Any) -> Any:
    """A message of the bag library from its type and its fields."""
    return typestore().types[kind](**fields)


def serialise(message: Any) -> bytes:
    """The bytes (CDR) of a message that `make_message` made, or that was read from a bag."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


class Entry(NamedTuple):
    """A message of a bag: topic, type, when it was recorded in ns, serialised bytes."""

    topic: str
    msgtype: str
    time_ns: int
    data: bytes


class Bag:
    """A bag open for reading; a context. Types are read as the bag itself defines them."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with damage(path):
            self._reader = BagReader(path)

    def __enter__(self) -> Bag:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        """BagError: damaged."""
        with damage(self.path):
            self._reader.open()
            self._types = self._own_types()

    def close(self) -> None:
        self._reader.close()

    @property
    def connections(self) -> list[Connection]:
        return self._reader.connections

    @property
    def start_ns(self) -> int:
        """When the earliest message was recorded."""
        return self._reader.start_time

    @property
    def end_ns(self) -> int:
        """When the latest message was recorded."""
        return self._reader.end_time - 1

    def topics(self, msgtype: str) -> list[str]:
        """Topics of a type."""
        return sorted(
            {connection.topic for connection in self.connections if connection.msgtype == msgtype}
        )

    def skin(self) -> str:
        """The prefix of the skin's topics, which ends in /. BagError: no skin, or several."""
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
        """Messages from start_ns until before stop_ns, of some topics or all, in the order of
        recording."""
        for connection, time_ns, data in self._messages(topics, start_ns, stop_ns):
            yield Entry(connection.topic, connection.msgtype, time_ns, data)

    def _messages(
        self, topics: set[str] | None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        wanted = [c for c in self.connections if topics is None or c.topic in topics]
        if not wanted:
            return
        count = 0
        with damage(self.path):
            for message in self._reader.messages(wanted, start_ns, stop_ns):
                count += 1
                yield message
        # A name damaged in one place only makes rosbags leave messages out without a word.
        promised = sum(connection.msgcount for connection in wanted)
        if start_ns is None and stop_ns is None and count != promised:
            names = ", ".join(sorted({connection.topic for connection in wanted}))
            raise BagError(
                f"{self.path}: damaged: {count} messages on {names}, the bag says {promised}; "
                f"./cube bag repair {self.path} may help"
            )

    @property
    def version(self) -> int:
        """Of this package's messages, as the bag defines them."""
        if self._lacks(STRESS, "left_out"):
            return 1
        return 2 if self._lacks(FREQUENCIES, "status") else max(VERSIONS)

    def _lacks(self, msgtype: str, field: str) -> bool:
        """Whether the bag defines a type, and without this field."""
        _, fields = self._types.fielddefs.get(msgtype, ((), ()))
        return bool(fields) and all(name != field for name, _ in fields)

    def decode(self, entry: Entry) -> Any:
        """The message. BagError: its bytes do not fit its type."""
        with damage(self.path):
            return self._types.deserialize_cdr(entry.data, entry.msgtype)

    def fields(self, msgtype: str) -> list[tuple[str, Any]]:
        """Name and kind (as rosbags describes it) of a type's fields; none of an unknown type."""
        return list(self._types.fielddefs.get(msgtype, ((), ()))[1])

    def infos(self, topic: str) -> list[Any]:
        """The SkinInfo messages of a topic. BagError: none, or a version that cannot be read."""
        infos = [self.decode(entry) for entry in self.entries({topic})]
        if not infos:
            raise BagError(
                f"{self.path}: no message on {topic}: the bag does not say what its frequencies "
                f"mean; record {topic} too"
            )
        for info in infos:
            if info.version not in VERSIONS:
                older = "older than" if info.version < min(VERSIONS) else "newer than"
                raise BagError(
                    f"{self.path}: {topic} has version {info.version}, {older} what this "
                    f"package reads ({', '.join(map(str, VERSIONS))}); use the package it was "
                    "recorded with, or a newer one"
                )
        return infos

    def frequencies(self, topic: str) -> Iterator[tuple[Decoded[FrequencyRows], NDArray[np.int64]]]:
        """The frequencies on a topic in the order of recording, and when they were recorded, (M,)
        ns.

        Messages of one shape that follow each other come together, at most `TOGETHER`. BagError: a
        message contradicts itself.
        """
        codec = frequency_codec if self.version > 2 else frequency_codec_2
        return self._decoded(topic, codec, codec.decode)

    def stress(self, topic: str) -> Iterator[tuple[Decoded[StressRows], NDArray[np.int64]]]:
        """As `frequencies`, of a topic with stress."""
        codec = stress_codec if self.version > 1 else stress_codec_1
        return self._decoded(topic, codec, codec.decode)

    def stress_columns(self, topic: str, names: Sequence[str]) -> Iterator[list[NDArray[Any]]]:
        """As `stress`, but only `stamp_ns` and the named columns. Not of version 1."""
        decode = partial(stress_codec.decode_columns, names)
        for columns, _ in self._decoded(topic, stress_codec, decode):
            yield columns

    def _decoded(
        self, topic: str, codec: MessageCodec[Any], decode: Callable[..., Any]
    ) -> Iterator[tuple[Any, NDArray[np.int64]]]:
        """What `decode` makes of messages of one shape, and when they were recorded."""
        waiting: list[bytes] = []
        times_ns: list[int] = []
        size = most = 0
        shape = b""
        try:
            for _, time_ns, data in self._messages({topic}):
                together = len(data) == size and data.startswith(shape, SHAPE_AT)
                if len(waiting) >= most or not together:
                    if waiting:
                        yield decode(*waiting), np.array(times_ns)
                    waiting, times_ns = [], []
                    size, shape = len(data), codec.shape_bytes(data)
                    most = max(1, min(TOGETHER, TOGETHER_BYTES // max(1, size)))
                waiting.append(data)
                times_ns.append(time_ns)
            if waiting:
                yield decode(*waiting), np.array(times_ns)
        except MessageError as error:
            raise BagError(f"{self.path}: {topic}: {error}") from None

    def _own_types(self) -> Typestore:
        types: dict[str, Any] = {}
        for connection in self.connections:
            if (
                connection.msgdef.format == MessageDefinitionFormat.MSG
                and connection.msgtype.startswith(PACKAGE)
            ):
                types |= get_types_from_msg(connection.msgdef.data, connection.msgtype)
        if not types:
            return typestore()
        store = get_typestore(Stores.ROS2_JAZZY)
        store.register({name: types[name] for name in types if name.startswith(PACKAGE)})
        return store
