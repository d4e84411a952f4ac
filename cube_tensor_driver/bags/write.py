"""Bags written as rosbag2 writes them: a folder with metadata.yaml and storage files, which contain
the definitions of the message types."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NoReturn

from ..core.errors import BagError
from .mcap_file import McapWriter
from .metadata import (
    SUFFIXES,
    Connection,
    FileSummary,
    QosProfile,
    typestore,
    write_metadata,
)
from .sqlite_file import SqliteWriter

WRITE_ERRORS = (OSError, sqlite3.Error)
"""What the libraries raise where the disk is full or gone."""


@dataclass
class _Part:
    """The storage file that is being written.

    Attributes:
        path: The file.
        file: Its writer.
        channels: Number of each topic in the file.
        counts: Number of messages of each topic.
        first_ns: Time of the message that was written first.
        start_ns: Time of the earliest message.
        end_ns: Time of the latest message.
        messages: Number of messages.
        bytes: Their size.
    """

    path: Path
    file: McapWriter | SqliteWriter
    channels: dict[str, int] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    first_ns: int = 0
    start_ns: int = 0
    end_ns: int = 0
    messages: int = 0
    bytes: int = 0

    def count(
        self,
        topic: str,
        time_ns: int,
        size: int,
    ) -> None:
        """Take note of a message."""
        if not self.messages:
            self.first_ns = self.start_ns = self.end_ns = time_ns
        self.counts[topic] += 1
        self.messages += 1
        self.start_ns = min(self.start_ns, time_ns)
        self.end_ns = max(self.end_ns, time_ns)
        self.bytes += size

    def summary(self, topics: Sequence[Connection]) -> FileSummary:
        """Describe the file."""
        counted = [replace(one, msgcount=self.counts[one.topic]) for one in topics]
        return FileSummary(
            self.path.name,
            counted,
            self.start_ns,
            self.end_ns,
        )


class BagWriter:
    """A new bag, for one thread at a time; a context manager that completes it.

    Attributes:
        folder: Folder of the bag.
        messages: Number of messages written so far.
        bytes: Their size.
    """

    def __init__(
        self,
        folder: Path,
        storage: str = "mcap",
        max_bytes: int = 0,
        max_seconds: float = 0.0,
    ) -> None:
        """Create the folder and the first storage file.

        Args:
            folder: Folder to create.
            storage: Format of the files, ``mcap`` or ``sqlite3``.
            max_bytes: Size of messages after which a new file begins; 0: never.
            max_seconds: Duration after which a new file begins, in s; 0: never.

        Raises:
            BagError: The folder exists or cannot be created, or the format is unknown.
        """
        if storage not in SUFFIXES:
            raise BagError(f"storage {storage!r}: use one of {', '.join(SUFFIXES)}")
        if folder.exists():
            raise BagError(f"{folder} is there already; name a new folder")
        self.folder = folder
        self.messages = self.bytes = 0
        self._storage = storage
        self._max_bytes = max_bytes
        self._max_ns = round(max_seconds * 1e9)
        self._topics: list[Connection] = []
        self._complete: list[FileSummary] = []
        self._part: _Part | None = None
        # Now, not with the first message, so that a folder that cannot be written is noticed early.
        self._attempt(lambda: folder.mkdir(parents=True))
        self._attempt(self._begin_part)

    def __repr__(self) -> str:
        return f"BagWriter({str(self.folder)!r}: {self.messages} messages, {self.bytes} bytes)"

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        # After an error of writing nothing more can be written: `repair` saves what is there.
        if error is None or not issubclass(error, BagError):
            self.close()

    def add_topic(
        self,
        topic: str,
        msgtype: str,
        qos: Sequence[QosProfile] = (),
    ) -> None:
        """Add a topic before its first message.

        Args:
            topic: Name of the topic.
            msgtype: Type of its messages.
            qos: Profiles that its publishers offer, as `quality` makes them.

        Raises:
            BagError: The type is unknown.
        """
        store = typestore()
        if msgtype not in store.fielddefs:
            raise BagError(
                f"{topic}: the type {msgtype} is not known; known are those of ROS 2 Jazzy and "
                "of this package"
            )
        # The definition goes into the file, so that the bag can be read without this package.
        definition, _ = store.generate_msgdef(msgtype, ros_version=2)
        one = Connection(topic, msgtype, definition, list(qos))
        self._topics.append(one)  # for the files that follow
        self._attempt(lambda: self._connect(self._open_part(), one))

    def write(
        self,
        topic: str,
        time_ns: int,
        data: bytes,
    ) -> None:
        """Add a message.

        Args:
            topic: Topic that has been added.
            time_ns: Time at which it was received, in ns since the epoch.
            data: Serialised message (CDR).

        Raises:
            BagError: The disk is full or gone.
        """
        part = self._open_part()
        is_large = self._max_bytes and part.bytes >= self._max_bytes
        duration_ns = time_ns - part.first_ns if part.messages else 0
        is_long = self._max_ns and duration_ns >= self._max_ns
        if is_large or is_long:
            # metadata.yaml is complete at this point, so a reader sees all files before this one.
            self.close()
            self._attempt(self._begin_part)
            part = self._open_part()
        try:
            part.file.write(part.channels[topic], time_ns, data)
        except WRITE_ERRORS as error:
            self._fail(error)
        part.count(topic, time_ns, len(data))
        self.messages += 1
        self.bytes += len(data)

    def flush(self) -> None:
        """Hand everything written so far to the system, so that it survives the process."""
        if self._part is not None:
            self._attempt(self._part.file.flush)

    def close(self) -> None:
        """Complete the bag; a second time does nothing."""
        if self._part is not None:
            self._attempt(self._finish_part)

    def _open_part(self) -> _Part:
        if self._part is None:
            raise BagError(f"{self.folder} is closed")
        return self._part

    def _begin_part(self) -> None:
        """Create the next storage file, with all topics that are known."""
        name = f"{self.folder.resolve().name}_{len(self._complete)}{SUFFIXES[self._storage]}"
        path = self.folder / name
        file = McapWriter(path) if self._storage == "mcap" else SqliteWriter(path)
        self._part = _Part(path, file)
        for one in self._topics:
            self._connect(self._part, one)

    def _finish_part(self) -> None:
        """Complete the storage file, and describe it in metadata.yaml."""
        part = self._open_part()
        summary = part.summary(self._topics)
        part.file.finish(summary)
        # From here on a failure does not concern this file any more.
        self._part = None
        self._complete.append(summary)
        write_metadata(self.folder, self._storage, self._complete)

    @staticmethod
    def _connect(part: _Part, one: Connection) -> None:
        """Make a topic known in a storage file."""
        channel = part.file.add_topic(
            one.topic,
            one.msgtype,
            one.definition,
            one.qos,
        )
        part.channels[one.topic] = channel
        part.counts[one.topic] = 0

    def _attempt(self, work: Callable[[], object]) -> None:
        try:
            work()
        except WRITE_ERRORS as error:
            self._fail(error)

    def _fail(self, error: Exception) -> NoReturn:
        """Give the bag up, so that nothing is written behind a gap."""
        part, self._part = self._part, None
        if part is not None:
            part.file.abort()
        reason = getattr(error, "strerror", None) or str(error)
        raise BagError(
            f"{self.folder}: {reason}; name a folder that can be written, on a disk with room"
        ) from None
