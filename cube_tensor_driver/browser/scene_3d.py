"""The skin in 3-D on the page of the browser view: cubes, field, arrows, crosses, contact. Knows
viser, not ROS.

A machine without a graphics card draws each instance of a batched mesh by itself, which a thousand
cubes twenty times a second are too many for. So what grows with the skin is one object: arrows are
one mesh, many cubes part of the carpet.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from ..core import scene
from ..core.scene import QUANTITIES, CubePoses, Newest, Quantity
from ..elastic.surface import Contact, Surface
from . import markup
from .surface_layer import SurfaceLayer

SPAN = 2.0
"""The longest side of a skin in the scene: cameras and clipping planes of viewers are made for
metres, skins for cm."""
MOST_SOLID = 256
"""Cubes that are drawn as cubes; more lie as squares on the carpet."""
LAYERS = ("field", "traction", "gradient", "principal")
LEAST_ARROW = SPAN / 16
"""Arrows are drawn as if the pitch were at least this: of a thousand cubes the direction of a touch
is still seen."""
THIN = SPAN / 1000
"""Of a line: less is not seen on all screens."""
DIM = 0.5
"""The carpet's colours beside the cubes', which stand out by it."""
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
CUBE_FACES = np.array(
    [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
)
PLAIN: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
SIDES = 6
"""Of what arrows and crosses are made of."""
AMBIENT, DIRECT = 2.0, 1.4
WHITE, GOLD, PULL, PUSH = (235, 235, 235), (255, 153, 38), (255, 90, 70), (90, 150, 255)


class Scene3D:
    """`draw` shows the newest rows: of LAYERS those in `layers`, a ring around the `selected` cube.
    `top` is that of the colours' range, SI; pick is called with the cube that was clicked."""

    def __init__(
        self, to: viser.SceneApi, places: CubePoses, surface: Surface, pick: Callable[[int], None]
    ) -> None:
        self._scene, self._surface = to, surface
        centre = self._centre = (places.position.min(axis=0) + places.position.max(axis=0)) / 2
        self._unit = SPAN / (np.ptp(places.position, axis=0).max() + places.pitch)
        self._places = CubePoses(
            (places.position - centre) * self._unit, places.rotation, places.half_side * self._unit
        )
        self._pitch = places.pitch * self._unit
        self._arrow = max(self._pitch, LEAST_ARROW)
        self.selected = int(((places.position - centre) ** 2).sum(axis=1).argmin())
        self.layers = {"field", "traction", "gradient"}
        self.top = self._longest = self._steepest = 0.0
        self._health = np.zeros(0)
        self._turns = scene.turns(places.rotation)
        # No shadows, no reflections, and as much light as shows colours as the legend has them; a
        # machine without a graphics card shall do.
        to.configure_default_lights(enabled=False)
        to.configure_environment_map(None)
        to.add_light_ambient("/light/all", intensity=AMBIENT)
        to.add_light_directional("/light/above", intensity=DIRECT, position=(-0.4, -0.6, 1.0))
        self._solid: Any = None
        if len(self._turns) <= MOST_SOLID:
            grey = np.full((len(self._turns), 3), 90, np.uint8)
            self._solid = to.add_batched_meshes_simple(
                "/cubes",
                CUBE,
                CUBE_FACES,
                self._turns,
                self._places.position,
                batched_scales=self._places.half_side,
                batched_colors=grey,
                flat_shading=True,
                lod="off",
                **PLAIN,
            )
        cube = surface.cube
        down = places.rotation[cube, :, 2] * self._places.half_side[cube, None]
        self._carpet = SurfaceLayer(
            to,
            (surface.points - centre) * self._unit - down,
            places.rotation[cube],
            surface.spacing * self._unit,
            None if self._solid else self._places,
        )
        self._traction, self._gradient = self._mesh("traction", WHITE), self._mesh("gradient", GOLD)
        self._principal = to.add_frame("/principal", show_axes=False, visible=False)
        self._pulls, self._pushes = (
            self._mesh("principal/pulls", PULL),
            self._mesh("principal/pushes", PUSH),
        )
        marks = (255 * scene.MARK).astype(int).tolist()
        self._faults = {
            k: self._mesh(f"faults/{k}", marks[k])
            for k in (scene.DOUBTFUL, scene.FAULTY, scene.STALE)
        }
        ring = np.linspace(0, 2 * np.pi, 49)
        circle = np.stack([np.cos(ring), np.sin(ring), 0 * ring], axis=1) * (
            0.6 * self._pitch + 0.01 * self._arrow
        )
        self._ring = self._mesh("selected", WHITE)
        _shape(self._ring, rods(np.stack([circle[:-1], circle[1:]], 1), THIN + 0.005 * self._arrow))
        self._hidable = {
            "traction": self._traction,
            "gradient": self._gradient,
            "principal": self._principal,
        }
        self._label = to.add_label(
            "/contact", "", visible=False, anchor="bottom-center", font_screen_scale=1.3
        )

        @to.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            ray = np.array(event.ray_origin), np.array(event.ray_direction)
            cube = hit(self._places.position, self._pitch, *ray)
            if cube is not None:
                pick(cube)

    def _mesh(self, name: str, colour: Any) -> viser.MeshHandle:
        look: dict[str, Any] = {
            "color": tuple(colour),
            "flat_shading": True,
            "side": "double",
            **PLAIN,
        }
        return self._scene.add_mesh_simple(f"/{name}", *NOTHING, **look)

    def draw(self, quantity: Quantity, top: float, newest: Newest, health: np.ndarray) -> None:
        """Colours, arrows, crosses, carpet; top: of the colours' range, SI, 0 follows what is
        there."""
        places = self._places
        values = newest.believed(health)
        shown = quantity.of(values, newest.residual)
        self.top = top or scene.automatic(quantity, shown, self.top)
        shear, gradient = QUANTITIES["shear"], QUANTITIES["gradient"]
        self._longest = scene.automatic(shear, values[:, 2:5], self._longest)
        self._steepest = scene.automatic(
            gradient, gradient.of(values, newest.residual), self._steepest
        )
        field = np.full((len(self._surface.points), 3), np.nan)
        if "field" in self.layers:
            field = DIM * scene.colours(quantity, self._field(quantity, values, shown), self.top)
        cubes = scene.colours(quantity, shown, self.top)
        if self._solid:
            self._solid.batched_colors = light(cubes)
        self._carpet.paint(field if self._solid else np.concatenate([field, cubes]))
        for name, node in self._hidable.items():
            node.visible = name in self.layers
        if self._traction.visible:
            self._draw_arrows(
                self._traction,
                scene.traction_arrows(places, values, 1.8 * self._arrow / self._longest),
            )
        if self._gradient.visible:
            arrows = scene.gradient_arrows(places, values, 1.2 * self._arrow / self._steepest)
            self._draw_arrows(self._gradient, arrows)
        if self._principal.visible:
            lines, pulls = scene.principal_crosses(places, values, self._pitch / self._longest)
            for node, those in ((self._pulls, pulls), (self._pushes, ~pulls)):
                _shape(node, rods(lines[those], 0.02 * self._pitch))
        if not np.array_equal(health, self._health):
            self._health = health
            for kind, node in self._faults.items():
                bad = np.flatnonzero(health == kind)
                lines = scene.fault_crosses(
                    CubePoses(*(column[bad] for column in places)), health[bad]
                )
                _shape(node, rods(lines.reshape(-1, 2, 3), 0.03 * self._pitch))
        up = places.rotation[self.selected, :, 2] * places.half_side[self.selected] * 1.1
        self._ring.position = places.position[self.selected] + up
        self._ring.wxyz = self._turns[self.selected]

    def show(self, contact: Contact | None) -> None:
        """The contact's forces above it."""
        if contact is not None:
            self._label.text = markup.newtons(contact)
            self._label.position = (
                contact.position - self._centre
            ) * self._unit + 1.1 * self._arrow * contact.normal
        self._label.visible = contact is not None

    def _field(self, quantity: Quantity, values: np.ndarray, shown: np.ndarray) -> np.ndarray:
        """On the carpet: the interpolated field where it is pressure or shear, elsewhere each
        cube's own value."""
        if quantity is QUANTITIES["pressure"]:
            return self._surface.field(values).pressure
        if quantity is QUANTITIES["shear"]:
            return np.linalg.norm(np.nan_to_num(self._surface.field(values).shear), axis=1)
        return shown[self._surface.cube]

    def _draw_arrows(self, node: viser.MeshHandle, arrows: np.ndarray) -> None:
        """Those of which more than the head would be seen."""
        size = self._arrow
        arrows = arrows[np.linalg.norm(arrows[:, 1] - arrows[:, 0], axis=1) > 0.15 * size]
        tail, tip = arrows[:, 0], arrows[:, 1]
        way = tip - tail
        length = np.linalg.norm(way, axis=1, keepdims=True)
        neck = tip - way * np.minimum(0.2 * size / length, 1)
        shafts, heads = np.stack([tail, neck], axis=1), np.stack([neck, tip], axis=1)
        (shaft, shaft_faces), (head, head_faces) = (
            rods(shafts, 0.025 * size),
            rods(heads, 0.075 * size, 0.0),
        )
        _shape(
            node,
            (np.concatenate([shaft, head]), np.concatenate([shaft_faces, head_faces + len(shaft)])),
        )


