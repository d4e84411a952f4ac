"""The legend of the `markers` picture: a bar of colours with its numbers, and what arrows mean."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import Point, Vector3
from numpy.typing import NDArray
from visualization_msgs.msg import Marker

from ...core.latest_stress import FINE, HEALTH_WORDS
from ...core.poses import CubePoses
from ...views import scene
from .serialised import SerialisedMarkers
from .shapes import (
    GRADIENT,
    GRADIENT_LENGTH,
    TRACTION,
    TRACTION_LENGTH,
    UPSIDE_DOWN,
    allocate,
    four_places,
    marker,
    text_marker,
)

LEGEND_BYTES = 128
"""One line, with spaces on both sides, because viewers centre it. RViz sets a second line 1 cm
lower, whatever the size of the text.

A dot stands at either end. RViz 2 takes a space for more than a metre at first. If a text began
with spaces it would seem out of sight, and never be drawn."""
PLAIN_LETTERS = str.maketrans("−σ∂", "-sd")
"""RViz 2 reads a text byte by byte, so a letter of two bytes makes two gaps."""
BAR_CUBES = 32
"""The bar is made of so many boxes."""
NUMBERS = 0.0, 0.5, 1.0
"""Where the bar has numbers, in its width."""
TEXT = 0.05
"""Height of the texts, in widths of the bar."""
SCALES = (("traction", "kPa"), ("gradient", "kPa/mm"))


class LegendPlace(NamedTuple):
    """Where the legend is, in the parent frame, m: beside the skin, towards -y.

    pitch: of the cubes. width: of the bar. middle, top, z: x of its middle, y of its upper edge, z.
    """

    pitch: float
    width: float
    middle: float
    top: float
    z: float

    @classmethod
    def beside(cls, poses: CubePoses) -> LegendPlace:
        pitch = poses.pitch
        low, high = poses.position.min(axis=0), poses.position.max(axis=0)
        width = max(high[0] - low[0], 4 * pitch)
        return cls(pitch, float(width), float(low[0] + high[0]) / 2, low[1] - 1.1 * pitch, low[2])

    def at(self, across: float, line: float) -> NDArray[np.float64]:
        """(3,) across the bar from 0 to 1, so many lines of text below it."""
        x = self.middle + (across - 0.5) * self.width
        y = self.top - 0.3 * self.pitch - 1.5 * TEXT * self.width * line
        return np.array([x, y, self.z])


class Legend:
    """Draws into the serialised markers that `legend_markers` made."""

    def __init__(self, markers: SerialisedMarkers, place: LegendPlace) -> None:
        self._markers = markers
        across = np.linspace(0, 1, 2 * BAR_CUBES + 1)[1::2]
        bar = np.array([place.at(x, 0) for x in across])
        bar[:, 1] += 0.15 * place.pitch
        markers["legend bar"].points[:] = bar * UPSIDE_DOWN
        for line, (name, length) in enumerate(
            (("traction", TRACTION_LENGTH), ("gradient", GRADIENT_LENGTH))
        ):
            tail = place.at(0, 3.5 + 1.2 * line)
            tip = tail + np.array([length * place.pitch, 0, 0])
            lines = scene.heads(np.stack([tail, tip])[None], np.array([[0.0, 0.0, 1.0]]))
            markers[f"{name} arrow"].points[:] = lines.reshape(-1, 3)

    def draw(self, quantity: scene.Quantity, top: float, health: NDArray[np.integer]) -> None:
        """What colours mean and how the cubes are; top: of the range, SI."""
        low = -top if quantity.signed else 0.0
        values = np.linspace(low, top, BAR_CUBES)
        self._markers["legend bar"].colours[:, :3] = scene.colours(quantity, values, top)
        for number, share in enumerate(NUMBERS):
            value = (low + share * (top - low)) / quantity.size
            sign = "-" if value < 0 else "+" if quantity.signed else ""
            self._write(f"legend number {number}", sign + four_places(abs(value)))
        line = legend_text(quantity, top, health).encode()[: LEGEND_BYTES - 2]
        self._write("legend", "." + line.decode().center(LEGEND_BYTES - 2) + ".")

    def draw_scale(self, traction: float, gradient: float) -> None:
        """What the longest arrows stand for, Pa and Pa/m."""
        for (name, unit), value in zip(SCALES, (traction / 1e3, gradient / 1e6), strict=True):
            self._write(f"{name} scale", scale_text(name, value, unit))

    def _write(self, name: str, text: str) -> None:
        self._markers[name].text[:] = np.frombuffer(text.encode(), np.uint8)


def legend_markers(frame_id: str, place: LegendPlace, signed: bool) -> list[Marker]:
    """signed: whether the bar's numbers have signs."""
    height = TEXT * place.width
    bar = marker(frame_id, "legend bar", Marker.CUBE_LIST)
    bar.pose.orientation.y, bar.pose.orientation.w = 1.0, 0.0
    bar.scale = Vector3(x=place.width / BAR_CUBES, y=0.3 * place.pitch, z=0.05 * place.pitch)
    allocate(bar, BAR_CUBES, with_colours=True)
    made = [bar]
    for number, across in enumerate(NUMBERS):
        text = "+" * signed + four_places(0.0)
        made.append(
            _placed(
                text_marker(frame_id, f"legend number {number}", height, text),
                place.at(across, 0.7),
            )
        )
    for line, ((name, unit), colour) in enumerate(zip(SCALES, (TRACTION, GRADIENT), strict=True)):
        arrow = marker(frame_id, f"{name} arrow", Marker.LINE_LIST, colour)
        arrow.scale.x = 0.05 * place.pitch
        allocate(arrow, 6, with_colours=False)
        text = scale_text(name, 0.0, unit)
        words = text_marker(frame_id, f"{name} scale", height, text)
        # A letter is about half as wide as high; the text begins beside the longest arrow.
        begin = (TRACTION_LENGTH + 0.3) * place.pitch / place.width
        across = begin + 0.25 * len(text) * TEXT
        made += [arrow, _placed(words, place.at(across, 3.5 + 1.2 * line))]
    title = text_marker(frame_id, "legend", height, "." * LEGEND_BYTES)
    return [*made, _placed(title, place.at(0.5, 2.0))]


def legend_text(quantity: scene.Quantity, top: float, health: NDArray[np.integer]) -> str:
    """What colours mean and how the cubes are; top: of the range, SI."""
    high = top / quantity.size
    low = -high if quantity.signed else 0
    label, unit = quantity.label.translate(PLAIN_LETTERS), quantity.unit.replace("σ", "sigma")
    states = []
    for state, word in enumerate(HEALTH_WORDS):
        count = np.count_nonzero(health == state)
        if count or state == FINE:
            states.append(f"{count} {word}")
    return f"{label}: {low:.3g} to {high:.3g} {unit}; {', '.join(states)}"


def scale_text(name: str, value: float, unit: str) -> str:
    """Of the longest arrow, whatever the value as long."""
    return f"{name} {four_places(value)} {unit}"


def _placed(made: Marker, position: NDArray[np.float64]) -> Marker:
    x, y, z = position.tolist()
    made.pose.position = Point(x=x, y=y, z=z)
    return made
