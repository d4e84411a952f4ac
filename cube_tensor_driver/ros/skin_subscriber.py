"""Following a skin: its `info` and its newest `stress`, for nodes that show it or make something of
it now and then."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from cube_tensor_driver.msg import SkinInfo, SkinStress

from ..bags.message_codec import stress_codec
from ..core.errors import MessageError
from ..core.scene import CubePoses, Newest
from ..core.tensor import rotation_from_quaternion
from .messages import to_time
from .node import CubeNode

DEPTH = 10
"""A viewer wants the newest messages, not all: a short queue, best effort, so that a slow one holds
up nobody."""
STALE_S = 1.0
"""A cube that nothing came from for so long is stale."""


class SkinSubscriber:
    """Keeps `info`, `places` and `newest` of the skin whose topics the node sees; `info` is None
    until it came.

    on_skin: called when there is a skin, or another one. stamp: of the newest rows, None before
    they came. Messages that contradict themselves are counted and left out.
    """

    def __init__(self, node: Node, on_skin: Callable[[], None]) -> None:
        self.info: Any = None  # of type SkinInfo
        self.stamp: Any = None  # of type builtin_interfaces/Time
        self.bad_messages = 0
        self._node, self._on_skin = node, on_skin
        latched = QoSProfile(depth=DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        quick = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._subscriptions = [
            node.create_subscription(SkinInfo, "info", self._take_info, latched),
            node.create_subscription(SkinStress, "stress", self._take_stress, quick, raw=True),
        ]

    def close(self) -> None:
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def now(self) -> float:
        """The node's clock in s."""
        return 1e-9 * float(self._node.get_clock().now().nanoseconds)

    def health(self, stale: float = STALE_S) -> np.ndarray:
        """(cubes,) as `Newest.health` has it."""
        return self.newest.health(self.now(), stale)

    def _take_info(self, info: SkinInfo) -> None:
        before, self.info = self.info, info
        if before is not None and _where(before) == _where(info):
            return
        self.places, self.newest, self.stamp = places(info), Newest(len(info.cubes)), None
        self._on_skin()

    def _take_stress(self, data: bytes) -> None:
        if self.info is None:
            return
        try:
            message = stress_codec.decode(data)
        except MessageError as error:
            self.bad_messages += 1
            self._node.get_logger().error(str(error), throttle_duration_sec=5.0)
            return
        self.newest.update(message.rows.cube, message.rows, self.now())
        self.stamp = to_time(int(message.stamp_ns[0]))


class SkinSubscriberNode(CubeNode):
    """A lifecycle node that makes one topic of a skin's newest rows, `rate` times a second while
    somebody listens."""

    def __init__(self, name: str, kind: type, depth: int) -> None:
        """kind: of the messages on the topic `name`; depth: of its queue."""
        super().__init__(name)
        self._kind, self._depth, self._active = kind, depth, False
        self.declare(
            "autostart",
            True,
            "Configure and activate at once; false waits for lifecycle transitions.",
        )
        self.declare("rate", 20.0, "Most messages per second.", (0.1, 100.0))

    def new_skin(self) -> None:
        """There is a skin, or another one: `follower` has it."""

    def message(self) -> Any:
        """What to publish now, a message or its bytes; None: nothing."""

    def configure(self) -> None:
        self.subscriber = SkinSubscriber(self, self.new_skin)
        self._publisher = self.create_lifecycle_publisher(self._kind, self.get_name(), self._depth)
        self._timer = self.create_timer(1.0 / self.value("rate"), self._publish)

    def activate(self) -> None:
        self._active = True

    def deactivate(self) -> None:
        self._active = False

    def cleanup(self) -> None:
        if hasattr(self, "_timer"):
            self.destroy_timer(self._timer)
            self.subscriber.close()
            self.destroy_publisher(self._publisher)
            del self._timer

    def _publish(self) -> None:
        if (
            self._active
            and self.subscriber.info is not None
            and self._publisher.get_subscription_count()
        ):
            message = self.message()
            if message is not None:
                self._publisher.publish(message)


def places(info: SkinInfo) -> CubePoses:
    """Where the cubes of an `info` are. CubeError: a pose that is none."""
    position = [
        (cube.pose.position.x, cube.pose.position.y, cube.pose.position.z) for cube in info.cubes
    ]
    turns = [cube.pose.orientation for cube in info.cubes]
    rotation = [rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w])) for q in turns]
    return CubePoses(
        np.array(position), np.array(rotation), np.array([cube.half_side for cube in info.cubes])
    )


def _where(info: SkinInfo) -> list[object]:
    return [info.header.frame_id, *((cube.name, cube.pose, cube.half_side) for cube in info.cubes)]
