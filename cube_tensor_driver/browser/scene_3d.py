"""The skin in 3-D on the page: cubes, field, arrows, crosses, contact.

A computer without a graphics card draws each instance of a batched mesh by itself. A thousand cubes
twenty times a second are too many for it. So what grows with the skin is a single object: all
arrows of one sort are one mesh, and the cubes of a large skin are squares in their colours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import viser
from numpy.typing import NDArray

from ..core.arrays import Array
from ..core.latest_stress import DOUBTFUL, FAULTY, STALE
from ..core.poses import CubePoses, quaternions
from ..touch.surface import Contact, Surface
from ..views import scene
from ..views.scene import QUANTITIES, Quantity
from . import markup
from .meshes import CUBE, CUBE_EDGES, NOTHING, Mesh, arrows, hit, ring, rods
from .moment import DEVIATION, Moment
from .surface_layer import SquareLayer

Colour = tuple[int, int, int]

SPAN = 2.0
"""The longest side of a skin in the scene. Cameras and clipping planes of viewers are made for
metres, skins are centimetres long."""
MOST_SOLID = 256
"""Skins with more cubes show them as squares where their upper faces would be."""
MOST_NAMES = 256
"""Larger skins have no names in 3-D: they would cover it."""
LEAST_ARROW = SPAN / 16
"""Arrows are drawn as if the pitch were at least this, so that the direction of a touch is still
seen among a thousand cubes."""
THIN = SPAN / 1000
"""Thinner lines are not seen on all screens."""
AMBIENT, DIRECT = 2.4, 1.7
"""Intensities of the lights with which colours look as in the legend."""
DARK, BLUE, EDGE = (40, 44, 52), (25, 105, 210), (110, 114, 122)
PULL, PUSH = (210, 40, 40), (40, 80, 220)
FAULT_COLOURS = {DOUBTFUL: (230, 130, 0), FAULTY: (215, 25, 25), STALE: DARK}
CROSS_HEIGHT = 0.75
"""Of the middle of principal crosses above the cubes' centres, in pitches: outside the cubes."""
NO_SHADOWS: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}


class Colouring(NamedTuple):
    """What colours mean in one picture of a skin with N cubes and M points of its surface.

    quantity: what is shown. cubes: (N,) and field: (M,) its values, SI. top: of its range, SI.
    above: (N, 2) pressure on the surface above each cube, and its standard deviation, Pa; None:
    the node `contacts` says nothing of it.
    """

    quantity: Quantity
    cubes: Array
    field: Array
    top: float
    above: Array | None

    @classmethod
    def of(
        cls, moment: Moment, surface: Surface, quantity: Quantity, wanted: float, before: float
    ) -> Colouring:
        """wanted: top of the range, SI; 0: it follows what there is, and `before`."""
        pressure, sigma = moment.field.pressure, moment.field.sigma
        above = None
        if sigma is not None:
            above = np.stack([pressure, sigma], axis=1)[surface.middle]
        cubes = quantity.of(moment.values, moment.residual)
        if quantity is DEVIATION and above is not None:
            cubes = above[:, 1]
        field = _field(moment, surface, quantity, cubes)
        top = wanted or scene.automatic(quantity, np.concatenate([cubes, field]), before)
        return cls(quantity, cubes, field, top, above)

    def text(self, cube: int) -> str:
        """What is said of a cube: its value, and the pressure on the surface above it."""
        value = markup.value(self.quantity, self.cubes[cube])
        if self.above is None or self.quantity not in (QUANTITIES["pressure"], DEVIATION):
            return value
        surface = markup.surface_pressure(*self.above[cube])
        return f"pressure {surface}" if self.quantity is DEVIATION else f"{value}, {surface}"


def _field(moment: Moment, surface: Surface, quantity: Quantity, cubes: Array) -> Array:
    """(M,) on the points of the surface: the field's if it has the quantity, otherwise the value
    of the nearest cube."""
    if quantity is QUANTITIES["pressure"]:
        return moment.field.pressure
    if quantity is QUANTITIES["shear"]:
        return moment.field.shear
    if quantity is DEVIATION and moment.field.sigma is not None:
        return moment.field.sigma
    return cubes[surface.cube]


