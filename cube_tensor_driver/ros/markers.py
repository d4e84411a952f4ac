"""The markers node: `stress` in, one MarkerArray with a few markers out, at a rate for eyes.

A marker's points and colours are thousands of Python objects to rclpy. So the array is serialised
once per skin, and each picture is numpy writing into those bytes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import Point, Quaternion, Vector3
from rclpy.serialization import serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from ..core import scene
from ..core.errors import ConfigError
from .node import run
from .skin_subscriber import SkinSubscriberNode

LEGEND_BYTES = 128
"""One line, filled up on both sides: viewers centre it. RViz sets a second one 1 cm lower, whatever
the text's size.

A dot at either end: RViz 2 first takes a blank for over a metre, finds a text that begins with
blanks out of sight and never draws it."""
PLAIN = str.maketrans("−σ∂", "-sd")
"""RViz 2 reads a text byte by byte: each byte of another letter is a gap."""
LIFETIME_S = 2
"""Viewers drop the picture so long after the node is gone: no old load stands there as if it were
true."""
BAR = 32
UPSIDE_DOWN = np.array([-1.0, 1.0, -1.0])
"""Half a turn about y: the same box. RViz 2 draws a box's −z face at 0.9 of its colour, the +z face
at 0.5."""
WHITE, TRACTION, GRADIENT, PULL, PUSH = (
    (0.9, 0.9, 0.9),
    (0.95, 0.95, 0.95),
    (1.0, 0.6, 0.1),
    (0.9, 0.3, 0.2),
    (0.3, 0.5, 1),
)


class Drawn(NamedTuple):
    """A marker's arrays inside the serialised message: points (n, 3), colours (n, 4) or (0, 4)."""

    points: np.ndarray
    colours: np.ndarray


class Markers(SkinSubscriberNode):
    """Publishes `markers`: cubes coloured by a quantity, traction and gradient arrows, crosses over
    faulty cubes."""

    def __init__(self) -> None:
        super().__init__("markers", MarkerArray, 2)
        self.declare(
            "quantity", "pressure", "What the colours mean.", choices=", ".join(scene.QUANTITIES)
        )
        self.declare(
            "range", 0.0, "Top of the colours' range, SI; 0: follows what is there.", (0.0, 1e9)
        )
        self.declare("crosses", False, "Draw the principal stresses of each cube as a cross.")

    def configure(self) -> None:
        name = self.value("quantity")
        if name not in scene.QUANTITIES:
            raise ConfigError(
                f"parameter quantity is {name!r}, allowed: {', '.join(scene.QUANTITIES)}"
            )
        self._quantity = scene.QUANTITIES[name]
        super().configure()

    def new_skin(self) -> None:
        places = self.subscriber.places
        self._pitch = places.pitch
        self._canvas = Canvas(
            self.subscriber.info.header.frame_id, places, self._pitch, self.value("crosses")
        )
        self._top = self._longest = self._steepest = 0.0
        self._health = np.empty(0)

    def message(self) -> bytes:
        canvas, places, newest = self._canvas, self.subscriber.places, self.subscriber.newest
        health = self.subscriber.health()
        values = newest.believed(health)
        shown = self._quantity.of(values, newest.residual)
        self._top = float(self.value("range")) or scene.automatic(self._quantity, shown, self._top)
        canvas.colour_cubes(scene.colours(self._quantity, shown, self._top))

        normal = places.rotation[:, :, 2]
        shear, gradient = scene.QUANTITIES["shear"], scene.QUANTITIES["gradient"]
        self._longest = scene.automatic(shear, values[:, 2:5], self._longest)
        self._steepest = scene.automatic(
            gradient, gradient.of(values, newest.residual), self._steepest
        )
        arrows = scene.traction_arrows(places, values, 1.2 * self._pitch / self._longest)
        canvas["traction"].points[:] = scene.heads(arrows, normal).reshape(-1, 3)
        arrows = scene.gradient_arrows(places, values, 0.8 * self._pitch / self._steepest)
        canvas["gradient"].points[:] = scene.heads(arrows, normal).reshape(-1, 3)
        if not np.array_equal(health, self._health):
            self._health = health
            canvas["faults"].points[:] = scene.fault_crosses(places, health).reshape(-1, 3)
            canvas["faults"].colours[:, :3] = np.repeat(scene.MARK[health], 4, axis=0)
        if "crosses" in canvas:
            lines, pulls = scene.principal_crosses(places, values, self._pitch / self._longest)
            canvas["crosses"].points[:] = lines.reshape(-1, 3)
            canvas["crosses"].colours[:, :3] = np.repeat(
                np.where(pulls.reshape(-1, 1), PULL, PUSH), 2, axis=0
            )
        bar = np.linspace(-self._top if self._quantity.signed else 0.0, self._top, BAR)
        canvas["legend bar"].colours[:, :3] = scene.colours(self._quantity, bar, self._top)
        canvas.write(self._legend(health))
        return bytes(canvas.message)

    def _legend(self, health: np.ndarray) -> str:
        quantity = self._quantity
        top = self._top / quantity.size
        counts = [f"{np.count_nonzero(health == k)} {word}" for k, word in enumerate(scene.HEALTH)]
        states = ", ".join(
            text for k, text in enumerate(counts) if k == scene.FINE or np.any(health == k)
        )
        low = -top if quantity.signed else 0
        label, unit = quantity.label.translate(PLAIN), quantity.unit.replace("σ", "sigma")
        return f"{label}: {low:.3g} to {top:.3g} {unit}; {states}"


