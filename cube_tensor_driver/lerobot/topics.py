"""Topics other than stress that become features of a data set: images, joint states and other
messages of numbers with a stamp.

Each frame gets the newest message that is stamped before the end of the frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from ..bags.read import Bag
from ..bags.recording import stamp_ns
from ..core.arrays import Single, Times
from ..core.errors import BagError
from ..messages.types import PACKAGE
from .images import IMAGE_TYPES, ImageStream, Shape
from .plan import Choices, Episode

JOINT_STATE_TYPE = "sensor_msgs/msg/JointState"
"""Message type of joint states: names, positions, velocities and efforts of a robot's joints."""

HEADER_TYPE = "std_msgs/msg/Header"
"""Message type of the header, which contains the stamp of a message."""

JOINT_FIELDS = ("position", "velocity", "effort")
"""Fields of a JointState message that have one number per joint."""

STATE_FEATURE = "observation.state"
"""Name that LeRobot requires for the feature (column) with the robot's state, such as joint
positions."""

ACTION_FEATURE = "action"
"""Name that LeRobot requires for the feature (column) with the commands to the robot."""


@dataclass
class Topic:
    """A topic of the bags that becomes a feature (column) of a data set.

    Attributes:
        msgtype: Type of its messages.
        shape: Height, width and number of bands of its images; zeros for a topic of numbers.
        names: Names of the numbers in a message, such as ``wrench.force.x``; empty for images.
        key: Name of the feature.
    """

    msgtype: str
    shape: Shape = (0, 0, 0)
    names: list[str] = field(default_factory=list)
    key: str = ""


@dataclass(frozen=True, eq=False)
class Signal:
    """The numbers in all messages on a topic of one bag.

    Attributes:
        names: Names of the D numbers in a message, such as ``wrench.force.x``.
        stamp_ns: (M,) stamps of the M messages in ascending order, in ns since the Unix epoch.
        values: (M, D) values; NaN for a number that neither the message nor an earlier one has.
    """

    names: list[str]
    stamp_ns: Times
    values: Single

    def at(
        self,
        episode: Episode,
        first: int,
        last: int,
        names: list[str],
    ) -> Single:
        """Return the newest values before the end of each of several successive frames.

        Args:
            episode: Episode of the frames.
            first: Number of the first frame in the episode.
            last: Number of the frame after the last one.
            names: Names of the wanted numbers.

        Returns:
            (frames, names) values; NaN before the first message, and for numbers that the bag does
            not have.
        """
        frames = np.arange(first, last)
        # A message belongs to the frame in which its stamp lies, as a sample of a cube does.
        frame_of_message = episode.frame_of(self.stamp_ns)
        newest = np.searchsorted(frame_of_message, frames, side="right") - 1
        has_value = newest >= 0
        shape = (len(frames), len(names))
        found = np.full(shape, np.nan, np.float32)
        for column, name in enumerate(names):
            if name in self.names:
                values = self.values[:, self.names.index(name)]
                found[has_value, column] = values[newest[has_value]]
        return found


class TopicReader:
    """Reads the topics of one bag that become features of a data set, frame by frame."""

    def __init__(self, bag: Bag, topics: dict[str, Topic]) -> None:
        """Read the topics with numbers, and prepare to read those with images.

        Args:
            bag: Open bag.
            topics: The topics by their names.
        """
        self._topics = topics
        self._sources: dict[str, Signal | ImageStream] = {}
        for name, topic in topics.items():
            if topic.msgtype in IMAGE_TYPES:
                # Images are read one by one when their frames are written, because a recording of
                # images can be larger than the memory. Topics of numbers are read completely here.
                self._sources[name] = ImageStream(bag, name, topic.shape)
            else:
                self._sources[name] = read_signal(bag, name, topic.msgtype)

    def at(
        self,
        episode: Episode,
        first: int,
        last: int,
    ) -> dict[str, Any]:
        """Return the values of all features in several successive frames.

        Args:
            episode: Episode of the frames.
            first: Number of the first frame in the episode.
            last: Number of the frame after the last one.

        Returns:
            By the names of the features: an array (frames, numbers), or a list of images.
        """
        found: dict[str, Any] = {}
        for name, topic in self._topics.items():
            source = self._sources[name]
            if isinstance(source, Signal):
                found[topic.key] = source.at(
                    episode,
                    first,
                    last,
                    topic.names,
                )
            else:
                found[topic.key] = source.at(episode, first, last)
        return found


