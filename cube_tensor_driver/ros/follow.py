"""Following a skin: its `info` and its newest `stress`, for nodes that show it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from cube_tensor_driver.msg import SkinInfo, SkinStress

from ..core.errors import MessageError
from ..core.pipeline import StressRows
from ..core.scene import Newest, Places
from ..core.tensor import rotation_from_quaternion
from .messages import Times, read_stress

DEPTH = 10
"""A viewer wants the newest messages, not all: a short queue, best effort, so that a slow one holds up nobody."""
STALE_S = 1.0
"""A cube that nothing came from for so long is stale."""


class Follower:
    """Keeps `info`, `places` and `newest` of the skin whose topics the node sees; `info` is None until it came.

    on_skin: called when there is a skin, or another one. on_stress: called with the rows of each message. Messages
    that contradict themselves are counted and left out.
    """

    def __init__(
        self,
        node: Node,
        on_skin: Callable[[], None] | None = None,
        on_stress: Callable[[Times, StressRows], None] | None = None,
    ) -> None:
        self.info: Any = None  # of type SkinInfo
        self.bad_messages = 0
        self.messages = 0
        self._node, self._on_skin, self._on_stress = node, on_skin, on_stress
        latched = QoSProfile(depth=DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        quick = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._subscriptions = [
            node.create_subscription(SkinInfo, "info", self._take_info, latched),
            node.create_subscription(SkinStress, "stress", self._take_stress, quick),
        ]

    def close(self) -> None:
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def now(self) -> float:
        """The node's clock in s."""
        return 1e-9 * float(self._node.get_clock().now().nanoseconds)

    def health(self) -> np.ndarray:
        """(cubes,) as `Newest.health` has it."""
        return self.newest.health(self.now(), STALE_S)

    def _take_info(self, info: SkinInfo) -> None:
        before, self.info = self.info, info
        if before is not None and _where(before) == _where(info):
            return
        self.places = places(info)
        self.newest = Newest(len(info.cubes))
        if self._on_skin:
            self._on_skin()

    def _take_stress(self, message: SkinStress) -> None:
        if self.info is None:
            return
        try:
            times, rows = read_stress(message)
        except MessageError as error:
            self.bad_messages += 1
            self._node.get_logger().error(str(error), throttle_duration_sec=5.0)
            return
        self.messages += 1
        self.newest.update(times.cube, rows, self.now())
        if self._on_stress:
            self._on_stress(times, rows)


def places(info: SkinInfo) -> Places:
    """Where the cubes of an `info` are. CubeError: a pose that is none."""
    position = [(cube.pose.position.x, cube.pose.position.y, cube.pose.position.z) for cube in info.cubes]
    turns = [cube.pose.orientation for cube in info.cubes]
    rotation = [rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w])) for q in turns]
    return Places(np.array(position), np.array(rotation), np.array([cube.half_side for cube in info.cubes]))


def _where(info: SkinInfo) -> list[object]:
    return [info.header.frame_id, *((cube.name, cube.pose, cube.half_side) for cube in info.cubes)]
