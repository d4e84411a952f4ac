# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The motion of a skin from an IMU or from TF, for the compensation of weight and inertia.

A cube cannot measure its own acceleration while loads act on it, because a load can cause the same
stresses. So the motion comes from elsewhere.
"""

from __future__ import annotations

import math
import struct
from typing import Any, NamedTuple

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
from ..messages.codec import LITTLE_ENDIAN, SECOND
from .messages import log_refused_message, to_ns
from .node import CubeNode
from .qos import NEWEST

MAX_SAMPLES = 4096
"""Maximum number of samples of an IMU that are kept. When it is reached, the older half is dropped.

A message of frequencies covers up to 1 s, in which an IMU with 1 kHz sends 1000 samples. So the
2048 samples that are left suffice.
"""

MAX_TRANSFORM_AGE_NS = SECOND
"""Maximum difference, in ns, between the time of a transform and the time of the newest row (sample
of a cube). With an older transform the direction of gravity counts as unknown. The limit does not
apply to static transforms."""


class MissingMotion(CubeError):
    """The motion of the skin is unknown. The text of the error states the reason and the remedy."""


def make_motion_source(
    node: CubeNode,
    parent_frame: str,
) -> ImuMotion | GravityMotion | None:
    """Return the source of the motion that a parameter of a node selects.

    The parameter `imu` selects an IMU by its topic, and the parameter `gravity` selects TF by the
    name of a frame whose z axis points up. If both are empty, the result is None.

    Args:
        node: The node, which is being configured.
        parent_frame: Parent frame of the skin.

    Raises:
        ConfigError: Both parameters are set.
    """
    topic = str(node.read_value("imu"))
    frame = str(node.read_value("gravity"))
    if topic and frame:
        raise ConfigError(f"parameters imu ({topic}) and gravity ({frame}): set only one of them")
    if topic:
        return ImuMotion(node, topic, parent_frame)
    return GravityMotion(node, frame, parent_frame) if frame else None


class Transforms:
    """Receives the transforms between frames on the topics /tf and /tf_static."""

    def __init__(self, node: CubeNode) -> None:
        # The import is here and not at the top, so that robots without TF need not install tf2_ros.
        try:
            import tf2_ros
        except ModuleNotFoundError:
            self._buffer: Any = None
            return
        self._buffer = tf2_ros.Buffer()
        self._error = tf2_ros.TransformException
        listener = tf2_ros.TransformListener(self._buffer, node)
        node.call_at_cleanup(listener.unregister)

    def find_newest(
        self,
        target: str,
        source: str,
    ) -> tuple[Array, Array, int]:
        """Return the newest transform from one frame to another.

        Args:
            target: Frame into which vectors are transformed.
            source: Frame in which the vectors are given.

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
                f"no transform from {source} to {target}: {str(error).rstrip(' .')}; publish it "
                "on /tf or /tf_static"
            ) from None
        p = found.transform.translation
        q = found.transform.rotation
        rotation = rotation_from_quaternion([q.x, q.y, q.z, q.w])
        position = np.array([p.x, p.y, p.z])
        time_ns = to_ns(found.header.stamp)
        return rotation, position, time_ns


class GravityMotion:
    """The motion of a skin that moves so slowly that its acceleration is negligible.

    The specific force is then opposite to gravity, whose direction in the parent frame of the skin
    is taken from TF.
    """

    def __init__(
        self,
        node: CubeNode,
        frame: str,
        parent_frame: str,
    ) -> None:
        """Listen to TF.

        Args:
            node: The node, which is being configured.
            frame: Frame whose z axis points up.
            parent_frame: Parent frame of the skin.
        """
        self._frame = frame
        self._parent_frame = parent_frame
        self._transforms = Transforms(node)

    def compute_motion(self, first_ns: int, last_ns: int) -> Motion:
        """Return the motion of the skin at the end of a span of time: the specific force of a body
        at rest, whose direction is taken from the newest transform of TF.

        Arguments and errors are those of `ImuMotion.compute_motion`.
        """
        rotation, _, time_ns = self._transforms.find_newest(self._parent_frame, self._frame)
        age_ns = last_ns - time_ns
        if time_ns and abs(age_ns) > MAX_TRANSFORM_AGE_NS:
            side = "older" if age_ns > 0 else "newer"
            raise MissingMotion(
                f"transform from {self._frame} to {self._parent_frame} is "
                f"{abs(age_ns) / 1e9:.1f} s {side} than the rows: see who publishes it, and that "
                "clocks agree"
            )
        state = np.zeros((1, 4, 3))
        state[0, 0] = STANDARD_GRAVITY * rotation[:, 2]
        return Motion(np.array([last_ns]), state)


