# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Publishes wrenches as state interfaces of ros2_control, the framework of robot controllers.

The hardware component ``cm_topic_hardware_component/CMTopicSystem`` of ros2_control turns two
topics, ``<component>/names`` and ``<component>/values``, into state interfaces (numbers that
controllers read). The source code of this component decides what is sent here. The component finds
the names that belong to values by their common version, and takes version 0 for "no data yet". It
warns in every cycle while it does not know the version, and returns the last values for ever if no
more come.
"""

from __future__ import annotations

import threading
import time
import zlib
from array import array

import numpy as np
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import Header

from ...config.skin import Skin
from ...core.arrays import Array
from ...core.errors import ConfigError
from ...core.forces import Forces
from ...core.rows import StressRows
from ...core.status import INVALID
from ...core.tensor import compute_contact_wrench
from ...device.links.session import SILENT_S
from ..messages import find_message_class, pack_array, to_time
from ..node import CubeNode
from ..qos import DEFAULT_RATE_HZ

COMPONENTS = ("force.x", "force.y", "force.z", "torque.x", "torque.y", "torque.z")
"""Names of the state interfaces of a force-torque sensor: forces in N, torques in N m."""

NAMES_PERIOD_S = 1.0
"""Time, in s, between two messages with the names of the state interfaces. They are repeated
because the hardware component of ros2_control does not get messages that were sent before it
subscribed."""

CHECK_PERIOD_S = 0.1
"""Time, in s, between two checks. A check sets the wrenches of cubes whose last row (sample) is too
old to NaN, and sends the names of the state interfaces to new subscribers."""

LAST_VALUES_S = 0.2
"""Time, in s, for which NaN is repeated before the publisher of the values is destroyed. DDS
discards what a subscriber has not yet taken when the publisher ends, so that a controller manager
that is late by a few milliseconds would miss a single message."""

LAST_VALUES_PERIOD_S = 0.02
"""Time, in s, between two of the messages with NaN for all wrenches that the node sends for
`LAST_VALUES_S` before its publisher of the values is destroyed."""


class SkinWrenches:
    """The latest wrench of each cube of a skin and of the whole skin; NaN where it is not known.

    The wrench of a cube acts on its face +z and is given in the frame of the cube. The wrench of
    the skin is the sum of the wrenches of all cubes about the origin of the parent frame, in that
    frame; it is known only if the wrenches of all cubes are known.

    Attributes:
        names: Names of the cubes, then that of the skin.
    """

    def __init__(
        self,
        skin: Skin,
        side: float | None,
        stale_s: float,
    ) -> None:
        """Prepare the wrenches of a skin.

        Args:
            skin: The skin.
            side: Side of the square face over which stress is integrated, in m; None: the side of
                the cube itself.
            stale_s: Time without a row (sample) of a cube after which its wrench is unknown, in s.

        Raises:
            ConfigError: The skin has the name of one of its cubes.
        """
        if skin.name in skin.names:
            raise ConfigError(f"hardware_name: skin and cube are named {skin.name}; rename one")
        self.names = [*skin.names, skin.name]
        self._side = Forces(skin, side).side
        self._position, self._rotation, _ = skin.poses
        n_cubes = len(skin.cubes)
        self._wrench = np.full((n_cubes, 6), np.nan)
        self._arrived = np.full(n_cubes, -np.inf)
        self._stale_s = stale_s

    def update(self, rows: StressRows, now: float) -> None:
        """Compute the wrenches of cubes from new rows. Of several rows of a cube, the last counts.

        Args:
            rows: Rows of stress, one sample of one cube each. Rows of cubes that the skin does not
                have are ignored.
            now: Time of arrival, in s from any origin.
        """
        rows = rows.select(rows.cube < len(self._wrench))
        sides = self._side[rows.cube, None]
        force, torque = compute_contact_wrench(
            rows.stress,
            rows.gradient,
            sides,
        )
        wrench = np.hstack([force, torque])
        # `compute_contact_wrench` counts unknown components as 0, which would look like no load.
        is_invalid = rows.status & INVALID != 0
        wrench[is_invalid] = np.nan
        self._wrench[rows.cube] = wrench
        self._arrived[rows.cube] = now

    def forget_stale(self, now: float) -> bool:
        """Set the wrenches of cubes whose last row (sample) is too old to NaN.

        Args:
            now: Present time, in s, on the clock of `update`.

        Returns:
            Whether a wrench that was known has become unknown.
        """
        is_stale = now - self._arrived > self._stale_s
        is_known = ~np.isnan(self._wrench[:, 0])
        is_lost = is_stale & is_known
        self._wrench[is_lost] = np.nan
        return bool(is_lost.any())

    def compute_wrenches(self) -> Array:
        """Return the wrenches of all cubes and of the skin, (cubes + 1, 6).

        The rows are in the order of `names`, and the columns in the order of `COMPONENTS`.
        """
        rotation = self._rotation
        force = np.einsum("nij,nj->ni", rotation, self._wrench[:, :3])
        torque = np.einsum("nij,nj->ni", rotation, self._wrench[:, 3:])
        torque_about_origin = torque + np.cross(self._position, force)
        total_force = force.sum(axis=0)
        total_torque = torque_about_origin.sum(axis=0)
        total = np.hstack([total_force, total_torque])
        return np.vstack([self._wrench, total])


def make_state_interfaces(node: CubeNode, skin: Skin) -> StateInterfaces | None:
    """Return the publisher of wrenches as state interfaces (controller inputs) of ros2_control.

    Args:
        node: The node `reconstruction`, which is being configured.
        skin: The skin.

    Returns:
        The publisher; None if the parameter `hardware_name` is empty.

    Raises:
        CubeError: The skin has the same name as one of its cubes, so that their interfaces would
            have the same names, or the package pal_statistics_msgs is not installed.
    """
    component = node.read_value("hardware_name")
    if not component:
        return None
    # A wrench is unknown when the link counts as silent (after three sample periods, at least
    # SILENT_S). Rows are sent only once per publish period, so this period is added.
    silent_s = max(SILENT_S, 3 / (skin.rate or DEFAULT_RATE_HZ))
    stale_s = silent_s + node.read_value("publish_period")
    wrenches = SkinWrenches(
        skin,
        node.read_value("wrench_side") or None,
        stale_s,
    )
    return StateInterfaces(node, skin, component, wrenches)


class StateInterfaces:
    """Publishes the wrenches of a skin for a hardware component of ros2_control, until the node is
    cleaned up."""

    def __init__(
        self,
        node: CubeNode,
        skin: Skin,
        component: str,
        wrenches: SkinWrenches,
    ) -> None:
        """Make the publishers.

        Args:
            node: The node, which is being configured.
            skin: The skin.
            component: Name of the hardware component in the URDF of the robot.
            wrenches: The wrenches to publish.

        Raises:
            BagError: The package pal_statistics_msgs is not installed.
        """
        self._wrenches = wrenches
        self._frame_id = skin.parent_frame
        # The lock guards the wrenches. Two threads use them if the driver runs in this process.
        self._lock = threading.Lock()
        # The names of the topics begin with the name of the component's node, which ros2_control
        # derives from the name of the component by this rule.
        topic = component.lower().replace("/", "_")
        kinds = [
            find_message_class(
                "parameter hardware_name",
                f"pal_statistics_msgs/msg/Statistics{what}",
            )
            for what in ("Names", "Values")
        ]
        self._names_publisher, self._publisher = (
            node.own(node.create_publisher(kind, f"{topic}/{what}", qos_profile_sensor_data))
            for kind, what in zip(kinds, ("names", "values"), strict=True)
        )
        names = [f"state_interface.{one}/{part}" for one in wrenches.names for part in COMPONENTS]
        # The component finds the names that belong to values by their version. So other names need
        # another version, also after a restart of the node, and the version is computed from the
        # names. It is not 0, which would mean that there are no data.
        version = zlib.crc32("\n".join(names).encode()) or 1
        self._names = kinds[0](names=names, names_version=version)
        self._values = kinds[1](names_version=version)
        self._listeners = 0
        self._names_at = 0.0
        node.own(node.create_timer(CHECK_PERIOD_S, self._check))
        node.call_at_cleanup(self._forget_all)

    def publish(self, rows: StressRows, stamp_ns: int) -> None:
        """Compute wrenches from new rows, and publish the newest wrenches of all cubes.

        Args:
            rows: New rows of stress, one sample of one cube each.
            stamp_ns: Stamp of the message, in ns since the Unix epoch.
        """
        with self._lock:
            self._wrenches.update(rows, time.monotonic())
            self._send(stamp_ns)

    def _check(self) -> None:
        """Publish the names of the state interfaces if they are due or have a new subscriber, and
        set wrenches to NaN that are too old."""
        now = time.monotonic()
        listeners = self._names_publisher.get_subscription_count()
        if listeners > self._listeners or now >= self._names_at:
            self._names_publisher.publish(self._names)
            self._names_at = now + NAMES_PERIOD_S
        self._listeners = listeners
        with self._lock:
            if self._wrenches.forget_stale(now):
                self._send(time.time_ns())

    def _forget_all(self) -> None:
        """Publish NaN for all wrenches, because the hardware component would otherwise return the
        last values for ever."""
        end = time.monotonic() + LAST_VALUES_S
        with self._lock:
            self._wrenches.forget_stale(np.inf)
            while time.monotonic() < end:
                self._send(time.time_ns())
                time.sleep(LAST_VALUES_PERIOD_S)

    def _send(self, stamp_ns: int) -> None:
        stamp = to_time(stamp_ns)
        self._values.header = Header(stamp=stamp, frame_id=self._frame_id)
        values: array[float] = pack_array("d", self._wrenches.compute_wrenches())
        self._values.values = values
        self._publisher.publish(self._values)
