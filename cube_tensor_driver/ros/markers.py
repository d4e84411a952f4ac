"""The node `markers`: from `stress`, a MarkerArray with a few markers, at a rate for eyes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import Point, Quaternion, Vector3
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from ..core import scene
from ..core.errors import ConfigError
from .node import run
from .parameters import MARKERS
from .serialised_markers import SerialisedMarkers
from .skin_subscriber import FollowedSkin, SkinSubscriberNode

LEGEND_BYTES = 128
"""One line, with spaces on both sides, because viewers centre it. RViz sets a second line 1 cm
lower, whatever the size of the text.

A dot stands at either end. RViz 2 takes a space for more than a metre at first. If a text began
with spaces it would seem out of sight, and never be drawn."""
PLAIN_LETTERS = str.maketrans("−σ∂", "-sd")
"""RViz 2 reads a text byte by byte, so a letter of two bytes makes two gaps."""
LIFETIME_S = 2
"""Viewers remove the picture so long after the node has gone, so that no old load is shown as if it
were there."""
BAR_CUBES = 32
"""The bar of the legend is made of so many boxes."""
UPSIDE_DOWN = np.array([-1.0, 1.0, -1.0])
"""Half a turn about y, after which a box is the same. RViz 2 draws the face -z of a box at 0.9 of
its colour and the face +z at 0.5."""
SIDE = 2.04
"""Of a cube, in half sides: a little larger than in the robot model, so that faces in one plane do
not flicker."""

Colour = tuple[float, float, float]
WHITE, TRACTION, GRADIENT = (0.9, 0.9, 0.9), (0.95, 0.95, 0.95), (1.0, 0.6, 0.1)
PULL, PUSH = (0.9, 0.3, 0.2), (0.3, 0.5, 1.0)


class Ranges(NamedTuple):
    """The values that the longest arrows and the top of the colours stand for; they follow what is
    there.

    colours: SI of the quantity. traction: Pa. gradient: Pa/m.
    """

    colours: float = 0.0
    traction: float = 0.0
    gradient: float = 0.0


class Markers(SkinSubscriberNode):
    """Publishes `markers`: cubes in colours, arrows of traction and gradient, a legend, and crosses
    over cubes that are not fine."""

    def __init__(self) -> None:
        super().__init__("markers", MARKERS, MarkerArray, 2)

    def configure(self) -> None:
        name = self.value("quantity")
        if name not in scene.QUANTITIES:
            raise ConfigError(
                f"parameter quantity is {name!r}, allowed: {', '.join(scene.QUANTITIES)}"
            )
        self._quantity = scene.QUANTITIES[name]
        super().configure()

    def set_up(self, skin: FollowedSkin) -> None:
        frame_id = skin.info.header.frame_id
        self._canvas = Canvas(frame_id, skin.poses, self.value("crosses"))
        self._ranges = Ranges()

    def message(self, skin: FollowedSkin, health: np.ndarray) -> bytes:
        values, residual = skin.newest.believed(health), skin.newest.residual
        shown = self._quantity.of(values, residual)
        ranges = self._ranges = self._follow(values, residual, shown)
        canvas = self._canvas
        canvas.draw_cubes(scene.colours(self._quantity, shown, ranges.colours))
        canvas.draw_arrows(values, ranges)
        canvas.draw_faults(health)
        canvas.draw_crosses(values, ranges.traction)
        low = -ranges.colours if self._quantity.signed else 0.0
        bar = np.linspace(low, ranges.colours, BAR_CUBES)
        canvas.draw_legend(
            scene.colours(self._quantity, bar, ranges.colours),
            legend_text(self._quantity, ranges.colours, health),
        )
        return bytes(canvas.data)

    def _follow(
        self, values: NDArray[np.float64], residual: NDArray[np.float64], shown: NDArray[np.float64]
    ) -> Ranges:
        shear, gradient = scene.QUANTITIES["shear"], scene.QUANTITIES["gradient"]
        last, fixed = self._ranges, float(self.value("range"))
        return Ranges(
            colours=fixed or scene.automatic(self._quantity, shown, last.colours),
            traction=scene.automatic(shear, values[:, 2:5], last.traction),
            gradient=scene.automatic(gradient, gradient.of(values, residual), last.gradient),
        )


def legend_text(quantity: scene.Quantity, top: float, health: NDArray[np.integer]) -> str:
    """What colours mean and how the cubes are; top: of the range, SI."""
    high = top / quantity.size
    low = -high if quantity.signed else 0
    label, unit = quantity.label.translate(PLAIN_LETTERS), quantity.unit.replace("σ", "sigma")
    states = []
    for state, word in enumerate(scene.HEALTH):
        count = np.count_nonzero(health == state)
        if count or state == scene.FINE:
            states.append(f"{count} {word}")
    return f"{label}: {low:.3g} to {high:.3g} {unit}; {', '.join(states)}"


class Canvas:
    """The picture of a skin as a serialised MarkerArray.

    data: the message. Each marker has its name as namespace.
    """

    def __init__(self, frame_id: str, poses: scene.CubePoses, crosses: bool) -> None:
        """crosses: whether principal stresses are drawn."""
        self._poses = poses
        self._pitch = poses.pitch
        self._health: NDArray[np.integer] | None = None
        self._groups, rotations = _group_by_orientation(poses.rotation)
        legend = LegendPlace.beside(poses)
        markers = [
            *self._cube_markers(frame_id, rotations),
            *self._line_markers(frame_id, crosses),
            *_legend_markers(frame_id, legend),
        ]
        self._markers = SerialisedMarkers(markers)
        for group, (members, rotation) in enumerate(zip(self._groups, rotations, strict=True)):
            # The points of a marker are in the frame of its pose.
            self._markers[f"cubes {group}"].points[:] = poses.position[members] @ rotation
        self._markers["legend bar"].points[:] = legend.bar * UPSIDE_DOWN
        for marker in markers:
            self._markers[marker.ns].colours[:, 3] = 1.0

    @property
    def data(self) -> bytearray:
        return self._markers.data

    def draw_cubes(self, colours: NDArray[np.float64]) -> None:
        for group, members in enumerate(self._groups):
            self._markers[f"cubes {group}"].colours[:, :3] = colours[members]

    def draw_arrows(self, values: NDArray[np.float64], ranges: Ranges) -> None:
        normal = self._poses.rotation[:, :, 2]
        traction = scene.traction_arrows(self._poses, values, 1.2 * self._pitch / ranges.traction)
        gradient = scene.gradient_arrows(self._poses, values, 0.8 * self._pitch / ranges.gradient)
        for name, lines in (("traction", traction), ("gradient", gradient)):
            self._markers[name].points[:] = scene.heads(lines, normal).reshape(-1, 3)

    def draw_faults(self, health: NDArray[np.integer]) -> None:
        """Crosses over cubes that are not fine; drawn again only when health has changed."""
        if self._health is not None and np.array_equal(health, self._health):
            return
        self._health = health
        faults = self._markers["faults"]
        faults.points[:] = scene.fault_crosses(self._poses, health).reshape(-1, 3)
        faults.colours[:, :3] = np.repeat(scene.MARK[health], 4, axis=0)

    def draw_crosses(self, values: NDArray[np.float64], longest: float) -> None:
        """Principal stresses, if the picture has them; a line for `longest`, Pa, has the length of
        the pitch."""
        if "crosses" not in self._markers:
            return
        crosses = self._markers["crosses"]
        lines, pulls = scene.principal_crosses(self._poses, values, self._pitch / longest)
        crosses.points[:] = lines.reshape(-1, 3)
        crosses.colours[:, :3] = np.repeat(np.where(pulls.reshape(-1, 1), PULL, PUSH), 2, axis=0)

    def draw_legend(self, bar: NDArray[np.float64], text: str) -> None:
        """bar: (BAR_CUBES, 3) colours."""
        self._markers["legend bar"].colours[:, :3] = bar
        room = LEGEND_BYTES - 2
        line = b"." + text.encode()[:room].center(room) + b"."
        self._markers["legend"].text[:] = np.frombuffer(line, np.uint8)

    def _cube_markers(self, frame_id: str, rotations: NDArray[np.float64]) -> list[Marker]:
        """One for each orientation, because all boxes of a CUBE_LIST are parallel."""
        markers = []
        for group, (w, x, y, z) in enumerate(scene.quaternions(rotations).tolist()):
            members = self._groups[group]
            side = SIDE * float(self._poses.half_side[members].max())
            marker = _marker(frame_id, f"cubes {group}", Marker.CUBE_LIST)
            marker.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
            marker.scale = Vector3(x=side, y=side, z=side)
            _allocate(marker, len(members), with_colours=True)
            markers.append(marker)
        return markers

    def _line_markers(self, frame_id: str, crosses: bool) -> list[Marker]:
        """Arrows of three lines, crosses over faults of two, principal crosses of three."""
        cubes = len(self._poses.position)
        traction = _marker(frame_id, "traction", Marker.LINE_LIST, TRACTION)
        gradient = _marker(frame_id, "gradient", Marker.LINE_LIST, GRADIENT)
        faults = _marker(frame_id, "faults", Marker.LINE_LIST)
        principal = _marker(frame_id, "crosses", Marker.LINE_LIST)
        _allocate(traction, 6 * cubes, with_colours=False)
        _allocate(gradient, 6 * cubes, with_colours=False)
        _allocate(faults, 4 * cubes, with_colours=True)
        _allocate(principal, 6 * cubes, with_colours=True)
        markers = [traction, gradient, faults, *([principal] if crosses else [])]
        for marker in markers:
            marker.scale.x = 0.05 * self._pitch
        return markers


class LegendPlace(NamedTuple):
    """Where the legend is, in the parent frame, m.

    width, height: of the bar. bar: (BAR_CUBES, 3) its boxes. text: (3,) the middle of the text.
    """

    width: float
    height: float
    bar: NDArray[np.float64]
    text: NDArray[np.float64]

    @classmethod
    def beside(cls, poses: scene.CubePoses) -> LegendPlace:
        """Beside the skin, towards -y."""
        pitch = poses.pitch
        low, high = poses.position.min(axis=0), poses.position.max(axis=0)
        middle = 0.5 * (low[0] + high[0])
        width = max(high[0] - low[0], 4 * pitch)
        bar = np.empty((BAR_CUBES, 3))
        bar[:, 0] = middle + width * (np.linspace(0, 1, BAR_CUBES) - 0.5)
        bar[:, 1] = low[1] - 1.2 * pitch
        bar[:, 2] = low[2]
        text = np.array([middle, low[1] - 2.2 * pitch - 0.07 * width, low[2]])
        return cls(width, 0.3 * pitch, bar, text)


def _legend_markers(frame_id: str, place: LegendPlace) -> list[Marker]:
    bar = _marker(frame_id, "legend bar", Marker.CUBE_LIST)
    bar.pose.orientation = Quaternion(y=1.0, w=0.0)
    bar.scale = Vector3(x=place.width / BAR_CUBES, y=place.height, z=place.height / 6)
    _allocate(bar, BAR_CUBES, with_colours=True)

    text = _marker(frame_id, "legend", Marker.TEXT_VIEW_FACING)
    x, y, z = place.text.tolist()
    text.pose.position = Point(x=x, y=y, z=z)
    text.scale.z = 0.05 * place.width
    # RViz 2 draws a space half as wide as this; if it is 0, over a metre wide.
    text.scale.x = 0.5 * text.scale.z
    text.text = " " * LEGEND_BYTES
    return [bar, text]


def _marker(frame_id: str, name: str, shape: int, colour: Colour = WHITE) -> Marker:
    marker = Marker(ns=name, type=shape, action=Marker.ADD, frame_locked=True)
    marker.header.frame_id = frame_id
    marker.lifetime.sec = LIFETIME_S
    marker.pose.orientation.w = 1.0
    red, green, blue = colour
    marker.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
    return marker


def _allocate(marker: Marker, points: int, with_colours: bool) -> None:
    marker.points = [Point()] * points
    marker.colors = [ColorRGBA()] * (points if with_colours else 0)


def _group_by_orientation(
    rotation: NDArray[np.float64],
) -> tuple[list[NDArray[np.intp]], NDArray[np.float64]]:
    """The cubes of each orientation that occurs, and the orientations (G, 3, 3), upside down."""
    flat = rotation.round(6).reshape(len(rotation), 9)
    unique, group = np.unique(flat, axis=0, return_inverse=True)
    members = [np.flatnonzero(group.ravel() == number) for number in range(len(unique))]
    return members, unique.reshape(-1, 3, 3) * UPSIDE_DOWN


def main() -> None:
    run(lambda: [Markers()])


if __name__ == "__main__":
    main()