IMU_HEADER = struct.Struct("<4xiII")
"""Layout of the beginning of a serialised message sensor_msgs/Imu (little-endian CDR): seconds and
nanoseconds of the stamp, and length of the frame id. The frame id follows."""

IMU_NUMBERS = struct.Struct("<104x3d72x4d")
"""Layout of the numbers behind the frame id in a serialised message sensor_msgs/Imu: angular
velocity, linear acceleration, and the first element of the covariance of the linear acceleration.
Orientation and other covariances are skipped."""

Vector = tuple[float, ...]
"""A few numbers, such as the components x, y and z of a vector. Computing with a tuple of floats is
faster than with a short numpy array."""

UNKNOWN: Vector = (math.nan,) * 3
"""Vector that is not known."""

MOUNTING_PERIOD_NS = SECOND
"""Time, in ns, after which the transform from an IMU to the parent frame is read again. It rarely
changes, because both are fixed to one rigid body."""


class _Sample(NamedTuple):
    """One sample of an IMU, in the frame of the IMU.

    Attributes:
        time_ns: Time of the sample, in ns since the Unix epoch.
        angular_velocity: Angular velocity, in rad/s.
        mean_acceleration: Mean angular acceleration since the sample before, in rad/s²; None if
            there was none shortly before.
        motion: Specific force, in m/s², then the 9 numbers of its gradient row by row, as in
            `Motion`; the gradient is NaN if there was no sample shortly before.
    """

    time_ns: int
    angular_velocity: Vector
    mean_acceleration: Vector | None
    motion: Vector


