"""The skin in 3-D on the page: cubes, field, arrows, crosses, contact.

A computer without a graphics card draws each instance of a batched mesh separately, and a thousand
cubes twenty times a second are too many for it. Parts whose number grows with the skin are
therefore joined to one object: all arrows of one kind are one mesh, and the cubes of a large skin
are squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from ..core.arrays import AnyArray, Array
from ..core.latest_stress import DOUBTFUL, FAULTY, STALE
from ..core.poses import CubePoses, quaternions
from ..touch.surface import Contact, Surface
from ..views import scene
from ..views.scene import QUANTITIES, Quantity
from . import markup
from .colouring import Colouring
from .controls import Shown
from .meshes import CUBE, CUBE_EDGES, NO_MESH, Mesh, SquareLayer, arrows, hit, ring, rods
from .moment import Moment

Colour = tuple[int, int, int]
"""A colour as red, green and blue from 0 to 255."""

SPAN = 2.0
"""Length of the longest side of every skin, in units of the 3-D scene.

The default camera and clipping planes of viser suit objects a few units long. Skins are only
centimetres long, so they are enlarged to this length.
"""

MAX_SOLID_CUBES = 256
"""Maximum number of cubes that are drawn as solids.

In a larger skin, only the upper face of each cube is drawn, as a square.
"""

MAX_NAMED_CUBES = 256
"""Maximum number of cubes of a skin whose names are drawn; more names would cover the skin."""

MIN_ARROW_UNIT = SPAN / 16
"""Minimum of the unit length to which the sizes of arrows are relative, in units of the scene.

The unit length is the pitch (distance of neighbouring cubes) if that is larger. On a skin of a
thousand cubes the pitch is so small that the directions of such arrows could not be seen.
"""

MIN_THICKNESS = SPAN / 1000
"""Minimum radius of a line, in units of the scene, that is visible on every screen."""

AMBIENT_LIGHT = 2.4
"""Intensity of the ambient light, in units of viser.

It is chosen together with `DIRECT_LIGHT` so that the cubes have the colours of the legend.
"""

DIRECT_LIGHT = 1.7
"""Intensity of the directional light from above, in units of viser."""

DARK: Colour = (40, 44, 52)
BLUE: Colour = (25, 105, 210)
EDGE_COLOUR: Colour = (110, 114, 122)
"""Colour of the edges of the cubes."""

TENSION_COLOUR: Colour = (210, 40, 40)
"""Colour of the lines of positive principal stresses (tension)."""
COMPRESSION_COLOUR: Colour = (40, 80, 220)
"""Colour of the lines of negative principal stresses (compression)."""

FAULT_COLOURS = {DOUBTFUL: (230, 130, 0), FAULTY: (215, 25, 25), STALE: DARK}
"""Health of a cube -> colour of the cross that is drawn over it, as red, green, blue from 0 to 255.

A cube whose health is `FINE` has no cross.
"""

CROSS_HEIGHT = 0.75
"""Height of the crosses of the principal stresses above the centres of the cubes.