@dataclass(frozen=True)
class Placement:
    """Where the skin's cubes are in the scene.

    poses: in units of the scene. centre: the scene's origin in the parent frame, m. unit: scene
    units per m. pitch: typical distance of neighbours in the scene. arrow: unit length of arrows.
    """

    poses: CubePoses
    centre: Array
    unit: float
    pitch: float
    arrow: float

    @classmethod
    def of(cls, poses: CubePoses) -> Placement:
        """Of cubes at `poses` in the parent frame, m."""
        low, high = poses.position.min(axis=0), poses.position.max(axis=0)
        centre = (low + high) / 2
        unit = SPAN / ((high - low).max() + poses.pitch)
        pitch = poses.pitch * unit
        scaled = CubePoses((poses.position - centre) * unit, poses.rotation, poses.half_side * unit)
        return cls(scaled, centre, unit, pitch, max(pitch, LEAST_ARROW))

    def point(self, position: Array) -> Array:
        """A position (..., 3) in m of the parent frame, in the scene."""
        return (position - self.centre) * self.unit


@dataclass
class Shown:
    """Which parts of the 3-D view are drawn."""

    field: bool = True
    traction: bool = True
    gradient: bool = True
    principal: bool = False
    names: bool = False


class Scene3D:
    """The 3-D part of the page.

    shown: which parts are drawn; selected: the cube with a ring around it. Both may be set.
    pick: called with a cube that was clicked.
    """

    def __init__(
        self,
        api: viser.SceneApi,
        names: Sequence[str],
        poses: CubePoses,
        surface: Surface,
        pick: Callable[[int], None],
    ) -> None:
        placement = Placement.of(poses)
        self.shown = Shown()
        self.selected = int((placement.poses.position**2).sum(axis=1).argmin())
        self._unit = placement.unit
        _set_up_lights(api)
        self.bar = ScaleBar(api, placement, surface).length
        self._cubes = Cubes(api, placement, surface)
        self._names = Names(api, placement, names)
        self._traction = Arrows(api, placement, TRACTION)
        self._gradient = Arrows(api, placement, GRADIENT)
        self._crosses = PrincipalCrosses(api, placement)
        self._faults = FaultCrosses(api, placement)
        self._chosen = ChosenCube(api, placement, names)
        self._label = ContactLabel(api, placement)

        @api.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            start, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            cube = hit(placement.poses.position, placement.pitch, start, direction)
            if cube is not None:
                pick(cube)

    def draw(self, moment: Moment, colouring: Colouring) -> None:
        shown, values = self.shown, moment.values
        self._cubes.draw(colouring, with_field=shown.field)
        self._names.visible = shown.names
        self._traction.draw(values, moment.residual, visible=shown.traction)
        self._gradient.draw(values, moment.residual, visible=shown.gradient)
        self._crosses.draw(values, self._traction.longest, visible=shown.principal)
        self._faults.draw(moment.health)
        self._chosen.show(self.selected, colouring.text(self.selected))
        self._label.show(moment.contact)

    def bar_stress(self) -> float:
        """The traction, Pa, whose arrow is as long as the scale bar."""
        return self.bar * self._unit * self._traction.value_per_length

    def bar_gradient(self) -> float:
        """The gradient, Pa/m, whose arrow is as long as the scale bar."""
        return self.bar * self._unit * self._gradient.value_per_length


class ScaleBar:
    """A bar in front of the skin, and the axes of its parent frame beside it.

    length: of the bar, m: 1, 2 or 5 times a power of ten, about a quarter of the skin.
    """

    def __init__(self, api: viser.SceneApi, placement: Placement, surface: Surface) -> None:
        span = SPAN / placement.unit
        self.length = round_down(span / 4)
        points = placement.point(surface.points)
        low, high = points.min(axis=0), points.max(axis=0)
        y, z = low[1] - 0.16 * SPAN, low[2] - float(placement.poses.half_side.max())
        start = np.array([low[0], y, z])
        end = start + np.array([self.length * placement.unit, 0, 0])
        _set_mesh(_add_mesh(api, "bar", DARK), rods(np.array([[start, end]]), 0.006 * SPAN))
        middle = tuple((start + end) / 2 - np.array([0, 0.03 * SPAN, 0]))
        api.add_label(
            "/bar/label", f"{1e3 * self.length:g} mm", position=middle, anchor="top-center"
        )
        corner, axis = np.array([high[0] - 0.05 * SPAN, y, z]), 0.1 * SPAN
        api.add_frame(
            "/axes",
            axes_length=axis,
            axes_radius=0.006 * SPAN,
            origin_radius=0.01 * SPAN,
            position=tuple(corner),
        )
        for name, direction in zip("xyz", np.eye(3), strict=True):
            api.add_label(
                f"/axes/{name}",
                name,
                position=tuple(1.3 * axis * direction),
                anchor="center-center",
            )


def round_down(length: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(k for k in (1, 2, 5) if k * power <= length * (1 + 1e-9)))


