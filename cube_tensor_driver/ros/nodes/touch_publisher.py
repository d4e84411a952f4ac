# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Publishes the touches of each scan (sample of every cube) on `touch`."""

from __future__ import annotations

import struct

import numpy as np
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

from ...config.skin import Skin
from ...core.rows import StressRows
from ...messages.codec import SECOND
from ...messages.types import TOUCH
from ...msg import SkinTouch
from ...touch.touch_detection import NO_TOUCHES, Touch, Touches
from ..messages import make_message, to_time
from ..node import CubeNode

STAMP = struct.Struct("<iI")
"""Seconds and nanoseconds of the stamp in a serialised message (CDR, little endian)."""

STAMP_OFFSET = 4
"""Byte offset of the time stamp from the start of a serialised message, after its encoding."""


class TouchPublisher:
    """Finds touches in the rows of a reconstruction node, and publishes one message per scan."""

    def __init__(
        self,
        node: CubeNode,
        skin: Skin,
        profile: QoSProfile,
        false_alarms: float,
    ) -> None:
        """Make the publisher.

        Args:
            node: The node, which is being configured.
            skin: The skin.
            profile: Quality of service of `touch`.
            false_alarms: Rate of touches found in noise alone, per hour, of the whole skin.
        """
        self._touch = Touch(skin, false_alarms)
        self._frame_id = skin.parent_frame
        self._publisher = node.own(node.create_lifecycle_publisher(SkinTouch, "touch", profile))
        self._rest_changes = 0
        # Most messages say that nothing touches, and differ in their stamp only.
        self._empty = bytearray(serialize_message(self._make_message(NO_TOUCHES)))

    def publish(self, rows: StressRows, rest_changes: int) -> None:
        """Find and publish the touches of one or several scans.

        Args:
            rows: Rows of stress (samples of one cube each).
            rest_changes: Number of changes of the rest frequencies (frequencies without load)
                before these rows.
        """
        if rest_changes != self._rest_changes:
            self._rest_changes = rest_changes
            self._touch.restart()
        for touches in self._touch(rows):
            # Without subscribers the touches are followed, too.
            if not self._publisher.get_subscription_count():
                continue
            if len(touches.cube):
                self._publisher.publish(self._make_message(touches))
            else:
                STAMP.pack_into(self._empty, STAMP_OFFSET, *divmod(touches.stamp_ns, SECOND))
                self._publisher.publish(bytes(self._empty))

    def _make_message(self, touches: Touches) -> SkinTouch:
        shear_x, shear_y, along_z = touches.force.T
        shear_x_uncertainty, shear_y_uncertainty, force_uncertainty = touches.force_uncertainty.T
        columns = {
            "pressure": touches.pressure,
            "pressure_uncertainty": touches.pressure_uncertainty,
            "normal_force": -along_z,
            "force_uncertainty": force_uncertainty,
            "shear_x": shear_x,
            "shear_y": shear_y,
            "shear_x_uncertainty": shear_x_uncertainty,
            "shear_y_uncertainty": shear_y_uncertainty,
        }
        return make_message(
            TOUCH,
            header=Header(stamp=to_time(touches.stamp_ns), frame_id=self._frame_id),
            cube=touches.cube.astype(np.uint16),
            **{name: column.astype(np.float32) for name, column in columns.items()},
        )
