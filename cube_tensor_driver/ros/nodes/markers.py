"""The node `markers`: from `stress`, a MarkerArray with a few markers, at a rate for eyes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import Quaternion, Vector3
from numpy.typing import NDArray
from visualization_msgs.msg import Marker, MarkerArray

from ...config.parameters import MARKERS
from ...core.errors import ConfigError
from ...core.poses import CubePoses, quaternions
from ...msg import SkinContacts
from ...views import scene
from ..markers.contacts import ContactMarkers, contact_markers
from ..markers.legend import Legend, LegendPlace, legend_markers
from ..markers.serialised import SerialisedMarkers
from ..markers.shapes import (
    GRADIENT,
    GRADIENT_LENGTH,
    TRACTION,
    TRACTION_LENGTH,
    UPSIDE_DOWN,
    allocate,
    marker,
)
from ..messages import to_ns
from ..node import run
from ..skin_subscriber import FollowedSkin, SkinSubscriberNode

CONTACTS_NS = 1_000_000_000
"""Contacts that are so much older than the stress are not drawn."""
SIDE, THICKNESS, HEIGHT = 2.04, 0.3, 0.9
"""Of the plate that has the colour of a cube, and of its middle above the cube's, in half sides. It
covers the upper face, so that the cube of the robot model is seen below it."""

PULL, PUSH = (0.9, 0.3, 0.2), (0.3, 0.5, 1.0)


class Ranges(NamedTuple):
    """The values that the longest arrows and the top of the colours stand for; they follow what is
    there.

    colours: SI of the quantity. traction: Pa. gradient: Pa/m.
    """

    colours: float = 0.0
    traction: float = 0.0
    gradient: float = 0.0


class Markers(SkinSubscriberNode):
    """Publishes `markers`: cubes in colours, arrows of traction and gradient, a legend, crosses
    over cubes that are not fine, and the contacts while the node `contacts` runs."""

    def __init__(self) -> None:
        super().__init__("markers", MARKERS, MarkerArray, 2)
        self._contacts: SkinContacts | None = None

    def configure(self) -> None:
        name = self.value("quantity")
        if name not in scene.QUANTITIES:
            raise ConfigError(
                f"parameter quantity is {name!r}, allowed: {', '.join(scene.QUANTITIES)}"
            )
        self._quantity = scene.QUANTITIES[name]
        self._contacts = None
        contacts = self.create_subscription(SkinContacts, "contacts", self._on_contacts, 2)
        self._configured.callback(self.destroy_subscription, contacts)
        super().configure()

    def set_up(self, skin: FollowedSkin) -> None:
        frame_id = skin.info.header.frame_id
        self._canvas = Canvas(
            frame_id, skin.poses, crosses=self.value("crosses"), signed=self._quantity.signed
        )
        self._ranges = Ranges()

    def message(self, skin: FollowedSkin, health: np.ndarray) -> bytes:
        values, residual = skin.newest.usable_values(health), skin.newest.residual
        shown = self._quantity.of(values, residual)
        ranges = self._ranges = self._follow(values, residual, shown)
        canvas = self._canvas
        canvas.draw_cubes(scene.colours(self._quantity, shown, ranges.colours))
        canvas.draw_arrows(values, ranges)
        canvas.draw_faults(health)
        canvas.draw_crosses(values, ranges.traction)
        canvas.legend.draw(self._quantity, ranges.colours, health)
        canvas.legend.draw_scale(ranges.traction, ranges.gradient)
        canvas.contacts.draw(self._newest_contacts(skin))
        return bytes(canvas.data)

    def _newest_contacts(self, skin: FollowedSkin) -> SkinContacts | None:
        """None: the node `contacts` does not run, or speaks of long ago."""
        contacts = self._contacts
        if contacts is None or skin.stamp_ns - to_ns(contacts.header.stamp) > CONTACTS_NS:
            return None
        return contacts

    def _on_contacts(self, message: SkinContacts) -> None:
        self._contacts = message

    def _follow(
        self, values: NDArray[np.float64], residual: NDArray[np.float64], shown: NDArray[np.float64]
    ) -> Ranges:
        shear, gradient = scene.QUANTITIES["shear"], scene.QUANTITIES["gradient"]
        last, fixed = self._ranges, float(self.value("range"))
        return Ranges(
            colours=fixed or scene.automatic(self._quantity, shown, last.colours),
            traction=scene.automatic(shear, values[:, 2:5], last.traction),
            gradient=scene.automatic(gradient, gradient.of(values, residual), last.gradient),
        )


class Canvas:
    """The picture of a skin as a serialised MarkerArray.

    data: the message. Each marker has its name as namespace.
    """

    def __init__(self, frame_id: str, poses: CubePoses, *, crosses: bool, signed: bool) -> None:
        """crosses: whether principal stresses are drawn; signed: whether colours lie about zero."""
        self._poses = poses
        self._pitch = poses.pitch
        self._health: NDArray[np.integer] | None = None
        self._groups, rotations = _group_by_orientation(poses.rotation)
        place = LegendPlace.beside(poses)
        heights = HEIGHT * poses.half_side[:, None]
        plates = poses.position + heights * poses.rotation[:, :, 2]
        markers = [
            *self._cube_markers(frame_id, rotations),
            *self._line_markers(frame_id, crosses),
            *contact_markers(frame_id, self._pitch),
            *legend_markers(frame_id, place, signed),
        ]
        self._markers = SerialisedMarkers(markers)
        for group, (members, rotation) in enumerate(zip(self._groups, rotations, strict=True)):
            # The points of a marker are in the frame of its pose.
            self._markers[f"cubes {group}"].points[:] = plates[members] @ rotation
        for each in markers:
            self._markers[each.ns].colours[:, 3] = 1.0
        self.legend = Legend(self._markers, place)
        self.contacts = ContactMarkers(self._markers)

    @property
    def data(self) -> bytearray:
        return self._markers.data

    def draw_cubes(self, colours: NDArray[np.float64]) -> None:
        for group, members in enumerate(self._groups):
            self._markers[f"cubes {group}"].colours[:, :3] = colours[members]

    def draw_arrows(self, values: NDArray[np.float64], ranges: Ranges) -> None:
        normal = self._poses.rotation[:, :, 2]
        length = TRACTION_LENGTH * self._pitch / ranges.traction
        traction = scene.traction_arrows(self._poses, values, length)
        length = GRADIENT_LENGTH * self._pitch / ranges.gradient
        gradient = scene.gradient_arrows(self._poses, values, length)
        for name, lines in (("traction", traction), ("gradient", gradient)):
            self._markers[name].points[:] = scene.heads(lines, normal).reshape(-1, 3)

    def draw_faults(self, health: NDArray[np.integer]) -> None:
        """Crosses over cubes that are not fine; drawn again only when health has changed."""
        if self._health is not None and np.array_equal(health, self._health):
            return
        self._health = health
        faults = self._markers["faults"]
        faults.points[:] = scene.fault_crosses(self._poses, health).reshape(-1, 3)
        faults.colours[:, :3] = np.repeat(scene.MARK[health], 4, axis=0)

    def draw_crosses(self, values: NDArray[np.float64], longest: float) -> None:
        """Principal stresses, if the picture has them; a line for `longest`, Pa, has the length of
        the pitch."""
        if "crosses" not in self._markers:
            return
        crosses = self._markers["crosses"]
        lines, pulls = scene.principal_crosses(self._poses, values, self._pitch / longest)
        crosses.points[:] = lines.reshape(-1, 3)
        crosses.colours[:, :3] = np.repeat(np.where(pulls.reshape(-1, 1), PULL, PUSH), 2, axis=0)

    def _cube_markers(self, frame_id: str, rotations: NDArray[np.float64]) -> list[Marker]:
        """One for each orientation, because all boxes of a CUBE_LIST are parallel."""
        markers = []
        for group, (w, x, y, z) in enumerate(quaternions(rotations).tolist()):
            members = self._groups[group]
            half_side = float(self._poses.half_side[members].max())
            made = marker(frame_id, f"cubes {group}", Marker.CUBE_LIST)
            made.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
            made.scale = Vector3(x=SIDE * half_side, y=SIDE * half_side, z=THICKNESS * half_side)
            allocate(made, len(members), with_colours=True)
            markers.append(made)
        return markers

    def _line_markers(self, frame_id: str, crosses: bool) -> list[Marker]:
        """Arrows of three lines, crosses over faults of two, principal crosses of three."""
        cubes = len(self._poses.position)
        traction = marker(frame_id, "traction", Marker.LINE_LIST, TRACTION)
        gradient = marker(frame_id, "gradient", Marker.LINE_LIST, GRADIENT)
        faults = marker(frame_id, "faults", Marker.LINE_LIST)
        principal = marker(frame_id, "crosses", Marker.LINE_LIST)
        allocate(traction, 6 * cubes, with_colours=False)
        allocate(gradient, 6 * cubes, with_colours=False)
        allocate(faults, 4 * cubes, with_colours=True)
        allocate(principal, 6 * cubes, with_colours=True)
        markers = [traction, gradient, faults, *([principal] if crosses else [])]
        for each in markers:
            each.scale.x = 0.05 * self._pitch
        return markers


def _group_by_orientation(
    rotation: NDArray[np.float64],
) -> tuple[list[NDArray[np.intp]], NDArray[np.float64]]:
    """The cubes of each orientation that occurs, and the orientations (G, 3, 3), upside down."""
    flat = rotation.round(6).reshape(len(rotation), 9)
    unique, group = np.unique(flat, axis=0, return_inverse=True)
    members = [np.flatnonzero(group.ravel() == number) for number in range(len(unique))]
    return members, unique.reshape(-1, 3, 3) * UPSIDE_DOWN


def main() -> None:
    run(lambda: [Markers()])


if __name__ == "__main__":
    main()
