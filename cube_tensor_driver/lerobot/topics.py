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
from typing import TYPE_CHECKING

import numpy as np
from rosbags.interfaces import Nodetype

from ..bags.read import Bag, list_message_fields, stamp_ns
from ..core.arrays import Single, Times
from ..core.errors import BagError
from ..messages.types import PACKAGE
from .images import IMAGE_TYPES, LEAVE_OUT, ImageStream, Shape, encode
from .plan import Choices

if TYPE_CHECKING:
    from geometry_msgs.msg import WrenchStamped
    from rosbags.interfaces.typing import Fielddefs
    from sensor_msgs.msg import JointState


JOINT_STATE_TYPE = "sensor_msgs/msg/JointState"
"""Message type of joint states: names, positions, velocities and efforts of a robot's joints."""

HEADER_KIND = (Nodetype.NAME, "std_msgs/msg/Header")
"""Type, as the library rosbags describes it, of the field with a message's header and stamp."""

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
        key: Name of the feature.
        shape: Height, width and number of bands of its images; one pixel if there is no image.
        names: Names of the numbers in all of its messages; empty for images.
    """

    name: str
    msgtype: str
    key: str
    shape: Shape = (1, 1, 1)
    names: dict[str, None] = field(default_factory=dict)

    @property
    def is_image(self) -> bool:
        """Whether the messages of the topic are images."""
        return self.msgtype in IMAGE_TYPES

    def describe(self, bag: Bag) -> None:
        """Read the messages in a bag, to extend `names` or, for images, to set `shape`."""
        if not self.is_image:
            # Bags may contain different joints, so the feature gets the joints of all bags.
            for _, numbers in _read_numbers(bag, self):
                self.names |= dict.fromkeys(numbers)
        elif self.shape == Topic.shape:
            for _, message in bag.read_decoded({self.name}):
                _, self.shape = encode(message, f"{bag.path}: {self.name}")
                return

    def open(self, bag: Bag) -> ImageStream | Signal:
        """Read the topic's numbers in a bag, or prepare to read its images there.

        Images are read one by one when their frames are written, because a recording of images can
        be larger than the memory.
        """
        if self.is_image:
            return ImageStream(
                bag,
                self.name,
                self.shape,
            )
        return Signal(bag, self)


class Signal:
    """The numbers in all messages on a topic of one bag."""

    def __init__(self, bag: Bag, topic: Topic) -> None:
        """Read the numbers, such as joint positions, from all messages on the topic.

        Args:
            bag: Open bag.
            topic: The topic. Its `names` must contain the numbers of every bag of the data set (see
                `Topic.describe`), because each name becomes a column for every bag.

        Raises:
            BagError: The bag is damaged, or a JointState has more or fewer values than joint names.
        """
        messages = sorted(_read_numbers(bag, topic), key=itemgetter(0))
        self._stamp_ns: Times = np.array([stamp for stamp, _ in messages], np.int64)
        # Row k has the numbers that hold after k messages. A JointState may contain only some of
        # the joints. The others keep their latest values, which are NaN until a message has them.
        latest = dict.fromkeys(topic.names, np.nan)
        self._values: Single = np.full(
            (len(messages) + 1, len(latest)),
            np.nan,
            np.float32,
        )
        for row, (_, numbers) in enumerate(messages, 1):
            latest |= numbers
            self._values[row] = list(latest.values())

    def at(self, ends_ns: Times) -> Single:
        """Return the newest values (frames, numbers) before the end of each frame.

        They are NaN before the first message, and for numbers that the bag does not have.

        Args:
            ends_ns: (frames,) ends of frames, in ns since the Unix epoch.
        """
        n_before = np.searchsorted(self._stamp_ns, ends_ns)
        return self._values[n_before]


def find_topics(paths: Sequence[Path], choices: Choices) -> list[Topic]:
    """Find the topics of the bags that become features of a data set.

    Args:
        paths: Folders or files of the bags.
        choices: Topics that the user chose.

    Raises:
        BagError: A chosen topic does not exist in any bag, or its type differs between bags.
    """
    found: dict[str, Topic] = {}
    existing: set[str] = set()
    named = [
        *(choices.topics or ()),
        choices.state,
        choices.action,
    ]
    wanted = {topic for topic in named if topic}
    for path in paths:
        with Bag(path) as bag:
            frequencies = choices.frequencies or f"{bag.find_skin_prefix()}frequencies"
            cubes = frequencies.removesuffix("frequencies") + "cubes/"
            for one in sorted(bag.connections, key=attrgetter("topic")):
                # Topics of single cubes are left out: the stress of the skin has their numbers.
                name, msgtype = one.topic, one.msgtype
                if not one.msgcount or name.startswith(cubes) or not _is_usable(msgtype):
                    continue
                existing.add(name)
                if choices.topics is not None and name not in wanted:
                    continue
                kind = "images" if msgtype in IMAGE_TYPES else "topics"
                key = f"observation.{kind}.{name.strip('/').replace('/', '.')}"
                topic = found.setdefault(
                    name,
                    Topic(
                        name,
                        msgtype,
                        key,
                    ),
                )
                if topic.msgtype != msgtype:
                    raise BagError(
                        f"{path}: {name} is {msgtype}, in other bags {topic.msgtype}; {LEAVE_OUT}"
                    )
                topic.describe(bag)
    missing = sorted(wanted - found.keys())
    if missing:
        raise BagError(
            f"{paths[0]}: no images and no stamped numbers on {', '.join(missing)}; there are "
            f"{', '.join(sorted(existing)) or 'none'}"
        )
    # JointState messages may contain no joints; such a topic has no numbers and is left out.
    used: dict[str | None, Topic] = {
        name: topic for name, topic in found.items() if topic.names or topic.is_image
    }
    joints = [name for name, topic in used.items() if topic.msgtype == JOINT_STATE_TYPE]
    # If there are several topics of joint states, only the user can decide which one is the state.
    others = [name for name in joints if name != choices.action]
    state = choices.state or (others[0] if len(others) == 1 else None)
    for chosen, key in ((choices.action, ACTION_FEATURE), (state, STATE_FEATURE)):
        if chosen in used:
            used[chosen].key = key
    return list(used.values())


def _is_usable(msgtype: str) -> bool:
    """Return whether messages of a type can become a feature."""
    return msgtype in (JOINT_STATE_TYPE, *IMAGE_TYPES) or bool(_number_paths(msgtype))


def _read_numbers(
    bag: Bag,
    topic: Topic,
) -> Iterator[tuple[int, dict[str, float]]]:
    """Yield the stamp, in ns, and the numbers by their names of each message on a topic."""
    paths = _number_paths(topic.msgtype)
    messages: Iterator[tuple[int, JointState | WrenchStamped]] = bag.read_decoded({topic.name})
    for _, message in messages:
        if topic.msgtype == JOINT_STATE_TYPE:
            numbers = _find_joint_numbers(message, f"{bag.path}: {topic.name}")
        else:
            numbers = {}
            for path in paths:
                value = attrgetter(path)(message)
                if np.ndim(value):
                    numbers |= {f"{path}.{k}": float(one) for k, one in enumerate(value)}
                else:
                    numbers[path] = float(value)
        yield stamp_ns(message), numbers


def _number_paths(msgtype: str) -> list[str]:
    """Return the paths of the numbers in messages of a type, such as ``wrench.force.x``.

    The list is empty if the type has no header (and therefore no stamp), contains a list of
    variable length, or belongs to this package.
    """
    fields = list_message_fields(msgtype)
    if not fields or fields[0][1] != HEADER_KIND or msgtype.startswith(PACKAGE):
        return []
    paths = list(_find_nested_paths(fields[1:], ""))
    return [] if None in paths else [path for path in paths if path]


def _find_nested_paths(fields: Fielddefs, prefix: str) -> Iterator[str | None]:
    """Yield the paths of the numbers in some fields, including those in nested messages.

    Args:
        fields: Name and kind (type, as the library rosbags describes it) of each field, as
            `list_message_fields` returns them.
        prefix: Path from the outermost message to these fields, ending in "."; "" if they are the
            fields of the outermost message itself.

    Yields:
        Path of a number or of a list of numbers of fixed length; None for a field of another kind,
        such as a list of variable length.
    """
    for name, field_kind in fields:
        # For a list of fixed length, the second element of its kind is (kind of element, length).
        kind = field_kind[1][0] if field_kind[0] == Nodetype.ARRAY else field_kind
        if field_kind[0] == Nodetype.NAME:
            yield from _find_nested_paths(list_message_fields(field_kind[1]), f"{prefix}{name}.")
        elif kind[0] != Nodetype.BASE:
            yield None
        elif kind[1][0] != "string":
            yield f"{prefix}{name}"


def _find_joint_numbers(message: JointState, where: str) -> dict[str, float]:
    """Return the numbers in a JointState message by their names, such as ``elbow.position``.

    Args:
        message: The message, which may contain only some of the robot's joints.
        where: Bag and topic, for errors.

    Raises:
        BagError: The message has more or fewer values of a quantity than joint names.
    """
    numbers = {}
    joints = message.name
    for quantity in JOINT_FIELDS:
        values = getattr(message, quantity)
        if len(values) not in (0, len(joints)):
            raise BagError(
                f"{where}: a message has {len(joints)} joints and {len(values)} values of "
                f"{quantity}; {LEAVE_OUT}"
            )
        for joint, value in zip(
            joints,
            values,
            strict=False,
        ):
            numbers[f"{joint}.{quantity}"] = float(value)
    return numbers