It is relative to the pitch (distance of neighbouring cubes). At this height the centres of the
crosses are outside of the cubes and can be seen.
"""

NO_SHADOWS: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
"""Arguments of viser for an object that neither casts nor receives shadows."""


@dataclass(frozen=True)
class Placement:
    """Transformation of the skin from its parent frame to the 3-D scene, and lengths in the scene.

    Attributes:
        poses: Poses of the cubes, in units of the scene.
        centre: (3,) origin of the scene in the parent frame, in metres.
        unit: Units of the scene per metre.
        pitch: Typical distance of neighbouring cubes, in units of the scene.
        arrow: Unit length to which the sizes of arrows are relative, in units of the scene.
    """

    poses: CubePoses
    centre: Array
    unit: float
    pitch: float
    arrow: float

    @classmethod
    def of(cls, poses: CubePoses) -> Placement:
        """Compute the transformation that gives the longest side of a skin the length `SPAN`.

        Args:
            poses: Poses of the cubes in the parent frame, in metres.
        """
        # The skin ends half a pitch outside of the centres of its outer cubes.
        low, high = poses.position.min(axis=0), poses.position.max(axis=0)
        centre = (low + high) / 2
        unit = SPAN / ((high - low).max() + poses.pitch)
        pitch = poses.pitch * unit
        scaled = CubePoses((poses.position - centre) * unit, poses.rotation, poses.half_side * unit)
        return cls(scaled, centre, unit, pitch, max(pitch, MIN_ARROW_UNIT))

    def point(self, position: Array) -> Array:
        """Transform positions (..., 3) from the parent frame, in metres, to units of the scene."""
        return (position - self.centre) * self.unit


class Scene3D:
    """The 3-D view of the page.

    Attributes:
        shown: Which parts are drawn; the caller may change it between two pictures.
        selected: Index of the chosen cube, which has a ring around it; the caller may set it.
        bar: Length of the scale bar beside the skin, in metres.
    """

    def __init__(
        self,
        api: viser.SceneApi,
        names: Sequence[str],
        poses: CubePoses,
        surface: Surface,
        pick: Callable[[int], None],
    ) -> None:
        """Add all objects to the scene.

        Args:
            api: The scene of one browser.
            names: Names of the cubes.
            poses: Poses of the cubes in the parent frame, in metres.
            surface: Grid of points around the cubes at which the field (pressure and shear) is
                drawn.
            pick: Function that is called with the index of a cube when the user clicks it.
        """
        placement = Placement.of(poses)
        self.shown = Shown()
        # Until the user chooses a cube, the one nearest to the centre of the skin is chosen.
        distance = np.linalg.norm(placement.poses.position, axis=1)
        self.selected = int(distance.argmin())
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
            # viser reports a click as a ray from the camera through the point that was clicked.
            cube = hit(placement.poses.position, placement.pitch, start, direction)
            if cube is not None:
                pick(cube)

    def draw(self, moment: Moment, colouring: Colouring) -> None:
        """Draw the skin at one instant.

        Args:
            moment: Values of the cubes at this instant, with their health and the contacts.
            colouring: The values that are drawn as colours.
        """
        shown, values = self.shown, moment.values
        self._cubes.draw(colouring, with_field=shown.field)
        self._names.visible = shown.names
        self._traction.draw(values, moment.residual, visible=shown.traction)
        self._gradient.draw(values, moment.residual, visible=shown.gradient)
        self._crosses.draw(values, self._traction.longest, visible=shown.principal)
        self._faults.draw(moment.health)
        self._chosen.show(self.selected, colouring.text(self.selected))
        self._label.show(moment.strongest_contact)

    def bar_stress(self) -> float:
        """Return the traction (force per area on the upper face of a cube), in Pa, whose arrow is
        as long as the scale bar."""
        return self.bar * self._unit * self._traction.value_per_length

    def bar_gradient(self) -> float:
        """Return the gradient of pressure along the skin, in Pa/m, whose arrow is as long as the
        scale bar."""
        return self.bar * self._unit * self._gradient.value_per_length


class ScaleBar:
    """A scale bar in front of the skin, and the axes of the skin's parent frame beside it.

    Attributes:
        length: Length that the bar represents, in metres: the largest of 1, 2 or 5 times a power
            of ten that is at most a quarter of the skin's length.
    """

    def __init__(
        self,
        api: viser.SceneApi,
        placement: Placement,
        surface: Surface,
    ) -> None:
        span = SPAN / placement.unit
        self.length = round_down(span / 4)
        points = placement.point(surface.points)
        low, high = points.min(axis=0), points.max(axis=0)
        y = low[1] - 0.16 * SPAN
        z = low[2] - float(placement.poses.half_side.max())

        start = np.array([low[0], y, z])
        end = start + np.array([self.length * placement.unit, 0, 0])
        bar = np.array([[start, end]])
        _set_mesh(_add_mesh(api, "bar", DARK), rods(bar, 0.006 * SPAN))
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
    """Return the largest number of the form 1, 2 or 5 times a power of ten that is at most
    `length`, which must be positive."""
    power = 10.0 ** np.floor(np.log10(length))
    # Without the tolerance, rounding could reduce a length of exactly 1, 2 or 5.
    limit = length * (1 + 1e-9)
    return float(power * max(factor for factor in (1, 2, 5) if factor * power <= limit))


class Cubes:
    """The coloured cubes, and below them the coloured field (values between the cubes)."""

    def __init__(
        self,
        api: viser.SceneApi,
        placement: Placement,
        surface: Surface,
    ) -> None:
        poses, of_cube = placement.poses, surface.cube
        # The field is drawn at the lower faces of the cubes, so that it does not hide them.
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
        if len(poses.position) > MAX_SOLID_CUBES:
            up = poses.rotation[:, :, 2] * poses.half_side[:, None]
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
            # By default viser simplifies distant meshes, but a cube cannot have fewer triangles.
            lod="off",
            **NO_SHADOWS,
        )
        # Neighbouring cubes of the same colour could not be told apart without drawn edges.
        edges = np.einsum("nij,eaj->neai", poses.rotation, CUBE_EDGES)
        lines = poses.position[:, None, None] + poses.half_side[:, None, None, None] * edges
        api.add_line_segments(
            "/edges", lines.reshape(-1, 2, 3), EDGE_COLOUR, thickness=1.5, thickness_units="screen"
        )

    def draw(self, colouring: Colouring, with_field: bool) -> None:
        """Colour the cubes, and colour or hide the field.

        Args:
            colouring: The values that are drawn as colours.
            with_field: Whether the field is shown.
        """
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
    """The names of the cubes, each above its cube; none in a skin above `MAX_NAMED_CUBES`."""

    def __init__(
        self,
        api: viser.SceneApi,
        placement: Placement,
        names: Sequence[str],
    ) -> None:
        # All names are children of one frame; hiding the frame hides them with a single message.
        self._frame = api.add_frame("/names", show_axes=False, visible=False)
        if len(names) > MAX_NAMED_CUBES:
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
        """Whether the names of the cubes are shown."""
        return bool(self._frame.visible)

    @visible.setter
    def visible(self, visible: bool) -> None:
        # viser sends each assignment to the browser, even if the value is the same.
        if visible != self._frame.visible:
            self._frame.visible = visible


@dataclass(frozen=True)
class ArrowStyle:
    """Meaning and appearance of a set of arrows, one per cube.

    Attributes:
        name: Name of the set in the scene.
        colour: Colour of the arrows.
        full_length: Length of the longest arrow, relative to the unit length `Placement.arrow`.
        quantity: Quantity whose `min_top` limits the automatic range of the lengths from below.
        measured: Function of values (N, 15) and residual (N,) that returns the values, in SI
            units, that the automatic range follows.
        lines: Function of poses, values (N, 15) and a scale in length per SI unit that returns
            tails and tips (N, 2, 3).
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
    """An arrow on the upper face of each cube; all arrows are one mesh.

    Attributes:
        longest: Value, in SI units, that an arrow of full length stands for. It follows a rise of
            the measured values at once and a fall slowly.
    """

    def __init__(
        self,
        api: viser.SceneApi,
        placement: Placement,
        style: ArrowStyle,
    ) -> None:
        self.longest = 0.0
        self._placement = placement
        self._style = style
        self._mesh = _add_mesh(api, style.name, style.colour)

    @property
    def value_per_length(self) -> float:
        """Value, in SI units, that an arrow with a length of one unit of the scene stands for."""
        return self.longest / (self._style.full_length * self._placement.arrow)

    def draw(
        self,
        values: Array,
        residual: Array,
        visible: bool,
    ) -> None:
        """Update the automatic range of the lengths, and draw the arrows if they are shown.

        Args:
            values: (N, 15) 6 stress components in Pa and 9 gradients in Pa/m, in the frames of the
                cubes.
            residual: (N,) misfit between pads and tensor relative to the noise.
            visible: Whether the arrows are shown.
        """
        style, unit = self._style, self._placement.arrow
        measured = style.measured(values, residual)
        self.longest = scene.automatic(style.quantity, measured, self.longest)
        # The range was updated even if the arrows are hidden, so it is right when they appear.
        self._mesh.visible = visible
        if visible:
            scale = style.full_length * unit / self.longest
            lines = style.lines(self._placement.poses, values, scale)
            _set_mesh(self._mesh, arrows(lines, unit))


