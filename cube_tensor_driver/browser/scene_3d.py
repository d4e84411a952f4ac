"""The skin in 3-D on the page: cubes, field, arrows, crosses, contact.

A computer without a graphics card draws each instance of a batched mesh by itself. A thousand cubes
twenty times a second are too many for it. So what grows with the skin is a single object: all
arrows of one sort are one mesh, and the cubes of a large skin are part of the surface layer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import viser
from numpy.typing import NDArray

from ..core import scene
from ..core.scene import QUANTITIES, CubePoses, Newest, Quantity
from ..elastic.surface import Contact, Surface
from . import markup
from .meshes import CUBE, NOTHING, Mesh, arrows, hit, ring, rods
from .surface_layer import SurfaceLayer

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

SPAN = 2.0
"""The longest side of a skin in the scene. Cameras and clipping planes of viewers are made for
metres, skins are centimetres long."""
MOST_SOLID = 256
"""Skins with more cubes show them as squares in the surface layer."""
LAYERS = ("field", "traction", "gradient", "principal")
SHOWN_AT_FIRST = {"field", "traction", "gradient"}
LEAST_ARROW = SPAN / 16
"""Arrows are drawn as if the pitch were at least this, so that the direction of a touch is still
seen among a thousand cubes."""
THIN = SPAN / 1000
"""Thinner lines are not seen on all screens."""
FIELD_BRIGHTNESS = 0.5
"""The field is darker than the cubes, so that these stand out."""
AMBIENT, DIRECT = 2.0, 1.4
"""Intensities of the lights with which colours look as in the legend."""
WHITE, GOLD = (235, 235, 235), (255, 153, 38)
PULL, PUSH = (255, 90, 70), (90, 150, 255)
NO_SHADOWS: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}


class Colouring(NamedTuple):
    """What colours mean in one picture of a skin with N cubes.

    values: (N, 15) as in core/scene.py, NaN where a cube has no tensor. quantity: what is shown;
    shown: (N,) its values; top: of its range, SI.
    """

    values: Array
    quantity: Quantity
    shown: Array
    top: float


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


class Scene3D:
    """The 3-D part of the page.

    shown: which of LAYERS are drawn; selected: the cube with a ring around it; top: of the range
    that colours were drawn with last, SI. All three may be set. pick: called with a cube that was
    clicked.
    """

    def __init__(
        self,
        api: viser.SceneApi,
        poses: CubePoses,
        surface: Surface,
        pick: Callable[[int], None],
    ) -> None:
        placement = Placement.of(poses)
        self.shown = set(SHOWN_AT_FIRST)
        self.selected = int((placement.poses.position**2).sum(axis=1).argmin())
        self.top = 0.0
        _set_up_lights(api)
        self._cubes = Cubes(api, placement, surface)
        self._traction = Arrows(api, placement, TRACTION)
        self._gradient = Arrows(api, placement, GRADIENT)
        self._crosses = PrincipalCrosses(api, placement)
        self._faults = FaultCrosses(api, placement)
        self._ring = SelectionRing(api, placement)
        self._label = ContactLabel(api, placement)

        @api.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            start, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            cube = hit(placement.poses.position, placement.pitch, start, direction)
            if cube is not None:
                pick(cube)

    def draw(
        self, quantity: Quantity, top: float, newest: Newest, health: NDArray[np.integer]
    ) -> None:
        """Draw the newest rows. top: of the range of colours, SI; 0 follows what is there."""
        values = newest.believed(health)
        shown = quantity.of(values, newest.residual)
        self.top = top or scene.automatic(quantity, shown, self.top)
        colouring = Colouring(values, quantity, shown, self.top)
        self._cubes.draw(colouring, with_field="field" in self.shown)
        self._traction.draw(values, newest.residual, visible="traction" in self.shown)
        self._gradient.draw(values, newest.residual, visible="gradient" in self.shown)
        self._crosses.draw(values, self._traction.longest, visible="principal" in self.shown)
        self._faults.draw(health)
        self._ring.surround(self.selected)

    def show_contact(self, contact: Contact | None) -> None:
        """Write the forces of a contact above it; None: there is none."""
        self._label.show(contact)


class Cubes:
    """The cubes and the field below them, in colour."""

    def __init__(self, api: viser.SceneApi, placement: Placement, surface: Surface) -> None:
        poses = placement.poses
        self._surface = surface
        self._solid: viser.BatchedMeshHandle | None = None
        if len(poses.position) <= MOST_SOLID:
            vertices, faces = CUBE
            self._solid = api.add_batched_meshes_simple(
                "/cubes",
                vertices,
                faces,
                scene.quaternions(poses.rotation),
                poses.position,
                batched_scales=poses.half_side,
                batched_colors=np.full((len(poses.position), 3), 90, np.uint8),
                flat_shading=True,
                lod="off",
                **NO_SHADOWS,
            )
        of_cube = surface.cube
        down = poses.rotation[of_cube, :, 2] * poses.half_side[of_cube, None]
        self._layer = SurfaceLayer(
            api,
            placement.point(surface.points) - down,
            poses.rotation[of_cube],
            surface.spacing * placement.unit,
            None if self._solid else poses,
        )

    def draw(self, colouring: Colouring, with_field: bool) -> None:
        field = np.full((len(self._surface.points), 3), np.nan)
        if with_field:
            brightness = scene.colours(colouring.quantity, self._field(colouring), colouring.top)
            field = FIELD_BRIGHTNESS * brightness
        cubes = scene.colours(colouring.quantity, colouring.shown, colouring.top)
        if self._solid is not None:
            self._solid.batched_colors = linear_light(cubes)
            self._layer.paint(field)
        else:
            self._layer.paint(np.concatenate([field, cubes]))

    def _field(self, colouring: Colouring) -> Array:
        """(M,) on the points of the surface: interpolated if the quantity is pressure or shear,
        otherwise the value of the nearest cube."""
        if colouring.quantity is QUANTITIES["pressure"]:
            return self._surface.field(colouring.values).pressure
        if colouring.quantity is QUANTITIES["shear"]:
            shear = np.nan_to_num(self._surface.field(colouring.values).shear)
            return np.linalg.norm(shear, axis=1)
        return colouring.shown[self._surface.cube]


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
    colour=WHITE,
    full_length=1.8,
    quantity=QUANTITIES["shear"],
    measured=lambda values, residual: values[:, 2:5],
    lines=scene.traction_arrows,
)
GRADIENT = ArrowStyle(
    name="gradient",
    colour=GOLD,
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

    def draw(self, values: Array, residual: Array, visible: bool) -> None:
        style, unit = self._style, self._placement.arrow
        measured = style.measured(values, residual)
        self.longest = scene.automatic(style.quantity, measured, self.longest)
        self._mesh.visible = visible
        if visible:
            scale = style.full_length * unit / self.longest
            _set_mesh(self._mesh, arrows(style.lines(self._placement.poses, values, scale), unit))


class PrincipalCrosses:
    """The principal stresses of each cube as a cross."""

    def __init__(self, api: viser.SceneApi, placement: Placement) -> None:
        self._placement = placement
        self._frame = api.add_frame("/principal", show_axes=False, visible=False)
        self._pulls = _add_mesh(api, "principal/pulls", PULL)
        self._pushes = _add_mesh(api, "principal/pushes", PUSH)

    def draw(self, values: Array, longest: float, visible: bool) -> None:
        """longest: the stress, Pa, whose line is as long as the pitch."""
        self._frame.visible = visible
        if not visible:
            return
        pitch = self._placement.pitch
        lines, pulls = scene.principal_crosses(self._placement.poses, values, pitch / longest)
        _set_mesh(self._pulls, rods(lines[pulls], 0.02 * pitch))
        _set_mesh(self._pushes, rods(lines[~pulls], 0.02 * pitch))


class FaultCrosses:
    """A cross over each cube that is not fine, in the colour of its health."""

    def __init__(self, api: viser.SceneApi, placement: Placement) -> None:
        self._placement = placement
        self._drawn: NDArray[np.integer] | None = None
        self._meshes = {}
        for state in (scene.DOUBTFUL, scene.FAULTY, scene.STALE):
            red, green, blue = (255 * scene.MARK[state]).astype(int).tolist()
            self._meshes[state] = _add_mesh(api, f"faults/{state}", (red, green, blue))

    def draw(self, health: NDArray[np.integer]) -> None:
        if self._drawn is not None and np.array_equal(health, self._drawn):
            return
        self._drawn = health
        for state, mesh in self._meshes.items():
            chosen = np.flatnonzero(health == state)
            poses = CubePoses(*(column[chosen] for column in self._placement.poses))
            lines = scene.fault_crosses(poses, health[chosen]).reshape(-1, 2, 3)
            _set_mesh(mesh, rods(lines, 0.03 * self._placement.pitch))


class SelectionRing:
    """A ring around the cube whose numbers the page shows."""

    def __init__(self, api: viser.SceneApi, placement: Placement) -> None:
        poses = placement.poses
        self._upper_faces = (
            poses.position + 1.1 * poses.rotation[:, :, 2] * poses.half_side[:, None]
        )
        self._orientations = scene.quaternions(poses.rotation)
        radius = 0.6 * placement.pitch + 0.01 * placement.arrow
        self._mesh = _add_mesh(api, "selected", WHITE)
        _set_mesh(self._mesh, ring(radius, THIN + 0.005 * placement.arrow))

    def surround(self, cube: int) -> None:
        self._mesh.position = self._upper_faces[cube]
        self._mesh.wxyz = self._orientations[cube]


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
