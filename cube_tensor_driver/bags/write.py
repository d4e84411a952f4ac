# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Writing of bags in the format of rosbag2: a folder with metadata.yaml and storage files.

The storage files contain the definitions of the message types, so that a bag can be read without
this package.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from ..core.errors import BagError
from .mcap_file import McapWriter
from .metadata import (
    SUFFIXES,
    Connection,
    FileSummary,
    QosProfile,
    make_typestore,
    write_metadata,
)
from .sqlite_file import SqliteWriter

WRITE_ERRORS = (OSError, sqlite3.Error)
"""Exceptions that the libraries raise when writing fails, for example on a full disk."""


@dataclass
class _Part:
    """The storage file that is being written; a bag can be divided into several.

    All times are those at which messages were received, in ns since the Unix epoch.

    Attributes:
        path: Path of the file.
        file: Writer of the file's format.
        channels: Name of each topic -> number by which the file identifies the topic.
        counts: Name of each topic -> number of messages written on it.
        first_ns: Time of the message that was written first; None: there is no message yet.
        start_ns: Time of the earliest message; 0 without messages.
        end_ns: Time of the latest message; 0 without messages.
        n_bytes: Total size of the serialised messages, in bytes.
    """

    path: Path
    file: McapWriter | SqliteWriter
    channels: dict[str, int] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    first_ns: int | None = None
    start_ns: int = 0
    end_ns: int = 0
    n_bytes: int = 0

    def write(self, topic: str, time_ns: int, data: bytes) -> None:
        """Write a message; the arguments are those of `BagWriter.write`."""
        self.file.write(self.channels[topic], time_ns, data)
        if self.first_ns is None:
            self.first_ns = self.start_ns = self.end_ns = time_ns
        self.counts[topic] += 1
        self.start_ns = min(self.start_ns, time_ns)
        self.end_ns = max(self.end_ns, time_ns)
        self.n_bytes += len(data)


class BagWriter:
    """A new bag, open for writing; a context manager that completes the bag on exit.

    It may be used by several threads, but not at the same time.

    Attributes:
        folder: Folder of the bag.
        messages: Number of messages written so far.
        bytes: Total size of these messages in serialised form, in bytes.
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
            max_bytes: Total size of the messages in a storage file, in bytes, at which a new file
                begins; 0: no limit.
            max_seconds: Time since the first message of a storage file, in s, at which a new file
                begins; 0: no limit.

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
        # Folder and file are created now, not with the first message, so that a folder that cannot
        # be written is reported before recording begins.
        with self._report_failure():
            folder.mkdir(parents=True)
            self._begin_part()

    def __repr__(self) -> str:
        return f"BagWriter({str(self.folder)!r}: {self.messages} messages, {self.bytes} bytes)"

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        error: type[BaseException] | None,
        *_: object,
    ) -> None:
        # After an error of writing (BagError) the bag cannot be completed, so it is not closed
        # here; `repair` makes it readable later.
        if error is None or not issubclass(error, BagError):
            self.close()

    def add_topic(
        self,
        topic: str,
        msgtype: str,
        qos: Sequence[QosProfile] = (),
    ) -> None:
        """Add a topic, which must happen before its first message is written.

        Args:
            topic: Name of the topic.
            msgtype: Type of its messages, such as ``std_msgs/msg/String``.
            qos: Quality of service profiles that its publishers offer, as `describe_quality`
                returns them.

        Raises:
            BagError: The message type is unknown, or writing to the disk failed.
        """
        store = make_typestore()
        if msgtype not in store.fielddefs:
            raise BagError(
                f"{topic}: the type {msgtype} is not known; known are those of ROS 2 Jazzy and "
                "of this package"
            )
        # The file contains the type's definition, so that the bag can be read without this package.
        definition, _ = store.generate_msgdef(msgtype, ros_version=2)
        one = Connection(
            topic,
            msgtype,
            definition,
            list(qos),
        )
        self._topics.append(one)  # each storage file that begins later gets the topic, too
        with self._report_failure():
            part = self._open_part()
            part.channels[topic] = part.file.add_topic(one)

    def write(
        self,
        topic: str,
        time_ns: int,
        data: bytes,
    ) -> None:
        """Add a message.

        Args:
            topic: Name of a topic that has been added with `add_topic`.
            time_ns: Time at which the message was received, in ns since the Unix epoch.
            data: Serialised message (CDR).

        Raises:
            BagError: Writing to the disk failed; after that, nothing can be written any more.
        """
        part = self._open_part()
        is_large = self._max_bytes and part.n_bytes >= self._max_bytes
        first_ns = time_ns if part.first_ns is None else part.first_ns
        is_long = self._max_ns and time_ns - first_ns >= self._max_ns
        if is_large or is_long:
            # `close` also writes metadata.yaml, so that all complete files can be read while the
            # recording continues in the next one.
            self.close()
            with self._report_failure():
                self._begin_part()
            part = self._open_part()
        with self._report_failure():
            part.write(topic, time_ns, data)
        self.messages += 1
        self.bytes += len(data)

    def flush(self) -> None:
        """Hand all messages to the operating system, so that none is lost if the process is killed.

        Until the bag is closed, reading them requires `repair`.
        """
        if self._part is not None:
            with self._report_failure():
                self._part.file.flush()

    def close(self) -> None:
        """Complete the storage file and metadata.yaml; a second call does nothing."""
        if self._part is not None:
            with self._report_failure():
                self._finish_part()

    def _open_part(self) -> _Part:
        """Return the current storage file.

        Raises:
            BagError: The bag has been closed.
        """
        if self._part is None:
            raise BagError(f"{self.folder} is closed")
        return self._part

    def _begin_part(self) -> None:
        """Create the next storage file and add all topics of the bag to it."""
        name = f"{self.folder.resolve().name}_{len(self._complete)}{SUFFIXES[self._storage]}"
        path = self.folder / name
        file = McapWriter(path) if self._storage == "mcap" else SqliteWriter(path)
        self._part = part = _Part(path, file)
        for one in self._topics:
            part.channels[one.topic] = file.add_topic(one)

    def _finish_part(self) -> None:
        """Complete the current storage file, and list it in metadata.yaml."""
        part = self._open_part()
        summary = FileSummary(
            part.path.name,
            [replace(one, msgcount=part.counts[one.topic]) for one in self._topics],
            part.start_ns,
            part.end_ns,
        )
        part.file.finish(summary)
        # The file is complete now. A failure in writing metadata.yaml must not close it again.
        self._part = None
        self._complete.append(summary)
        write_metadata(self.folder, self._storage, self._complete)

    @contextmanager
    def _report_failure(self) -> Iterator[None]:
        """Close the current file after one of `WRITE_ERRORS` in the `with` block; raise a BagError.

        Nothing can be written afterwards; otherwise messages would be missing within the bag.
        """
        try:
            yield
        except WRITE_ERRORS as error:
            part, self._part = self._part, None
            if part is not None:
                part.file.abort()
            reason = getattr(error, "strerror", None) or str(error)
            raise BagError(
                f"{self.folder}: {reason}; name a folder that can be written, on a disk with room"
            ) from None
