# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Publishes stress rows (the stress of one cube at one instant each) on several topics.

All rows go to `stress`, forces of all cubes to `forces`, and the rows of single cubes to
`cubes/<name>/stress` and `cubes/<name>/wrench`. Estimated errors of the stress that are not caused
by noise go to `stress_errors`.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float32MultiArray, Header, MultiArrayDimension

from ...config.skin import Skin
from ...core.arrays import Array
from ...core.forces import Forces
from ...core.reconstructor import Reconstructor
from ...core.rows import FrequencyRows, StressRows
from ...core.status import INVALID
from ...core.stress_errors import StressErrors
from ...core.tensor import compute_contact_wrench
from ...messages.codec import stress_codec
from ...messages.point_cloud import make_cloud_message
from ...msg import SkinStress, StressTensorStamped
from ..messages import make_message, make_tensor_message, make_wrench_message, pack_array, to_time
from ..node import MAX_BUFFERS, CubeNode

LISTENERS_PERIOD_S = 0.5
"""Time, in seconds, between two searches for subscribers of the topics of single cubes
(`cubes/<name>/stress` and `cubes/<name>/wrench`)."""

MAX_ANNOUNCED_CUBES = 64
"""Maximum number of cubes of a skin whose single-cube topics (`cubes/<name>/stress` and
`cubes/<name>/wrench`) all get a publisher at the start.

On a larger skin such a publisher is made only when somebody subscribes to its topic, because DDS
sends the description of every publisher to every process in the domain.
"""

CUBE_TOPIC_DEPTH = 10
"""Depth of the queues of the topics of single cubes (`cubes/<name>/stress` and
`cubes/<name>/wrench`), in messages."""

FORCE_FIELDS = ("x", "y", "z", "fx", "fy", "fz")
"""Names of the float32 fields of a point in the point cloud `forces`: position of the cube, in m,
and force on it, in N, both in the parent frame of the skin."""


class StressPublisher:
    """Publishes the rows (stress of one cube at one instant each) of a reconstruction node."""

    def __init__(
        self,
        node: CubeNode,
        skin: Skin,
        reconstructor: Reconstructor,
        profile: QoSProfile,
        *,
        side: float | None,
        with_forces: bool,
    ) -> None:
        """Make the publishers.

        Args:
            node: The node, which is being configured.
            skin: The skin.
            reconstructor: Computes the covariances of stress and gradients.
            profile: Quality of service of `stress` and `forces`.
            side: Side, in m, of the square face over which stress is integrated to wrenches and
                forces; None: the side of the cube itself.
            with_forces: Whether `forces` is published, too.
        """
        self._buffer = lru_cache(maxsize=MAX_BUFFERS)(stress_codec.make_buffer)
        self._publisher = node.own(node.create_lifecycle_publisher(SkinStress, "stress", profile))
        forces = Forces(skin, side)
        self._cubes = CubeTopics(
            node,
            skin,
            reconstructor,
            forces.side,
        )
        self._forces = ForceCloud(node, skin, profile, forces) if with_forces else None
        self._errors = ErrorPublisher(node, reconstructor)
        node.own(node.create_timer(LISTENERS_PERIOD_S, self._cubes.find_listeners))

    def make_rows(self, rows: FrequencyRows, frame_id: bytes) -> StressRows:
        """Return rows of stress for the caller to fill; they are views of the next message's bytes.

        Args:
            rows: Rows of frequencies (samples of one cube each). Their cubes, sequence numbers and
                stamps are copied into the returned rows.
            frame_id: Frame id of the message, encoded and with a closing zero byte.
        """
        self._message = self._buffer(frame_id, len(rows))
        out = self._message.rows
        out.cube[:] = rows.cube
        out.sequence[:] = rows.sequence
        out.stamp_ns[:] = rows.stamp_ns
        return out

    def publish(self, stamp_ns: int) -> None:
        """Publish the rows that `make_rows` returned last and the caller has filled.

        They become one message of `stress`, and messages of `forces` and of the topics of single
        cubes that have subscribers.

        Args:
            stamp_ns: Stamp of the message, in ns since the Unix epoch.
        """
        stress = self._message.rows
        # The errors come first, so that nobody takes the stress for more certain than it is.
        self._errors.publish(stress, stamp_ns)
        self._publisher.publish(self._message.encode(stamp_ns))
        self._cubes.publish(stress)
        if self._forces is not None:
            self._forces.publish(stress, stamp_ns)


