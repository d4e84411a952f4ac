# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Topics other than stress that become features of a data set: images, joint states and other
messages of numbers with a stamp.

Each frame gets the newest message that is stamped before the end of the frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.interfaces import Nodetype

from ..bags.read import Bag, message_fields, stamp_ns
from ..core.arrays import Single, Times
from ..core.errors import BagError
from ..messages.types import PACKAGE
from .images import IMAGE_TYPES, ImageStream, Shape
from .plan import Choices, Episode

if TYPE_CHECKING:
    from sensor_msgs.msg import JointState

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
        name: Name of the topic.
        msgtype: Type of its messages.
        shape: Height, width and number of bands of its images; zeros for a topic of numbers.
        names: Names of the numbers in a message, such as ``wrench.force.x``; empty for images.
        key: Name of the feature.
    """

    name: str
    msgtype: str
    shape: Shape = (0, 0, 0)
    names: list[str] = field(default_factory=list)
    key: str = ""

    @property
    def is_image(self) -> bool:
        """Whether the messages of the topic are images."""
        return self.msgtype in IMAGE_TYPES

    def describe(self, bag: Bag) -> None:
        """Read the messages in a bag, to extend `names` or, for images, to set `shape`."""
        if not self.is_image:
            # Bags may contain different joints, so the feature gets the joints of all bags.
            names = dict.fromkeys(self.names)
            for _, numbers in _read_numbers(bag, self):
                names |= dict.fromkeys(numbers)
            self.names = list(names)
        elif not any(self.shape):
            self.shape = ImageStream(bag, self.name).shape

    def open(self, bag: Bag) -> ImageStream | Signal:
        """Read the topic's numbers in a bag, or prepare to read its images there.

        Images are read one by one when their frames are written, because a recording of images can
        be larger than the memory.
        """
        if self.is_image:
            return ImageStream(bag, self.name, self.shape)
        return Signal(bag, self)


class Signal:
    """The numbers in all messages on a topic of one bag."""

    def __init__(self, bag: Bag, topic: Topic) -> None:
        """Read the numbers.

        Args:
            bag: Open bag.
            topic: The topic. Its `names` are those of the numbers in all bags of the data set.

        Raises:
            BagError: The bag is damaged, or a JointState has more or fewer values than joint names.
        """
        messages = list(_read_numbers(bag, topic))
        messages.sort(key=itemgetter(0))
        stamps = [stamp for stamp, _ in messages]
        self._stamp_ns: Times = np.array(stamps, np.int64)
        # Row k + 1 of `_values` has the numbers that hold after message k; row 0 is NaN. A
        # JointState may contain only some of the joints. The others keep their latest values, which
        # are NaN until a message contains them.
        latest = dict.fromkeys(topic.names, np.nan)
        shape = (len(messages) + 1, len(latest))
        self._values: Single = np.full(shape, np.nan, np.float32)
        rows = self._values[1:]
        for row, (_, numbers) in zip(rows, messages, strict=True):
            latest |= numbers
            row[:] = list(latest.values())

    def at(
        self,
        episode: Episode,
        first: int,
        last: int,
    ) -> Single:
        """Return the newest values before the end of each of several successive frames.

        Args:
            episode: Episode of the frames (time steps of the data set).
            first: Number of the first frame in the episode.
            last: Number of the frame after the last one.

        Returns:
            (frames, numbers) values; NaN before the first message, and for numbers that the bag
            does not have.
        """
        # The row for a frame (time step) is the number of messages with stamps up to its end.
        frame_of_message = episode.frame_of(self._stamp_ns)
        frames = np.arange(first, last)
        row = np.searchsorted(frame_of_message, frames, side="right")
        values: Single = self._values[row]
        return values


def find_topics(
    paths: Sequence[Path],
    choices: Choices,
) -> list[Topic]:
    """Find the topics of the bags that become features of a data set.

    Args:
        paths: Folders or files of the bags.
        choices: Topics that the user chose.

    Raises:
        BagError: A chosen topic does not exist in any bag, or its type differs between bags.
    """
    found: dict[str, Topic] = {}
    existing: set[str] = set()
    named = choices.topics or ()
    chosen = [*named, choices.state, choices.action]
    wanted = {topic for topic in chosen if topic}
    for path in paths:
        with Bag(path) as bag:
            frequencies = choices.frequencies or f"{bag.skin_prefix()}frequencies"
            prefix = frequencies.removesuffix("frequencies")
            for name, msgtype in _find_stamped_topics(bag, prefix):
                existing.add(name)
                if choices.topics is not None and name not in wanted:
                    continue
                topic = found.setdefault(name, Topic(name, msgtype))
                if topic.msgtype != msgtype:
                    raise BagError(
                        f"{path}: {name} is {msgtype}, in other bags {topic.msgtype}; leave it out "
                        "by naming the others with --topics"
                    )
                topic.describe(bag)
    missing = sorted(wanted - found.keys())
    if missing:
        raise BagError(
            f"{paths[0]}: no images and no stamped numbers on {', '.join(missing)}; there are "
            f"{', '.join(sorted(existing)) or 'none'}"
        )
    # JointState messages may contain no joints; such a topic has no numbers and is left out.
    topics = found.values()
    used = [topic for topic in topics if topic.names or topic.is_image]
    joints = [topic.name for topic in used if topic.msgtype == JOINT_STATE_TYPE]
    # If there are several topics of joint states, only the user can decide which one is the state.
    others = [name for name in joints if name != choices.action]
    state = choices.state
    if state is None and len(others) == 1:
        state = others[0]
    for topic in used:
        dotted = topic.name.strip("/").replace("/", ".")
        kind = "images" if topic.is_image else "topics"
        topic.key = f"observation.{kind}.{dotted}"
        if topic.name == choices.action:
            topic.key = ACTION_FEATURE
        if topic.name == state:
            topic.key = STATE_FEATURE
    return used


def _read_numbers(
    bag: Bag,
    topic: Topic,
) -> Iterator[tuple[int, dict[str, float]]]:
    """Read the numbers in all messages on a topic, in the order of recording.

    Args:
        bag: Open bag.
        topic: The topic: JointState, or another type with a header and numbers.

    Yields:
        Stamp of a message, in ns since the Unix epoch, and its numbers by their names, such as
        ``elbow.position`` or ``wrench.force.x``.

    Raises:
        BagError: The bag is damaged, or a JointState has more or fewer values than joint names.
    """
    paths = _number_paths(topic.msgtype)
    for _, message in bag.decoded({topic.name}):
        if topic.msgtype == JOINT_STATE_TYPE:
            numbers = _find_joint_numbers(message, f"{bag.path}: {topic.name}")
        else:
            numbers = {}
            for path in paths:
                value = attrgetter(path)(message)
                if np.ndim(value) == 0:
                    numbers[path] = float(value)
                    continue
                for k, one in enumerate(value):
                    numbers[f"{path}.{k}"] = float(one)
        yield stamp_ns(message), numbers


def _find_stamped_topics(
    bag: Bag,
    skin: str,
) -> list[tuple[str, str]]:
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
        is_usable = is_known or _number_paths(one.msgtype)
        if one.msgcount and is_usable and not is_of_cube:
            found.append((one.topic, one.msgtype))
    return sorted(found)


def _number_paths(msgtype: str) -> list[str]:
    """Return the paths of the numbers in messages of a type, such as ``wrench.force.x``.

    The list is empty if the type has no header (and therefore no stamp), contains a list of
    variable length, or belongs to this package.
    """
    fields = message_fields(msgtype)
    if not fields or msgtype.startswith(PACKAGE):
        return []
    _, first = fields[0]
    if first != (Nodetype.NAME, HEADER_TYPE):
        return []
    paths = list(_list_nested_paths(fields[1:], ""))
    return [] if None in paths else [path for path in paths if path]


def _list_nested_paths(
    fields: list[tuple[str, Any]],
    prefix: str,
) -> Iterator[str | None]:
    """Yield the paths of the numbers in a message type, including those in nested messages.

    Args:
        fields: Name and kind of each field, as `message_fields` returns them.
        prefix: Path from the outermost message to these fields, ending in "."; "" if they are the
            fields of the outermost message itself.

    Yields:
        Paths such as ``wrench.force.x``, of a number or of a list of numbers of fixed length; None
        for a field of another kind, such as a list of variable length.
    """
    for name, (node, kind) in fields:
        if node == Nodetype.NAME:
            yield from _list_nested_paths(message_fields(kind), f"{prefix}{name}.")
            continue
        # For a list of fixed length, `kind` is a pair: (node and kind of an element, length).
        if node == Nodetype.ARRAY:
            node, kind = kind[0]
        if node != Nodetype.BASE:
            yield None
        elif kind[0] != "string":
            yield f"{prefix}{name}"


def _find_joint_numbers(
    message: JointState,
    where: str,
) -> dict[str, float]:
    """Return the numbers in a JointState message by their names, such as ``elbow.position``.

    Args:
        message: The message, which may contain only some of the robot's joints.
        where: Bag and topic, for errors.

    Raises:
        BagError: The message has more or fewer values of a quantity than joint names.
    """
    numbers = {}
    names = message.name
    for quantity in JOINT_FIELDS:
        values = getattr(message, quantity)
        if len(values) and len(values) != len(names):
            raise BagError(
                f"{where}: a message has {len(names)} joints and {len(values)} values of "
                f"{quantity}; leave the topic out by naming the others with --topics"
            )
        for name, value in zip(names, values, strict=False):
            numbers[f"{name}.{quantity}"] = float(value)
    return numbers
