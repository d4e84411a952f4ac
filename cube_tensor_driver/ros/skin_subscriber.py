# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Subscribes to the topics `info` and `stress` of a skin and keeps the newest values.

It serves nodes that display the skin, or compute something from its newest stress at a low rate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from rclpy.node import Node
from rclpy.publisher import Publisher

from ..config.parameters import Parameter
from ..core.arrays import Index
from ..core.errors import CubeError, MessageError
from ..core.latest_stress import STALE_S, LatestStress
from ..core.poses import CubePoses
from ..core.rate_limit import find_next_due_ns
from ..core.rows import StressRows
from ..messages.codec import stress_codec
from ..messages.skin_info import describe_geometry, read_cube_poses
from ..msg import SkinInfo, SkinStress
from .callbacks import CallbackErrors
from .messages import CheckedSubscription, log_refused_message
from .node import CubeNode
from .qos import LATCHED, NEWEST


@dataclass
class FollowedSkin:
    """The state of a skin as received on its topics.

    Attributes:
        info: The newest SkinInfo message (names, poses and calibrations of the cubes).
        poses: Poses of the cubes in the parent frame of the skin.
        newest: The newest stress of each cube.
        stamp_ns: Stamp of the newest message of `stress`, in ns since the Unix epoch; 0 before the
            first message.
        arrived_s: Time of the node's clock at which this message arrived, in s.
    """

    info: SkinInfo
    poses: CubePoses
    newest: LatestStress
    stamp_ns: int = 0
    arrived_s: float = 0.0


class SkinSubscriber:
    """Receives `info` and `stress` of the skin in the namespace of a node.

    Attributes:
        skin: The state of the skin; None until its first `info` message.
    """

    def __init__(
        self,
        node: Node,
        on_skin: Callable[[FollowedSkin], None],
        on_stress: Callable[[int, StressRows], None] | None = None,
    ) -> None:
        """Subscribe to both topics.

        Args:
            node: The node that subscribes.
            on_skin: Called at the first `info` message, and whenever names or poses of the cubes
                have changed.
            on_stress: Called at each `stress` message with its stamp, in ns since the Unix epoch,
                and its rows (the stress of one cube at one instant each).
        """
        self.skin: FollowedSkin | None = None
        self._node = node
        self._on_skin = on_skin
        self._on_stress = on_stress
        catch = CallbackErrors(node).catch
        on_info = catch(self._receive_info)
        on_stress = catch(self._receive_stress)
        self._info = CheckedSubscription(
            node,
            SkinInfo,
            "info",
            on_info,
            LATCHED,
        )
        self._stress = node.create_subscription(
            SkinStress,
            "stress",
            on_stress,
            NEWEST,
            raw=True,
        )

    def close(self) -> None:
        """End the subscriptions to `info` and `stress`."""
        self._info.close()
        self._node.destroy_subscription(self._stress)

    def now(self) -> float:
        """Return the time of the node's clock, in s, with which arrivals of stress are stored."""
        return 1e-9 * float(self._node.get_clock().now().nanoseconds)

    def _receive_info(self, info: SkinInfo) -> None:
        # After a tare the new `info` differs from the old one only in the rest frequencies. Then
        # the names and poses have not changed, and `on_skin` is not called.
        if self.skin is not None and describe_geometry(self.skin.info) == describe_geometry(info):
            self.skin.info = info
            return
        try:
            newest = LatestStress(len(info.cubes))
            skin = FollowedSkin(info, read_cube_poses(info), newest)
            self._on_skin(skin)
        except CubeError as error:
            log_refused_message(self._node, "info", error)
            return
        self.skin = skin

    def _receive_stress(self, data: bytes) -> None:
        # Before the first `info` the number of cubes is unknown, so stress cannot be stored yet.
        if self.skin is None:
            return
        try:
            message = stress_codec.decode(data)
        except MessageError as error:
            log_refused_message(self._node, "stress", error)
            return
        self.skin.arrived_s = self.now()
        self.skin.newest.update(message.rows, self.skin.arrived_s)
        self.skin.stamp_ns = int(message.stamp_ns[0])
        if self._on_stress is not None:
            self._on_stress(self.skin.stamp_ns, message.rows)


class SkinSubscriberNode(CubeNode):
    """Base class of nodes that compute one topic from the newest stress of a skin.

    The topic has the name of the node. It is published at most `rate` times per second (parameter),
    and only while it has subscribers.
    """

    def __init__(
        self,
        name: str,
        parameters: Sequence[Parameter],
        message_type: type,
        depth: int,
    ) -> None:
        """Make the node.

        Args:
            name: Name of the node and of its topic.
            parameters: Parameters of the node, among them `rate`.
            message_type: Type of the messages.
            depth: Depth of the queue of the topic, in messages.
        """
        super().__init__(name, parameters)
        self._message_type = message_type
        self._depth = depth

    def prepare(self, skin: FollowedSkin) -> None:
        """Prepare for computing messages from the stress of a skin; subclasses override it.

        It is called at the first `info` message, and when names or poses of cubes have changed.

        Args:
            skin: The state of the skin, as received on its topics.
        """

    def compute_message(self, skin: FollowedSkin, health: Index) -> object:
        """Return the message to publish now, or its serialised bytes; subclasses override it.

        A timer calls it `rate` times per second. If the subclass overrides `follow_stress`, too,
        there is no timer: it is called when a `stress` message arrives, but on average at most
        `rate` times per second by the stamps of these messages, as in reprocessing. If it returns
        None, nothing is published.

        Args:
            skin: The state of the skin.
            health: Health of each cube, (cubes,): fine, doubtful, faulty or stale, as
                `LatestStress.compute_health` returns it.
        """

    def follow_stress(self, skin: FollowedSkin, health: Index) -> object:
        """Return a message to publish at once, without waiting for the next regular one, or None.

        If a subclass overrides this method, it is called at each `stress` message at which
        `compute_message` is not called.

        Args:
            skin: The state of the skin.
            health: Health of each cube (cubes,), as in `compute_message`.
        """

    def has_listeners(self, publisher: Publisher) -> bool:
        """Return whether the topic has a subscriber. Without one, nothing is computed."""
        return bool(publisher.get_subscription_count())

    def configure(self) -> None:
        is_followed = type(self).follow_stress is not SkinSubscriberNode.follow_stress
        period_s = 1.0 / self.read_value("rate")
        period_ns = round(1e9 * period_s)
        due_ns = 0

        def receive(stamp_ns: int, rows: StressRows) -> None:
            nonlocal due_ns
            next_ns = find_next_due_ns(stamp_ns, due_ns, period_ns)
            if next_ns is None:
                publish(self.follow_stress)
            else:
                due_ns = next_ns
                publish(self.compute_message)

        subscriber = SkinSubscriber(
            self,
            self.prepare,
            receive if is_followed else None,
        )
        self.call_at_cleanup(subscriber.close)
        topic = self.get_name()
        publisher: Publisher = self.own(
            self.create_lifecycle_publisher(self._message_type, topic, self._depth)
        )

        def publish(compute: Callable[[FollowedSkin, Index], object]) -> None:
            skin = subscriber.skin
            if skin is None or not self.is_active or not self.has_listeners(publisher):
                return
            # A timer also publishes when no message arrives, so that cubes become stale.
            now_s = skin.arrived_s if is_followed else subscriber.now()
            health = skin.newest.compute_health(now_s, STALE_S)
            message = compute(skin, health)
            if message is not None:
                publisher.publish(message)

        if not is_followed:
            compute = partial(publish, self.compute_message)
            self.own(self.create_timer(period_s, compute))
