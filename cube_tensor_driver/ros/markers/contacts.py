"""Contacts in the `markers` picture: a ring of the size of each, and its forces as a text."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from visualization_msgs.msg import Marker

from ...msg import SkinContacts
from .serialised import SerialisedMarkers
from .shapes import CONTACT, allocate, four_places, marker, text_marker

MOST = 8
"""Contacts that are drawn: those with the greatest forces."""
CORNERS = 24
"""Of a ring."""
HIDDEN = 0.001
"""Of a text without a contact: RViz warns of a colour that is quite transparent."""


class ContactMarkers:
    """Draws into the serialised markers that `contact_markers` made."""

    def __init__(self, markers: SerialisedMarkers) -> None:
        self._markers = markers
        self.draw(None)

    def draw(self, contacts: SkinContacts | None) -> None:
        """The greatest contacts; None: none."""
        rings = np.zeros((MOST, CORNERS, 2, 3))
        count = 0 if contacts is None else min(MOST, len(contacts.position))
        for number in range(MOST):
            label = self._markers[f"contact {number}"]
            label.colour[3] = HIDDEN
            if contacts is None or number >= count:
                continue
            at, n = contacts.position[number], contacts.normal[number]
            position, normal = np.array([at.x, at.y, at.z]), np.array([n.x, n.y, n.z])
            radius = float(np.sqrt(max(0.0, contacts.area[number]) / np.pi))
            rings[number] = ring(position, normal, radius)
            label.colour[3] = 1.0
            label.position[:] = position + max(radius, 2e-3) * normal
            text = force_text(contacts.normal_force[number], contacts.shear_force[number])
            label.text[:] = np.frombuffer(text.encode(), np.uint8)
        self._markers["contacts"].points[:] = rings.reshape(-1, 3)


def contact_markers(frame_id: str, pitch: float) -> list[Marker]:
    """Rings and texts without contacts; pitch: of the cubes, m."""
    rings = marker(frame_id, "contacts", Marker.LINE_LIST, CONTACT)
    rings.scale.x = 0.06 * pitch
    allocate(rings, 2 * MOST * CORNERS, with_colours=False)
    texts = []
    for number in range(MOST):
        text = text_marker(frame_id, f"contact {number}", 0.3 * pitch, force_text(0.0, 0.0))
        text.color.r, text.color.g, text.color.b = CONTACT
        texts.append(text)
    return [rings, *texts]


def force_text(normal: float, shear: float) -> str:
    """As long for all forces, N; shear NaN: not observed."""
    return f"{four_places(normal)} N, shear {four_places(shear)} N"


def ring(
    centre: NDArray[np.float64], normal: NDArray[np.float64], radius: float
) -> NDArray[np.float64]:
    """(CORNERS, 2, 3) lines around a centre (3,) across a unit normal (3,)."""
    aside = np.eye(3)[np.abs(normal).argmin()]
    one = np.cross(normal, aside)
    one /= np.linalg.norm(one)
    other = np.cross(normal, one)
    angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
    corners = centre + radius * (np.outer(np.cos(angle), one) + np.outer(np.sin(angle), other))
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