def find_topics(paths: Sequence[Path], choices: Choices) -> dict[str, Topic]:
    """Find the topics of the bags that become features of a data set.

    Args:
        paths: Folders or files of the bags.
        choices: Topics that the user chose.

    Returns:
        The topics, by their names.

    Raises:
        BagError: A chosen topic does not exist in any bag, or its type differs between bags.
    """
    found: dict[str, Topic] = {}
    existing: set[str] = set()
    wanted = set(choices.topics or ())
    wanted |= {topic for topic in (choices.state, choices.action) if topic}
    for path in paths:
        with Bag(path) as bag:
            frequencies = choices.frequencies or f"{bag.skin()}frequencies"
            prefix = frequencies.removesuffix("frequencies")
            for topic, msgtype in _stamped_topics(bag, prefix):
                existing.add(topic)
                if choices.topics is None or topic in wanted:
                    _describe_topic(bag, topic, msgtype, found)
    missing = sorted(wanted - found.keys())
    if missing:
        raise BagError(
            f"{paths[0]}: no images and no stamped numbers on {', '.join(missing)}; there are "
            f"{', '.join(sorted(existing)) or 'none'}"
        )
    # JointState messages may contain no joints; such a topic has no numbers and is left out.
    used = {}
    for name, described in found.items():
        if described.names or any(described.shape):
            used[name] = described
    joints = [name for name in used if used[name].msgtype == JOINT_STATE_TYPE]
    # If there are several topics of joint states, only the user can decide which one is the state.
    others = [name for name in joints if name != choices.action]
    state = choices.state
    if state is None and len(others) == 1:
        state = others[0]
    for name, described in used.items():
        dotted = name.strip("/").replace("/", ".")
        kind = "images" if described.msgtype in IMAGE_TYPES else "topics"
        described.key = f"observation.{kind}.{dotted}"
        if name == choices.action:
            described.key = ACTION_FEATURE
        if name == state:
            described.key = STATE_FEATURE
    return used


def _describe_topic(
    bag: Bag,
    name: str,
    msgtype: str,
    found: dict[str, Topic],
) -> None:
    """Add the names of the numbers, or the shape of the images, on a topic to its description.

    Args:
        bag: Open bag that has the topic.
        name: Name of the topic.
        msgtype: Type of its messages in this bag.
        found: Descriptions by the names of the topics; that of this topic is added or extended.

    Raises:
        BagError: The topic has another type in a bag that was read before.
    """
    topic = found.setdefault(name, Topic(msgtype))
    if topic.msgtype != msgtype:
        raise BagError(
            f"{bag.path}: {name} is {msgtype}, in other bags {topic.msgtype}; leave it out by "
            "naming the others with --topics"
        )
    if msgtype not in IMAGE_TYPES:
        # Bags may contain different joints, so the feature gets the joints of all bags.
        names = read_signal(bag, name, msgtype).names
        topic.names += [one for one in names if one not in topic.names]
    elif not any(topic.shape):
        topic.shape = ImageStream(bag, name).shape


def read_signal(
    bag: Bag,
    topic: str,
    msgtype: str,
) -> Signal:
    """Read the numbers in all messages on a topic.

    Args:
        bag: Open bag.
        topic: Name of the topic.
        msgtype: Type of its messages: JointState, or another one with a header and numbers.

    Raises:
        BagError: The bag is damaged, or a JointState has more or fewer values than joint names.
    """
    names: dict[str, int] = {}
    messages: list[tuple[int, dict[str, float]]] = []
    fixed = _number_names(bag, msgtype)
    for entry in bag.entries({topic}):
        message = bag.decode(entry)
        if msgtype == JOINT_STATE_TYPE:
            numbers = _joint_numbers(message, f"{bag.path}: {topic}")
        else:
            numbers = {name: _value(message, name) for name in fixed}
        for name in numbers:
            names.setdefault(name, len(names))
        messages.append((stamp_ns(message), numbers))
    messages.sort(key=lambda one: one[0])

    shape = (len(messages), len(names))
    values = np.full(shape, np.nan, np.float32)
    for row, (_, numbers) in zip(values, messages, strict=True):
        # Each number is put into the column of its name, because the order of the joints may differ
        # between messages.
        columns = [names[name] for name in numbers]
        row[columns] = list(numbers.values())
    # A JointState may contain only some of the joints; the others keep their latest values.
    rows = np.arange(len(values))[:, np.newaxis]
    rows_with_value = np.where(np.isnan(values), 0, rows)
    newest = np.maximum.accumulate(rows_with_value, axis=0)
    values = np.take_along_axis(values, newest, axis=0)
    stamps = np.array([stamp for stamp, _ in messages], np.int64)
    return Signal(list(names), stamps, values)


