"""A serialised MarkerArray whose points, colours and texts are written in place.

The points and colours of a marker are thousands of Python objects to rclpy. So the array is made of
markers with placeholders and serialised once, and each picture is numpy writing into those bytes.

A message is serialised as CDR: four bytes of encapsulation, then all fields in order, each aligned
to its size; the length of a text or sequence stands before it in 4 bytes. Source: OMG Common Object
Request Broker Architecture 3.3, part 2, section 9.3 (CDR transfer syntax).
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
"""Time, in seconds, after which viewers remove the picture if the node sends no other one.

So no old load is shown as if it were there.
"""

ENCAPSULATION_BYTES = 4
"""Number of bytes before the first field of a message."""

MAX_PADDING_BYTES = 3
"""Number of bytes that the middleware may add to a message, to fill up the last four."""

ITEM_BYTES = {
    "boolean": 1,
    "octet": 1,
    "uint8": 1,
    "int32": 4,
    "uint32": 4,
    "float": 4,
    "double": 8,
}
"""Plain type of a field of a Marker -> its size, in bytes."""

Colour = tuple[float, float, float]
"""Red, green and blue, from 0 to 1."""

WHITE: Colour = (0.95, 0.95, 0.95)


def make_marker(
    frame_id: str,
    name: str,
    shape: int,
    colour: Colour = WHITE,
) -> Marker:
    """Return a marker without points. Its namespace is its name."""
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
    """Return a text that faces the viewer, centred on its position.

    Args:
        frame_id: The frame of its position.
        name: Its namespace.
        height: Height of the letters, in m.
        text: The text. Later texts have the same length.
    """
    marker = make_marker(frame_id, name, Marker.TEXT_VIEW_FACING)
    marker.scale.z = height
    # RViz 2 draws a space half as wide as this; if it is 0, over a metre wide.
    marker.scale.x = 0.5 * height
    marker.text = text
    return marker


def allocate(marker: Marker, n_points: int, with_colours: bool) -> None:
    """Give a marker placeholders for its points, each with a colour if `with_colours`."""
    marker.points = [Point()] * n_points
    marker.colors = [ColorRGBA()] * (n_points if with_colours else 0)


class MarkerArrays(NamedTuple):
    """Views on the bytes of a marker.

    Attributes:
        points: Points in the frame of the marker's pose, (n, 3), in m.
        colours: Colours of the points, (n, 4), or (0, 4) where points have none.
        text: Text in ASCII.
        position: Position of the whole marker, (3,), in m.
        colour: Colour of the whole marker, (4,).
    """

    points: Array
    colours: Single
    text: AnyArray
    position: Array
    colour: Single


class SerialisedMarkers:
    """A serialised MarkerArray. Its arrays are found by the markers' namespaces.

    Attributes:
        data: The message.
    """

    def __init__(self, markers: Sequence[Marker]) -> None:
        """Serialise markers, whose numbers of points and colours and lengths of texts are final.

        Raises:
            MessageError: The installed visualization_msgs has other fields than expected.
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
                # The position is the first field of the pose, and aligned only itself.
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
        """Write a text in ASCII that is as long as the one before."""
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
    """Goes through serialised values in order.

    Attributes:
        end: Where the last value ended, in bytes after the encapsulation.
    """

    def __init__(self) -> None:
        self.end = 0

    def skip(self, type_name: str, value: Any) -> int:
        """Go over a value, and return where its content begins."""
        sequence = re.fullmatch(r"sequence<(.*)>", type_name)
        if sequence:
            return self._skip_sequence(sequence[1], value)
        if type_name == "string":
            start = self.skip("uint32", len(value)) + ITEM_BYTES["uint32"]
            self.end = start + len(value.encode()) + 1  # with a closing zero
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
        """Go over a message, and return where the content of each field begins."""
        types = message.get_fields_and_field_types()
        return {name: self.skip(types[name], getattr(message, name)) for name in types}

    def _skip_sequence(self, item_type: str, items: Sequence[Any]) -> int:
        self.skip("uint32", len(items))
        if not len(items):
            return self.end
        if item_type in ITEM_BYTES:
            start = self.skip(item_type, items[0])
        else:
            # The padding before the first field belongs to no item.
            start = min(self.skip_message(items[0]).values())
        # All items are alike, and their size is a multiple of their alignment.
        self.end = start + len(items) * (self.end - start)
        return start


def _align(start: int, size: int) -> int:
    """Return the first multiple of a size from `start` on."""
    return -(-start // size) * size
