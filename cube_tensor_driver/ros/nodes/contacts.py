# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The node `contacts`: computes position, size and force of contacts on the skin from `stress`."""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields
from functools import partial

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float32MultiArray

from ...config.parameters import CONTACTS
from ...core.arrays import Array, Index
from ...core.modes import COMPONENTS
from ...messages.contacts import encode_contacts, make_traction_message
from ...messages.skin_info import read_cube_calibrations, read_skin_elastomer
from ...msg import SkinContacts, SkinTouch
from ...touch.contact_finder import ContactFinder, ContactSettings, make_contact_finder
from ...touch.touch_detection import NO_TOUCHES, Touches
from ..diagnostics.updater import Diagnostics, make_status
from ..messages import make_message
from ..node import run
from ..qos import NEWEST
from ..skin_subscriber import FollowedSkin, SkinSubscriberNode

RETRY_PERIOD_S = 5.0
"""Time, in seconds, from a failed set-up of the contact finder to the next attempt. It may succeed
then, because a missing or damaged file may have been replaced."""

MAX_ERRORS_AGE_S = 5.0
"""Maximum age, in seconds, of the newest message of `stress_errors`. If it is older, the errors
count as unknown, and `ContactFinder.update` gets None for them. Usually a message comes every half
second."""


class Contacts(SkinSubscriberNode):
    """Publishes the contacts on a skin on the topic `contacts`, computed from the newest stress.

    A message is published at most `rate` times per second (parameter). Without contacts its arrays
    are empty. If the parameter `method` is `inverse`, the node also publishes `traction`, the force
    per area on the surface of the skin, and checks at each message of `stress` whether a contact
    begins to slip. If so, it publishes the last contacts again at once with their new states of
    slip, because a hand that loses an object must react before the next regular message.
    The ids of the touches that the contacts belong to come from the topic `touch`.

    The `ContactFinder` is set up in another thread, because that may take long on a large skin and
    the node must answer requests meanwhile. Nothing is published before it is ready.
    """

    def __init__(self) -> None:
        super().__init__("contacts", CONTACTS, SkinContacts, 10)
        self._worker = ThreadPoolExecutor(1)
        self._finder: ContactFinder | None = None
        self._future_finder: Future[ContactFinder] | None = None
        self._problem = ""
        self._touch = b""
        self._updater = Diagnostics(self, self._make_statuses)

    def configure(self) -> None:
        self._traction = self.own(self.create_lifecycle_publisher(PointCloud2, "traction", 2))
        self._touch = b""
        touch = self.create_subscription(
            SkinTouch,
            "touch",
            self._on_touch,
            NEWEST,
            raw=True,
        )
        self.own(touch)
        self._errors: Array | None = None
        self._errors_s = 0.0
        self.own(self.create_subscription(Float32MultiArray, "stress_errors", self._on_errors, 2))
        super().configure()

    def has_listeners(self, publisher: Publisher) -> bool:
        return self._has_traction_listeners() or super().has_listeners(publisher)

    def prepare(self, skin: FollowedSkin) -> None:
        # For each field of ContactSettings the node has a parameter of the same name.
        names = [field.name for field in fields(ContactSettings)]
        settings = ContactSettings(**{name: self.read_value(name) for name in names})
        self._finder = None
        self._set_up = partial(
            make_contact_finder,
            settings,
            skin.poses,
            read_cube_calibrations(skin.info),
            read_skin_elastomer(skin.info),
        )
        self._future_finder = self._worker.submit(self._set_up)

    def compute_message(
        self,
        skin: FollowedSkin,
        health: Index,
    ) -> bytes | None:
        finder = self._take_finder()
        if finder is None:
            return None
        newest = skin.newest
        values = newest.select_usable_values(health)
        frame_id = skin.info.header.frame_id
        finder.update(
            1e-9 * skin.stamp_ns,
            values,
            newest.left_out,
            newest.status,
            self._read_touches(),
            self._find_errors(len(values)),
        )
        # Computing the point cloud takes time, so it is done only while somebody subscribes.
        if self._has_traction_listeners():
            cloud = finder.make_cloud(values)
            if cloud is not None:
                message = make_traction_message(
                    make_message,
                    skin.stamp_ns,
                    frame_id,
                    cloud,
                )
                self._traction.publish(message)
        return self._encode(skin, finder)

    def _on_errors(self, message: Float32MultiArray) -> None:
        shape = [dimension.size for dimension in message.layout.dim]
        self._errors = np.array(message.data, float).reshape(shape)
        self._errors_s = time.monotonic()

    def _find_errors(self, n_cubes: int) -> Array | None:
        """Return the newest errors of the stress (`Reconstructor.errors`), (cubes, 15, causes).

        The result is None if they are unknown or too old, or belong to another skin.
        """
        errors = self._errors
        is_old = time.monotonic() - self._errors_s > MAX_ERRORS_AGE_S
        if errors is None or is_old or errors.shape[:2] != (n_cubes, len(COMPONENTS)):
            return None
        return errors

    def follow_stress(
        self,
        skin: FollowedSkin,
        health: Index,
    ) -> bytes | None:
        finder = self._finder
        if finder is None:
            return None
        values = skin.newest.select_usable_values(health)
        begins = finder.follow(1e-9 * skin.stamp_ns, values)
        return self._encode(skin, finder) if begins else None

    def _encode(self, skin: FollowedSkin, finder: ContactFinder) -> bytes:
        return encode_contacts(
            skin.stamp_ns,
            skin.info.header.frame_id,
            finder.contacts,
            finder.slip,
            finder.touch_id,
        )

    def _on_touch(self, data: bytes) -> None:
        # Most messages are replaced by newer ones before they are used, so none is decoded here.
        self._touch = data

    def _read_touches(self) -> Touches:
        """Return the cubes and ids of the newest touches; the other fields are empty."""
        if not self._touch:
            return NO_TOUCHES
        message = deserialize_message(self._touch, SkinTouch)
        return NO_TOUCHES._replace(cube=np.array(message.cube, int), id=np.array(message.id, int))

    def _take_finder(self) -> ContactFinder | None:
        """Return the contact finder; None while it is being set up, or if the set-up has failed.

        A failure is logged once, and the set-up is tried again after `RETRY_PERIOD_S`.
        """
        future = self._future_finder
        if future is not None and future.done():
            self._future_finder = None
            self._ended_s = time.monotonic()
            error = future.exception()
            problem = "" if error is None else str(error) or type(error).__name__
            if error is None:
                self._finder = future.result()
            elif problem != self._problem:
                self.get_logger().error(problem)
            self._problem = problem
        is_idle = self._problem and self._future_finder is None
        if is_idle and time.monotonic() - self._ended_s >= RETRY_PERIOD_S:
            self._future_finder = self._worker.submit(self._set_up)
        return self._finder

    def _make_statuses(self) -> list[DiagnosticStatus]:
        """Return one diagnostic status with the reason why no contacts are computed; an empty list
        if contacts are computed."""
        if self._take_finder() is not None or not self._problem:
            return []
        text = f"no contacts: {self._problem}"
        return [
            make_status(
                "contact finder",
                "",
                DiagnosticStatus.ERROR,
                text,
                {},
            )
        ]

    def _has_traction_listeners(self) -> bool:
        return bool(self._traction.get_subscription_count())


def main() -> None:
    """Run the node `contacts`."""
    run(lambda: [Contacts()])


if __name__ == "__main__":
    main()
