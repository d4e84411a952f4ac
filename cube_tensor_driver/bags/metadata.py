# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The file metadata.yaml of a bag: its storage files, topics, times and numbers of messages.

The format is that of rosbag2, version 9. The library rosbags provides the definitions of message
types and the hashes that identify them.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from ..config.input_files import read_bounded
from ..config.package_data import find_package_data
from ..config.yaml import parse_yaml, write_yaml
from ..core.errors import BagError, ConfigError
from ..messages.types import PACKAGE

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict
    from rosbags.typesys.store import Typestore

FILE_NAME = "metadata.yaml"
"""Name of the file in a bag's folder that describes the bag."""

METADATA_VERSION = 9
"""Version of the format in which this package writes metadata.yaml, as rosbag2 of ROS 2 Jazzy
does."""

SUFFIXES = {"mcap": ".mcap", "sqlite3": ".db3"}
"""File name suffix of each storage format; the keys are rosbag2's names of the formats."""

_TOPICS = re.compile(rb"^  topics_with_message_count:\n((    |  -).*\n)*", re.MULTILINE)
"""Pattern of the list of topics in metadata.yaml, which is removed before the text is parsed. This
list is most of the text, and parsing it takes longer than reading the messages of a bag of a few
seconds."""

_UNLIMITED_DURATION = {"sec": 9223372036, "nsec": 854775807}
"""Duration that states "no limit" in a quality of service profile of DDS (the middleware of ROS 2):
the largest number of nanoseconds in 64 bits, divided into seconds and nanoseconds."""

QosProfile = dict[str, object]
"""Quality of service profile of a publisher, as metadata.yaml lists it: key, such as
``reliability``, and value."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Connection:
    """A recorded topic.

    Attributes:
        topic: Name of the topic.
        msgtype: Type of its messages, such as ``std_msgs/msg/String``.
        definition: Text of the type's definition, with the definitions of the types of its fields;
            "" if the bag does not contain it.
        qos: Quality of service profiles that its publishers offered.
        msgcount: Number of messages on the topic.
    """

    topic: str
    msgtype: str
    definition: str
    qos: Sequence[QosProfile] = ()
    msgcount: int = 0

    @property
    def is_latched(self) -> bool:
        """Whether all publishers kept their last messages for subscribers that start later."""
        names = ("transient_local", 1)
        durabilities = [profile.get("durability") for profile in self.qos]
        return bool(durabilities) and all(name in names for name in durabilities)

    @property
    def is_best_effort(self) -> bool:
        """Whether at least one publisher did not resend lost messages (BEST_EFFORT)."""
        # Up to version 8 of metadata.yaml, rosbag2 wrote numbers instead of the policies' names.
        names = ("best_effort", 2)
        return any(profile.get("reliability") in names for profile in self.qos)


@dataclass(frozen=True)
class FileSummary:
    """Topics, times and numbers of messages of one storage file of a bag.

    Attributes:
        name: Name of the file in the bag's folder.
        connections: Topics of the file, with their numbers of messages.
        start_ns: Time at which its earliest message was recorded, in ns since the Unix epoch.
        end_ns: Time at which its latest message was recorded, in ns since the Unix epoch.
    """

    name: str
    connections: Sequence[Connection]
    start_ns: int
    end_ns: int

    @property
    def msgcount(self) -> int:
        """Number of messages in the file."""
        return sum(connection.msgcount for connection in self.connections)


def describe_quality(
    *,
    latched: bool = False,
    reliable: bool = True,
    depth: int = 10,
) -> QosProfile:
    """Return the quality of service profile of a topic, with the keys of metadata.yaml.

    Args:
        latched: Whether late subscribers get the last messages (durability TRANSIENT_LOCAL).
        reliable: Whether lost messages are sent again (RELIABLE) or not (BEST_EFFORT).
        depth: Number of messages that a publisher keeps until they are sent.
    """
    return {
        "history": "keep_last",
        "depth": depth,
        "reliability": "reliable" if reliable else "best_effort",
        "durability": "transient_local" if latched else "volatile",
        "deadline": dict(_UNLIMITED_DURATION),
        "lifespan": dict(_UNLIMITED_DURATION),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_UNLIMITED_DURATION),
        "avoid_ros_namespace_conventions": False,
    }


@lru_cache
def parse_profiles(text: str, topic: str) -> Sequence[QosProfile]:
    """Return the quality of service profiles that a storage file states for a topic.

    The result is cached, because bags of one robot have the same text for the same topic. It is
    empty if the text is damaged, because messages can be read without the profiles.

    Args:
        text: List of profiles as YAML; "" if the file states none.
        topic: Name of the topic, for warnings.
    """
    reason = "no list of mappings"
    try:
        profiles = parse_yaml(text or "[]", topic)
        if isinstance(profiles, list) and all(isinstance(one, dict) for one in profiles):
            return profiles
    except ConfigError as error:
        reason = str(error)
    _log.warning(
        "%s: its quality of service profiles are damaged (%s)",
        topic,
        reason,
    )
    return ()


@lru_cache
def make_typestore() -> Typestore:
    """Return the message types of ROS 2 Jazzy and of the installed version of this package."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: Typesdict = {}
    folder = find_package_data() / "msg"
    for path in sorted(folder.glob("*.msg")):
        name = f"{PACKAGE}/msg/{path.stem}"
        types |= get_types_from_msg(path.read_text("utf-8"), name)
    # All types are registered in one call, because messages of this package contain each other.
    store.register(types)
    return store


