"""Bags written as rosbag2 does: a folder with storage files and metadata.yaml, message definitions
inside.

rosbags writes each storage file in a folder of its own. The file moves up when it is complete, so
every file in the bag's folder can be read. mcap chunks carry a checksum.
"""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ..config.yaml import write_yaml
from ..core.errors import BagError
from .mcap import HEAD, McapOutput
from .read import DAMAGE, damage, typestore
from .rosbags_storage import Sqlite3Writer

STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
SUFFIXES = {"mcap": ".mcap", "sqlite3": ".db3"}
METADATA_VERSION: Literal[9] = 9
ERRORS = (OSError, WriterError, sqlite3.Error)
FOREVER = QosTime(9223372036, 854775807)


def quality(*, latched: bool = False, reliable: bool = True, depth: int = 10) -> Qos:
    """Quality of service as metadata.yaml says it, so that a replay offers the same."""
    return Qos(
        QosHistory.KEEP_LAST,
        depth,
        QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        FOREVER,
        FOREVER,
        QosLiveliness.AUTOMATIC,
        FOREVER,
        False,
    )


class _Sqlite3Output(Sqlite3Writer):
    """As rosbags writes it, but usable from any thread, one at a time."""

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(path, compression)
        self.conn.close()
        self.conn = sqlite3.connect(self.path, check_same_thread=False)
        self.cursor = self.conn.cursor()


class _Writer(Writer):
    STORAGE_PLUGINS = MappingProxyType(
        {StoragePlugin.MCAP: McapOutput, StoragePlugin.SQLITE3: _Sqlite3Output}
    )

    def write_many(
        self, connection: Connection, times_ns: NDArray[np.int64], records: NDArray[np.uint8]
    ) -> None:
        """`write` of messages of one length, (B, HEAD + bytes)."""
        if not isinstance(self.storage, McapOutput):
            for time_ns, record in zip(times_ns.tolist(), records, strict=True):
                self.write(connection, time_ns, record[HEAD:].tobytes())
            return
        self.storage.write_many(connection, times_ns, records)
        self.counts[connection.id] += len(records)
        self.min_timestamp = min(int(times_ns.min()), self.min_timestamp)
        self.max_timestamp = max(int(times_ns.max()), self.max_timestamp)


class BagWriter:
    """A new bag; a context that completes it. For one thread at a time.

    storage: mcap or sqlite3. max_bytes, max_seconds: of one storage file, 0 without limit.
    messages, bytes: written.
    BagError: the folder is there already, cannot be written, or the disk is full; `repair` then
    saves what was written.
    """

    def __init__(
        self, folder: Path, storage: str = "mcap", max_bytes: int = 0, max_seconds: float = 0.0
    ) -> None:
        self.folder = folder
        self.messages = self.bytes = 0
        self._part_start_ns = self._part_bytes = self._part_messages = 0
        self._storage, self._max_bytes, self._max_ns = storage, max_bytes, round(max_seconds * 1e9)
        self._types: dict[str, tuple[str, tuple[Qos, ...]]] = {}
        self._parts = 0
        self._writer: _Writer | None = None
        if storage not in STORAGES:
            raise BagError(f"storage {storage!r}: use one of {', '.join(STORAGES)}")
        if folder.exists():
            raise BagError(f"{folder} is there already; name a new folder")
        self._attempt(lambda: folder.mkdir(parents=True))
        self._begin()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if error is None or not issubclass(error, BagError):
            self.close()

    def add_topic(self, topic: str, msgtype: str, qos: Iterable[Qos] = ()) -> None:
        """Before its first message. BagError: the type is not known."""
        if msgtype not in typestore().fielddefs:
            raise BagError(
                f"{topic}: the type {msgtype} is not known; known are those of ROS 2 Jazzy and "
                "of this package"
            )
        self._types[topic] = msgtype, tuple(qos)
        self._attempt(lambda: self._connect(topic))

    def write(self, topic: str, time_ns: int, data: bytes | memoryview) -> None:
        """Add a message, serialised. BagError: the disk is full or gone."""
        self._put(
            1,
            time_ns,
            len(data),
            lambda writer: writer.write(self._connections[topic], time_ns, data),
        )

    def write_many(
        self, topic: str, times_ns: NDArray[np.int64], records: NDArray[np.uint8]
    ) -> None:
        """Add B messages of one length, serialised, each behind HEAD bytes: (B, HEAD + bytes).
        BagError: as `write`.

        All of them go into one storage file. The caller must not use the records any more.
        """
        self._put(
            len(records),
            int(times_ns[0]),
            records.size - HEAD * len(records),
            lambda writer: writer.write_many(self._connections[topic], times_ns, records),
        )

    def flush(self) -> None:
        """Hand everything written so far to the system, so that it survives the end of this
        process."""
        storage = self._writer.storage if self._writer else None
        if isinstance(storage, McapOutput):
            if storage.indexes:
                self._attempt(storage.close_chunk)
        elif isinstance(storage, Sqlite3Writer):
            self._attempt(storage.conn.commit)

    def close(self) -> None:
        """Complete the bag; a second time does nothing."""
        if self._writer is not None:
            self._attempt(self._complete)

    def _begin(self) -> None:
        self._part_start_ns = self._part_bytes = self._part_messages = 0
        self._connections: dict[str, Connection] = {}
        name = f"{self.folder.resolve().name}_{self._parts}"
        self._writer = _Writer(
            self.folder / name, version=METADATA_VERSION, storage_plugin=STORAGES[self._storage]
        )
        self._attempt(self._writer.open)
        for topic in self._types:
            self._attempt(lambda topic=topic: self._connect(topic))  # type: ignore[misc]

    def _put(self, count: int, time_ns: int, size: int, write: Callable[[_Writer], None]) -> None:
        """Write messages into the current storage file, or into the next one if the current one is
        large or long enough."""
        if (self._max_bytes and self._part_bytes >= self._max_bytes) or (
            self._max_ns and self._part_messages and time_ns - self._part_start_ns >= self._max_ns
        ):
            self._attempt(self._complete)
            self._begin()
        if not self._part_messages:
            self._part_start_ns = time_ns
        if self._writer is None:
            raise BagError(f"{self.folder} is closed")
        try:
            write(self._writer)
        except ERRORS as error:
            self._fail(error)
        self._part_messages += count
        self._part_bytes += size
        self.messages += count
        self.bytes += size

    def _connect(self, topic: str) -> None:
        if self._writer is None:
            raise BagError(f"{self.folder} is closed")
        msgtype, qos = self._types[topic]
        self._connections[topic] = self._writer.add_connection(
            topic, msgtype, typestore=typestore(), offered_qos_profiles=qos
        )

    def _complete(self) -> None:
        writer = self._writer
        if writer is None:
            return
        writer.close()
        self._writer = None
        self._parts += 1
        move_up(writer.path)
        write_metadata(self.folder)

    def _attempt(self, work: Callable[[], object]) -> None:
        try:
            work()
        except ERRORS as error:
            self._fail(error)

    def _fail(self, error: Exception) -> NoReturn:
        writer, self._writer = self._writer, None
        if writer is not None:
            with suppress(*ERRORS):
                writer.abort()
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise BagError(
            f"{self.folder}: {reason}; name a folder that can be written, on a disk with room"
        ) from None


