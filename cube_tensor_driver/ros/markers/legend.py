# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The legend of the picture of a skin: a colour bar with numbers, and the scales of the arrows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from visualization_msgs.msg import Marker

from ...core.arrays import Array, Index
from ...core.latest_stress import FINE, HEALTH_WORDS
from ...core.poses import CubePoses
from ...views import scene
from .serialised import Colour, Shape, make_lines, make_text

LINE_WIDTH = 0.05
"""Width of the lines of arrows and crosses, divided by the pitch (distance of neighbouring cubes).
"""

UPSIDE_DOWN = np.array([-1.0, 1.0, -1.0])
"""Rotation by 180 degrees about the y axis: the factors by which it multiplies the coordinates x, y
and z.

Boxes are drawn upside down, because RViz 2 shades them: the face towards -z has 0.9 of the
brightness of the colour, the face towards +z only 0.5. The rotation does not change the shape of a
box.
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
    def place_beside(cls, poses: CubePoses) -> LegendPlace:
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

    def compute_point(self, across: float, line: float) -> Array:
        """Return a point of the legend in the parent frame of the skin, (3,), in m.

        Args:
            across: Position along the colour bar, from 0 at its left end to 1 at its right end.
            line: Distance below the colour bar, divided by the distance of two lines of text.
        """
        x = self.centre_x + (across - 0.5) * self.width
        below = LINE_DISTANCE * TEXT_HEIGHT * self.width * line
        bar_bottom_y = self.top_y - 0.3 * self.pitch
        return np.array([x, bar_bottom_y - below, self.z])


def draw_arrows(
    scale: ArrowScale,
    name: str,
    arrows: Array,
    normal: Array,
    pitch: float,
) -> Shape:
    """Return arrows as a shape of lines.

    Args:
        scale: The kind of arrow.
        name: Name of the marker.
        arrows: Tails and tips of the arrows, (n, 2, 3), in m.
        normal: Direction perpendicular to the plane of each arrow, (n, 3).
        pitch: Distance of neighbouring cubes, in m.
    """
    return make_lines(
        name,
        scene.make_arrow_lines(arrows, normal),
        LINE_WIDTH * pitch,
        scale.colour,
    )


def draw_legend(
    place: LegendPlace,
    quantity: scene.Quantity,
    ranges: scene.Ranges,
    health: Index,
) -> list[Shape]:
    """Return the shapes of the legend.

    Args:
        place: Position and size of the legend.
        quantity: The quantity that colours show.
        ranges: Values at the upper end of the colour scale and of the longest arrows.
        health: Health of each cube, (cubes,): fine, doubtful, faulty or stale, as
            `LatestStress.compute_health` returns it.
    """
    height = TEXT_HEIGHT * place.width
    top = ranges.colours
    low = -top if quantity.signed else 0.0
    edges_and_centres = np.linspace(0, 1, 2 * BAR_BOXES + 1)
    centres = edges_and_centres[1::2]
    boxes = np.array([place.compute_point(across, 0) for across in centres])
    boxes[:, 1] += 0.15 * place.pitch
    values = np.linspace(low, top, BAR_BOXES)
    bar = Shape(
        "legend bar",
        Marker.CUBE_LIST,
        (place.width / BAR_BOXES, 0.3 * place.pitch, 0.05 * place.pitch),
        boxes * UPSIDE_DOWN,
        scene.choose_colours(quantity, values, top),
        # This quaternion is the rotation `UPSIDE_DOWN`, by 180 degrees about the y axis.
        rotation=(0.0, 1.0, 0.0, 0.0),
    )
    shapes = [bar]

    for number, position in enumerate(NUMBER_POSITIONS):
        value = (low + position * (top - low)) / quantity.size
        sign = "-" if value < 0 else "+" if quantity.signed else ""
        text = sign + format_in_four_characters(abs(value))
        centre = place.compute_point(position, NUMBERS_LINE)
        shapes.append(
            make_text(
                f"legend number {number}",
                text,
                height,
                centre,
            )
        )

    upwards = np.array([[0.0, 0.0, 1.0]])
    longest = (ranges.traction, ranges.gradient)
    for number, (scale, value) in enumerate(zip(SCALES, longest, strict=True)):
        line = FIRST_SCALE_LINE + SCALE_LINES * number
        tail = place.compute_point(0, line)
        tip = tail + np.array([scale.length * place.pitch, 0, 0])
        arrow = np.stack([tail, tip])[np.newaxis]
        shapes.append(
            draw_arrows(
                scale,
                f"{scale.name} arrow",
                arrow,
                upwards,
                place.pitch,
            )
        )
        text = f"{scale.name} {format_in_four_characters(value / scale.unit_si)} {scale.unit}"
        # The text begins to the right of the longest arrow. The position of a text marker is the
        # centre of the text. To compute it, letters are assumed to be half as wide as high.
        begin = (TRACTION_LENGTH + 0.3) * place.pitch / place.width
        centre = place.compute_point(begin + 0.25 * len(text) * TEXT_HEIGHT, line)
        shapes.append(make_text(f"{scale.name} scale", text, height, centre))

    title = _make_title(quantity, top, health)
    return [
        *shapes,
        make_text(
            "legend",
            title,
            height,
            place.compute_point(0.5, TITLE_LINE),
        ),
    ]


def format_in_four_characters(value: float) -> str:
    """Return a number that is not negative in exactly four characters.

    Examples are 0.25, 18.7 and "250.". NaN and numbers that are negative or too large give "----".
    """
    # The comparison is false for NaN, too. Numbers from 9999.5 up would be rounded to five digits.
    if not 0 <= value < 9999.5:
        return "----"
    texts = [f"{value:.{digits}f}" for digits in (2, 1, 0)]
    return next(text for text in texts if len(text) <= 4).ljust(4, ".")


def _make_title(
    quantity: scene.Quantity,
    top: float,
    health: Index,
) -> str:
    """Return the title: quantity and range of the colours, and number of cubes in each health.

    It is a single line, because RViz draws a second line 1 cm lower, whatever the size of the text.

    Args:
        quantity: The quantity that colours show.
        top: Value at the upper end of the colour scale, in SI units.
        health: Health of each cube, (cubes,).
    """
    high = format_in_four_characters(top / quantity.size)
    low = f"-{high}" if quantity.signed else "0"
    label = quantity.label.translate(PLAIN_LETTERS)
    unit = quantity.unit.replace("σ", "sigma")
    states = []
    for state, word in enumerate(HEALTH_WORDS):
        count = np.count_nonzero(health == state)
        if count or state == FINE:
            states.append(f"{count} {word}")
    return f"{label}: {low} to {high} {unit}; {', '.join(states)}"