class Canvas:
    """A serialised MarkerArray whose points, colours and legend are numpy's to write; drawn by
    name."""

    def __init__(self, frame: str, places: scene.CubePoses, pitch: float, crosses: bool) -> None:
        self._drawn: dict[str, Drawn] = {}
        self._markers: list[Marker] = []
        self._frame = frame
        n = len(places.position)
        # CUBE_LIST has one orientation for all its points: one marker for each orientation in the
        # skin.
        unique, group = np.unique(
            places.rotation.round(6).reshape(n, 9), axis=0, return_inverse=True
        )
        turns = unique.reshape(-1, 3, 3) * UPSIDE_DOWN
        self._groups = [np.flatnonzero(group.ravel() == k) for k in range(len(turns))]
        for k, ((w, x, y, z), members) in enumerate(
            zip(scene.turns(turns).tolist(), self._groups, strict=True)
        ):
            marker = self._add(f"cubes {k}", Marker.CUBE_LIST, len(members), True)
            marker.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
            # A little larger than the robot model's, so that faces in one plane do not flicker.
            side = 2.04 * float(places.half_side[members].max())
            marker.scale = Vector3(x=side, y=side, z=side)
        for name, count, many, colour in (
            ("traction", 6, False, TRACTION),
            ("gradient", 6, False, GRADIENT),
            ("faults", 4, True, WHITE),
            ("crosses", 6, True, WHITE),
        ):
            if name != "crosses" or crosses:
                marker = self._add(name, Marker.LINE_LIST, count * n, many, colour)
                marker.scale.x = 0.05 * pitch
        low, high = places.position.min(axis=0), places.position.max(axis=0)
        width = max(high[0] - low[0], 4 * pitch)
        bar = self._add("legend bar", Marker.CUBE_LIST, BAR, True)
        bar.pose.orientation = Quaternion(y=1.0, w=0.0)
        bar.scale = Vector3(x=width / BAR, y=0.3 * pitch, z=0.05 * pitch)
        text = self._add("legend", Marker.TEXT_VIEW_FACING, 0, False, WHITE)
        text.scale.z = 0.05 * width
        text.scale.x = (
            0.5 * text.scale.z
        )  # of a blank in RViz 2, drawn half as wide; else over a metre
        text.text = "\x01" * LEGEND_BYTES
        middle = 0.5 * (low[0] + high[0])
        text.pose.position = Point(x=middle, y=low[1] - 2.2 * pitch - 0.07 * width, z=low[2])
        self._serialise()
        for k, (turn, members) in enumerate(zip(turns, self._groups, strict=True)):
            # points of a marker are in its pose, which is turned
            self[f"cubes {k}"].points[:] = places.position[members] @ turn
        across = middle + width * (np.linspace(0, 1, BAR) - 0.5)
        beside = np.broadcast_to([low[1] - 1.2 * pitch, low[2]], (BAR, 2))
        self["legend bar"].points[:] = np.column_stack([across, beside]) * UPSIDE_DOWN

    def __getitem__(self, name: str) -> Drawn:
        return self._drawn[name]

    def __contains__(self, name: str) -> bool:
        return name in self._drawn

    def colour_cubes(self, colours: np.ndarray) -> None:
        for k, members in enumerate(self._groups):
            self[f"cubes {k}"].colours[:, :3] = colours[members]

    def write(self, legend: str) -> None:
        room = LEGEND_BYTES - 2
        self._legend[:] = np.frombuffer(b"." + legend.encode()[:room].center(room) + b".", np.uint8)

    def _add(
        self, name: str, kind: int, n: int, many: bool, colour: tuple[float, float, float] = WHITE
    ) -> Marker:
        """A marker whose points, and colours if `many`, are its number until `_serialise` finds
        them by it."""
        number = 1e-30 * (len(self._markers) + 1)
        marker = Marker(ns=name, type=kind, action=Marker.ADD, frame_locked=True)
        marker.header.frame_id = self._frame
        marker.lifetime.sec = LIFETIME_S
        marker.pose.orientation.w = 1.0
        r, g, b = colour
        marker.color = ColorRGBA(r=float(r), g=float(g), b=float(b), a=1.0)
        marker.points = [Point(x=number, y=number, z=number)] * n
        marker.colors = [ColorRGBA(r=number, g=number, b=number, a=number)] * (n if many else 0)
        self._markers.append(marker)
        return marker

    def _serialise(self) -> None:
        self.message = bytearray(serialize_message(MarkerArray(markers=self._markers)))
        for k, marker in enumerate(self._markers):
            number = 1e-30 * (k + 1)
            points = self._find(np.full((len(marker.points), 3), number, "<f8"))
            colours = self._find(np.full((len(marker.colors), 4), number, "<f4"))
            colours[:, 3] = 1.0
            self._drawn[marker.ns] = Drawn(points, colours)
        self._legend = self._find(np.full(LEGEND_BYTES, 1, np.uint8))

    def _find(self, values: np.ndarray) -> Any:
        """The values' place in the message as an array to write to."""
        start = self.message.index(values.tobytes())
        return np.frombuffer(self.message, values.dtype, values.size, start).reshape(values.shape)


def main() -> None:
    run(lambda: [Markers()])


if __name__ == "__main__":
    main()
