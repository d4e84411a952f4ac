# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A serialised MarkerArray in which points, colours and texts are replaced in the bytes.

In rclpy each point and each colour of a marker is a Python object, so that serialising a picture of
thousands of points would be slow. Here a MarkerArray with placeholders is serialised once, and each
new picture is written by numpy into the bytes of the serialised message.

A message is serialised in the format CDR: four bytes of encapsulation, then all fields in order,
each aligned to a multiple of its size. Before a text or a sequence stands its length, in 4 bytes.
Source: OMG Common Object Request Broker Architecture 3.3, part 2, section 9.3 (CDR transfer
syntax).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import Point
from rclpy.serialization import serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from ...core.arrays import AnyArray, Array, Single
from ...core.errors import MessageError

LIFETIME_S = 2
"""Time, in seconds, after which viewers remove a picture if the node `markers` has sent no newer
one. So an old load is not shown as the present one after the node has ended."""

ENCAPSULATION_BYTES = 4
"""Number of bytes of the encapsulation, which precedes the first field of a serialised message."""

MAX_PADDING_BYTES = 3
"""Maximum number of bytes that the middleware appends to a serialised message, to make its size a
multiple of four."""

ITEM_BYTES = {
    "boolean": 1,
    "octet": 1,
    "uint8": 1,
    "int32": 4,
    "uint32": 4,
    "float": 4,
    "double": 8,
}
"""Primitive type of a field of a Marker -> its size in a serialised message, in bytes."""

Colour = tuple[float, float, float]
"""Red, green and blue, each from 0 to 1."""

WHITE: Colour = (0.95, 0.95, 0.95)
"""Colour of texts, and of markers whose points have colours of their own."""


def make_marker(
    frame_id: str,
    name: str,
    shape: int,
    colour: Colour = WHITE,
) -> Marker:
    """Return a marker without points.

    Args:
        frame_id: Frame id of the frame in which the pose of the marker is given.
        name: Name of the marker, which becomes its namespace.
        shape: Type of the marker, a constant such as Marker.LINE_LIST.
        colour: Colour of the whole marker.
    """
    marker = Marker(
        ns=name,
        type=shape,
        action=Marker.ADD,
        frame_locked=True,
    )
    marker.header.frame_id = frame_id
    marker.lifetime.sec = LIFETIME_S
    marker.pose.orientation.w = 1.0
    red, green, blue = colour
    marker.color = ColorRGBA(
        r=red,
        g=green,
        b=blue,
        a=1.0,
    )
    return marker


def make_text(
    frame_id: str,
    name: str,
    height: float,
    text: str,
) -> Marker:
    """Return a marker that shows a text, which always faces the viewer.

    Args:
        frame_id: Frame id of the frame in which the position of the text is given.
        name: Name of the marker, which becomes its namespace.
        height: Height of the letters, in m.
        text: The text. Texts that replace it must have the same length.
    """
    marker = make_marker(frame_id, name, Marker.TEXT_VIEW_FACING)
    marker.scale.z = height
    # RViz 2 draws a space half as wide as scale.x, and more than a metre wide if scale.x is 0.
    marker.scale.x = 0.5 * height
    marker.text = text
    return marker


def allocate(marker: Marker, n_points: int, with_colours: bool) -> None:
    """Add placeholders for points to a marker.

    Args:
        marker: The marker, which is changed.
        n_points: Number of points.
        with_colours: Whether each point has a colour of its own.
    """
    marker.points = [Point()] * n_points
    marker.colors = [ColorRGBA()] * (n_points if with_colours else 0)


class MarkerArrays(NamedTuple):
    """Numpy views of a marker in the bytes of a serialised message; writing changes the message.

    Attributes:
        points: Points in the frame of the marker's pose, (n, 3), in m.
        colours: Red, green, blue and opacity of each point, (n, 4); (0, 4) if points have none.
        text: Text of the marker as ASCII codes, (characters,).
        position: Position of the whole marker, (3,), in m.
        colour: Red, green, blue and opacity of the whole marker, (4,).
    """

    points: Array
    colours: Single
    text: AnyArray
    position: Array
    colour: Single