def hit(position: np.ndarray, pitch: float, start: np.ndarray, ray: np.ndarray) -> int | None:
    """Which of the cubes at (N, 3) a ray meets, not one behind it on the far side of a skin; None:
    it passes beside."""
    ray = ray / np.linalg.norm(ray)
    depth = (position - start) @ ray
    apart = np.linalg.norm(position - start - depth[:, None] * ray, axis=1)
    near = apart < pitch
    if not near.any():
        return None
    return int(np.where(near & (depth < depth[near].min() + 2 * pitch), apart, np.inf).argmin())


Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3) and faces (F, 3)."""
NOTHING: Mesh = (np.zeros((3, 3)), np.array([[0, 1, 2]]))


def rods(lines: np.ndarray, start: float, end: float | None = None) -> Mesh:
    """Prisms along lines (N, 2, 3), their radius going from start to end; end 0 makes them
    pyramids. Not closed."""
    if not len(lines):
        return NOTHING
    way = lines[:, 1] - lines[:, 0]
    # across whichever axis the line is least along
    across = np.cross(way, np.eye(3)[np.abs(way).argmin(axis=1)])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    other = np.cross(way, across)
    other /= np.maximum(np.linalg.norm(other, axis=1, keepdims=True), 1e-12)
    angle = 2 * np.pi * np.arange(SIDES)[:, None, None] / SIDES
    circle = (np.cos(angle) * across + np.sin(angle) * other).swapaxes(0, 1)
    radii = np.array([start, start if end is None else end])
    vertices = lines[:, :, None] + circle[:, None] * radii[:, None, None]
    k = np.arange(SIDES)
    a, b = k, (k + 1) % SIDES
    faces = (
        np.stack([[a, b, b + SIDES], [a, b + SIDES, a + SIDES]]).transpose(0, 2, 1).reshape(-1, 3)
    )
    return vertices.reshape(-1, 3), (
        faces + 2 * SIDES * np.arange(len(lines))[:, None, None]
    ).reshape(-1, 3)


def _shape(node: viser.MeshHandle, mesh: Mesh) -> None:
    node.vertices, node.faces = mesh


def light(colours: np.ndarray) -> np.ndarray:
    """Colours of batched meshes: the client takes them as amounts of light, not as sRGB."""
    return (
        255 * np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    ).astype(np.uint8)
