"""Other topics of the bags in a data set: images, joint states and numbers with a stamp.

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
from .images import IMAGES, ImageStream, Shape
from .plan import Choices, Episode

JOINTS = "sensor_msgs/msg/JointState"
HEADER = "std_msgs/msg/Header"
JOINT_FIELDS = ("position", "velocity", "effort")
STATE, ACTION = "observation.state", "action"


@dataclass
class Topic:
    """A topic that is added to a data set.

    Attributes:
        msgtype: Type of its messages.
        shape: Shape of its images; zeros for numbers.
        names: Names of its numbers; empty for images.
        key: Name of its feature.
    """

    msgtype: str
    shape: Shape = (0, 0, 0)
    names: list[str] = field(default_factory=list)
    key: str = ""


@dataclass(frozen=True, eq=False)
class Signal:
    """The numbers on a topic.

    Attributes:
        names: Names of the D numbers.
        stamp_ns: (M,) stamps in ascending order, in ns.
        values: (M, D) values.
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
        """Return the newest values (last - first, len(names)) before the end of each frame.

        They are NaN before the first message, and for names that the bag does not have.
        """
        frames = np.arange(first, last)
        # What is stamped in a frame belongs to it, as samples do.
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
    """Reads the values of the other topics of one bag, frame by frame."""

    def __init__(self, bag: Bag, topics: dict[str, Topic]) -> None:
        """Read the numbers, and prepare to read the images.

        Args:
            bag: Open bag.
            topics: The topics by their names.
        """
        self._topics = topics
        self._sources: dict[str, Signal | ImageStream] = {}
        for name, topic in topics.items():
            if topic.msgtype in IMAGES:
                # Images stay in the bag until their frame comes; numbers fit the memory.
                self._sources[name] = ImageStream(bag, name, topic.shape)
            else:
                self._sources[name] = read_signal(bag, name, topic.msgtype)

    def at(
        self,
        episode: Episode,
        first: int,
        last: int,
    ) -> dict[str, Any]:
        """Return the values in the frames from first to before last, by the features' names."""
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
    """Find the topics that are added, by their names.

    Raises:
        BagError: A chosen topic is not there, or bags differ in its type.
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
    # Joint states may be without any joint.
    used = {}
    for name, described in found.items():
        if described.names or any(described.shape):
            used[name] = described
    joints = [name for name in used if used[name].msgtype == JOINTS]
    # Of several robots only the user can tell whose state is meant.
    others = [name for name in joints if name != choices.action]
    state = choices.state
    if state is None and len(others) == 1:
        state = others[0]
    for name, described in used.items():
        dotted = name.strip("/").replace("/", ".")
        kind = "images" if described.msgtype in IMAGES else "topics"
        described.key = f"observation.{kind}.{dotted}"
        if name == choices.action:
            described.key = ACTION
        if name == state:
            described.key = STATE
    return used


def _describe_topic(
    bag: Bag,
    name: str,
    msgtype: str,
    found: dict[str, Topic],
) -> None:
    """Add what a bag has on a topic to the description of the topic."""
    topic = found.setdefault(name, Topic(msgtype))
    if topic.msgtype != msgtype:
        raise BagError(
            f"{bag.path}: {name} is {msgtype}, in other bags {topic.msgtype}; leave it out by "
            "naming the others with --topics"
        )
    if msgtype not in IMAGES:
        # Bags may be about different joints: the feature has the names of all.
        names = read_signal(bag, name, msgtype).names
        topic.names += [one for one in names if one not in topic.names]
    elif not any(topic.shape):
        topic.shape = ImageStream(bag, name).shape


def read_signal(
    bag: Bag,
    topic: str,
    msgtype: str,
) -> Signal:
    """Read the numbers of all messages on a topic.

    Raises:
        BagError: The bag is damaged, or a joint has no name.
    """
    names: dict[str, int] = {}
    messages: list[tuple[int, dict[str, float]]] = []
    fixed = _number_names(bag, msgtype)
    for entry in bag.entries({topic}):
        message = bag.decode(entry)
        if msgtype == JOINTS:
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
        # Messages may name the joints in different orders.
        columns = [names[name] for name in numbers]
        row[columns] = list(numbers.values())
    # A message about some of the joints leaves the others as they were.
    rows = np.arange(len(values))[:, np.newaxis]
    rows_with_value = np.where(np.isnan(values), 0, rows)
    newest = np.maximum.accumulate(rows_with_value, axis=0)
    values = np.take_along_axis(values, newest, axis=0)
    stamps = np.array([stamp for stamp, _ in messages], np.int64)
    return Signal(list(names), stamps, values)


def _stamped_topics(bag: Bag, skin: str) -> list[tuple[str, str]]:
    """Return name and type of the topics with images, joint states or other stamped numbers.

    Topics of single cubes (below ``cubes/`` of the skin with the prefix `skin`) are left out: their
    content is in the stress, too.
    """
    found = []
    for one in bag.connections:
        is_of_cube = one.topic.startswith(f"{skin}cubes/")
        is_known = one.msgtype in (JOINTS, *IMAGES)
        is_usable = is_known or _number_names(bag, one.msgtype)
        if one.msgcount and is_usable and not is_of_cube:
            found.append((one.topic, one.msgtype))
    return sorted(found)


def _number_names(bag: Bag, msgtype: str) -> list[str]:
    """Return the names of a type's numbers; none without a header, or with a list of any length."""
    fields = bag.fields(msgtype)
    has_header = bool(fields) and fields[0][1] == (Nodetype.NAME, HEADER)
    if not has_header or msgtype.startswith(PACKAGE):
        return []
    names = list(_numbers(bag, fields[1:], ""))
    return [] if None in names else [name for name in names if name]


def _numbers(
    bag: Bag,
    fields: list[tuple[str, Any]],
    prefix: str,
) -> Iterator[str | None]:
    """Yield the names of the numbers in fields; None stands for a list of any length."""
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
    """Return the numbers of a JointState, which may be about some of the joints only."""
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
    """Return the number of a message that a path such as ``wrench.force.x`` names."""
    for part in name.split("."):
        # A part of digits is a place in an array; no field has such a name.
        is_place = part.isdigit()
        message = message[int(part)] if is_place else getattr(message, part)
    return float(message)
