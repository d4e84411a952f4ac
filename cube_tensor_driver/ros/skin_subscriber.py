"""Subscribes to a skin: its `info` and its newest `stress`.

For nodes that show the skin, or make something of its newest rows now and then.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from ..config.parameters import Parameter
from ..core.errors import CubeError, MessageError
from ..core.latest_stress import STALE_S, LatestStress
from ..core.poses import CubePoses
from ..messages.codec import stress_codec
from ..messages.skin_info import cube_poses, geometry
from ..msg import SkinInfo, SkinStress
from .guard import CallbackGuard
from .node import CubeNode

DEPTH = 10
"""A viewer wants the newest messages, not all of them. So its queue is short and it asks for best
effort: a slow viewer holds up nobody."""
ERROR_PERIOD_S = 5.0
"""The log has at most one line about damaged messages in this time."""


@dataclass
class FollowedSkin:
    """A skin as its topics show it.

    info: of type SkinInfo. poses: of its cubes. newest: row of each cube. messages: how many of
    `stress` have come. stamp_ns: of the newest of them.
    """

    info: Any
    poses: CubePoses
    newest: LatestStress
    messages: int = 0
    stamp_ns: int = 0


class SkinSubscriber:
    """Follows the skin whose topics a node sees.

    skin: None until its `info` has come.
    """

    def __init__(self, node: Node, on_skin: Callable[[FollowedSkin], None]) -> None:
        """on_skin: called when there is a skin, and when there is another one."""
        self.skin: FollowedSkin | None = None
        self._node = node
        self._on_skin = on_skin
        latched = QoSProfile(depth=DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        newest = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        guard = CallbackGuard(node)
        on_info, on_stress = guard.wrap(self._receive_info), guard.wrap(self._receive_stress)
        self._subscriptions = [
            node.create_subscription(SkinInfo, "info", on_info, latched),
            node.create_subscription(SkinStress, "stress", on_stress, newest, raw=True),
        ]

    def close(self) -> None:
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def now(self) -> float:
        """The time of the node's clock in s, which `LatestStress` is told."""
        return 1e-9 * float(self._node.get_clock().now().nanoseconds)

    def _receive_info(self, info: SkinInfo) -> None:
        if self.skin is not None and geometry(self.skin.info) == geometry(info):
            self.skin.info = info
            return
        try:
            skin = FollowedSkin(info, cube_poses(info), LatestStress(len(info.cubes)))
            self._on_skin(skin)
        except CubeError as error:
            self._refuse(error)
            return
        self.skin = skin

    def _receive_stress(self, data: bytes) -> None:
        if self.skin is None:
            return
        try:
            message = stress_codec.decode(data)
        except MessageError as error:
            self._refuse(error)
            return
        self.skin.newest.update(message.rows, self.now())
        self.skin.messages += 1
        self.skin.stamp_ns = int(message.stamp_ns[0])

    def _refuse(self, error: CubeError) -> None:
        self._node.get_logger().error(str(error), throttle_duration_sec=ERROR_PERIOD_S)


class SkinSubscriberNode(CubeNode):
    """A lifecycle node that makes one topic, named as the node, of a skin's newest rows.

    It publishes at most `rate` messages a second, and only while somebody listens.
    """

    def __init__(
        self, name: str, parameters: Sequence[Parameter], message_type: type, depth: int
    ) -> None:
        """depth: of the queue of the topic."""
        super().__init__(name, parameters)
        self._message_type = message_type
        self._depth = depth
        self._active = False
        self._configured = ExitStack()

    def set_up(self, skin: FollowedSkin) -> None:
        """Prepare for a skin: there is one, or another one."""

    def message(self, skin: FollowedSkin, health: np.ndarray) -> Any:
        """What to publish now: a message, or its bytes, or None for nothing.

        health: (cubes,) as `LatestStress.health` gives it.
        """

    def is_wanted(self, publisher: Any) -> bool:
        """Whether somebody listens to what `message` makes."""
        return bool(publisher.get_subscription_count())

    def configure(self) -> None:
        topic = self.get_name()
        subscriber = SkinSubscriber(self, self.set_up)
        publisher = self.create_lifecycle_publisher(self._message_type, topic, self._depth)
        timer = self.create_timer(
            1.0 / self.value("rate"), lambda: self._publish(subscriber, publisher)
        )
        self._configured.callback(self.destroy_publisher, publisher)
        self._configured.callback(subscriber.close)
        self._configured.callback(self.destroy_timer, timer)

    def activate(self) -> None:
        self._active = True

    def deactivate(self) -> None:
        self._active = False

    def cleanup(self) -> None:
        self._configured.close()

    def _publish(self, subscriber: SkinSubscriber, publisher: Any) -> None:
        skin = subscriber.skin
        if skin is None or not self._active or not self.is_wanted(publisher):
            return
        message = self.message(skin, skin.newest.health(subscriber.now(), STALE_S))
        if message is not None:
            publisher.publish(message)
