# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A serialised MarkerArray in which points, colours and texts are replaced in the bytes.

In rclpy each point and each colour of a marker is a Python object, so that serialising a picture of
thousands of points would be slow. Here a MarkerArray with placeholders is serialised once, and each
new picture is written by numpy into the bytes of the serialised message.

The places of the fields in these bytes are found by a search: in a copy of the markers, each field
begins with a number or text that occurs nowhere else.
"""

from __future__ import annotations

import copy
import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import Point
from rclpy.serialization import serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from ...core.arrays import AnyArray, Array, Single

LIFETIME_S = 2
"""Time, in seconds, after which viewers remove a picture if the node `markers` has sent no newer
one. Without this limit viewers would show the last load for ever after the node has ended."""

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
    position: Array | None = None,
) -> Marker:
    """Return a marker that shows a text, which always faces the viewer.

    Args:
        frame_id: Frame id of the frame in which the position of the text is given.
        name: Name of the marker, which becomes its namespace.
        height: Height of the letters, in m.
        text: The text.
        position: Position of the centre of the text, (3,), in m; None: the origin of the frame.
    """
    marker = make_marker(frame_id, name, Marker.TEXT_VIEW_FACING)
    marker.scale.z = height
    # RViz 2 draws a space half as wide as scale.x, and more than a metre wide if scale.x is 0.
    marker.scale.x = 0.5 * height
    marker.text = text
    if position is not None:
        x, y, z = position.tolist()
        marker.pose.position = Point(x=x, y=y, z=z)
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

    data: bytearray

    def __init__(self, markers: Sequence[Marker]) -> None:
        """Serialise markers.

        Args:
            markers: The markers. Their numbers of points and colours cannot change afterwards; a
                text that is not empty has at least four letters.
        """
        self._markers = {marker.ns: marker for marker in markers}
        self._arrays: dict[str, MarkerArrays] = {}
        self._serialise()

    def __getitem__(self, namespace: str) -> MarkerArrays:
        return self._arrays[namespace]

    def __contains__(self, namespace: str) -> bool:
        return namespace in self._arrays

    def write_text(self, namespace: str, text: str) -> None:
        """Replace the text of a marker.

        A text of another length takes as long as a new message, and replaces all arrays.

        Args:
            namespace: Namespace of the marker.
            text: The new text in ASCII, at least four letters.
        """
        codes = np.frombuffer(text.encode(), np.uint8)
        if len(codes) != len(self._arrays[namespace].text):
            self._markers[namespace].text = text
            self._rebuild()
        self._arrays[namespace].text[:] = codes

    def _rebuild(self) -> None:
        """Serialise the markers again after one text has changed its length, with the present
        values of all other arrays."""
        previous = self._arrays
        self._serialise()
        for namespace, arrays in previous.items():
            old: Sequence[AnyArray] = arrays
            new: Sequence[AnyArray] = self._arrays[namespace]
            for field, value in zip(new, old, strict=True):
                if field.shape == value.shape:
                    field[:] = value

    def _serialise(self) -> None:
        markers = list(self._markers.values())
        self.data = bytearray(serialize_message(MarkerArray(markers=markers)))
        # The byte offset of a field depends only on the lengths of the lists and texts before it.
        # So it is found in the bytes of a copy in which the values of the fields are unique.
        copies = copy.deepcopy(markers)
        marks = [_mark(marker, number) for number, marker in enumerate(copies)]
        marked = serialize_message(MarkerArray(markers=copies))
        self._arrays = {}
        start = 0
        for marker, begins in zip(markers, marks, strict=True):
            offsets = [marked.index(begin, start) for begin in begins]
            points, colours, text, position, colour = offsets
            # The position is the first of these fields in the bytes of a marker.
            start = position
            n_points, n_colours = len(marker.points), len(marker.colors)
            n_characters = len(marker.text)
            self._arrays[marker.ns] = MarkerArrays(
                points=self._view("<f8", points, (n_points, 3)),
                colours=self._view("<f4", colours, (n_colours, 4)),
                text=self._view("u1", text, (n_characters,)),
                position=self._view("<f8", position, (3,)),
                colour=self._view("<f4", colour, (4,)),
            )

    def _view(self, dtype: str, start: int, shape: tuple[int, ...]) -> AnyArray:
        view: AnyArray = np.ndarray(shape, dtype, self.data, start)
        return view


def _mark(marker: Marker, number: int) -> tuple[bytes, bytes, bytes, bytes, bytes]:
    """Set the beginning of each field of a marker to a value that occurs nowhere else.

    The byte offset of a field in the serialised message is then found by searching for its value.

    Args:
        marker: The marker, which is changed.
        number: Index of the marker in the message.

    Returns:
        The serialised value at the beginning of each field, in the order of the fields of
        `MarkerArrays`; b"" for a field that is empty.
    """
    # Numbers of 1e30 and more do not occur as coordinates or colours, so they are unique.
    first = 1e30 * (2 * number + 1)
    second = 1e30 * (2 * number + 2)
    points = colours = text = b""
    if marker.points:
        marker.points[0] = Point(x=first)
        points = struct.pack("<d", first)
    if marker.colors:
        marker.colors[0] = ColorRGBA(r=first)
        colours = struct.pack("<f", first)
    if marker.text:
        marker.text = f"#{number:03}".ljust(len(marker.text))
        text = marker.text.encode()
    marker.pose.position.x = marker.color.r = second
    position = struct.pack("<d", second)
    colour = struct.pack("<f", second)
    return points, colours, text, position, colour
