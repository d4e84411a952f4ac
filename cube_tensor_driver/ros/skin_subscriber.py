"""Subscribes to a skin: its `info` and its newest `stress`.

For nodes that show the skin, or compute something from its newest rows at a lower rate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node

from ..config.parameters import Parameter
from ..core.arrays import Index
from ..core.errors import CubeError, MessageError
from ..core.latest_stress import STALE_S, LatestStress
from ..core.poses import CubePoses
from ..messages.codec import stress_codec
from ..messages.skin_info import cube_poses, geometry
from ..msg import SkinInfo, SkinStress
from .callbacks import CallbackErrors
from .messages import log_refused_message
from .node import CubeNode
from .qos import LATCHED, NEWEST


@dataclass
class FollowedSkin:
    """A skin as its topics show it.

    Attributes:
        info: The newest SkinInfo.
        poses: Poses of its cubes.
        newest: Newest row of each cube.
        messages: Number of messages of `stress` so far.
        stamp_ns: Stamp of the newest of them, in ns.
    """

    info: Any
    poses: CubePoses
    newest: LatestStress
    messages: int = 0
    stamp_ns: int = 0


class SkinSubscriber:
    """Follows the skin whose topics a node sees.

    Attributes:
        skin: The skin, or None until its `info` has come.
    """

    def __init__(self, node: Node, on_skin: Callable[[FollowedSkin], None]) -> None:
        """Subscribe; `on_skin` is called when there is a skin, and when there is another one."""
        self.skin: FollowedSkin | None = None
        self._node = node
        self._on_skin = on_skin
        catch = CallbackErrors(node).catch
        on_info, on_stress = catch(self._receive_info), catch(self._receive_stress)
        self._subscriptions = [
            node.create_subscription(
                SkinInfo,
                "info",
                on_info,
                LATCHED,
            ),
            node.create_subscription(
                SkinStress,
                "stress",
                on_stress,
                NEWEST,
                raw=True,
            ),
        ]

    def close(self) -> None:
        """End the subscriptions."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def now(self) -> float:
        """Return the time of the node's clock in s, which `LatestStress` takes."""
        return 1e-9 * float(self._node.get_clock().now().nanoseconds)

    def _receive_info(self, info: SkinInfo) -> None:
        # A tare changes only rest frequencies: the picture of the skin stays.
        if self.skin is not None and geometry(self.skin.info) == geometry(info):
            self.skin.info = info
            return
        try:
            skin = FollowedSkin(info, cube_poses(info), LatestStress(len(info.cubes)))
            self._on_skin(skin)
        except CubeError as error:
            log_refused_message(self._node, "info", error)
            return
        self.skin = skin

    def _receive_stress(self, data: bytes) -> None:
        # Without the poses and the number of cubes, rows mean nothing.
        if self.skin is None:
            return
        try:
            message = stress_codec.decode(data)
        except MessageError as error:
            log_refused_message(self._node, "stress", error)
            return
        self.skin.newest.update(message.rows, self.now())
        self.skin.messages += 1
        self.skin.stamp_ns = int(message.stamp_ns[0])


class SkinSubscriberNode(CubeNode):
    """A node that publishes one topic, named as the node, computed from a skin's newest rows.

    It publishes at most `rate` messages a second, and only while somebody listens.
    """

    def __init__(
        self, name: str, parameters: Sequence[Parameter], message_type: type, depth: int
    ) -> None:
        """Make a node whose topic has a queue of `depth` messages."""
        super().__init__(name, parameters)
        self._message_type = message_type
        self._depth = depth

    def prepare(self, skin: FollowedSkin) -> None:
        """Prepare for a skin: there is one, or another one."""

    def compute_message(self, skin: FollowedSkin, health: Index) -> Any:
        """Return what to publish now: a message, or its bytes, or None for nothing.

        Args:
            skin: The skin.
            health: Health of each cube, (cubes,), as `LatestStress.health` gives it.
        """

    def has_listeners(self, publisher: Any) -> bool:
        """Return whether somebody listens to what `compute_message` gives."""
        return bool(publisher.get_subscription_count())

    def configure(self) -> None:
        subscriber = SkinSubscriber(self, self.prepare)
        self.call_at_cleanup(subscriber.close)
        # A node publishes one topic, which has its name.
        publisher = self.own(
            self.create_lifecycle_publisher(self._message_type, self.get_name(), self._depth)
        )

        def publish() -> None:
            skin = subscriber.skin
            if skin is None or not self.is_active or not self.has_listeners(publisher):
                return
            # A cube that has become silent is shown as stale, so the time counts and not only rows.
            health = skin.newest.health(subscriber.now(), STALE_S)
            message = self.compute_message(skin, health)
            if message is not None:
                publisher.publish(message)

        self.own(self.create_timer(1.0 / self.value("rate"), publish))
