"""The topic `forces`: one force per cube as a point cloud, which other tactile stacks take."""

from __future__ import annotations

import array

import numpy as np
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2, PointField

from ...config.skin import Skin
from ...core.forces import Forces
from ...core.rows import StressRows
from ..messages import to_time

FIELDS = ("x", "y", "z", "fx", "fy", "fz")
"""Of each point, float32: m and N in the skin's parent frame."""


class ForceCloud:
    """Publishes `forces` while somebody listens: a point per cube, in the order of the skin."""

    def __init__(
        self, node: LifecycleNode, skin: Skin, quality: QoSProfile, side: float | None
    ) -> None:
        self._node = node
        self._forces = Forces(skin, side)
        self._publisher = node.create_lifecycle_publisher(PointCloud2, "forces", quality)
        self._cubes = len(skin.cubes)
        step = 4 * len(FIELDS)
        self._message = PointCloud2(
            height=1, width=self._cubes, point_step=step, row_step=step * self._cubes
        )
        self._message.header.frame_id = skin.parent_frame
        self._message.fields = [
            PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
            for k, name in enumerate(FIELDS)
        ]

    def publish(self, rows: StressRows, stamp_ns: int) -> None:
        """Send the last row of each cube; NaN for cubes without one."""
        if not self._publisher.get_subscription_count():
            return
        force = self._forces.of_skin(rows.select(rows.cube < self._cubes))
        cloud = np.hstack([self._forces.position, force]).astype("<f4")
        data = array.array("B")
        data.frombytes(cloud.tobytes())
        self._message.data = data
        self._message.is_dense = bool(np.isfinite(force).all())
        self._message.header.stamp = to_time(stamp_ns)
        self._publisher.publish(self._message)

    def close(self) -> None:
        self._node.destroy_publisher(self._publisher)
