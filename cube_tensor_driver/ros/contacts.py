"""The contacts node: `stress` in, where something presses on the skin and how hard out."""

from __future__ import annotations

from geometry_msgs.msg import Point, Vector3
from numpy.typing import NDArray

from cube_tensor_driver.msg import SkinContacts

from ..elastic.surface import Contact, Surface
from .follow import Follower
from .messages import Times
from .node import CubeNode, run


class Contacts(CubeNode):
    """Publishes `contacts` for the newest `stress`, at most `rate` times a second; empty arrays: nothing presses."""

    def __init__(self) -> None:
        super().__init__("contacts")
        self.declare("autostart", True, "Configure and activate at once; false waits for lifecycle transitions.")
        self.declare("rate", 20.0, "Most messages per second.", (0.1, 1000.0))
        self.declare("depth", 0.004, "From the cubes' centres to the skin's surface, m.", (1e-5, 1.0))
        self.declare("least", 300.0, "Pressure at the cubes that counts as contact, Pa.", (0.0, 1e9))
        self._active = False

    def configure(self) -> None:
        self._surface: Surface | None = None
        self._newest: Times | None = None
        self._follower = Follower(self, self._new_skin, self._new_rows)
        self._publisher = self.create_lifecycle_publisher(SkinContacts, "contacts", 10)
        self._timer = self.create_timer(1.0 / self.value("rate"), self._publish)

    def activate(self) -> None:
        self._active = True

    def deactivate(self) -> None:
        self._active = False

    def cleanup(self) -> None:
        if hasattr(self, "_timer"):
            self.destroy_timer(self._timer)
            self._follower.close()
            self.destroy_publisher(self._publisher)
            del self._timer

    def _new_skin(self) -> None:
        self._surface = Surface(self._follower.places, self.value("depth"))

    def _new_rows(self, times: Times, _: object) -> None:
        self._newest = times

    def _publish(self) -> None:
        times, self._newest = self._newest, None
        if not self._active or self._surface is None or times is None or not self._publisher.get_subscription_count():
            return
        message = contacts_message(self._surface.contacts(self._follower.newest.values, self.value("least")))
        message.header.stamp = times.header.stamp
        message.header.frame_id = self._follower.info.header.frame_id
        self._publisher.publish(message)


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