def move_up(part: Path) -> None:
    """Move a storage file from the folder that it was written in to the bag's folder."""
    for path in part.iterdir():
        if path.suffix in SUFFIXES.values():
            path.replace(part.parent / path.name)
    shutil.rmtree(part)


def part_number(path: Path) -> tuple[int, str]:
    """Sorts storage files in the order they were written in: name_2 before name_10."""
    number = path.stem.rpartition("_")[2]
    return int(number) if number.isdigit() else 0, path.name


def write_metadata(folder: Path) -> int:
    """Write metadata.yaml from what the storage files of a folder hold; returns the number of
    messages.

    BagError: no storage file, .mcap beside .db3, or one that cannot be read.
    """
    paths = sorted(
        (path for path in folder.iterdir() if path.suffix in SUFFIXES.values()), key=part_number
    )
    suffixes = {path.suffix for path in paths}
    if len(suffixes) != 1:
        raise BagError(
            f"{folder}: storage files with {len(suffixes)} suffixes; a bag's folder has .mcap "
            "files or .db3 files, one or more"
        )
    files: list[dict[str, Any]] = []
    topics: dict[tuple[str, str], dict[str, Any]] = {}
    for path in paths:
        with damage(path), Reader(path) as reader:
            files.append(
                describe_file(
                    path.name, reader.start_time, reader.end_time - 1, reader.message_count
                )
            )
            for connection in reader.connections:
                topic = topics.setdefault(
                    (connection.topic, connection.msgtype), _topic(connection)
                )
                topic["message_count"] += connection.msgcount
    storage = next(name for name, suffix in SUFFIXES.items() if suffix in suffixes)
    described = describe(storage, files, list(topics.values()))
    write_yaml(folder / "metadata.yaml", {"rosbag2_bagfile_information": described})
    return int(described["message_count"])


def describe_file(name: str, begin_ns: int, end_ns: int, messages: int) -> dict[str, Any]:
    """A storage file, as metadata.yaml has it."""
    return {
        "path": name,
        "starting_time": {"nanoseconds_since_epoch": begin_ns},
        "duration": {"nanoseconds": max(0, end_ns - begin_ns)},
        "message_count": messages,
    }


def describe(
    storage: str, files: list[dict[str, Any]], topics: list[dict[str, Any]]
) -> dict[str, Any]:
    """What metadata.yaml says about storage files; an mcap file also says it about itself. rosbag2
    requires every key."""
    used = [file for file in files if file["message_count"]] or files[:1]
    start = min(file["starting_time"]["nanoseconds_since_epoch"] for file in used)
    end = max(
        file["starting_time"]["nanoseconds_since_epoch"] + file["duration"]["nanoseconds"]
        for file in used
    )
    return {
        "version": METADATA_VERSION,
        "storage_identifier": storage,
        "duration": {"nanoseconds": end - start},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": sum(file["message_count"] for file in files),
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file["path"] for file in files],
        "files": files,
        "custom_data": None,
        "ros_distro": "rosbags",
    }


def _topic(connection: Connection) -> dict[str, Any]:
    qos = [
        {
            "history": one.history.name.lower(),
            "depth": one.depth,
            "reliability": one.reliability.name.lower(),
            "durability": one.durability.name.lower(),
            "deadline": one.deadline._asdict(),
            "lifespan": one.lifespan._asdict(),
            "liveliness": one.liveliness.name.lower(),
            "liveliness_lease_duration": one.liveliness_lease_duration._asdict(),
            "avoid_ros_namespace_conventions": one.avoid_ros_namespace_conventions,
        }
        for one in connection.ext.offered_qos_profiles  # type: ignore[union-attr]
    ]
    return {
        "topic_metadata": {
            "name": connection.topic,
            "type": connection.msgtype,
            "serialization_format": "cdr",
            "offered_qos_profiles": qos,
            "type_description_hash": connection.digest or _digest(connection),
        },
        "message_count": 0,
    }


def _digest(connection: Connection) -> str:
    """The type's hash; mcap files do not hold it. Empty where the definition cannot be read."""
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        return store.hash_rihs01(connection.msgtype)
    except DAMAGE:
        return ""
