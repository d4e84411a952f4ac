# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Publishes the touches of each scan (sample of every cube) on `touch`."""

from __future__ import annotations

import struct
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING

from rclpy.qos import QoSProfile

from ...config.skin import Skin
from ...core.reconstructor import Reconstructor
from ...core.rows import StressRows
from ...messages.codec import SECOND
from ...messages.touch import encode_touch
from ...msg import SkinTouch
from ..node import CubeNode

if TYPE_CHECKING:
    from ...touch.touch_detection import Touch

STAMP = struct.Struct("<iI")
"""Binary format of the stamp in a serialised message (CDR, little endian): seconds (int32), then
nanoseconds (uint32)."""

STAMP_OFFSET = 4
"""Offset of the stamp from the start of a serialised message, in bytes. The first four bytes of a
message state its encoding (CDR encapsulation header)."""


class TouchPublisher:
    """Finds touches in the stress of a skin, and publishes one message on `touch` for each scan.

    A scan is one sample of every cube. Without a subscriber nothing is computed. At the first
    subscriber, the detection is set up in another thread, because that takes seconds on a large
    bent skin.
    """

    def __init__(
        self,
        node: CubeNode,
        skin: Skin,
        profile: QoSProfile,
        false_alarms: float,
        reconstructor: Reconstructor,
    ) -> None:
        """Make the publisher.

        Args:
            node: The node, which is being configured.
            skin: The skin.
            profile: Quality of service of `touch`.
            false_alarms: Accepted rate of false alarms of the whole skin, per hour. A false alarm
                is a touch that is found although there is only noise.
            reconstructor: Computes the stress, and states its errors.
        """
        self._skin = skin
        self._false_alarms = false_alarms
        self._reconstructor = reconstructor
        self._worker = ThreadPoolExecutor(1)
        self._future: Future[Touch] | None = None
        self._publisher = node.own(node.create_lifecycle_publisher(SkinTouch, "touch", profile))
        self._rest_changes = 0

    def _set_up(self) -> Touch:
        """Set up the detection, and the message without touches."""
        # The import takes time, which a node that nobody asks for touches does not need.
        from ...touch.touch_detection import NO_TOUCHES, Touch

        # Most messages contain no touch and differ only in their stamps, so such a message is
        # serialised once, and later only its stamp is replaced.
        self._empty = bytearray(encode_touch(self._skin.parent_frame, NO_TOUCHES))
        return Touch(
            self._skin,
            self._false_alarms,
            self._reconstructor.errors,
        )

    def publish(self, rows: StressRows, rest_changes: int) -> None:
        """Find and publish the touches of one or several scans.

        Args:
            rows: Rows of stress (samples of one cube each).
            rest_changes: Number of times that the rest frequencies (frequencies without load) have
                changed before these rows. After a change the detection is restarted.
        """
        if not self._publisher.get_subscription_count():
            return
        if self._future is None:
            self._future = self._worker.submit(self._set_up)
        if not self._future.done():
            return
        touch = self._future.result()
        if rest_changes != self._rest_changes:
            self._rest_changes = rest_changes
            touch.restart()
        for touches in touch(rows):
            if len(touches.cube):
                self._publisher.publish(encode_touch(self._skin.parent_frame, touches))
            else:
                seconds, nanoseconds = divmod(touches.stamp_ns, SECOND)
                STAMP.pack_into(
                    self._empty,
                    STAMP_OFFSET,
                    seconds,
                    nanoseconds,
                )
                self._publisher.publish(bytes(self._empty))
