# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The node `markers`: draws the newest `stress` as a MarkerArray for RViz and Foxglove."""

from __future__ import annotations

from visualization_msgs.msg import MarkerArray

from ...config.parameters import MARKERS
from ...core.arrays import Index
from ...msg import SkinContacts
from ...views import scene
from ..markers.canvas import Canvas
from ..messages import CheckedSubscription, to_ns
from ..node import run
from ..skin_subscriber import FollowedSkin, SkinSubscriberNode

MAX_CONTACTS_AGE_NS = 1_000_000_000
"""Maximum age of a message of `contacts`, in ns, relative to the newest message of `stress`. Older
contacts are not drawn."""


class Markers(SkinSubscriberNode):
    """Publishes `markers`, the picture of a skin for RViz and Foxglove.

    The colour of each cube shows a quantity, such as the normal stress, and its arrows show the
    traction (force per area on the upper face) and the gradient of the stress. The picture also has
    a legend, crosses over cubes whose health is not fine, and the contacts while the node
    `contacts` runs.
    """

    def __init__(self) -> None:
        super().__init__("markers", MARKERS, MarkerArray, 2)

    def configure(self) -> None:
        self._quantity = scene.QUANTITIES[self.read_value("quantity")]
        self._contacts: SkinContacts | None = None
        contacts = CheckedSubscription(
            self,
            SkinContacts,
            "contacts",
            self._on_contacts,
            2,
        )
        self.call_at_cleanup(contacts.close)
        super().configure()

    def prepare(self, skin: FollowedSkin) -> None:
        frame_id = skin.info.header.frame_id
        self._canvas = Canvas(
            frame_id,
            skin.poses,
            crosses=self.read_value("crosses"),
        )
        self._ranges = scene.Ranges()

    def compute_message(self, skin: FollowedSkin, health: Index) -> bytes:
        values = skin.newest.select_usable_values(health)
        residual = skin.newest.residual
        shown = self._quantity.compute(values, residual)
        fixed = float(self.read_value("range"))
        last = self._ranges.colours
        top = fixed or scene.choose_automatic_top(self._quantity, shown, last)
        ranges = self._ranges = self._ranges.follow(values, residual, top)
        contacts = self._find_newest_contacts(skin)
        return self._canvas.draw(
            self._quantity,
            shown,
            values,
            ranges,
            health,
            contacts,
        )

    def _find_newest_contacts(self, skin: FollowedSkin) -> SkinContacts | None:
        """Return the newest contacts; None if no message of `contacts` has arrived, or the newest
        is more than `MAX_CONTACTS_AGE_NS` older than the newest stress.

        Args:
            skin: The state of the skin, with the stamp of the newest stress.
        """
        contacts = self._contacts
        if contacts is None:
            return None
        age_ns = skin.stamp_ns - to_ns(contacts.header.stamp)
        # Without this limit, the last contacts would be drawn for ever after the node `contacts`
        # has ended.
        return contacts if age_ns <= MAX_CONTACTS_AGE_NS else None

    def _on_contacts(self, message: SkinContacts) -> None:
        self._contacts = message


def main() -> None:
    """Run the node `markers`."""
    run(lambda: [Markers()])


if __name__ == "__main__":
    main()
