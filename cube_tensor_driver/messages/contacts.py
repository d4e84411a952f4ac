# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of contacts and surface traction, made in the same way by a node and by reprocessing.

For a message of traction, the caller passes the function that constructs it: a node passes one that
uses the classes of rclpy, reprocessing one that uses those of the bag library. So the node
`contacts` needs no bag library.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..core.arrays import AnyArray, Array, Index
from ..core.errors import BagError
from ..touch.slip import NO_CONTACTS, SLIP, Slip
from ..touch.surface import Contact
from ..touch.touch_detection import NO_TOUCHES
from ..touch.tracker.contact_tracker import TrackedContact
from .point_cloud import MakeMessage, make_cloud_message
from .sequences import encode_header, encode_sequences

if TYPE_CHECKING:
    from geometry_msgs.msg import Point, Vector3
    from sensor_msgs.msg import PointCloud2

    from ..msg import SkinContacts

CLOUD = ("x", "y", "z", "pressure", "shear", "sigma")
"""Names of the fields of each point of the topic `traction`, all float32: position x, y, z in the
parent frame of the skin, in m; pressure and shear stress on the surface, in Pa; and sigma, the
standard deviation of the pressure, in Pa."""

_NUMBERS = (
    "normal_force",
    "shear_force",
    "area",
    "position_uncertainty",
    "force_uncertainty",
)
"""Numbers of a contact that every method of contact estimation gives. Each has the same name in the
message SkinContacts and in `Contact`."""
_TRACKED_NUMBERS = (
    "moment",
    "shear_uncertainty",
    "area_uncertainty",
    "moment_uncertainty",
)
"""Numbers of a contact that only the method `inverse` of contact estimation gives. With another
method, the arrays of these numbers in the message are empty."""
_VECTORS = ("position", "normal", "force")
"""Vectors of a contact in the order of the message SkinContacts."""


def encode_contacts(
    stamp_ns: int,
    frame_id: str,
    contacts: Sequence[Contact] | Sequence[TrackedContact],
    slip: Slip = NO_CONTACTS,
    touch_id: Index = NO_TOUCHES.id,
) -> bytes:
    """Return a serialised SkinContacts message.

    Args:
        stamp_ns: Time stamp of the header, in ns since the Unix epoch.
        frame_id: Coordinate frame of the positions, normals and forces.
        contacts: The contacts: all with a tracker (`TrackedContact`) or all without one.
        slip: State and friction of these contacts; without a tracker the default, empty arrays.
        touch_id: Numbers of the touches of these contacts; without a tracker an empty array.
    """
    # Only tracked contacts have an id, a moment (torque about the normal), further uncertainties,
    # and `refined` (force from a fit of the traction). Without a tracker, these arrays stay empty.
    tracked = [contact for contact in contacts if isinstance(contact, TrackedContact)]
    ids = [contact.id for contact in tracked]
    are_refined = [contact.refined for contact in tracked]
    columns: list[AnyArray] = [
        *(_collect(contacts, name) for name in (*_VECTORS, *_NUMBERS)),
        np.array(ids, np.uint32),
        touch_id.astype(np.int64),
        *(_collect(tracked, name) for name in _TRACKED_NUMBERS),
        np.array(are_refined, bool),
        slip.state.astype(np.uint8),
        slip.friction,
        slip.friction_uncertainty,
        slip.friction_use,
        slip.velocity,
        slip.partial,
    ]
    return encode_sequences(encode_header(stamp_ns, frame_id), columns)


def make_traction_message(
    make: MakeMessage,
    stamp_ns: int,
    frame_id: str,
    cloud: Array,
) -> object:
    """Make a PointCloud2 message of the traction (pressure and shear stress) on the surface.

    Args:
        make: Function that constructs a message from its type's name and its fields.
        stamp_ns: Time stamp of the header, in ns since the Unix epoch.
        frame_id: Coordinate frame of the points, which is the parent frame of the skin.
        cloud: Points (M, 6) with the columns of `CLOUD`: position in m, pressure, shear stress and
            standard deviation of the pressure in Pa.
    """
    return make_cloud_message(
        make,
        stamp_ns,
        frame_id,
        CLOUD,
        cloud,
    )


def decode_contacts(message: SkinContacts) -> list[Contact]:
    """Return the contacts of a SkinContacts message.

    Values that only tracked contacts have are left out, except those from which the attributes
    `slips` and `is_coarse` of `Contact` are set.

    Raises:
        ValueError: The arrays of the message have different lengths.
    """

    def read_xyz(vector: Point | Vector3) -> Array:
        return np.array([vector.x, vector.y, vector.z])

    columns = [getattr(message, name) for name in (*_VECTORS, *_NUMBERS)]
    unknown = [False] * len(message.position)
    slips = [state == SLIP for state in message.slip] or unknown
    is_coarse = [not refined for refined in message.refined] or unknown
    return [
        Contact(
            read_xyz(position),
            read_xyz(normal),
            read_xyz(force),
            *others,
        )
        for position, normal, force, *others in zip(*columns, slips, is_coarse, strict=True)
    ]


def decode_traction(message: PointCloud2) -> Array:
    """Return the points (M, 6), with the columns of `CLOUD`, of a message of the topic `traction`.

    Raises:
        BagError: The points of the message have other fields than those of `CLOUD`.
    """
    names = tuple(field.name for field in message.fields)
    if names != CLOUD or message.point_step != 4 * len(CLOUD):
        raise BagError(
            f"a point cloud has the fields {', '.join(names)}; those of the topic traction are "
            f"{', '.join(CLOUD)}: listen to the topic of the node contacts"
        )
    # The data are an `array.array` in a message of rclpy, and a numpy array in one of a bag. ROS 2
    # Lyrical may pass a `rosidl_buffer.Buffer`, which only its own method converts.
    data = message.data
    data = data.to_bytes() if hasattr(data, "to_bytes") else bytes(data)
    points = np.frombuffer(data, "<f4")
    return points.reshape(-1, len(CLOUD)).astype(float)


def _collect(contacts: Sequence[object], name: str) -> Array:
    """Return one attribute of all contacts as an array whose first axis counts the contacts."""
    return np.array([getattr(contact, name) for contact in contacts], float)
