# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Links each contact on the skin to the touch that it belongs to.

Both describe what presses on the skin. A touch is detected in every scan (set of values of all
cubes), at the cube with the largest pressure (touch_detection.py). The contact tracker finds
contacts less often, but with more detail (tracker/contact_tracker.py).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..core.arrays import Array, Index
from ..core.poses import CubePoses
from .touch_detection import NO_TOUCH, Touches
from .tracker.contact_tracker import TrackedContact

MAX_PITCHES = 2.0
"""Largest distance, in pitches (distances of neighbouring cubes), from the edge of a contact to the
cube of the touch to which it is linked. The distance is not measured from the centre, because the
largest pressure of a wide contact may be far from it."""

MIN_CHANGE_PITCHES = 0.5
"""Distance, in pitches (distances of neighbouring cubes), by which another touch must be nearer to
a contact than the linked touch, before the link changes. Otherwise, the link of a contact between
two touches could change in every scan (set of values of all cubes)."""


class TouchLinks:
    """Links each contact that the contact tracker has found to the nearest touch, which is detected
    in every scan (set of values of all cubes)."""

    def __init__(self, poses: CubePoses) -> None:
        """Start without contacts, on a skin with cubes at these poses."""
        self._position = poses.position
        self._pitch = poses.pitch
        self._linked: dict[int, int] = {}

    def link(self, contacts: Sequence[TrackedContact], touches: Touches) -> Index:
        """Return the numbers (n,) of the touches of n contacts, `NO_TOUCH` where none was near.

        A contact whose touch has ended keeps its number until another touch is near.

        Args:
            contacts: The contacts.
            touches: Touches in the newest scan.
        """
        places = self._position[touches.cube]
        linked = {}
        for contact in contacts:
            distance: Array = np.linalg.norm(places - contact.position, axis=1)
            radius = np.sqrt(contact.area / np.pi)
            reach = radius + MAX_PITCHES * self._pitch
            touch = self._linked.get(contact.id, NO_TOUCH)
            own = distance[touches.id == touch].min(initial=np.inf)
            limit = min(reach, own - MIN_CHANGE_PITCHES * self._pitch)
            if distance.min(initial=np.inf) < limit:
                touch = int(touches.id[distance.argmin()])
            linked[contact.id] = touch
        self._linked = linked
        return np.array(list(linked.values()), np.int64)