class ErrorPublisher:
    """Publishes `stress_errors`: how uncertain the newest stress is for other reasons than noise.

    The message contains the result of `Reconstructor.errors` for all cubes. It is published only
    while something is compensated, or drift is tracked or stated in a calibration, and while the
    topic has subscribers.
    """

    def __init__(self, node: CubeNode, reconstructor: Reconstructor) -> None:
        self._errors = StressErrors(reconstructor)
        self._publisher = node.own(
            node.create_lifecycle_publisher(Float32MultiArray, "stress_errors", 2)
        )

    def publish(self, rows: StressRows, stamp_ns: int) -> None:
        """Publish the errors if they are due, see `StressErrors`.

        Args:
            rows: Rows of stress, one cube at one sampling time each.
            stamp_ns: Stamp of their message, in ns since the Unix epoch.
        """
        if not self._publisher.get_subscription_count():
            return
        errors = self._errors.update(rows, stamp_ns)
        if errors is None:
            return
        message = Float32MultiArray(data=pack_array("f", errors))
        labels = "cube", "component", "cause"
        for axis, (label, size) in enumerate(zip(labels, errors.shape, strict=True)):
            stride = math.prod(errors.shape[axis:])
            message.layout.dim.append(MultiArrayDimension(label=label, size=size, stride=stride))
        self._publisher.publish(message)


class ForceCloud:
    """Publishes `forces`, a point cloud with one force per cube in the order of the skin file.

    It is published only while it has subscribers. Software for other tactile sensors can read this
    form.
    """

    def __init__(
        self,
        node: CubeNode,
        skin: Skin,
        profile: QoSProfile,
        forces: Forces,
    ) -> None:
        self._forces = forces
        self._publisher = node.own(node.create_lifecycle_publisher(PointCloud2, "forces", profile))
        # The message is made once, and later only its data and stamp are replaced. The description
        # of its fields consists of many Python objects that never change.
        points = np.zeros((len(skin.cubes), len(FORCE_FIELDS)))
        self._message: PointCloud2 = make_cloud_message(
            make_message,
            0,
            skin.parent_frame,
            FORCE_FIELDS,
            points,
        )

    def publish(self, rows: StressRows, stamp_ns: int) -> None:
        """Publish the force of the last row of each cube; it is NaN for cubes without a row.

        Args:
            rows: Rows of stress, one cube at one sampling time each.
            stamp_ns: Stamp of the message, in ns since the Unix epoch.
        """
        if not self._publisher.get_subscription_count():
            return
        force = self._forces.compute_in_parent_frame(rows)
        points = np.hstack([self._forces.position, force])
        point_bytes = points.astype("<f4").view(np.uint8)
        self._message.data = pack_array("B", point_bytes)
        self._message.is_dense = bool(np.isfinite(force).all())
        self._message.header.stamp = to_time(stamp_ns)
        self._publisher.publish(self._message)


