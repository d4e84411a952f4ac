"""Keeps the messages of topics as they come, with the gaps in the numbers that DDS gives them.

A gap means that a message was sent and did not come here: so what this process missed is told from
what nobody sent. Messages are taken without an executor, because only so their numbers come along.
"""

from __future__ import annotations

from itertools import groupby
from typing import Any, Generic, NamedTuple

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from cube_tensor_driver.config.skin import Skin
from cube_tensor_driver.core.errors import MessageError
from cube_tensor_driver.core.rows import concatenate
from cube_tensor_driver.messages.codec import AnyRows, MessageCodec
from cube_tensor_driver.msg import StressTensorStamped
from cube_tensor_driver.ros.messages import to_ns

from ..checks.record import CubeMessages, Received

TOGETHER = 500
"""Messages that are decoded at a time."""
KEEP_ONE_OF = 8
"""Of the messages of single cubes."""
LISTEN = 4000
"""Messages of single cubes that are listened to. All of them would need a third of the machine."""
MOST = 300
"""Messages taken at a time, so that this process does other things, too."""


class Message(NamedTuple):
    """A serialised message, the number that DDS gave it, and when it was sent (wall clock)."""

    data: bytes
    number: int
    sent_ns: int


class _Subscription:
    """Serialised messages of a topic with their numbers."""

    def __init__(self, node: Node, kind: type, topic: str, quality: QoSProfile) -> None:
        self._node, self._kind = node, kind
        self._subscription = node.create_subscription(kind, topic, _nothing, quality, raw=True)

    def take(self) -> list[Message]:
        """What has come since the last call, MOST at a time."""
        taken: list[Message] = []
        handle = self._subscription.handle
        with handle:
            while len(taken) < MOST and (item := handle.take_message(self._kind, True)) is not None:
                data, about = item
                number, sent_ns = about["publication_sequence_number"], about["source_timestamp"]
                taken.append(Message(data, number, sent_ns))
        return taken

    def close(self) -> None:
        self._node.destroy_subscription(self._subscription)


class Tape(Generic[AnyRows]):
    """All rows of one batch topic. count: messages so far."""

    def __init__(
        self,
        node: Node,
        kind: type,
        topic: str,
        codec: MessageCodec[AnyRows],
        quality: QoSProfile,
        skin: Skin,
    ) -> None:
        self.count = 0
        self._codec: MessageCodec[AnyRows] = codec
        self._frame_id = skin.parent_frame.encode() + b"\0"
        self._subscription = _Subscription(node, kind, topic, quality)
        self._joined: list[AnyRows] = []
        self._waiting: list[Message] = []
        self._sent_ns: list[np.ndarray] = []
        self._number = self._rows = 0
        self._gaps: list[tuple[int, int]] = []
        self._cubes: set[int] = set()
        self._unreadable = 0

    def take(self) -> None:
        """Take what has come; to be called again and again."""
        for message in self._subscription.take():
            self.count += 1
            # A publisher that was made unnoticed begins at 1 again.
            before = self._number if message.number > self._number else 0
            self._number = message.number
            if message.number > before + 1:
                self._join()
                self._gaps.append((self._rows, message.number - before - 1))
            self._waiting.append(message)
        if len(self._waiting) >= TOGETHER:
            self._join()

    def new_writer(self) -> None:
        """The node that sends has made a new publisher: its numbers begin anew."""
        self.take()
        self._number = 0

    def cubes_so_far(self) -> int:
        """How many cubes rows have come of."""
        self._join()
        return len(self._cubes)

    def newest_ns(self) -> int:
        """Stamp of the newest message; 0 before the first."""
        self._join()
        return int(self._joined[-1].stamp_ns[-1]) if self._joined else 0

    def received(self) -> Received[AnyRows]:
        """All that came. MessageError: nothing came."""
        self._join()
        if not self._joined:
            raise MessageError("the driver or the reconstruction published nothing: see their logs")
        return Received(
            concatenate(self._joined),
            np.concatenate(self._sent_ns),
            tuple(self._gaps),
            self._unreadable,
        )

    def _join(self) -> None:
        """Decode what waits: neighbours of one shape together, because that takes less time."""
        waiting, self._waiting = self._waiting, []
        for _, group in groupby(waiting, self._shape):
            messages = list(group)
            try:
                decoded = self._codec.decode(*(message.data for message in messages))
            except MessageError:
                self._unreadable += len(messages)
                continue
            self._unreadable += len(messages) * (decoded.frame_id != self._frame_id)
            self._rows += len(decoded.rows)
            self._joined.append(decoded.rows)
            sent_ns = [message.sent_ns for message in messages]
            self._sent_ns.append(np.repeat(sent_ns, len(decoded.rows) // len(messages)))
            self._cubes.update(np.unique(decoded.rows.cube).tolist())

    def _shape(self, message: Message) -> tuple[int, bytes]:
        return len(message.data), self._codec.shape_bytes(message.data)


class CubeTape:
    """Some messages of the topics of one cube."""

    def __init__(self, node: Node, skin: Skin, cube: int, quality: QoSProfile) -> None:
        self._cube = cube
        topic = f"cubes/{skin.cubes[cube].name}"
        self._kinds = {"stress": StressTensorStamped, "wrench": WrenchStamped}
        self._subscriptions = {
            name: _Subscription(node, kind, f"{topic}/{name}", quality)
            for name, kind in self._kinds.items()
        }
        self._messages: dict[str, list[bytes]] = {name: [] for name in self._kinds}
        self._count = 0

    def take(self) -> None:
        """Take what has come; to be called again and again."""
        for name, subscription in self._subscriptions.items():
            for message in subscription.take():
                self._count += 1
                if self._count % KEEP_ONE_OF == 0:
                    self._messages[name].append(message.data)
        if self._count > LISTEN:
            self.close()

    def close(self) -> None:
        """Listen no more."""
        for subscription in self._subscriptions.values():
            subscription.close()
        self._subscriptions.clear()

    def received(self) -> CubeMessages:
        """Those that were kept."""
        tensors = [
            deserialize_message(data, StressTensorStamped) for data in self._messages["stress"]
        ]
        wrenches = [deserialize_message(data, WrenchStamped) for data in self._messages["wrench"]]
        return CubeMessages(
            self._cube,
            frozenset(message.header.frame_id for message in (*tensors, *wrenches)),
            tuple(_tensor(message) for message in tensors),
            tuple(_wrench(message) for message in wrenches),
        )


def _nothing(_: Any) -> None:
    """Messages are taken by `_Subscription.take`."""


def _tensor(message: StressTensorStamped) -> tuple[Any, ...]:
    tensor = message.tensor
    normal, shear = tensor.normal, tensor.shear
    values = [normal.x, normal.y, normal.z, shear.x, shear.y, shear.z, *tensor.normal_gradient]
    return (
        to_ns(message.header.stamp),
        np.array(values),
        tensor.residual,
        tensor.status,
        tensor.observed,
        np.array(tensor.covariance),
    )


def _wrench(message: WrenchStamped) -> tuple[int, Any]:
    force, torque = message.wrench.force, message.wrench.torque
    values = [force.x, force.y, force.z, torque.x, torque.y, torque.z]
    return to_ns(message.header.stamp), np.array(values)
