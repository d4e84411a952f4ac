# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Shapes of a picture, and their serialisation as a MarkerArray.

In rclpy each point and each colour of a marker is a Python object, so that serialising a picture of
thousands of points would be slow. Here the points and colours are arrays of numpy, whose bytes are
appended to the message. The message is little-endian CDR (OMG DDS-XTypes 7.4.1): a number begins at
an offset that is a multiple of its size, and a text or sequence begins with its length.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from visualization_msgs.msg import Marker

from ...core.arrays import AnyArray, Array
from ...messages.codec import LITTLE_ENDIAN

LIFETIME_S = 2
"""Time, in seconds, after which viewers remove a picture if the node `markers` has sent no newer
one. Without this limit viewers would show the last load for ever after the node has ended."""

Colour = tuple[float, float, float]
"""Red, green and blue, each from 0 to 1."""

WHITE: Colour = (0.95, 0.95, 0.95)
"""Colour of texts, and of markers whose points have colours of their own."""

NO_ROWS = np.empty((0, 3))
"""Points of a shape that has none, or colours of a shape whose points have none of their own."""


EMPTY_TEXT = (1, 0)
"""Serialised empty text, as two integers of 4 bytes. The first one is the length of the text, which
includes the closing zero byte. The second one is this byte, with three bytes of padding."""


class Shape(NamedTuple):
    """One marker of a picture.

    Attributes:
        name: Name of the marker, which becomes its namespace.
        kind: Type of the marker, a constant such as Marker.LINE_LIST.
        scale: Scale of the marker along x, y and z, in m; its meaning depends on the type.
        points: Points in the frame of the marker's pose, (n, 3), in m.
        colours: Red, green and blue of each point, (n, 3); (0, 3) if all have the same colour.
        colour: Colour of the whole marker.
        opacity: Opacity of the whole marker, from 0 to 1.
        position: Position of the whole marker in the frame of the picture, (3,), in m.
        rotation: Quaternion x, y, z, w of the whole marker, (4,).
        text: Text that is shown.
    """

    name: str
    kind: int
    scale: Sequence[float]
    points: Array = NO_ROWS
    colours: Array = NO_ROWS
    colour: Colour = WHITE
    opacity: float = 1.0
    position: Sequence[float] | Array = (0.0, 0.0, 0.0)
    rotation: Sequence[float] | Array = (0.0, 0.0, 0.0, 1.0)
    text: str = ""


def make_lines(
    name: str,
    ends: Array,
    width: float,
    colour: Colour = WHITE,
) -> Shape:
    """Return a shape of separate lines.

    Args:
        name: Name of the marker.
        ends: Both ends of each line, (..., 2, 3), in m.
        width: Width of the lines, in m.
        colour: Colour of the lines.
    """
    return Shape(
        name,
        Marker.LINE_LIST,
        (width, 0.0, 0.0),
        ends.reshape(-1, 3),
        colour=colour,
    )


def make_text(
    name: str,
    text: str,
    height: float,
    position: Sequence[float] | Array = (0.0, 0.0, 0.0),
) -> Shape:
    """Return a shape that shows a text, which always faces the viewer.

    Args:
        name: Name of the marker.
        text: The text.
        height: Height of the letters, in m.
        position: Position of the centre of the text, (3,), in m.
    """
    # RViz 2 draws a space half as wide as scale.x, and more than a metre wide if scale.x is 0.
    scale = (0.5 * height, 0.0, height)
    return Shape(
        name,
        Marker.TEXT_VIEW_FACING,
        scale,
        position=position,
        text=text,
    )


def serialise(frame_id: str, shapes: Sequence[Shape]) -> bytes:
    """Return the bytes of a MarkerArray message.

    Args:
        frame_id: Frame id of the frame in which the poses of the shapes are given.
        shapes: The shapes; their names differ.
    """
    message = _SerialisedMessage()
    message.add("u4", len(shapes))
    for shape in shapes:
        message.add("u4", (0, 0))  # the stamp 0 stands for the newest transform
        message.add_text(frame_id)
        message.add_text(shape.name)
        message.add("i4", (0, shape.kind, Marker.ADD))
        message.add("f8", (*shape.position, *shape.rotation, *shape.scale))
        message.add("f4", (*shape.colour, shape.opacity))
        message.add("i4", (LIFETIME_S, 0))
        # With `frame_locked`, viewers move the marker with its frame.
        message.add("?", True)
        message.add_sequence("f8", shape.points)
        colours = np.ones((len(shape.colours), 4), np.float32)  # the last column is the opacity
        colours[:, :3] = shape.colours
        message.add_sequence("f4", colours)
        # The marker has no texture. The empty fields of the texture are the resource, the image
        # (stamp, frame id, format and number of bytes), and the number of coordinates.
        message.add("u4", (*EMPTY_TEXT, 0, 0, *EMPTY_TEXT, *EMPTY_TEXT, 0, 0))
        message.add_text(shape.text)
        # The marker has no mesh. The empty fields of the mesh are the resource and the file (name
        # and number of bytes).
        message.add("u4", (*EMPTY_TEXT, *EMPTY_TEXT, 0))
        message.add("?", False)
    return bytes(message.data)


class _SerialisedMessage:
    """A serialised message to which fields are appended.

    Attributes:
        data: The bytes of the message.
    """

    def __init__(self) -> None:
        self.data = bytearray(LITTLE_ENDIAN)

    def add(self, kind: str, values: ArrayLike) -> None:
        """Append numbers.

        Args:
            kind: Type of a number in the notation of numpy, without the byte order.
            values: A number, or several of any shape.
        """
        numbers = np.asarray(values, f"<{kind}")
        if numbers.size:
            # Offsets are counted from the end of the four bytes that state the encoding.
            self.data += bytes((len(LITTLE_ENDIAN) - len(self.data)) % numbers.itemsize)
            self.data += numbers.tobytes()

    def add_sequence(self, kind: str, rows: AnyArray) -> None:
        """Append the number of rows and their numbers, each of the type `kind`."""
        self.add("u4", len(rows))
        self.add(kind, rows)

    def add_text(self, text: str) -> None:
        """Append a text, which ends with a zero byte."""
        code = text.encode() + b"\0"
        self.add("u4", len(code))
        self.data += code
