"""What the parts of the `markers` picture share: colours, lengths, how a marker is made."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

LIFETIME_S = 2
"""Viewers remove the picture so long after the node has gone, so that no old load is shown as if it
were there."""
UPSIDE_DOWN = np.array([-1.0, 1.0, -1.0])
"""Half a turn about y, after which a box is the same. RViz 2 draws the face -z of a box at 0.9 of
its colour and the face +z at 0.5."""
TRACTION_LENGTH, GRADIENT_LENGTH = 1.2, 0.8
"""Of the longest arrows, in pitches."""

Colour = tuple[float, float, float]
WHITE, TRACTION, GRADIENT = (0.95, 0.95, 0.95), (1.0, 1.0, 1.0), (0.2, 0.6, 1.0)
CONTACT = (1.0, 0.45, 0.75)


def marker(frame_id: str, name: str, shape: int, colour: Colour = WHITE) -> Marker:
    """A marker without points; its namespace is its name."""
    made = Marker(ns=name, type=shape, action=Marker.ADD, frame_locked=True)
    made.header.frame_id = frame_id
    made.lifetime.sec = LIFETIME_S
    made.pose.orientation.w = 1.0
    red, green, blue = colour
    made.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
    return made


def text_marker(frame_id: str, name: str, height: float, text: str) -> Marker:
    """A text that faces the viewer, centred on its position. Its length stays that of `text`."""
    made = marker(frame_id, name, Marker.TEXT_VIEW_FACING)
    made.scale.z = height
    # RViz 2 draws a space half as wide as this; if it is 0, over a metre wide.
    made.scale.x = 0.5 * height
    made.text = text
    return made


def allocate(made: Marker, points: int, with_colours: bool) -> None:
    """Room for so many points."""
    made.points = [Point()] * points
    made.colors = [ColorRGBA()] * (points if with_colours else 0)


def four_places(value: float) -> str:
    """A number from 0 up in four characters, so that a text keeps its length: 0.25, 18.7, 250."""
    if not value < 9999.5:
        return "----"
    return next(text for digits in (2, 1, 0) if len(text := f"{value:.{digits}f}") <= 4).ljust(
        4, "."
    )
