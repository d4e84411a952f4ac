# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The motion of a skin from an IMU or from TF, for the compensation of weight and inertia.

A cube cannot measure its own acceleration while loads act on it, because a load can cause the same
stresses. So the motion comes from elsewhere.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from typing import Any, NamedTuple, Protocol

import numpy as np
from sensor_msgs.msg import Imu

from ..core.arrays import Array
from ..core.compensation.motion import (
    MAX_EXTRAPOLATION_NS,
    MAX_INTERVAL_NS,
    Motion,
)
from ..core.compensation.weight import STANDARD_GRAVITY
from ..core.errors import ConfigError, CubeError
from ..core.tensor import rotation_from_quaternion
from ..messages.codec import SECOND
from .messages import CheckedSubscription, to_ns
from .node import CubeNode
from .qos import NEWEST

MAX_SAMPLES = 2048
"""Number of newest samples of an IMU that are kept: enough for the longest message of rows, 1 s."""

MAX_TRANSFORM_AGE_NS = SECOND
"""Age of a transform, relative to the newest row (sample of a cube), in ns, above which the
direction of gravity counts as unknown. A static transform does not age."""


class MissingMotion(CubeError):
    """The motion of the skin is unknown; the text says why, and how to mend it."""


class MotionSource(Protocol):
    """A source of the motion of a skin."""

    def motion(self, first_ns: int, last_ns: int) -> Motion:
        """Return the motion at instants around a span of time, in ns since the Unix epoch.

        Raises:
            MissingMotion: Nothing is known about the span.
        """


def make_motion_source(node: CubeNode, parent_frame: str) -> MotionSource | None:
    """Return the source that the parameters `imu` and `gravity` of a node name; None: neither does.

    Args:
        node: The node, which is being configured.
        parent_frame: Parent frame of the skin.

    Raises:
        ConfigError: Both parameters are set.
    """
    topic, frame = str(node.value("imu")), str(node.value("gravity"))
    if topic and frame:
        raise ConfigError(f"parameters imu ({topic}) and gravity ({frame}): set only one of them")
    if topic:
        return ImuMotion(node, topic, parent_frame)
    return GravityMotion(node, frame, parent_frame) if frame else None


class Transforms:
    """Transforms between frames, from the topics /tf and /tf_static."""

    def __init__(self, node: CubeNode) -> None:
        # Robots that do not use TF need not install it.
        try:
            import tf2_ros
        except ModuleNotFoundError:
            self._buffer: Any = None
            return
        self._buffer, self._error = tf2_ros.Buffer(), tf2_ros.TransformException
        listener = tf2_ros.TransformListener(self._buffer, node)
        node.call_at_cleanup(listener.unregister)

    def newest(self, target: str, source: str) -> tuple[Array, Array, int]:
        """Return the newest transform from one frame to another.

        Returns:
            Rotation (3, 3), position (3,) of the source's origin in the target frame, in m, and the
            time of the transform, in ns since the Unix epoch; 0 for a static one.

        Raises:
            MissingMotion: tf2_ros is not installed, or the frames are not connected.
        """
        if target == source:
            return np.eye(3), np.zeros(3), 0
        if self._buffer is None:
            raise MissingMotion("TF needs tf2_ros: apt install ros-$ROS_DISTRO-tf2-ros-py")
        from rclpy.time import Time

        try:
            found = self._buffer.lookup_transform(target, source, Time())
        except self._error as error:
            raise MissingMotion(
                f"no transform from {source} to {target}: {error}; publish it on /tf or /tf_static"
            ) from None
        p, q = found.transform.translation, found.transform.rotation
        rotation = rotation_from_quaternion([q.x, q.y, q.z, q.w])
        return rotation, np.array([p.x, p.y, p.z]), to_ns(found.header.stamp)


class GravityMotion:
    """The motion of a skin that moves so slowly that only its direction to gravity counts."""

    def __init__(self, node: CubeNode, frame: str, parent_frame: str) -> None:
        """Listen to TF.

        Args:
            node: The node, which is being configured.
            frame: Frame whose z axis points up.
            parent_frame: Parent frame of the skin.
        """
        self._frame, self._parent_frame = frame, parent_frame
        self._transforms = Transforms(node)

    def motion(self, first_ns: int, last_ns: int) -> Motion:
        """Return the motion at the newest transform; see `MotionSource.motion`."""
        rotation, _, time_ns = self._transforms.newest(self._parent_frame, self._frame)
        age_ns = last_ns - time_ns
        if time_ns and abs(age_ns) > MAX_TRANSFORM_AGE_NS:
            raise MissingMotion(
                f"transform from {self._frame} to {self._parent_frame} is {age_ns / 1e9:.1f} s "
                "older than the rows: see who publishes it, and that clocks agree"
            )
        up = rotation @ np.array([0.0, 0.0, STANDARD_GRAVITY])
        return Motion(np.array([last_ns]), up[None], np.zeros((1, 3, 3)))


