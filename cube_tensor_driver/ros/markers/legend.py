# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The legend of the picture of a skin: a colour bar with numbers, and the scales of the arrows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import Vector3
from visualization_msgs.msg import Marker

from ...core.arrays import Array, Index
from ...core.latest_stress import FINE, HEALTH_WORDS
from ...core.poses import CubePoses
from ...views import scene
from .serialised import (
    Colour,
    SerialisedMarkers,
    allocate,
    make_marker,
    make_text,
)

UPSIDE_DOWN = np.array([-1.0, 1.0, -1.0])
"""Rotation by 180 degrees about the y axis, as factors of the x, y and z coordinates.

Boxes are drawn upside down, because RViz 2 shades them: the face towards -z has 0.9 of the
brightness of the colour, the face towards +z only 0.5. The shape of a box does not change.
"""

TRACTION_LENGTH = 1.2
"""Length of the longest arrow of traction (force per area on the upper face of a cube), divided by
the pitch (distance of neighbouring cubes)."""

GRADIENT_LENGTH = 0.8
"""Length of the longest arrow of the gradient of stress, divided by the pitch (distance of
neighbouring cubes)."""

TRACTION_COLOUR: Colour = (1.0, 1.0, 1.0)
"""Colour of the arrows of traction (force per area on the upper face of a cube)."""

GRADIENT_COLOUR: Colour = (0.2, 0.6, 1.0)
"""Colour of the arrows of the gradient of normal stress (its change per distance)."""


class ArrowScale(NamedTuple):
    """Appearance of one kind of arrow in the picture and in the legend.

    Attributes:
        name: Quantity that the arrows show.
        unit: Name of the unit of the number beside the arrow in the legend.
        unit_si: Value of that unit in SI units, such as 1000 for kPa.
        length: Length of the longest arrow, divided by the pitch (distance of neighbouring cubes).
        colour: Colour of the arrows.
    """

    name: str
    unit: str
    unit_si: float
    length: float
    colour: Colour


SCALES = (
    ArrowScale(
        "traction",
        "kPa",
        1e3,
        TRACTION_LENGTH,
        TRACTION_COLOUR,
    ),
    ArrowScale(
        "gradient",
        "kPa/mm",
        1e6,
        GRADIENT_LENGTH,
        GRADIENT_COLOUR,
    ),
)
"""The two kinds of arrows in the picture, in the order of the legend from top to bottom."""

PLAIN_LETTERS = str.maketrans("−σ∂", "-sd")
"""Translation of letters that are not ASCII. RViz 2 draws a text byte by byte, and such a letter,
which has several bytes in UTF-8, would leave gaps."""

BAR_BOXES = 32
"""Number of boxes of different colours that form the colour bar of the legend."""

NUMBER_POSITIONS = (0.0, 0.5, 1.0)
"""Positions of the three numbers along the colour bar: 0 is its left end, 1 its right end."""

TEXT_HEIGHT = 0.05
"""Height of the letters of the legend, divided by the width of the colour bar."""

LINE_DISTANCE = 1.5
"""Distance between two lines of text of the legend, divided by the height of the letters."""

NUMBERS_LINE = 0.7
"""Distance of the numbers of the legend below the colour bar, divided by the distance of two lines
of text."""

TITLE_LINE = 2.0
"""Distance of the title of the legend below the colour bar, divided by the distance of two lines of
text."""

FIRST_SCALE_LINE = 3.5
"""Distance of the first arrow of the legend below the colour bar, divided by the distance of two
lines of text."""

SCALE_LINES = 1.2
"""Distance between the two arrows of the legend, divided by the distance of two lines of text."""


