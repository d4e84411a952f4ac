"""The other topics of a bag: numbers with a stamp, each frame with the newest before its end."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from ..bags.read import Bag
from ..core.errors import BagError
from ..messages.types import PACKAGE
from .frames import SECOND, Frames

JOINTS = "sensor_msgs/msg/JointState"
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
HEADER = "std_msgs/msg/Header"
OF_JOINTS = ("position", "velocity", "effort")


@dataclass(frozen=True, eq=False)
class Signal:
    """Numbers on a topic. stamp_ns: (M,) ascending; names: of the D values; values: (M, D)."""

    names: list[str]
    stamp_ns: NDArray[np.int64]
    values: NDArray[np.float32]

    def at(self, frames: Frames, first: int, last: int, names: list[str]) -> NDArray[np.float32]:
        """(last - first, names) the newest values before the end of each frame; NaN before the
        first message, and for names that the bag does not have."""
        # What is stamped in a frame belongs to it, as samples do.
        number = frames.number_of(self.stamp_ns)
        newest = np.searchsorted(number, np.arange(first, last), side="right") - 1
        found = np.full((last - first, len(names)), np.nan, np.float32)
        columns = [self.names.index(name) if name in self.names else -1 for name in names]
        there = np.array(columns) >= 0
        values = self.values[np.maximum(newest, 0)][:, columns]
        known = (newest >= 0)[:, None] & there
        found[known] = values[known]
        return found


def stamped_topics(bag: Bag, skin: str) -> dict[str, str]:
    """Topic -> type, of images, joint states and other messages of numbers behind a header.

    skin: prefix of the skin's own topics, which say nothing that the stress does not.
    """
    found = {}
    for connection in bag.connections:
        topic, kind = connection.topic, connection.msgtype
        if not connection.msgcount or topic.startswith(f"{skin}cubes/"):
            continue
        if kind in (JOINTS, *IMAGES) or number_names(bag, kind):
            found[topic] = kind
    return dict(sorted(found.items()))


def number_names(bag: Bag, kind: str) -> list[str]:
    """The numbers of a type whose messages have a header and always the same numbers, else []."""
    fields = bag.fields(kind)
    if kind.startswith(PACKAGE) or not fields or fields[0][1] != (Nodetype.NAME, HEADER):
        return []
    try:
        return list(_numbers(bag, fields[1:], ""))
    except _NotFixedError:
        return []


class _NotFixedError(Exception):
    """A type has a list of any length."""


def _numbers(bag: Bag, fields: list[tuple[str, Any]], prefix: str) -> Iterator[str]:
    for name, (node, what) in fields:
        if node == Nodetype.NAME:
            yield from _numbers(bag, bag.fields(what), f"{prefix}{name}.")
        elif node == Nodetype.BASE:
            if what[0] != "string":
                yield f"{prefix}{name}"
        elif node == Nodetype.ARRAY and what[0][0] == Nodetype.BASE:
            yield from (f"{prefix}{name}.{k}" for k in range(what[1]))
        else:
            raise _NotFixedError


def read_signal(bag: Bag, topic: str, kind: str) -> Signal:
    """All messages of a topic with numbers. BagError: damaged, or a joint has no name."""
    names: dict[str, int] = {}
    messages: list[tuple[int, dict[str, float]]] = []
    fixed = number_names(bag, kind)
    for entry in bag.entries({topic}):
        message = bag.decode(entry)
        if kind == JOINTS:
            numbers = joint_numbers(message, f"{bag.path}: {topic}")
        else:
            numbers = {name: _value(message, name) for name in fixed}
        for name in numbers:
            names.setdefault(name, len(names))
        messages.append((stamp_ns(message), numbers))
    messages.sort(key=lambda one: one[0])
    values = np.full((len(messages), len(names)), np.nan, np.float32)
    for row, (_, numbers) in zip(values, messages, strict=True):
        row[[names[name] for name in numbers]] = list(numbers.values())
    _hold(values)
    return Signal(list(names), np.array([stamp for stamp, _ in messages], np.int64), values)


def joint_numbers(message: Any, where: str) -> dict[str, float]:
    """The numbers of a JointState, which may be about some of the joints only."""
    numbers = {}
    for field in OF_JOINTS:
        values = getattr(message, field)
        if len(values) and len(values) != len(message.name):
            raise BagError(
                f"{where}: a message has {len(message.name)} joints and {len(values)} values of "
                f"{field}; leave the topic out by naming the others with --topics"
            )
        for name, value in zip(message.name, values, strict=False):
            numbers[f"{name}.{field}"] = float(value)
    return numbers


def stamp_ns(message: Any) -> int:
    """Of a message with a header."""
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def _value(message: Any, name: str) -> float:
    for part in name.split("."):
        message = message[int(part)] if part.isdigit() else getattr(message, part)
    return float(message)


def _hold(values: NDArray[np.float32]) -> None:
    """Fill what a message does not say with what the one before said."""
    rows = np.arange(len(values))[:, None]
    newest = np.maximum.accumulate(np.where(np.isnan(values), 0, rows), axis=0)
    values[:] = np.take_along_axis(values, newest, axis=0)