class ImuMotion:
    """The motion of a skin from an IMU that is fixed to the same rigid body."""

    def __init__(
        self,
        node: CubeNode,
        topic: str,
        parent_frame: str,
    ) -> None:
        """Subscribe to an IMU.

        Args:
            node: The node, which is being configured.
            topic: Topic of sensor_msgs/Imu.
            parent_frame: Parent frame of the skin.
        """
        self._topic = topic
        self._parent_frame = parent_frame
        self._transforms = Transforms(node)
        # `compute_motion` may read the list in another thread. So samples are only ever
        # appended to it, and it is replaced by another list to drop some.
        self._samples: list[_Sample] = []
        self._imu_frame = parent_frame
        # Result of `_find_mounting`; frame of the IMU, and time at which the transform was read.
        self._mounting = np.eye(12)
        self._mounted = "", 0
        self._problem = f"no message on {topic}: start the IMU, or set imu to its topic"
        self._node = node
        node.own(
            node.create_subscription(
                Imu,
                topic,
                self.on_imu,
                NEWEST,
                raw=True,
            )
        )

    def on_imu(self, data: bytes) -> None:
        """Store a serialised message of the IMU, which `compute_motion` uses.

        A message that cannot be used is ignored; the reason is stored as the text of the error that
        `compute_motion` raises.
        """
        try:
            time_ns, force, velocity, self._imu_frame = _decode(data)
        except (ValueError, struct.error) as error:
            log_refused_message(self._node, self._topic, error)
            return
        if not math.isfinite(sum(force) + sum(velocity)):
            self._problem = f"{self._topic} states no acceleration: name an IMU that measures it"
            return
        mean, acceleration = None, UNKNOWN
        if self._samples:
            before = self._samples[-1]
            interval_ns = time_ns - before.time_ns
            if interval_ns <= 0:
                # Time went back, because a replay has jumped or a clock was set. Older samples
                # cannot be compared with new ones any more.
                self._samples = []
            elif interval_ns <= MAX_INTERVAL_NS:
                rate = SECOND / interval_ns
                changes = zip(velocity, before.angular_velocity, strict=True)
                mean = tuple([(now - then) * rate for now, then in changes])
                # The mean angular acceleration is taken as that in the middle of the interval
                # between the samples. It is extrapolated linearly to the end of the interval, the
                # time of the new sample.
                means = zip(
                    mean,
                    before.mean_acceleration or mean,
                    strict=True,
                )
                acceleration = tuple([1.5 * now - 0.5 * then for now, then in means])
        if len(self._samples) == MAX_SAMPLES:
            self._samples = self._samples[MAX_SAMPLES // 2 :]
        motion = force + _find_gradient(velocity, acceleration)
        self._samples.append(_Sample(time_ns, velocity, mean, motion))

    def compute_motion(self, first_ns: int, last_ns: int) -> Motion:
        """Return the motion at the times of the IMU's samples before, in and after a span of time.

        The caller interpolates between these times.

        Args:
            first_ns: Start of the span, in ns since the Unix epoch.
            last_ns: End of the span, in ns since the Unix epoch.

        Raises:
            MissingMotion: The motion in this span is unknown.
        """
        samples = self._samples
        if len(samples) < 2:
            raise MissingMotion(self._problem)
        # The chosen samples enclose the span of time if possible. At least two are chosen, so that
        # the motion can be extrapolated.
        newest = len(samples) - 1
        first = newest - 1
        while first > 0 and samples[first].time_ns > first_ns:
            first -= 1
        last = first + 1
        while last < newest and samples[last].time_ns < last_ns:
            last += 1
        late_ns = last_ns - samples[last].time_ns
        early_ns = samples[first].time_ns - first_ns
        interval_ns = samples[first + 1].time_ns - samples[first].time_ns
        limit_ns = max(MAX_EXTRAPOLATION_NS, 2 * interval_ns)
        if max(late_ns, early_ns) > limit_ns:
            side, off_ns = ("older", late_ns) if late_ns > early_ns else ("newer", early_ns)
            raise MissingMotion(
                f"samples on {self._topic} are {off_ns / 1e9:.3f} s {side} than the rows: the IMU "
                "has stopped or is late, or its clock differs from that of this computer"
            )
        chosen = samples[first : last + 1]
        time_ns = np.array([sample.time_ns for sample in chosen])
        in_imu = np.array([sample.motion for sample in chosen])
        in_parent = in_imu @ self._find_mounting(last_ns)
        return Motion(time_ns, in_parent.reshape(-1, 4, 3))

    def _find_mounting(self, now_ns: int) -> Array:
        """Return the matrix (12, 12) that transforms motions from the IMU to the parent frame.

        A motion is a row of 12 numbers: the specific force s and its gradient G. It is multiplied
        by the matrix from the right. In the parent frame the gradient is G' = R G R^T, and the
        specific force at its origin is s' = R s - G' p, with the rotation R and the position p of
        the IMU.
        """
        frame, read_ns = self._mounted
        if frame != self._imu_frame or abs(now_ns - read_ns) > MOUNTING_PERIOD_NS:
            frame = self._imu_frame
            rotation, position, _ = self._transforms.find_newest(self._parent_frame, frame)
            of_gradient = np.kron(rotation, rotation)
            lever = -np.kron(np.eye(3), position) @ of_gradient
            self._mounting = np.zeros((12, 12))
            self._mounting[:3, :3] = rotation.T
            self._mounting[3:, :3] = lever.T
            self._mounting[3:, 3:] = of_gradient.T
            self._mounted = frame, now_ns
        return self._mounting


def _decode(data: bytes) -> tuple[int, Vector, Vector, str]:
    """Decode the needed fields of a serialised message sensor_msgs/Imu.

    rclpy decodes all fields, which takes ten times as long.

    Returns:
        Time stamp, in ns; specific force, NaN if the IMU does not measure it; angular velocity; and
        name of the frame.

    Raises:
        struct.error: The message is too short.
        ValueError: It is not little-endian CDR, or its frame is no text.
    """
    if data[:2] != LITTLE_ENDIAN[:2]:
        raise ValueError("not little-endian CDR")
    seconds, nanoseconds, length = IMU_HEADER.unpack_from(data)
    text_end = IMU_HEADER.size + length
    # The numbers are aligned to 8 bytes, from the end of the first four bytes.
    begin = -(-(text_end - 4) // 8) * 8 + 4
    numbers = IMU_NUMBERS.unpack_from(data, begin)
    # According to sensor_msgs/Imu, a first covariance of -1 means that there is no measurement.
    force = numbers[3:6] if numbers[6] != -1 else UNKNOWN
    frame = data[IMU_HEADER.size : text_end - 1].decode()
    return seconds * SECOND + nanoseconds, force, numbers[:3], frame


def _find_gradient(velocity: Vector, acceleration: Vector) -> Vector:
    """Return the gradient of the specific force on a rigid body, 9 numbers row by row, in 1/s².

    The acceleration at the position r relative to that at the origin is
    alpha x r + omega x (omega x r) = G r with the gradient G.

    Args:
        velocity: Angular velocity omega, in rad/s.
        acceleration: Angular acceleration alpha, in rad/s².
    """
    x, y, z = velocity
    a, b, c = acceleration
    return (
        *(-y * y - z * z, x * y - c, x * z + b),
        *(x * y + c, -x * x - z * z, y * z - a),
        *(x * z - b, y * z + a, -x * x - y * y),
    )