class SerialisedMarkers:
    """A serialised MarkerArray. Indexing with the namespace of a marker returns its arrays.

    Attributes:
        data: The serialised message.
    """

    def __init__(self, markers: Sequence[Marker]) -> None:
        """Serialise markers.

        Args:
            markers: The markers. Their numbers of points and colours and the lengths of their texts
                cannot change afterwards.

        Raises:
            MessageError: The serialised message has another size than computed, because the
                installed version of visualization_msgs has other fields.
        """
        self.data = bytearray(serialize_message(MarkerArray(markers=list(markers))))
        self._arrays: dict[str, MarkerArrays] = {}
        walk = _CdrWalk()
        walk.skip("uint32", len(markers))
        for marker in markers:
            start = walk.skip_message(marker)
            self._arrays[marker.ns] = MarkerArrays(
                points=self._view("<f8", start["points"], (len(marker.points), 3)),
                colours=self._view("<f4", start["colors"], (len(marker.colors), 4)),
                text=self._view("u1", start["text"], (len(marker.text),)),
                # The position is the first field of the pose. Only numbers are aligned, not the
                # messages that contain them, so the alignment of the first number is added.
                position=self._view("<f8", _align(start["pose"], 8), (3,)),
                colour=self._view("<f4", _align(start["color"], 4), (4,)),
            )

        expected = ENCAPSULATION_BYTES + walk.end
        if not 0 <= len(self.data) - expected <= MAX_PADDING_BYTES:
            raise MessageError(
                f"MarkerArray: serialised into {len(self.data)} bytes, expected are {expected}: "
                "this version of visualization_msgs is not known"
            )

    def __getitem__(self, namespace: str) -> MarkerArrays:
        return self._arrays[namespace]

    def __contains__(self, namespace: str) -> bool:
        return namespace in self._arrays

    def write_text(self, namespace: str, text: str) -> None:
        """Replace the text of a marker.

        Args:
            namespace: Namespace of the marker.
            text: The new text in ASCII, which must be as long as the previous one.
        """
        self._arrays[namespace].text[:] = np.frombuffer(text.encode(), np.uint8)

    def _view(
        self,
        dtype: str,
        start: int,
        shape: tuple[int, ...],
    ) -> AnyArray:
        view: AnyArray = np.ndarray(
            shape,
            dtype,
            self.data,
            ENCAPSULATION_BYTES + start,
        )
        return view


class _CdrWalk:
    """Computes the byte offsets of the fields of a serialised message, one after the other.

    Offsets are measured from the end of the encapsulation.

    Attributes:
        end: Byte offset at which the last value ended.
    """

    def __init__(self) -> None:
        self.end = 0

    def skip(self, type_name: str, value: Any) -> int:
        """Advance over a value of any type.

        Args:
            type_name: Type of the value, as ROS names it.
            value: The value; its lengths of texts and sequences determine its size.

        Returns:
            Byte offset of the number, of the first character of the text or of the first item of
            the sequence. For a message it is the end of the previous value, which may be followed
            by padding.
        """
        sequence = re.fullmatch(r"sequence<(.*)>", type_name)
        if sequence:
            return self._skip_sequence(sequence[1], value)
        if type_name == "string":
            start = self.skip("uint32", len(value)) + ITEM_BYTES["uint32"]
            self.end = start + len(value.encode()) + 1  # A text ends with a zero byte.
            return start
        if type_name in ITEM_BYTES:
            size = ITEM_BYTES[type_name]
            start = _align(self.end, size)
            self.end = start + size
            return start
        start = self.end
        self.skip_message(value)
        return start

    def skip_message(self, message: Any) -> dict[str, int]:
        """Advance over all fields of a message.

        Returns:
            Name of a field -> byte offset at which its content begins, as `skip` returns it.
        """
        types = message.get_fields_and_field_types()
        return {name: self.skip(types[name], getattr(message, name)) for name in types}

    def _skip_sequence(self, item_type: str, items: Sequence[Any]) -> int:
        self.skip("uint32", len(items))
        if not len(items):
            return self.end
        if item_type in ITEM_BYTES:
            start = self.skip(item_type, items[0])
        else:
            # The first field may follow padding, which is not a part of the item.
            start = min(self.skip_message(items[0]).values())
        # All items have the same size, and there is no padding between them, because the size is a
        # multiple of the alignment.
        self.end = start + len(items) * (self.end - start)
        return start


def _align(start: int, size: int) -> int:
    """Return the byte offset at which a number begins that is aligned to its size.

    Args:
        start: Byte offset at which the previous value ended.
        size: Size of the number, in bytes; the result is a multiple of it, at least `start`.
    """
    return -(-start // size) * size
