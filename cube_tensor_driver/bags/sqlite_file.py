# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""SQLite files of bags (.db3), read and written with Python's sqlite3."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from ..config.yaml import to_yaml
from .metadata import (
    METADATA_VERSION,
    Connection,
    FileSummary,
    find_type_hash,
    make_bag_information,
    parse_profiles,
)
from .stored_messages import StoredMessages, join_in_blocks

_TABLES = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(
  id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL
);
CREATE TABLE topics(
  id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
  serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL,
  type_description_hash TEXT NOT NULL
);
CREATE TABLE message_definitions(
  id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
  encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL
);
CREATE TABLE messages(
  id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
  data BLOB NOT NULL
);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO schema(schema_version, ros_distro) VALUES (4, 'rosbags');
"""
"""SQL that creates the tables of a .db3 file as rosbag2 of ROS 2 Jazzy does (schema version 4)."""

_IS_SOUND = "typeof(timestamp) = 'integer' AND typeof(data) = 'blob'"
"""SQL condition that is true for a row of the table ``messages`` if the row can be read. SQLite
stores a type with every value, not per column, so damage can change the type of a single value."""

_log = logging.getLogger(__name__)


def execute(
    database: sqlite3.Connection,
    sql: str,
    values: Sequence[object] = (),
) -> sqlite3.Cursor:
    """Execute an SQL statement, and convert a UnicodeDecodeError to a `sqlite3.Error`.

    Raises:
        sqlite3.Error: The database is damaged; for some damaged texts, sqlite3 itself raises a
            UnicodeDecodeError.
    """
    try:
        return database.execute(sql, values)
    except UnicodeDecodeError as error:
        # sqlite3 cannot decode its own error message if that quotes a damaged text of the file.
        raise sqlite3.DatabaseError(f"a text of the file is damaged ({error})") from None


class SqliteReader:
    """An SQLite file open for reading.

    Attributes:
        summary: Topics, times and numbers of messages of the file.
        connections: Topics of the file by their ids in the table ``topics``.
    """

    def __init__(self, path: Path) -> None:
        """Open a file and read its topics with their numbers of messages.

        Raises:
            sqlite3.Error: The file cannot be read, or is damaged.
        """
        # The option "immutable" makes SQLite read without lock files, which it could not create in
        # a write-protected folder.
        uri = f"{path.resolve().as_uri()}?immutable=1"
        self._database = sqlite3.connect(
            uri,
            uri=True,
            check_same_thread=False,
        )
        try:
            self.connections = self._read_connections()
            (found,) = execute(
                self._database,
                "SELECT min(timestamp), max(timestamp), (SELECT count(*) FROM messages)"
                " FROM messages WHERE typeof(timestamp) = 'integer'",
            )
        except BaseException:
            self._database.close()
            raise
        connections = list(self.connections.values())
        # SQL's min and max are NULL (None) if the file has no message.
        start_ns, end_ns, total = found
        self.summary = FileSummary(
            path.name,
            connections,
            start_ns or 0,
            end_ns or 0,
        )
        damaged = total - self.summary.msgcount
        if damaged:
            _log.warning(
                "%s: %d damaged messages are left out",
                path,
                damaged,
            )

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def read_messages(
        self,
        topics: Collection[str],
        start_ns: int,
        stop_ns: int,
    ) -> Iterator[StoredMessages]:
        """Read messages in the order of their times of recording.

        Args:
            topics: Names of the topics to read.
            start_ns: Earliest time of recording that is read, in ns since the Unix epoch.
            stop_ns: Time of recording, in ns since the Unix epoch, before which messages are read.

        Yields:
            Groups of successive messages, whose channels are ids in the table ``topics``.
        """
        numbers = [number for number, one in self.connections.items() if one.topic in topics]
        places = ",".join("?" * len(numbers))
        rows: Iterator[tuple[int, int, bytes]] = execute(
            self._database,
            f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({places})"
            f" AND {_IS_SOUND} AND timestamp >= ? AND timestamp < ? ORDER BY timestamp, id",
            [*numbers, start_ns, stop_ns],
        )
        return join_in_blocks(rows)

    def _read_connections(self) -> dict[int, Connection]:
        """Read the topics of the file by their ids in the table ``topics``."""
        definitions: dict[str, str] = {}
        # rosbag2 of ROS 2 Humble stores no definitions of message types.
        if execute(self._database, "PRAGMA table_info(message_definitions)").fetchone():
            definitions = dict(
                execute(
                    self._database,
                    "SELECT topic_type, CAST(encoded_message_definition AS TEXT)"
                    " FROM message_definitions WHERE encoding = 'ros2msg'",
                )
            )
        # No table states the number of messages per topic, so the messages are counted here.
        # Counting is fast compared with reading them.
        counts = dict(
            execute(
                self._database,
                f"SELECT topic_id, count(*) FROM messages WHERE {_IS_SOUND} GROUP BY topic_id",
            )
        )
        topics = execute(
            self._database,
            "SELECT id, name, type, CAST(offered_qos_profiles AS TEXT) FROM topics"
            " WHERE typeof(name) = 'text' AND typeof(type) = 'text'",
        )
        return {
            number: Connection(
                topic,
                msgtype,
                definitions.get(msgtype, ""),
                parse_profiles(qos, topic),
                counts.get(number, 0),
            )
            for number, topic, msgtype, qos in topics
        }


class SqliteWriter:
    """A new SQLite file of a bag, open for writing."""

    def __init__(self, path: Path) -> None:
        """Create the file with empty tables.

        Raises:
            sqlite3.Error: The file cannot be created.
        """
        # Several threads may use the file, because a recorder adds topics in one thread and
        # messages in another. They never do so at the same time, so SQLite's check is not needed.
        self._database = sqlite3.connect(path, check_same_thread=False)
        self._database.executescript(_TABLES)
        # The known types and the number of topics are also kept in memory, so that the database is
        # never queried while recording.
        self._types: set[str] = set()
        self._topics = 0

    def add_topic(self, topic: Connection) -> int:
        """Add a topic to the file, which must happen before its first message is written.

        Returns:
            The id of the topic in the file, which `write` takes.
        """
        digest = find_type_hash(topic.msgtype, topic.definition)
        if topic.msgtype not in self._types:
            self._types.add(topic.msgtype)
            self._database.execute(
                "INSERT INTO message_definitions(topic_type, encoding, encoded_message_definition,"
                " type_description_hash) VALUES (?, 'ros2msg', ?, ?)",
                (topic.msgtype, topic.definition, digest),
            )
        self._topics += 1
        profiles = to_yaml(list(topic.qos)) if topic.qos else ""
        self._database.execute(
            "INSERT INTO topics VALUES (?, ?, ?, 'cdr', ?, ?)",
            (self._topics, topic.topic, topic.msgtype, profiles, digest),
        )
        return self._topics

    def write(
        self,
        channel: int,
        time_ns: int,
        data: bytes,
    ) -> None:
        """Add a message.

        Args:
            channel: Id of the topic that `add_topic` returned.
            time_ns: Time at which the message was received, in ns since the Unix epoch.
            data: Serialised message (CDR).
        """
        self._database.execute(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)",
            (channel, time_ns, data),
        )

    def flush(self) -> None:
        """Commit all messages, so that they are in the file even if the process is killed later."""
        self._database.commit()

    def finish(self, summary: FileSummary) -> None:
        """Write the description of the file into it and close it.

        Args:
            summary: Topics, times and numbers of messages of the file.
        """
        information = to_yaml(make_bag_information("sqlite3", [summary]))
        self._database.execute(
            "INSERT INTO metadata(metadata_version, metadata) VALUES (?, ?)",
            (METADATA_VERSION, information),
        )
        self._database.commit()
        self._database.close()

    def abort(self) -> None:
        """Close the file after writing failed; messages since the last `flush` are lost."""
        with suppress(sqlite3.Error):
            self._database.rollback()
        self._database.close()
