# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""PointCloud2 messages and message headers.

The caller passes the function that constructs a message, because this folder does not import ROS.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from ..core.arrays import Array
from .codec import SECOND
from .types import TRACTION_TYPE

Message = TypeVar("Message")

MakeMessage = Callable[..., object]
"""Function that constructs a message. Its arguments are the name of the type, such as
"geometry_msgs/msg/Point", and the fields by name; arrays of numbers are numpy arrays."""

FLOAT32 = 7
"""Value of the constant FLOAT32 of sensor_msgs/msg/PointField."""

FLOAT32_SIZE = 4
"""Size, in bytes, of a number of the type FLOAT32 of a PointField."""


def make_cloud_message(
    make: Callable[..., Message],
    stamp_ns: int,
    frame_id: str,
    names: Sequence[str],
    points: Array,
) -> Message:
    """Make a PointCloud2 message.

    Args:
        make: Function that constructs a message from its type's name and its fields.
        stamp_ns: Time stamp of the header, in ns since the Unix epoch.
        frame_id: Coordinate frame of the points.
        names: Names of the numbers of a point.
        points: The points, (M, len(names)).
    """
    fields = [
        make(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=FLOAT32_SIZE * number,
            datatype=FLOAT32,
            count=1,
        )
        for number, name in enumerate(names)
    ]
    step = FLOAT32_SIZE * len(fields)
    return make(
        TRACTION_TYPE,
        header=make_header(make, stamp_ns, frame_id),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=step * len(points),
        # PointCloud2 stores the values of all points as bytes.
        data=points.astype("<f4").reshape(-1).view(np.uint8),
        is_dense=True,
    )


def make_header(make: MakeMessage, stamp_ns: int, frame_id: str) -> object:
    """Make the header of a message (std_msgs/Header).

    Args:
        make: Function that constructs a message from its type's name and its fields.
        stamp_ns: Time stamp, in ns since the Unix epoch.
        frame_id: Coordinate frame.
    """
    seconds, nanoseconds = divmod(stamp_ns, SECOND)
    stamp = make(
        "builtin_interfaces/msg/Time",
        sec=seconds,
        nanosec=nanoseconds,
    )
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)
