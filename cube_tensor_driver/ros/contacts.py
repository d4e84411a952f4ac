"""The node `contacts`: from `stress`, where something presses on the skin and how hard."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Vector3
from numpy.typing import NDArray

from cube_tensor_driver.msg import SkinContacts

from ..elastic.surface import Contact, Surface
from .messages import to_time
from .node import run
from .parameters import CONTACTS
from .skin_subscriber import FollowedSkin, SkinSubscriberNode


class Contacts(SkinSubscriberNode):
    """Publishes `contacts` for the newest `stress`, at most `rate` times a second.

    The arrays of a message are empty where nothing presses.
    """

    def __init__(self) -> None:
        super().__init__("contacts", CONTACTS, SkinContacts, 10)

    def set_up(self, skin: FollowedSkin) -> None:
        self._surface = Surface(skin.poses, self.value("depth"))
        self._seen = 0

    def message(self, skin: FollowedSkin, health: np.ndarray) -> SkinContacts | None:
        if skin.messages == self._seen:
            return None
        self._seen = skin.messages
        values = skin.newest.believed(health)
        message = contacts_message(self._surface.contacts(values, self.value("least")))
        message.header.stamp = to_time(skin.stamp_ns)
        message.header.frame_id = skin.info.header.frame_id
        return message


def contacts_message(contacts: list[Contact]) -> SkinContacts:
    """The message without its header."""
    return SkinContacts(
        position=[Point(**_xyz(contact.position)) for contact in contacts],
        normal=[Vector3(**_xyz(contact.normal)) for contact in contacts],
        force=[Vector3(**_xyz(contact.force)) for contact in contacts],
        normal_force=[contact.normal_force for contact in contacts],
        shear_force=[contact.shear_force for contact in contacts],
        area=[contact.area for contact in contacts],
        position_uncertainty=[contact.position_uncertainty for contact in contacts],
        force_uncertainty=[contact.force_uncertainty for contact in contacts],
    )


def _xyz(vector: NDArray[np.floating]) -> dict[str, float]:
    return dict(zip("xyz", vector.tolist(), strict=True))


def main() -> None:
    run(lambda: [Contacts()])


if __name__ == "__main__":
    main()