def _stamped_topics(bag: Bag, skin: str) -> list[tuple[str, str]]:
    """Return name and type of the topics with images, joint states or other stamped numbers.

    Topics of single cubes are left out, because the stress of the skin contains the same numbers.

    Args:
        bag: Open bag.
        skin: Common prefix of the names of the skin's topics; those of single cubes have
            ``cubes/`` after it.
    """
    found = []
    for one in bag.connections:
        is_of_cube = one.topic.startswith(f"{skin}cubes/")
        is_known = one.msgtype in (JOINT_STATE_TYPE, *IMAGE_TYPES)
        is_usable = is_known or _number_names(bag, one.msgtype)
        if one.msgcount and is_usable and not is_of_cube:
            found.append((one.topic, one.msgtype))
    return sorted(found)


def _number_names(bag: Bag, msgtype: str) -> list[str]:
    """Return the names of the numbers in messages of a type, such as ``wrench.force.x``.

    The list is empty if the type has no header (and therefore no stamp), contains a list of
    variable length, or belongs to this package.
    """
    fields = bag.fields(msgtype)
    has_header = bool(fields) and fields[0][1] == (Nodetype.NAME, HEADER_TYPE)
    if not has_header or msgtype.startswith(PACKAGE):
        return []
    names = list(_numbers(bag, fields[1:], ""))
    return [] if None in names else [name for name in names if name]


def _numbers(
    bag: Bag,
    fields: list[tuple[str, Any]],
    prefix: str,
) -> Iterator[str | None]:
    """Yield the names of the numbers in a message type, including those in nested messages.

    Args:
        bag: Open bag, which knows the fields of nested types.
        fields: Name and kind of each field, as `Bag.fields` returns them.
        prefix: Path of the fields within the outermost message, ending in "."; "" for its own.

    Yields:
        Names such as ``wrench.force.x``; None for a field that is not a fixed set of numbers, such
        as a list of variable length.
    """
    for name, (node, kind) in fields:
        if node == Nodetype.NAME:
            yield from _numbers(bag, bag.fields(kind), f"{prefix}{name}.")
        elif node == Nodetype.BASE:
            if kind[0] != "string":
                yield f"{prefix}{name}"
        elif node == Nodetype.ARRAY and kind[0][0] == Nodetype.BASE:
            yield from (f"{prefix}{name}.{k}" for k in range(kind[1]))
        else:
            yield None


def _joint_numbers(message: Any, where: str) -> dict[str, float]:
    """Return the numbers in a JointState message by their names, such as ``elbow.position``.

    Args:
        message: The message, which may contain only some of the robot's joints.
        where: Bag and topic, for errors.

    Raises:
        BagError: The message has more or fewer values of a quantity than joint names.
    """
    numbers = {}
    for quantity in JOINT_FIELDS:
        values = getattr(message, quantity)
        if len(values) and len(values) != len(message.name):
            raise BagError(
                f"{where}: a message has {len(message.name)} joints and {len(values)} values of "
                f"{quantity}; leave the topic out by naming the others with --topics"
            )
        for name, value in zip(message.name, values, strict=False):
            numbers[f"{name}.{quantity}"] = float(value)
    return numbers


def _value(message: Any, name: str) -> float:
    """Return the number in a message that a path such as ``wrench.force.x`` names."""
    for part in name.split("."):
        # A part that consists of digits is an index of an array, because names of fields in ROS
        # begin with a letter.
        is_place = part.isdigit()
        message = message[int(part)] if is_place else getattr(message, part)
    return float(message)
