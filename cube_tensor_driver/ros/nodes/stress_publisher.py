"""The sink of a running skin: publishes `stress`, and the topics of single cubes to who listens."""

from __future__ import annotations

from functools import lru_cache

from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile

from ...config.skin import Skin
from ...core.reconstructor import Reconstructor
from ...core.rows import StressRows
from ...messages.codec import stress_codec
from ...msg import SkinStress
from ..node import BUFFERS_KEPT
from .cube_topics import CubeTopics
from .force_cloud import ForceCloud

LISTENERS_S = 0.5
"""How often the node looks up which cubes' own topics anybody listens to."""


class StressPublisher:
    """Publishers of one reconstruction.

    side: of the face that wrenches and forces refer to, m; None: each cube's own
    forces: publish one force per cube, too
    """

    def __init__(
        self,
        node: LifecycleNode,
        skin: Skin,
        reconstructor: Reconstructor,
        quality: QoSProfile,
        side: float | None,
        forces: bool,
    ) -> None:
        self._node = node
        self._buffer = lru_cache(maxsize=BUFFERS_KEPT)(stress_codec.buffer)
        self._publisher = node.create_lifecycle_publisher(SkinStress, "stress", quality)
        self._cubes = CubeTopics(node, skin, reconstructor, side)
        self._forces = ForceCloud(node, skin, quality, side) if forces else None
        self._timer = node.create_timer(LISTENERS_S, self._cubes.find_listeners)

    def publish(self, stress: StressRows, stamp_ns: int, frame_id: bytes) -> None:
        """Send rows in one message with this stamp, and cube by cube what somebody listens to."""
        message = self._buffer(frame_id, len(stress))
        message.fill(stress)
        self._publisher.publish(message.data(stamp_ns))
        self._cubes.publish(stress)
        if self._forces is not None:
            self._forces.publish(stress, stamp_ns)

    def close(self) -> None:
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)
        self._cubes.close()
        if self._forces is not None:
            self._forces.close()
