# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Topics other than stress that become features of a data set: images, joint states and other
messages of numbers with a stamp.

Each frame gets the newest message that is stamped before the end of the frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, is_dataclass
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, SupportsFloat, cast

import numpy as np
from rosbags.interfaces import Nodetype

from ..bags.metadata import make_typestore
from ..bags.read import Bag, list_message_fields, read_stamp_ns
from ..core.arrays import Single, Times
from ..core.errors import BagError
from ..messages.types import PACKAGE
from .images import IMAGE_TYPES, LEAVE_OUT, Shape, encode, make_black_image
from .plan import Choices

if TYPE_CHECKING:
    from geometry_msgs.msg import WrenchStamped
    from sensor_msgs.msg import CompressedImage, Image, JointState

JOINT_STATE_TYPE = "sensor_msgs/msg/JointState"
"""Message type of joint states: names, positions, velocities and efforts of a robot's joints."""

HEADER_KIND = (Nodetype.NAME, "std_msgs/msg/Header")
"""Type, as the library rosbags describes it, of the field with a message's header and stamp."""

LIST_SIGNS = ("[]", "[<=")
"""Signs of lists of variable length in the definition of a message type."""

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
        shape: Height, width and number of bands of its images; None until one has been read.
        names: Names of the numbers in all of its messages; empty for images.
    """

    name: str
    msgtype: str
    shape: Shape | None = None
    names: dict[str, None] = field(default_factory=dict)

    def describe(self, bag: Bag) -> None:
        """Read the messages in a bag, to extend `names` or, for images, to set `shape`."""
        if self.msgtype not in IMAGE_TYPES:
            # Bags may contain different joints, so the feature gets the joints of all bags.
            for _, numbers in self._read_numbers(bag):
                self.names |= dict.fromkeys(numbers)
                # Messages of other types have the same numbers in every message.
                if self.msgtype != JOINT_STATE_TYPE:
                    return
        elif self.shape is None:
            for _, message in bag.read_decoded({self.name}):
                _, self.shape = encode(message, f"{bag.path}: {self.name}")
                return

    def sample(
        self,
        bag: Bag,
        blocks: Iterable[Times],
    ) -> Iterator[Single | list[bytes]]:
        """Yield the newest values before the ends of some frames, one block of frames at a time.

        Before the first message, numbers are NaN and images are black. So they are in bags that do
        not have the topic.

        Args:
            bag: Open bag.
            blocks: (frames,) ends of frames in rising order, in ns since the Unix epoch.

        Yields:
            The numbers (frames, numbers), or the contents of the image files.

        Raises:
            BagError: The bag is damaged, a message has more or fewer values than joints, or an
                image cannot be read or has another shape than the first one.
        """
        if self.shape is None:
            yield from self._sample_numbers(bag, blocks)
            return
        where = f"{bag.path}: {self.name}"
        file = make_black_image(self.shape)
        # Images are read one by one, because a recording of images can be larger than the memory.
        messages: Iterator[tuple[int, Image | CompressedImage]] = bag.read_decoded({self.name})
        following: Image | CompressedImage | None
        _, following = next(messages, (0, None))
        for ends_ns in blocks:
            files = []
            for end_ns in ends_ns:
                newest = None
                while following is not None and read_stamp_ns(following) < end_ns:
                    newest = following
                    _, following = next(messages, (0, None))
                # Only the last image before the end is encoded, because encoding is slow.
                if newest is not None:
                    file, shape = encode(newest, where)
                    if shape != self.shape:
                        raise BagError(
                            f"{where}: an image of {shape} after ones of {self.shape}; {LEAVE_OUT}"
                        )
                files.append(file)
            yield files

    def _sample_numbers(
        self,
        bag: Bag,
        blocks: Iterable[Times],
    ) -> Iterator[Single]:
        """Yield the newest numbers before the ends of some frames; see `sample`."""
        messages = sorted(self._read_numbers(bag), key=itemgetter(0))
        stamps_ns = [stamp for stamp, _ in messages]
        # Row k has the numbers that hold after k messages. A JointState may contain only some of
        # the joints. The others keep their latest values, which are NaN until a message has them.
        latest = dict.fromkeys(self.names, np.nan)
        rows = [list(latest.values())]
        for _, numbers in messages:
            latest |= numbers
            rows.append(list(latest.values()))
        values = np.array(rows, np.float32)
        for ends_ns in blocks:
            yield values[np.searchsorted(stamps_ns, ends_ns)]

    def _read_numbers(self, bag: Bag) -> Iterator[tuple[int, dict[str, float]]]:
        """Yield the stamp, in ns, and the numbers by their names of each message."""
        messages: Iterator[tuple[int, JointState | WrenchStamped]] = bag.read_decoded({self.name})
        for _, message in messages:
            if self.msgtype == JOINT_STATE_TYPE:
                numbers = _find_joint_numbers(message, f"{bag.path}: {self.name}")
            else:
                numbers = _find_numbers(vars(message).items(), "")
            yield read_stamp_ns(message), numbers


def find_topics(paths: Sequence[Path], choices: Choices) -> dict[str, Topic]:
    """Find the topics of the bags that become features of a data set.

    Args:
        paths: Folders or files of the bags.
        choices: Topics that the user chose.

    Returns:
        The topics by the names of the features.

    Raises:
        BagError: A chosen topic does not exist in any bag, or its type differs between bags.
    """
    found: dict[str, Topic] = {}
    named = [*(choices.topics or ()), choices.state, choices.action]
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
                topic = found.setdefault(name, Topic(name, msgtype))
                if choices.topics is not None and name not in wanted:
                    continue
                if topic.msgtype != msgtype:
                    raise BagError(
                        f"{path}: {name} is {msgtype}, in other bags {topic.msgtype}; {LEAVE_OUT}"
                    )
                topic.describe(bag)
    # Topics that were not chosen have not been described. JointState messages may have no joints.
    used = [topic for topic in found.values() if topic.names or topic.shape]
    missing = sorted(wanted.difference(topic.name for topic in used))
    if missing:
        raise BagError(
            f"{paths[0]}: no images and no stamped numbers on {', '.join(missing)}; there are "
            f"{', '.join(sorted(found)) or 'none'}"
        )
    # If there are several topics of joint states, only the user can decide which one is the state.
    joints = [topic.name for topic in used if topic.msgtype == JOINT_STATE_TYPE]
    others = [name for name in joints if name != choices.action]
    state = choices.state or (others[0] if len(others) == 1 else None)
    chosen = {choices.action: ACTION_FEATURE, state: STATE_FEATURE}
    features: dict[str, Topic] = {}
    for topic in used:
        kind = "images" if topic.shape else "topics"
        key = f"observation.{kind}.{topic.name.strip('/').replace('/', '.')}"
        features[chosen.get(topic.name, key)] = topic
    return features


def _is_usable(msgtype: str) -> bool:
    """Return whether messages of a type can become a feature.

    They can if they are images or joint states, or have a header, and therefore a stamp, but no
    list of variable length. Messages of this package cannot.
    """
    if msgtype in (JOINT_STATE_TYPE, *IMAGE_TYPES):
        return True
    described = list_message_fields(msgtype)
    if not described or described[0][1] != HEADER_KIND or msgtype.startswith(PACKAGE):
        return False
    definition, _ = make_typestore().generate_msgdef(msgtype, ros_version=2)
    return not any(sign in definition for sign in LIST_SIGNS)


def _find_numbers(
    parts: Iterable[tuple[object, object]],
    prefix: str,
) -> dict[str, float]:
    """Return the numbers in a message by their paths, such as ``wrench.force.x``.

    Args:
        parts: Names and values of the fields of a message, or indices and values of a list.
        prefix: Path from the outermost message to these parts, ending in "."; "" for its fields.
    """
    numbers: dict[str, float] = {}
    for name, part in parts:
        if name == "header" or isinstance(part, str):
            continue
        path = f"{prefix}{name}"
        if is_dataclass(part):
            numbers |= _find_numbers(vars(part).items(), f"{path}.")
        elif isinstance(part, Iterable):
            numbers |= _find_numbers(enumerate(part), f"{path}.")
        else:
            # All other fields are numbers or truth values.
            numbers[path] = float(cast("SupportsFloat", part))
    return numbers


def _find_joint_numbers(message: JointState, where: str) -> dict[str, float]:
    """Return the numbers in a JointState message by their names, such as ``elbow.position``.

    Args:
        message: The message, which may contain only some of the robot's joints.
        where: Bag and topic, for errors.

    Raises:
        BagError: The message has more or fewer values of a quantity than joint names.
    """
    numbers: dict[str, float] = {}
    for quantity in JOINT_FIELDS:
        values = getattr(message, quantity)
        if len(values) not in (0, len(message.name)):
            raise BagError(
                f"{where}: a message has {len(message.name)} joints and {len(values)} values of "
                f"{quantity}; {LEAVE_OUT}"
            )
        names = [f"{joint}.{quantity}" for joint in message.name]
        numbers |= zip(names, map(float, values), strict=False)
    return numbers