class _Sample(NamedTuple):
    """One sample of an IMU, in the parent frame of the skin.

    Attributes:
        time_ns: Time of the sample, in ns since the Unix epoch.
        angular_velocity: Angular velocity (3,), in rad/s.
        change: Its change since the sample before (3,), in rad/s².
        specific_force: Specific force at the origin of the frame (3,), in m/s².
        gradient: Its derivatives with respect to position (3, 3), in 1/s².
    """

    time_ns: int
    angular_velocity: Array
    change: Array
    specific_force: Array
    gradient: Array


class ImuMotion:
    """The motion of a skin from an IMU that is fixed to the same rigid body."""

    def __init__(self, node: CubeNode, topic: str, parent_frame: str) -> None:
        """Subscribe to an IMU.

        Args:
            node: The node, which is being configured.
            topic: Topic of sensor_msgs/Imu.
            parent_frame: Parent frame of the skin.
        """
        self._topic, self._parent_frame = topic, parent_frame
        self._transforms = Transforms(node)
        self._samples: deque[_Sample] = deque(maxlen=MAX_SAMPLES)
        self._problem = f"no message on {topic}: start the IMU, or set imu to its topic"
        subscription = CheckedSubscription(node, Imu, topic, self.on_imu, NEWEST)
        node.call_at_cleanup(subscription.close)

    def on_imu(self, message: Imu) -> None:
        """Take a sample of the IMU."""
        try:
            rotation, position, _ = self._transforms.newest(
                self._parent_frame, message.header.frame_id
            )
        except MissingMotion as error:
            self._problem = str(error)
            return
        a, w = message.linear_acceleration, message.angular_velocity
        force, velocity = rotation @ [a.x, a.y, a.z], rotation @ [w.x, w.y, w.z]
        # By REP 145 and sensor_msgs, -1 states that the IMU does not measure the quantity.
        if (
            message.linear_acceleration_covariance[0] == -1
            or not np.isfinite([force, velocity]).all()
        ):
            self._problem = f"{self._topic} states no acceleration: name an IMU that measures it"
            return
        time_ns = to_ns(message.header.stamp)
        before = self._samples[-1] if self._samples else None
        if before is not None and time_ns <= before.time_ns:
            # A replay has jumped, or a clock was set; the older samples are of another time.
            self._samples.clear()
            before = None
        change = acceleration = np.zeros(3)
        if before is not None and time_ns - before.time_ns <= MAX_INTERVAL_NS:
            seconds = (time_ns - before.time_ns) / SECOND
            change = (velocity - before.angular_velocity) / seconds
            # The change is that of the middle between the samples, so it is extrapolated by half.
            acceleration = 1.5 * change - 0.5 * before.change
        # alpha x r + omega x (omega x r) = G r
        turning = _cross_matrix(velocity)
        gradient = _cross_matrix(acceleration) + turning @ turning
        at_origin = force - gradient @ position
        self._samples.append(_Sample(time_ns, velocity, change, at_origin, gradient))

    def motion(self, first_ns: int, last_ns: int) -> Motion:
        """Return the motion at the samples around a span of time; see `MotionSource.motion`."""
        # A copy, because a driver in the same process calls this in another thread than `on_imu`.
        samples = tuple(self._samples)
        if len(samples) < 2:
            raise MissingMotion(self._problem)
        # From the last sample not after the span to the first not before it, and two at least.
        first = bisect_right(samples, first_ns, 1, len(samples) - 1, key=_time_ns) - 1
        last = bisect_left(samples, last_ns, first + 1, len(samples) - 1, key=_time_ns)
        chosen = samples[first : last + 1]
        late_ns, early_ns = last_ns - chosen[-1].time_ns, chosen[0].time_ns - first_ns
        limit_ns = max(MAX_EXTRAPOLATION_NS, 2 * (chosen[1].time_ns - chosen[0].time_ns))
        if max(late_ns, early_ns) > limit_ns:
            side, off_ns = ("older", late_ns) if late_ns > early_ns else ("newer", early_ns)
            raise MissingMotion(
                f"samples on {self._topic} are {off_ns / 1e9:.3f} s {side} than the rows: the IMU "
                "has stopped or is late, or its clock differs from that of this computer"
            )
        return Motion(
            np.array([sample.time_ns for sample in chosen]),
            np.array([sample.specific_force for sample in chosen]),
            np.array([sample.gradient for sample in chosen]),
        )


def _time_ns(sample: _Sample) -> int:
    return sample.time_ns


def _cross_matrix(vector: Array) -> Array:
    """Return the matrix (3, 3) of the cross product with a vector (3,) from the left."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
