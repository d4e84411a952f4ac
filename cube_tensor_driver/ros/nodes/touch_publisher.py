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
"""Binary format of the stamp in a serialised message (CDR, little endian): seconds (int32), then
nanoseconds (uint32)."""

STAMP_OFFSET = 4
"""Offset of the stamp from the start of a serialised message, in bytes. The first four bytes of a
message state its encoding (CDR encapsulation header)."""


class TouchPublisher:
    """Finds touches in the stress of a skin, and publishes one message on `touch` for each scan.

    A scan is one sample of every cube.
    """

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
            false_alarms: Accepted rate of false alarms of the whole skin, per hour. A false alarm
                is a touch that is found although there is only noise.
        """
        self._touch = Touch(skin, false_alarms)
        self._frame_id = skin.parent_frame
        self._publisher = node.own(node.create_lifecycle_publisher(SkinTouch, "touch", profile))
        self._rest_changes = 0
        # Most messages contain no touch and differ only in their stamps, so such a message is
        # serialised once, and later only its stamp is replaced.
        self._empty = bytearray(serialize_message(self._make_message(NO_TOUCHES)))

    def publish(self, rows: StressRows, rest_changes: int) -> None:
        """Find and publish the touches of one or several scans.

        Args:
            rows: Rows of stress (samples of one cube each).
            rest_changes: Number of times that the rest frequencies (frequencies without load) have
                changed before these rows. After a change the detection is restarted.
        """
        if rest_changes != self._rest_changes:
            self._rest_changes = rest_changes
            self._touch.restart()
        for touches in self._touch(rows):
            # Without subscribers only publishing is left out. The detection above must go on,
            # because it compares each scan with earlier ones.
            if not self._publisher.get_subscription_count():
                continue
            if len(touches.cube):
                self._publisher.publish(self._make_message(touches))
            else:
                seconds, nanoseconds = divmod(touches.stamp_ns, SECOND)
                STAMP.pack_into(
                    self._empty,
                    STAMP_OFFSET,
                    seconds,
                    nanoseconds,
                )
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
        header = Header(stamp=to_time(touches.stamp_ns), frame_id=self._frame_id)
        arrays = {name: column.astype(np.float32) for name, column in columns.items()}
        return make_message(
            TOUCH,
            header=header,
            cube=touches.cube.astype(np.uint16),
            **arrays,
        )
