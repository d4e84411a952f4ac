"""What the node `contacts` finds, if it runs, for the page."""

from __future__ import annotations

import time

import numpy as np
from rclpy.node import Node
from scipy.spatial import cKDTree
from sensor_msgs.msg import PointCloud2

from ..core.arrays import Array
from ..messages.contacts import decode_contacts, decode_traction
from ..msg import SkinContacts
from ..ros.guard import CallbackGuard
from ..touch.surface import Contact, Surface
from .moment import Found, SurfaceField

NEIGHBOURS = 4
"""Points of `traction` between which it is interpolated."""
OLD_S = 1.0
"""What came longer ago is not shown: the node has ended, or the skin says nothing."""


class ContactsClient:
    """Listens to `contacts` and `traction`."""

    def __init__(self, node: Node, guard: CallbackGuard) -> None:
        node.create_subscription(SkinContacts, "contacts", guard.wrap(self._receive_contacts), 2)
        node.create_subscription(PointCloud2, "traction", guard.wrap(self._receive_traction), 2)
        self._contacts: list[Contact] = []
        self._cloud = np.empty((0, 6))
        self._contacts_at = self._cloud_at = -np.inf
        self._between: _Between | None = None

    def found(self, surface: Surface) -> Found:
        """What is not old: contacts, and the field on the points of a surface."""
        oldest = time.monotonic() - OLD_S
        contacts = self._contacts if self._contacts_at > oldest else None
        if self._cloud_at < oldest or not len(self._cloud):
            return Found(contacts)
        places = self._cloud[:, :3]
        if self._between is None or not self._between.fits(surface, places):
            self._between = _Between(surface, places)
        pressure, shear, sigma = self._between.values(self._cloud[:, 3:]).T
        return Found(contacts, SurfaceField(pressure, shear, sigma))

    def _receive_contacts(self, message: SkinContacts) -> None:
        self._contacts, self._contacts_at = decode_contacts(message), time.monotonic()

    def _receive_traction(self, message: PointCloud2) -> None:
        cloud = decode_traction(message)
        placed = np.isfinite(cloud[:, :3]).all(axis=1)
        self._cloud, self._cloud_at = cloud[placed], time.monotonic()


class _Between:
    """Interpolates on the points of a surface between the nearest of `places` (M, 3), which are
    fewer, by their inverse squared distances."""

    def __init__(self, surface: Surface, places: Array) -> None:
        self._surface, self._places = surface, places
        shape = len(surface.points), min(NEIGHBOURS, len(places))
        # Its points are at the depth of the cubes.
        up = surface.depth * surface.poses.rotation[surface.cube, :, 2]
        distance, near = cKDTree(places).query(surface.points + up, shape[1])
        self._near = near.reshape(shape)
        weight = 1 / np.maximum(distance.reshape(shape), 1e-3 * surface.spacing) ** 2
        self._weight = weight / weight.sum(axis=1, keepdims=True)

    def fits(self, surface: Surface, places: Array) -> bool:
        """Whether it was made for these."""
        return surface is self._surface and np.array_equal(places, self._places)

    def values(self, values: Array) -> Array:
        """(points, C) of values (M, C) at the places; NaN next to a place where it is NaN."""
        between: Array = np.einsum("pk,pkc->pc", self._weight, values[self._near])
        return between