def find_type_hash(msgtype: str, definition: str) -> str:
    """Return the hash by which ROS 2 identifies the definition of a message type (REP 2011).

    Args:
        msgtype: Name of the type, such as ``std_msgs/msg/String``.
        definition: Text of its definition, with the definitions of the types of its fields.

    Returns:
        The hash, such as ``RIHS01_…``; "" if the definition cannot be read.
    """
    # The type is registered in a separate store, because the installed definition may differ.
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(definition, msgtype))
        return store.hash_rihs01(msgtype)
    except (TypesysError, SerdeError, KeyError, SyntaxError):
        # rosbags generates Python code from the definition, which a damaged name makes invalid.
        return ""


def read_metadata(folder: Path) -> tuple[list[Path], str]:
    """Read the names of the storage files from metadata.yaml in a bag's folder.

    Returns:
        The files in the order of recording, and the mode of compression (zstd): "file" if rosbag2
        compressed whole files, "message" if it compressed single messages; any other text means
        that nothing is compressed.

    Raises:
        BagError: There is no metadata.yaml in the folder, it is damaged, or it has a newer version
            that states the files in another way.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        raise BagError(
            f"{folder}: no {FILE_NAME}: no bag, or a recording that was cut off; "
            f"./cube bag repair {folder} makes the latter readable"
        )
    # Only file names and compression are taken from metadata.yaml. Topics and times are taken from
    # the storage files, which also state them.
    advice = f"./cube bag repair {folder} writes it again"
    try:
        text = _TOPICS.sub(b"", read_bounded(path, "metadata of a bag"))
        document = parse_yaml(text, str(path))
    except (OSError, ConfigError) as error:
        raise BagError(f"{path}: damaged ({error}); {advice}") from None
    about = _as_mapping(_as_mapping(document).get("rosbag2_bagfile_information"))
    reason = "damaged (it names no files)"
    version = about.get("version")
    if isinstance(version, int) and version > METADATA_VERSION:
        reason = f"its version {version} is newer than {METADATA_VERSION}, the newest known one"
        _log.warning("%s: %s", path, reason)
    names = about.get("relative_file_paths")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise BagError(f"{path}: {reason}; {advice}")
    # Some versions of rosbag2 write "folder/file" instead of the name of the file.
    paths = [folder / Path(name).name for name in names]
    return paths, str(about.get("compression_mode") or "").lower()


def _as_mapping(value: object) -> dict[object, object]:
    """Return a value of a YAML text if it is a mapping, otherwise an empty mapping."""
    return value if isinstance(value, dict) else {}


def write_metadata(
    folder: Path,
    storage: str,
    files: Sequence[FileSummary],
) -> None:
    """Write metadata.yaml of a bag whose storage files are complete.

    Args:
        folder: Folder of the bag.
        storage: Storage format, a key of `SUFFIXES`.
        files: The storage files in the order of recording, at least one.

    Raises:
        BagError: The file cannot be written.
    """
    try:
        information = make_bag_information(storage, files)
        write_yaml(folder / FILE_NAME, {"rosbag2_bagfile_information": information})
    except ConfigError as error:
        raise BagError(str(error)) from None


def make_bag_information(
    storage: str,
    files: Sequence[FileSummary],
) -> dict[str, object]:
    """Return the content of metadata.yaml, with every key that rosbag2 requires.

    Args:
        storage: Storage format, a key of `SUFFIXES`.
        files: The storage files in the order of recording, at least one.
    """
    # Files without messages have no times, so they do not count for the time span of the bag.
    used = [file for file in files if file.msgcount] or files[:1]
    start_ns = min(file.start_ns for file in used)
    end_ns = max(file.end_ns for file in used)
    return {
        "version": METADATA_VERSION,
        "storage_identifier": storage,
        **_describe_time_span(start_ns, end_ns),
        "message_count": sum(file.msgcount for file in files),
        "topics_with_message_count": [
            _make_topic_information(connection)
            for connection in merge_connections(file.connections for file in files)
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [
            {
                "path": file.name,
                **_describe_time_span(file.start_ns, file.end_ns),
                "message_count": file.msgcount,
            }
            for file in files
        ],
        "custom_data": None,
        "ros_distro": "rosbags",
    }


def merge_connections(of_files: Iterable[Sequence[Connection]]) -> list[Connection]:
    """Return each topic of several files once, with its number of messages in all files together.

    Args:
        of_files: The topics of each file.
    """
    merged: dict[tuple[str, str], Connection] = {}
    for connections in of_files:
        for one in connections:
            key = one.topic, one.msgtype
            if key in merged:
                count = merged[key].msgcount + one.msgcount
                merged[key] = replace(merged[key], msgcount=count)
            else:
                merged[key] = one
    return list(merged.values())


def _describe_time_span(start_ns: int, end_ns: int) -> dict[str, object]:
    """Return start and duration of a span of time with the keys of metadata.yaml.

    Args:
        start_ns: Start of the span, in ns since the Unix epoch.
        end_ns: End of the span, in ns since the Unix epoch.
    """
    return {
        "starting_time": {"nanoseconds_since_epoch": start_ns},
        "duration": {"nanoseconds": max(0, end_ns - start_ns)},
    }


def _make_topic_information(connection: Connection) -> dict[str, object]:
    """Return the entry of a topic in metadata.yaml, with the keys that rosbag2 requires.

    Args:
        connection: Topic with its message type, quality of service and number of messages.
    """
    return {
        "topic_metadata": {
            "name": connection.topic,
            "type": connection.msgtype,
            "serialization_format": "cdr",
            "offered_qos_profiles": list(connection.qos),
            "type_description_hash": find_type_hash(connection.msgtype, connection.definition),
        },
        "message_count": connection.msgcount,
    }
