"""The node `contacts`: computes position, size and force of contacts on the skin from `stress`."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields
from typing import Any

from sensor_msgs.msg import PointCloud2

from ...config.parameters import CONTACTS
from ...core.arrays import Index
from ...core.errors import CubeError
from ...messages.contacts import contacts_message, traction_message
from ...messages.skin_info import cube_calibrations
from ...msg import SkinContacts
from ...touch.contact_finder import (
    INVERSE,
    ContactFinder,
    ContactSettings,
    contact_finder,
)
from ..messages import make_message
from ..node import run
from ..skin_subscriber import FollowedSkin, SkinSubscriberNode


class Contacts(SkinSubscriberNode):
    """Publishes `contacts` for the newest `stress`, at most `rate` times per second (parameter).

    Without contacts the arrays of a message are empty. With the method `inverse` the node also
    publishes `traction`, the force per area on the surface of the skin. The `ContactFinder` is set
    up in another thread, because that may take long on a large skin and the node must answer
    requests meanwhile. Nothing is published before it is ready.
    """

    def __init__(self) -> None:
        super().__init__("contacts", CONTACTS, SkinContacts, 10)
        self._worker = ThreadPoolExecutor(1)

    def configure(self) -> None:
        self._traction = None
        if self.value("method") == INVERSE:
            self._traction = self.own(self.create_lifecycle_publisher(PointCloud2, "traction", 2))
        super().configure()

    def has_listeners(self, publisher: Any) -> bool:
        return self._has_traction_listeners() or super().has_listeners(publisher)

    def prepare(self, skin: FollowedSkin) -> None:
        # Each field of ContactSettings has a parameter of the same name.
        names = [field.name for field in fields(ContactSettings)]
        settings = ContactSettings(**{name: self.value(name) for name in names})
        calibrations = cube_calibrations(skin.info)
        self._processed_messages = 0
        self._finder: ContactFinder | None = None
        self._future_finder: Future[ContactFinder] | None = self._worker.submit(
            contact_finder, settings, skin.poses, calibrations
        )

    def compute_message(self, skin: FollowedSkin, health: Index) -> SkinContacts | None:
        finder = self._take_finder()
        # The finder tracks contacts over time, so it must not get the same message twice.
        if finder is None or skin.messages == self._processed_messages:
            return None
        self._processed_messages = skin.messages
        values, frame_id = skin.newest.usable_values(health), skin.info.header.frame_id
        contacts = finder.update(values, skin.newest.left_out)
        # Computing the point cloud takes time, so it is done only while somebody subscribes.
        if self._traction is not None and self._has_traction_listeners():
            cloud = finder.cloud(values)
            if cloud is not None:
                message = traction_message(
                    make_message,
                    skin.stamp_ns,
                    frame_id,
                    cloud,
                )
                self._traction.publish(message)
        return contacts_message(
            make_message,
            skin.stamp_ns,
            frame_id,
            contacts,
        )

    def _take_finder(self) -> ContactFinder | None:
        """Return the contact finder; None while it is being set up, or if the set-up has failed.

        A failure is logged once.
        """
        if self._future_finder is not None and self._future_finder.done():
            future, self._future_finder = self._future_finder, None
            try:
                self._finder = future.result()
            except CubeError as error:
                self.get_logger().error(str(error))
        return self._finder

    def _has_traction_listeners(self) -> bool:
        return self._traction is not None and self._traction.get_subscription_count() > 0


def main() -> None:
    run(lambda: [Contacts()])


if __name__ == "__main__":
    main()
