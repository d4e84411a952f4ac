"""The node `contacts`: from `stress`, where something presses on the skin and how hard."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields
from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2

from ...config.parameters import CONTACTS
from ...core.errors import CubeError
from ...messages.contacts import contacts_message, traction_message
from ...messages.skin_info import cube_calibrations
from ...msg import SkinContacts
from ...touch.contact_finder import INVERSE, ContactFinder, ContactSettings, contact_finder
from ..messages import make_message
from ..node import run
from ..skin_subscriber import FollowedSkin, SkinSubscriberNode


class Contacts(SkinSubscriberNode):
    """Publishes `contacts` for the newest `stress`, at most `rate` times a second.

    The arrays of a message are empty where nothing presses. The method `inverse` publishes the
    surface's `traction`, too. The method is set up beside the node's thread: nothing is published
    before.
    """

    def __init__(self) -> None:
        super().__init__("contacts", CONTACTS, SkinContacts, 10)
        self._worker = ThreadPoolExecutor(1)

    def configure(self) -> None:
        self._traction = None
        if self.value("method") == INVERSE:
            self._traction = self.create_lifecycle_publisher(PointCloud2, "traction", 2)
            self._configured.callback(self.destroy_publisher, self._traction)
        super().configure()

    def is_wanted(self, publisher: Any) -> bool:
        return self._traction_is_wanted() or super().is_wanted(publisher)

    def set_up(self, skin: FollowedSkin) -> None:
        names = [field.name for field in fields(ContactSettings)]
        settings = ContactSettings(**{name: self.value(name) for name in names})
        calibrations = cube_calibrations(skin.info)
        self._seen = 0
        self._finder: ContactFinder | None = None
        self._coming: Future[ContactFinder] | None = self._worker.submit(
            contact_finder, settings, skin.poses, calibrations
        )

    def message(self, skin: FollowedSkin, health: np.ndarray) -> SkinContacts | None:
        finder = self._ready()
        if finder is None or skin.messages == self._seen:
            return None
        self._seen = skin.messages
        values, frame_id = skin.newest.usable_values(health), skin.info.header.frame_id
        contacts = finder.update(values, skin.newest.left_out)
        if self._traction is not None and self._traction_is_wanted():
            cloud = finder.cloud(values)
            if cloud is not None:
                self._traction.publish(
                    traction_message(make_message, skin.stamp_ns, frame_id, cloud)
                )
        return contacts_message(make_message, skin.stamp_ns, frame_id, contacts)

    def _ready(self) -> ContactFinder | None:
        """None while it is being set up, or if it could not be: that is logged once."""
        if self._coming is not None and self._coming.done():
            coming, self._coming = self._coming, None
            try:
                self._finder = coming.result()
            except CubeError as error:
                self.get_logger().error(str(error))
        return self._finder

    def _traction_is_wanted(self) -> bool:
        return self._traction is not None and self._traction.get_subscription_count() > 0


def main() -> None:
    run(lambda: [Contacts()])


if __name__ == "__main__":
    main()