class PrincipalCrosses:
    """The principal stresses of each cube as a cross of three lines above it.

    Each line lies along a principal direction; its colour tells tension from compression.
    """

    def __init__(self, api: viser.SceneApi, placement: Placement) -> None:
        self._placement = placement
        self._frame = api.add_frame("/principal", show_axes=False, visible=False)
        # `scene.principal_crosses` returns crosses centred on the upper faces; this lifts them.
        self._lift = _above(placement, CROSS_HEIGHT, placement.pitch) - _above(placement, 1.0)
        self._tension = _add_mesh(api, "principal/pulls", TENSION_COLOUR)
        self._compression = _add_mesh(api, "principal/pushes", COMPRESSION_COLOUR)

    def draw(
        self,
        values: Array,
        longest: float,
        visible: bool,
    ) -> None:
        """Draw or hide the crosses.

        Args:
            values: (N, 15) 6 stress components in Pa and 9 gradients in Pa/m, in the frames of the
                cubes.
            longest: Stress, in Pa, whose line is as long as the pitch (distance of neighbouring
                cubes).
            visible: Whether the crosses are shown.
        """
        self._frame.visible = visible
        if not visible:
            return
        pitch = self._placement.pitch
        scale = pitch / longest
        lines, is_tension = scene.principal_crosses(self._placement.poses, values, scale)
        lines = lines + self._lift[:, None, None]
        _set_mesh(self._tension, rods(lines[is_tension], 0.02 * pitch))
        _set_mesh(self._compression, rods(lines[~is_tension], 0.02 * pitch))