class CubeTopics:
    """Publishes the topics of single cubes, `cubes/<name>/stress` and `cubes/<name>/wrench`.

    A topic is published only while it has subscribers.
    """

    def __init__(
        self,
        node: CubeNode,
        skin: Skin,
        reconstructor: Reconstructor,
        sides: Array,
    ) -> None:
        self._skin = skin
        self._reconstructor = reconstructor
        self._sides = sides
        self._tensors = _CubePublishers(
            node,
            skin,
            "stress",
            StressTensorStamped,
        )
        self._wrenches = _CubePublishers(
            node,
            skin,
            "wrench",
            WrenchStamped,
        )

    def find_listeners(self) -> None:
        """Update the lists of cubes whose topics have subscribers. A timer calls this method."""
        self._tensors.find_listeners()
        self._wrenches.find_listeners()

    def publish(self, rows: StressRows) -> None:
        """Publish rows on the topics of their cubes that have subscribers.

        A wrench is published only for valid rows.

        Args:
            rows: Rows of stress: one cube at one sampling time each.
        """
        # The lists are read only once: `find_listeners` may replace them meanwhile in the main
        # thread, if a driver in this process calls this method in its own thread.
        tensors = self._tensors.listened
        wrenches = self._wrenches.listened
        if wrenches:
            self._publish_wrenches(rows, wrenches)
        if tensors:
            self._publish_tensors(rows, tensors)

    def _publish_tensors(self, rows: StressRows, listened: list[int]) -> None:
        is_chosen = np.isin(rows.cube, listened)
        for row in np.flatnonzero(is_chosen).tolist():
            cube = int(rows.cube[row])
            left_out = int(rows.left_out[row])
            covariance = self._reconstructor.compute_covariance(cube, left_out)
            header = self._make_header(rows, row, cube)
            message = make_tensor_message(header, rows, row, covariance)
            self._tensors.publish(cube, message)

    def _publish_wrenches(self, rows: StressRows, listened: list[int]) -> None:
        # `compute_contact_wrench` would compute the wrench 0 for an invalid row, which looks like
        # the measurement of no load.
        is_listened = np.isin(rows.cube, listened)
        is_valid = rows.status & INVALID == 0
        chosen = np.flatnonzero(is_listened & is_valid)
        cubes = rows.cube[chosen].tolist()
        stress = rows.stress[chosen]
        gradient = rows.gradient[chosen]
        sides = self._sides[cubes][:, None]
        forces, torques = compute_contact_wrench(stress, gradient, sides)
        each = zip(
            chosen.tolist(),
            cubes,
            forces,
            torques,
            strict=True,
        )
        for row, cube, force, torque in each:
            header = self._make_header(rows, row, cube)
            message = make_wrench_message(header, force, torque)
            self._wrenches.publish(cube, message)

    def _make_header(self, rows: StressRows, row: int, cube: int) -> Header:
        stamp = to_time(int(rows.stamp_ns[row]))
        frame_id = self._skin.make_frame_id(self._skin.cubes[cube])
        return Header(stamp=stamp, frame_id=frame_id)


class _CubePublishers:
    """The publishers of the topics `cubes/<name>/stress` of all cubes, or `cubes/<name>/wrench`.

    Attributes:
        listened: Indices of the cubes whose topic has a subscriber.
    """

    def __init__(
        self,
        node: CubeNode,
        skin: Skin,
        what: str,
        message_type: type,
    ) -> None:
        """Make the publishers, unless the skin is large (see `MAX_ANNOUNCED_CUBES`).

        Args:
            node: The node, which is being configured.
            skin: The skin.
            what: Last part of the names of the topics, stress or wrench.
            message_type: Type of the messages.
        """
        self.listened: list[int] = []
        self._node = node
        self._message_type = message_type
        self._publishers: dict[int, Publisher] = {}
        # Name of a topic that has no publisher yet -> index of its cube.
        self._unannounced = {
            node.resolve_topic_name(f"cubes/{name}/{what}"): number
            for number, name in enumerate(skin.names)
        }
        if len(skin.cubes) <= MAX_ANNOUNCED_CUBES:
            self._announce(set(self._unannounced))

    def find_listeners(self) -> None:
        """Update the attribute `listened`.

        First, publishers are made for topics that have a subscriber but no publisher yet.
        """
        if self._unannounced:
            known_topics = {name for name, _ in self._node.get_topic_names_and_types()}
            self._announce(known_topics & self._unannounced.keys())
        self.listened = [
            cube
            for cube, publisher in self._publishers.items()
            if publisher.get_subscription_count()
        ]

    def publish(
        self,
        cube: int,
        message: StressTensorStamped | WrenchStamped,
    ) -> None:
        """Publish a message of a cube.

        Args:
            cube: Index of the cube, which is in `listened`.
            message: Stress or wrench of the cube.
        """
        self._publishers[cube].publish(message)

    def _announce(self, topics: set[str]) -> None:
        for topic in sorted(topics):
            cube = self._unannounced.pop(topic)
            publisher: Publisher = self._node.create_publisher(
                self._message_type,
                topic,
                CUBE_TOPIC_DEPTH,
            )
            self._publishers[cube] = self._node.own(publisher)