class LegendPlace(NamedTuple):
    """Position and size of the legend in the parent frame: beside the skin in the direction -y.

    Attributes:
        pitch: Distance of neighbouring cubes, in m.
        width: Width of the colour bar along x, in m.
        centre_x: x coordinate of the centre of the colour bar, in m.
        top_y: y coordinate of the upper edge of the colour bar, in m.
        z: z coordinate of the legend, in m.
    """

    pitch: float
    width: float
    centre_x: float
    top_y: float
    z: float

    @classmethod
    def beside(cls, poses: CubePoses) -> LegendPlace:
        """Return the position and size of the legend of a skin whose cubes have these poses."""
        low = poses.position.min(axis=0)
        high = poses.position.max(axis=0)
        pitch = poses.pitch
        # The width has a minimum, so that the legend of a single cube is legible.
        width = max(high[0] - low[0], 4 * pitch)
        centre_x = float(low[0] + high[0]) / 2
        return cls(
            pitch,
            float(width),
            centre_x,
            low[1] - 1.1 * pitch,
            low[2],
        )

    def point(self, across: float, line: float) -> Array:
        """Return a point of the legend in the parent frame of the skin, (3,), in m.

        Args:
            across: Position along the colour bar, from 0 at its left end to 1 at its right end.
            line: Distance below the colour bar, divided by the distance of two lines of text.
        """
        x = self.centre_x + (across - 0.5) * self.width
        below = LINE_DISTANCE * TEXT_HEIGHT * self.width * line
        bar_bottom_y = self.top_y - 0.3 * self.pitch
        return np.array([x, bar_bottom_y - below, self.z])


class Legend:
    """Draws the legend by writing into the serialised markers that `legend_markers` has made."""

    def __init__(self, markers: SerialisedMarkers, place: LegendPlace) -> None:
        self._markers = markers
        edges_and_centres = np.linspace(0, 1, 2 * BAR_BOXES + 1)
        centres = edges_and_centres[1::2]
        bar = np.array([place.point(across, 0) for across in centres])
        bar[:, 1] += 0.15 * place.pitch
        markers["legend bar"].points[:] = bar * UPSIDE_DOWN
        upwards = np.array([[0.0, 0.0, 1.0]])
        for number, scale in enumerate(SCALES):
            tail = place.point(0, FIRST_SCALE_LINE + SCALE_LINES * number)
            length = scale.length * place.pitch
            tip = tail + np.array([length, 0, 0])
            arrow = np.stack([tail, tip])
            lines = scene.heads(arrow[np.newaxis], upwards)
            markers[f"{scale.name} arrow"].points[:] = lines.reshape(-1, 3)

    def draw(
        self,
        quantity: scene.Quantity,
        top: float,
        health: Index,
    ) -> None:
        """Draw the colour bar with its numbers, and the title with the health of the cubes.

        Args:
            quantity: The quantity that colours show.
            top: Value at the upper end of the colour scale, in SI units.
            health: Health of each cube, (cubes,): fine, doubtful, faulty or stale, as
                `LatestStress.health` returns it.
        """
        low = -top if quantity.signed else 0.0
        values = np.linspace(low, top, BAR_BOXES)
        bar = self._markers["legend bar"]
        bar.colours[:, :3] = scene.colours(quantity, values, top)
        for number, position in enumerate(NUMBER_POSITIONS):
            value = (low + position * (top - low)) / quantity.size
            # Numbers of a quantity that can be negative always have a sign, so that the length of
            # the text does not change.
            sign = "-" if value < 0 else "+" if quantity.signed else ""
            text = sign + four_characters(abs(value))
            self._markers.write_text(f"legend number {number}", text)

        self._markers.write_text("legend", _title(quantity, top, health))

    def draw_scale(self, traction_pa: float, gradient_pa_per_m: float) -> None:
        """Write the values of the longest arrows.

        Args:
            traction_pa: Traction (force per area on the upper face) of the longest arrow, in Pa.
            gradient_pa_per_m: Gradient of stress of the longest arrow, in Pa/m.
        """
        for scale, value in zip(SCALES, (traction_pa, gradient_pa_per_m), strict=True):
            self._markers.write_text(f"{scale.name} scale", _scale_text(scale, value))


