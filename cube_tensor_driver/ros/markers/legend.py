"""The legend of the `markers` picture: a bar of colours with its numbers, and a scale of arrows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import Point, Vector3
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
"""Half a turn about y, as factors of the axes of a frame.

It leaves a box as it is. RViz 2 draws the face -z of a box at 0.9 of its colour and the face +z at
0.5, so boxes are drawn upside down.
"""

TRACTION_LENGTH = 1.2
"""Length of the longest arrow of traction, in pitches."""

GRADIENT_LENGTH = 0.8
"""Length of the longest arrow of gradient, in pitches."""

TRACTION_COLOUR: Colour = (1.0, 1.0, 1.0)
GRADIENT_COLOUR: Colour = (0.2, 0.6, 1.0)


class ArrowScale(NamedTuple):
    """How one kind of arrow is drawn.

    Attributes:
        name: What the arrows show.
        unit: Unit of the number beside the arrow in the legend.
        unit_si: That unit in SI.
        length: Length of the longest arrow, in pitches.
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

TITLE_BYTES = 128
"""Length of the legend's title, in bytes: one line, with spaces on both sides to centre it.

RViz sets a second line 1 cm lower, whatever the size of the text. A dot stands at either end,
because RViz 2 takes a space for more than a metre at first. If a text began with spaces, it would
seem out of sight, and never be drawn.
"""

PLAIN_LETTERS = str.maketrans("−σ∂", "-sd")
"""Replacements of letters of two bytes. RViz 2 reads a text byte by byte, so one makes two gaps."""

BAR_BOXES = 32
"""Number of boxes that make up the bar of colours."""

NUMBER_POSITIONS = (0.0, 0.5, 1.0)
"""Positions of the numbers along the bar of colours, from 0 to 1."""

TEXT_HEIGHT = 0.05
"""Height of the texts of the legend, in widths of its bar of colours."""

LINE_DISTANCE = 1.5
"""Distance between two lines of text in the legend, in heights of the text."""

NUMBERS_LINE = 0.7
"""Place of the numbers of the legend, in lines of text below its bar of colours."""

TITLE_LINE = 2.0
"""Place of the title of the legend, in lines of text below its bar of colours."""

FIRST_SCALE_LINE = 3.5
"""Place of the first arrow of the legend, in lines of text below its bar of colours."""

SCALE_LINES = 1.2
"""Distance between two arrows of the legend, in lines of text."""


class LegendPlace(NamedTuple):
    """Where the legend is in the parent frame: beside the skin, towards -y.

    Attributes:
        pitch: Pitch of the cubes, in m.
        width: Width of the bar, in m.
        centre_x: x of the centre of the bar, in m.
        top_y: y of its upper edge, in m.
        z: z of the whole, in m.
    """

    pitch: float
    width: float
    centre_x: float
    top_y: float
    z: float

    @classmethod
    def beside(cls, poses: CubePoses) -> LegendPlace:
        """Return a place beside the cubes with these poses."""
        low, high = poses.position.min(axis=0), poses.position.max(axis=0)
        pitch = poses.pitch
        # A legend as narrow as a single cube could not be read.
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
        """Return a point (3,).

        Args:
            across: Position along the bar, from 0 to 1.
            line: Number of lines of text below the bar.
        """
        x = self.centre_x + (across - 0.5) * self.width
        below = LINE_DISTANCE * TEXT_HEIGHT * self.width * line
        return np.array([x, self.top_y - 0.3 * self.pitch - below, self.z])


