"""Messages of contacts, made alike by the node `contacts` and by reprocessing.

The caller passes the function that makes a message: of rclpy's classes in a node, of the bag
library's in reprocessing. So a robot needs no bag library for its contacts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..core.arrays import Array
from ..core.errors import BagError
from ..touch.surface import Contact
from ..touch.tracker.contact_tracker import TrackedContact
from .codec import SECOND
from .types import CONTACTS, TRACTION

MakeMessage = Callable[..., Any]
"""Makes a message from its type, such as geometry_msgs/msg/Point, and its fields by name. Fields
with numbers are numpy arrays."""

CLOUD = ("x", "y", "z", "pressure", "shear", "sigma")
"""Of the points of `traction`, each a float32: m in the skin's parent frame, Pa on the surface, and
the standard deviation of the pressure, Pa."""
_NUMBERS = ("normal_force", "shear_force", "area", "position_uncertainty", "force_uncertainty")
_TRACKED = ("moment", "shear_uncertainty", "area_uncertainty", "moment_uncertainty")
_FLOAT32 = 7
"""`FLOAT32` of PointField."""


def contacts_message(
    make: MakeMessage,
    stamp_ns: int,
    frame_id: str,
    contacts: Sequence[Contact] | Sequence[TrackedContact],
) -> Any:
    """A SkinContacts."""
    tracked = [one for one in contacts if isinstance(one, TrackedContact)]
    fields: dict[str, Any] = {name: _column(contacts, name) for name in _NUMBERS}
    fields |= {name: _column(tracked, name) for name in _TRACKED}
    fields["id"] = np.array([one.id for one in tracked], np.uint32)
    fields["position"] = [_xyz(make, "Point", one.position) for one in contacts]
    fields["normal"] = [_xyz(make, "Vector3", one.normal) for one in contacts]
    fields["force"] = [_xyz(make, "Vector3", one.force) for one in contacts]
    return make(CONTACTS, header=_header(make, stamp_ns, frame_id), **fields)


def traction_message(make: MakeMessage, stamp_ns: int, frame_id: str, cloud: Array) -> Any:
    """A PointCloud2 of a `ContactFinder.cloud` (M, 6)."""
    data = cloud.astype("<f4")
    step = data.itemsize * len(CLOUD)
    fields = [
        make("sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=_FLOAT32, count=1)
        for k, name in enumerate(CLOUD)
    ]
    return make(
        TRACTION,
        header=_header(make, stamp_ns, frame_id),
        height=1,
        width=len(data),
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=step * len(data),
        data=data.reshape(-1).view(np.uint8),
        is_dense=True,
    )


def decode_contacts(message: Any) -> list[Contact]:
    """The contacts of a SkinContacts. ValueError: its arrays differ in length."""

    def xyz(one: Any) -> Array:
        return np.array([one.x, one.y, one.z])

    vectors = message.position, message.normal, message.force
    numbers = (getattr(message, name) for name in _NUMBERS)
    return [
        Contact(xyz(position), xyz(normal), xyz(force), *rest)
        for position, normal, force, *rest in zip(*vectors, *numbers, strict=True)
    ]


def decode_traction(message: Any) -> Array:
    """(M, 6) the cloud of a PointCloud2 from `traction`. BagError: it has other fields."""
    names = tuple(field.name for field in message.fields)
    if names != CLOUD or message.point_step != 4 * len(CLOUD):
        raise BagError(
            f"a point cloud has the fields {', '.join(names)}; those of the topic traction are "
            f"{', '.join(CLOUD)}: listen to the topic of the node contacts"
        )
    points = np.frombuffer(bytes(message.data), "<f4")
    return points.reshape(-1, len(CLOUD)).astype(float)


def _column(contacts: Sequence[Any], name: str) -> Array:
    return np.array([getattr(one, name) for one in contacts], float)


def _header(make: MakeMessage, stamp_ns: int, frame_id: str) -> Any:
    seconds, rest = divmod(stamp_ns, SECOND)
    stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def _xyz(make: MakeMessage, kind: str, vector: Array) -> Any:
    x, y, z = vector.tolist()
    return make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)
