"""The contacts node: `stress` in, where something presses on the skin and how hard out."""

from __future__ import annotations

from geometry_msgs.msg import Point, Vector3
from numpy.typing import NDArray

from cube_tensor_driver.msg import SkinContacts

from ..core.defaults import CONTACT_PRESSURE, SURFACE_DEPTH
from ..elastic.surface import Contact, Surface
from .node import run
from .skin_subscriber import SkinSubscriberNode


class Contacts(SkinSubscriberNode):
    """Publishes `contacts` for the newest `stress`, at most `rate` times a second; empty arrays:
    nothing presses."""

    def __init__(self) -> None:
        super().__init__("contacts", SkinContacts, 10)
        self.declare(
            "depth", SURFACE_DEPTH, "From the cubes' centres to the skin's surface, m.", (1e-5, 1.0)
        )
        self.declare(
            "least",
            CONTACT_PRESSURE,
            "Pressure at the cubes that counts as contact, Pa.",
            (0.0, 1e9),
        )

    def new_skin(self) -> None:
        self._surface, self._said = Surface(self.subscriber.places, self.value("depth")), None

    def message(self) -> SkinContacts | None:
        stamp = self.subscriber.stamp
        if stamp is self._said:
            return None
        self._said = stamp
        values = self.subscriber.newest.believed(self.subscriber.health())
        message = contacts_message(self._surface.contacts(values, self.value("least")))
        message.header.stamp = stamp
        message.header.frame_id = self.subscriber.info.header.frame_id
        return message


def contacts_message(contacts: list[Contact]) -> SkinContacts:
    """Without its header."""
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


def _xyz(vector: NDArray) -> dict[str, float]:
    return dict(zip("xyz", vector.tolist(), strict=True))


def main() -> None:
    run(lambda: [Contacts()])


if __name__ == "__main__":
    main()