class Cubes:
    """The cubes and the field below them, in colour."""

    def __init__(self, api: viser.SceneApi, placement: Placement, surface: Surface) -> None:
        poses, of_cube = placement.poses, surface.cube
        down = poses.rotation[of_cube, :, 2] * poses.half_side[of_cube, None]
        self._field = SquareLayer(
            api,
            "field",
            placement.point(surface.points) - down,
            poses.rotation[of_cube],
            surface.spacing * placement.unit,
        )
        self._solid: viser.BatchedMeshHandle | None = None
        self._squares: SquareLayer | None = None
        up = poses.rotation[:, :, 2] * poses.half_side[:, None]
        if len(poses.position) > MOST_SOLID:
            side = 2 * float(np.median(poses.half_side))
            self._squares = SquareLayer(api, "cubes", poses.position + up, poses.rotation, side)
            return
        self._solid = api.add_batched_meshes_simple(
            "/cubes",
            *CUBE,
            quaternions(poses.rotation),
            poses.position,
            batched_scales=poses.half_side,
            batched_colors=np.full((len(poses.position), 3), 200, np.uint8),
            flat_shading=True,
            lod="off",
            **NO_SHADOWS,
        )
        edges = np.einsum("nij,eaj->neai", poses.rotation, CUBE_EDGES)
        lines = poses.position[:, None, None] + poses.half_side[:, None, None, None] * edges
        api.add_line_segments(
            "/edges", lines.reshape(-1, 2, 3), EDGE, thickness=1.5, thickness_units="screen"
        )

    def draw(self, colouring: Colouring, with_field: bool) -> None:
        quantity, top = colouring.quantity, colouring.top
        if with_field:
            self._field.paint(quantity, colouring.field, top)
        else:
            self._field.hide()
        if self._squares is not None:
            self._squares.paint(quantity, colouring.cubes, top)
        elif self._solid is not None:
            colours = scene.colours(quantity, colouring.cubes, top)
            self._solid.batched_colors = linear_light(colours)


class Names:
    """The names of all cubes of a skin that is not large, above them."""

    def __init__(self, api: viser.SceneApi, placement: Placement, names: Sequence[str]) -> None:
        self._frame = api.add_frame("/names", show_axes=False, visible=False)
        if len(names) > MOST_NAMES:
            return
        for number, (name, point) in enumerate(zip(names, _above(placement, 1.3), strict=True)):
            api.add_label(
                f"/names/{number}",
                name,
                position=tuple(point),
                anchor="bottom-center",
                font_screen_scale=0.8,
            )

    @property
    def visible(self) -> bool:
        return bool(self._frame.visible)

    @visible.setter
    def visible(self, visible: bool) -> None:
        if visible != self._frame.visible:
            self._frame.visible = visible


@dataclass(frozen=True)
class ArrowStyle:
    """What a set of arrows shows, and how.

    full_length: of the arrow for the top of the range, in unit lengths. quantity: whose range that
    is. measured: what the range follows, from values and residual. lines: tails and tips from
    poses, values and a scale in length per SI unit.
    """

    name: str
    colour: Colour
    full_length: float
    quantity: Quantity
    measured: Callable[[Array, Array], Array]
    lines: Callable[[CubePoses, Array, float], Array]


TRACTION = ArrowStyle(
    name="traction",
    colour=DARK,
    full_length=1.8,
    quantity=QUANTITIES["shear"],
    measured=lambda values, residual: values[:, 2:5],
    lines=scene.traction_arrows,
)
GRADIENT = ArrowStyle(
    name="gradient",
    colour=BLUE,
    full_length=1.2,
    quantity=QUANTITIES["gradient"],
    measured=QUANTITIES["gradient"].of,
    lines=scene.gradient_arrows,
)


class Arrows:
    """An arrow on the upper face of each cube, all of them one mesh.

    longest: the value, SI, that an arrow of full length stands for. It follows what is measured.
    """

    def __init__(self, api: viser.SceneApi, placement: Placement, style: ArrowStyle) -> None:
        self.longest = 0.0
        self._placement = placement
        self._style = style
        self._mesh = _add_mesh(api, style.name, style.colour)

    @property
    def value_per_length(self) -> float:
        """SI units per unit of length in the scene."""
        return self.longest / (self._style.full_length * self._placement.arrow)

    def draw(self, values: Array, residual: Array, visible: bool) -> None:
        style, unit = self._style, self._placement.arrow
        measured = style.measured(values, residual)
        self.longest = scene.automatic(style.quantity, measured, self.longest)
        self._mesh.visible = visible
        if visible:
            scale = style.full_length * unit / self.longest
            _set_mesh(self._mesh, arrows(style.lines(self._placement.poses, values, scale), unit))