class Legend:
    """Draws into the serialised markers that `legend_markers` made."""

    def __init__(self, markers: SerialisedMarkers, place: LegendPlace) -> None:
        self._markers = markers
        centres = np.linspace(0, 1, 2 * BAR_BOXES + 1)[1::2]
        bar = np.array([place.point(across, 0) for across in centres])
        bar[:, 1] += 0.15 * place.pitch
        markers["legend bar"].points[:] = bar * UPSIDE_DOWN
        upwards = np.array([[0.0, 0.0, 1.0]])
        for number, scale in enumerate(SCALES):
            tail = place.point(0, FIRST_SCALE_LINE + SCALE_LINES * number)
            tip = tail + np.array([scale.length * place.pitch, 0, 0])
            arrow = np.stack([tail, tip])
            lines = scene.heads(arrow[np.newaxis], upwards)
            markers[f"{scale.name} arrow"].points[:] = lines.reshape(-1, 3)

    def draw(
        self,
        quantity: scene.Quantity,
        top: float,
        health: Index,
    ) -> None:
        """Draw what colours mean and how the cubes are.

        Args:
            quantity: The quantity that colours show.
            top: Top of their range, in SI units.
            health: Health of each cube, (cubes,).
        """
        low = -top if quantity.signed else 0.0
        values = np.linspace(low, top, BAR_BOXES)
        self._markers["legend bar"].colours[:, :3] = scene.colours(quantity, values, top)
        for number, position in enumerate(NUMBER_POSITIONS):
            value = (low + position * (top - low)) / quantity.size
            # Always one character where the quantity has signs, so that the text keeps its length.
            sign = "-" if value < 0 else "+" if quantity.signed else ""
            text = sign + four_characters(abs(value))
            self._markers.write_text(f"legend number {number}", text)

        title = _title(quantity, top, health)
        width = TITLE_BYTES - 2  # without the dots at both ends
        self._markers.write_text("legend", f".{title[:width].center(width)}.")

    def draw_scale(self, traction_pa: float, gradient_pa_per_m: float) -> None:
        """Draw what the longest arrows stand for."""
        for scale, value in zip(
            SCALES,
            (traction_pa, gradient_pa_per_m),
            strict=True,
        ):
            self._markers.write_text(f"{scale.name} scale", _scale_text(scale, value))


def legend_markers(
    frame_id: str,
    place: LegendPlace,
    signed: bool,
) -> list[Marker]:
    """Return the markers of a legend; the numbers of the bar have signs if `signed`."""
    height = TEXT_HEIGHT * place.width
    bar = make_marker(frame_id, "legend bar", Marker.CUBE_LIST)
    # Half a turn about y, see `UPSIDE_DOWN`.
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
        text = make_text(
            frame_id,
            f"legend number {number}",
            height,
            placeholder,
        )
        markers.append(_move(text, place.point(across, NUMBERS_LINE)))

    for number, scale in enumerate(SCALES):
        arrow = make_marker(
            frame_id,
            f"{scale.name} arrow",
            Marker.LINE_LIST,
            scale.colour,
        )
        arrow.scale.x = 0.05 * place.pitch
        allocate(arrow, 6, with_colours=False)
        placeholder = _scale_text(scale, 0.0)
        text = make_text(
            frame_id,
            f"{scale.name} scale",
            height,
            placeholder,
        )
        # A letter is about half as wide as high; the text begins beside the longest arrow.
        begin = (TRACTION_LENGTH + 0.3) * place.pitch / place.width
        across = begin + 0.25 * len(placeholder) * TEXT_HEIGHT
        point = place.point(across, FIRST_SCALE_LINE + SCALE_LINES * number)
        markers += [arrow, _move(text, point)]

    title = make_text(frame_id, "legend", height, "." * TITLE_BYTES)
    return [*markers, _move(title, place.point(0.5, TITLE_LINE))]


def four_characters(value: float) -> str:
    """Return a number from 0 up in four characters, so that a text keeps its length.

    Examples are 0.25, 18.7 and "250.". NaN and numbers that are too large become "----".
    """
    # NaN compares false. From 9999.5 on a number would be rounded to five digits.
    if not value < 9999.5:
        return "----"
    texts = [f"{value:.{digits}f}" for digits in (2, 1, 0)]
    return next(text for text in texts if len(text) <= 4).ljust(4, ".")


def _title(quantity: scene.Quantity, top: float, health: Index) -> str:
    """Return what colours mean up to the top of their range, in SI units, and how the cubes are."""
    high = top / quantity.size
    low = -high if quantity.signed else 0
    label = quantity.label.translate(PLAIN_LETTERS)
    unit = quantity.unit.replace("σ", "sigma")
    states = []
    for state, word in enumerate(HEALTH_WORDS):
        count = np.count_nonzero(health == state)
        if count or state == FINE:
            states.append(f"{count} {word}")
    return f"{label}: {low:.3g} to {high:.3g} {unit}; {', '.join(states)}"


def _scale_text(scale: ArrowScale, value: float) -> str:
    """Return what the longest arrow stands for, whose SI value is given, in a constant length."""
    return f"{scale.name} {four_characters(value / scale.unit_si)} {scale.unit}"


def _move(marker: Marker, position: Array) -> Marker:
    x, y, z = position.tolist()
    marker.pose.position = Point(
        x=x,
        y=y,
        z=z,
    )
    return marker