def legend_markers(
    frame_id: str,
    place: LegendPlace,
    signed: bool,
) -> list[Marker]:
    """Return the markers of a legend, with placeholders for texts and colours.

    Args:
        frame_id: Frame id of the parent frame of the skin.
        place: Position and size of the legend.
        signed: Whether the quantity that colours show can be negative, so that its numbers have
            signs.
    """
    height = TEXT_HEIGHT * place.width
    bar = make_marker(frame_id, "legend bar", Marker.CUBE_LIST)
    # This quaternion is the rotation `UPSIDE_DOWN`, by 180 degrees about the y axis.
    bar.pose.orientation.y, bar.pose.orientation.w = 1.0, 0.0
    bar.scale = Vector3(
        x=place.width / BAR_BOXES,
        y=0.3 * place.pitch,
        z=0.05 * place.pitch,
    )
    allocate(bar, BAR_BOXES, with_colours=True)
    markers = [bar]

    for number, across in enumerate(NUMBER_POSITIONS):
        placeholder = ("+" if signed else "") + four_characters(0.0)
        position = place.point(across, NUMBERS_LINE)
        name = f"legend number {number}"
        markers.append(make_text(frame_id, name, height, placeholder, position))

    for number, scale in enumerate(SCALES):
        arrow = make_marker(frame_id, f"{scale.name} arrow", Marker.LINE_LIST, scale.colour)
        arrow.scale.x = 0.05 * place.pitch
        allocate(arrow, 6, with_colours=False)
        placeholder = _scale_text(scale, 0.0)
        # The text begins to the right of the longest arrow. The position of a text marker is the
        # centre of the text. To compute it, letters are assumed to be half as wide as high.
        begin = (TRACTION_LENGTH + 0.3) * place.pitch / place.width
        across = begin + 0.25 * len(placeholder) * TEXT_HEIGHT
        position = place.point(across, FIRST_SCALE_LINE + SCALE_LINES * number)
        text = make_text(frame_id, f"{scale.name} scale", height, placeholder, position)
        markers += [arrow, text]

    centre = place.point(0.5, TITLE_LINE)
    return [*markers, make_text(frame_id, "legend", height, "title", centre)]


def four_characters(value: float) -> str:
    """Return a number that is not negative in exactly four characters.

    Examples are 0.25, 18.7 and "250.". NaN and numbers that are negative or too large give "----".
    """
    # The comparison is false for NaN, too. Numbers from 9999.5 up would be rounded to five digits.
    if not 0 <= value < 9999.5:
        return "----"
    texts = [f"{value:.{digits}f}" for digits in (2, 1, 0)]
    return next(text for text in texts if len(text) <= 4).ljust(4, ".")


def _title(quantity: scene.Quantity, top: float, health: Index) -> str:
    """Return the title: quantity and range of the colours, and number of cubes in each health.

    It is a single line, because RViz draws a second line 1 cm lower, whatever the size of the text.
    Its length changes only with the numbers of cubes.

    Args:
        quantity: The quantity that colours show.
        top: Value at the upper end of the colour scale, in SI units.
        health: Health of each cube, (cubes,).
    """
    high = four_characters(top / quantity.size)
    low = f"-{high}" if quantity.signed else "0"
    label = quantity.label.translate(PLAIN_LETTERS)
    unit = quantity.unit.replace("σ", "sigma")
    states = []
    for state, word in enumerate(HEALTH_WORDS):
        count = np.count_nonzero(health == state)
        if count or state == FINE:
            states.append(f"{count} {word}")
    return f"{label}: {low} to {high} {unit}; {', '.join(states)}"


def _scale_text(scale: ArrowScale, value: float) -> str:
    """Return a text of constant length with the value of the longest arrow.

    Args:
        scale: The kind of arrow.
        value: Value of the longest arrow, in SI units.
    """
    return f"{scale.name} {four_characters(value / scale.unit_si)} {scale.unit}"