class PrincipalCrosses:
    """The principal stresses of each cube as a cross above it."""

    def __init__(self, api: viser.SceneApi, placement: Placement) -> None:
        self._placement = placement
        self._frame = api.add_frame("/principal", show_axes=False, visible=False)
        self._lift = _above(placement, CROSS_HEIGHT, placement.pitch) - _above(placement, 1.0)
        self._pulls = _add_mesh(api, "principal/pulls", PULL)
        self._pushes = _add_mesh(api, "principal/pushes", PUSH)

    def draw(self, values: Array, longest: float, visible: bool) -> None:
        """longest: the stress, Pa, whose line is as long as the pitch."""
        self._frame.visible = visible
        if not visible:
            return
        pitch = self._placement.pitch
        lines, pulls = scene.principal_crosses(self._placement.poses, values, pitch / longest)
        lines = lines + self._lift[:, None, None]
        _set_mesh(self._pulls, rods(lines[pulls], 0.02 * pitch))
        _set_mesh(self._pushes, rods(lines[~pulls], 0.02 * pitch))


class FaultCrosses:
    """A cross over each cube that is not fine, in the colour of its health."""

    def __init__(self, api: viser.SceneApi, placement: Placement) -> None:
        self._placement = placement
        self._drawn: NDArray[np.integer] | None = None
        self._meshes = {}
        for state, colour in FAULT_COLOURS.items():
            self._meshes[state] = _add_mesh(api, f"faults/{state}", colour)

    def draw(self, health: NDArray[np.integer]) -> None:
        if self._drawn is not None and np.array_equal(health, self._drawn):
            return
        self._drawn = health
        for state, mesh in self._meshes.items():
            chosen = np.flatnonzero(health == state)
            poses = CubePoses(*(column[chosen] for column in self._placement.poses))
            lines = scene.fault_crosses(poses, health[chosen]).reshape(-1, 2, 3)
            _set_mesh(mesh, rods(lines, 0.03 * self._placement.pitch))


class ChosenCube:
    """A ring around the cube whose numbers the page shows, with its name and a text."""

    def __init__(self, api: viser.SceneApi, placement: Placement, names: Sequence[str]) -> None:
        self._names = names
        self._upper_faces = _above(placement, 1.1)
        self._orientations = quaternions(placement.poses.rotation)
        radius = 0.6 * placement.pitch + 0.01 * placement.arrow
        self._ring = _add_mesh(api, "chosen", DARK)
        _set_mesh(self._ring, ring(radius, THIN + 0.005 * placement.arrow))
        # Away from the viewer's side of a contact's label, which stands above its cube.
        self._label = api.add_label(
            "/chosen/label", "", position=(0.0, -radius, 0.0), anchor="top-center"
        )

    def show(self, cube: int, text: str) -> None:
        self._ring.position = self._upper_faces[cube]
        self._ring.wxyz = self._orientations[cube]
        self._label.text = f"{self._names[cube]}: {text}"


class ContactLabel:
    """The forces of the strongest contact, written above it."""

    def __init__(self, api: viser.SceneApi, placement: Placement) -> None:
        self._placement = placement
        self._label = api.add_label(
            "/contact", "", visible=False, anchor="bottom-center", font_screen_scale=1.3
        )

    def show(self, contact: Contact | None) -> None:
        if contact is not None:
            above = 1.1 * self._placement.arrow * contact.normal
            self._label.text = markup.newtons(contact)
            self._label.position = self._placement.point(contact.position) + above
        self._label.visible = contact is not None


def _above(placement: Placement, factor: float, unit: float | None = None) -> Array:
    """(N, 3) points above the cubes' centres: `factor` times half a side, or times a unit."""
    poses = placement.poses
    height = poses.half_side[:, None] if unit is None else unit
    return poses.position + factor * height * poses.rotation[:, :, 2]


def _set_up_lights(api: viser.SceneApi) -> None:
    """Without shadows and reflections: a computer without a graphics card draws them slowly."""
    api.configure_default_lights(enabled=False)
    api.configure_environment_map(None)
    api.add_light_ambient("/light/all", intensity=AMBIENT)
    api.add_light_directional("/light/above", intensity=DIRECT, position=(-0.4, -0.6, 1.0))


def _add_mesh(api: viser.SceneApi, name: str, colour: Colour) -> viser.MeshHandle:
    return api.add_mesh_simple(
        f"/{name}", *NOTHING, color=colour, flat_shading=True, side="double", **NO_SHADOWS
    )


def _set_mesh(handle: viser.MeshHandle, mesh: Mesh) -> None:
    handle.vertices, handle.faces = mesh


def linear_light(colours: Array) -> NDArray[np.uint8]:
    """Bytes of sRGB colours (N, 3) from 0 to 1, as linear light.

    The client takes the colours of batched meshes as such. Source: IEC 61966-2-1.
    """
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    return (255 * linear).astype(np.uint8)