class FaultCrosses:
    """A cross over each cube whose health is not `FINE`, in the colour of `FAULT_COLOURS`."""

    def __init__(self, api: viser.SceneApi, placement: Placement) -> None:
        self._placement = placement
        self._drawn: AnyArray | None = None
        self._meshes = {}
        for state, colour in FAULT_COLOURS.items():
            self._meshes[state] = _add_mesh(api, f"faults/{state}", colour)

    def draw(self, health: AnyArray) -> None:
        """Draw the crosses again if the health of any cube has changed.

        Args:
            health: (N,) health of the cubes (fine, doubtful, faulty or stale), coded as in
                core/latest_stress.py.
        """
        # The comparison saves work and data: health seldom changes, and each change of a mesh sends
        # the whole mesh to the browser.
        if self._drawn is not None and np.array_equal(health, self._drawn):
            return
        self._drawn = health
        for state, mesh in self._meshes.items():
            chosen = np.flatnonzero(health == state)
            poses = CubePoses(*(column[chosen] for column in self._placement.poses))
            lines = scene.fault_crosses(poses, health[chosen]).reshape(-1, 2, 3)
            _set_mesh(mesh, rods(lines, 0.03 * self._placement.pitch))


class ChosenCube:
    """A ring around the chosen cube, whose numbers the page shows, with a label below it."""

    def __init__(
        self,
        api: viser.SceneApi,
        placement: Placement,
        names: Sequence[str],
    ) -> None:
        self._names = names
        self._upper_faces = _above(placement, 1.1)
        self._orientations = quaternions(placement.poses.rotation)
        radius = 0.6 * placement.pitch + 0.01 * placement.arrow
        self._ring = _add_mesh(api, "chosen", DARK)
        _set_mesh(self._ring, ring(radius, MIN_THICKNESS + 0.005 * placement.arrow))
        # The label stands below the ring, because the label of a contact stands above a cube.
        self._label = api.add_label(
            "/chosen/label", "", position=(0.0, -radius, 0.0), anchor="top-center"
        )

    def show(self, cube: int, text: str) -> None:
        """Move the ring to a cube, and write the cube's name and a text into the label.

        Args:
            cube: Index of the cube.
            text: Text behind the name, such as the value of the cube.
        """
        self._ring.position = self._upper_faces[cube]
        self._ring.wxyz = self._orientations[cube]
        self._label.text = f"{self._names[cube]}: {text}"


class ContactLabel:
    """A label with the forces of the strongest contact, above the contact."""

    def __init__(self, api: viser.SceneApi, placement: Placement) -> None:
        self._placement = placement
        self._label = api.add_label(
            "/contact", "", visible=False, anchor="bottom-center", font_screen_scale=1.3
        )

    def show(self, contact: Contact | None) -> None:
        """Write normal and shear force of a contact above its position.

        Args:
            contact: The contact; None: there is none, and the label is hidden.
        """
        if contact is not None:
            # The distance keeps the label clear of the cubes and of short arrows.
            above = 1.1 * self._placement.arrow * contact.normal
            self._label.text = markup.newtons(contact)
            self._label.position = self._placement.point(contact.position) + above
        self._label.visible = contact is not None


def _above(placement: Placement, factor: float, unit: float | None = None) -> Array:
    """Return one point above the centre of each cube (N, 3), in units of the scene.

    Args:
        placement: Poses of the cubes in the scene.
        factor: Height of the points above the centres, as a multiple of `unit`.
        unit: Unit of the height, in units of the scene; None: half the side of each cube.
    """
    poses = placement.poses
    height = poses.half_side[:, None] if unit is None else unit
    return poses.position + factor * height * poses.rotation[:, :, 2]


def _set_up_lights(api: viser.SceneApi) -> None:
    """Set up lights without shadows and reflections.

    A computer without a graphics card computes shadows and reflections slowly.
    """
    api.configure_default_lights(enabled=False)
    api.configure_environment_map(None)
    api.add_light_ambient("/light/all", intensity=AMBIENT_LIGHT)
    api.add_light_directional("/light/above", intensity=DIRECT_LIGHT, position=(-0.4, -0.6, 1.0))


def _add_mesh(api: viser.SceneApi, name: str, colour: Colour) -> viser.MeshHandle:
    return api.add_mesh_simple(
        f"/{name}", *NO_MESH, color=colour, flat_shading=True, side="double", **NO_SHADOWS
    )


def _set_mesh(handle: viser.MeshHandle, mesh: Mesh) -> None:
    handle.vertices, handle.faces = mesh


def linear_light(colours: Array) -> NDArray[np.uint8]:
    """Convert sRGB colours (N, 3) from 0 to 1 into linear intensities from 0 to 255.

    The browser interprets the colours of batched meshes as linear intensities of light. The
    conversion is the transfer function of sRGB (IEC 61966-2-1).
    """
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    return (255 * linear).astype(np.uint8)
