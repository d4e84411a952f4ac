# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The skin in 3-D on the page: cubes, field, arrows, crosses, contact.

A computer without a graphics card draws each instance of a batched mesh separately, and a thousand
cubes twenty times a second are too many for it. The cubes of a large skin are therefore squares,
which are joined to one mesh for each colour, and arrows, crosses and rings consist of lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import viser

from ..core.arrays import AnyArray, Array
from ..core.latest_stress import DOUBTFUL, FAULTY, STALE
from ..core.poses import CubePoses, compute_quaternions
from ..touch.surface import Contact, Surface
from ..views import scene
from ..views.meshes import (
    COLOUR_STEPS,
    CUBE_EDGES,
    NO_MESH,
    compute_square_corners,
    compute_step_colours,
    find_hit_cube,
    make_corner_lines,
    make_cube,
    paint_squares,
)
from ..views.round_numbers import round_down
from .colouring import Colouring
from .scan import Scan

Properties = dict[str, object]
"""Name of a property of an object on the page (of the 3-D scene or a control) -> its value."""

Update = dict[str, Properties]
"""Name of an object on the page -> the properties that it has while one scan (the values of all
cubes at one instant) is shown."""

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

The unit length is the pitch (distance of neighbouring cubes) if the pitch is larger than this
minimum. On a skin of a thousand cubes the pitch is so small that the directions of arrows of that
size could not be seen.
"""

MIN_THICKNESS = SPAN / 500
"""Minimum thickness of a line, in units of the scene, that is visible on every screen."""

AMBIENT_LIGHT = 2.4
"""Intensity of the ambient light, in units of viser.

It is chosen together with `DIRECT_LIGHT` so that the cubes have the colours of the legend.
"""

DIRECT_LIGHT = 1.7
"""Intensity of the directional light from above, in units of viser."""

DARK: Colour = (40, 44, 52)
"""Colour of arrows of traction, of marks, of the scale bar and of crosses over stale cubes."""
BLUE: Colour = (25, 105, 210)
"""Colour of arrows of the gradient of pressure."""
EDGE_COLOUR: Colour = (110, 114, 122)
"""Colour of the edges of the cubes."""

FAULT_COLOURS = {
    DOUBTFUL: (230, 130, 0),
    FAULTY: (215, 25, 25),
    STALE: DARK,
}
"""Health of a cube -> colour of the cross that is drawn over it, as red, green, blue from 0 to 255.

A cube whose health is `FINE` has no cross.
"""

LINES: dict[str, tuple[Colour, float]] = {
    "traction": (DARK, 0.05),
    "gradient": (BLUE, 0.05),
    "tension": ((210, 40, 40), 0.04),
    "compression": ((40, 80, 220), 0.04),
    "chosen": (DARK, 0.014),
    "contacts": ((200, 40, 160), 0.02),
    **{f"fault {state}": (colour, 0.06) for state, colour in FAULT_COLOURS.items()},
}
"""Name of a group of lines that are redrawn in each update -> colour and thickness of its lines.

The thickness is relative to the unit length of arrows, which is about the pitch (distance of
neighbouring cubes).
"""

NO_LINES = np.zeros((1, 2, 3))
"""An invisible line without length, because the browser cannot draw an object without lines."""

MIN_ARROW = 0.15
"""Minimum length of an arrow that is drawn, relative to the unit length of arrows (about the pitch,
which is the distance of neighbouring cubes)."""

VIEW_DIRECTION = np.array([0.1, -0.7, 0.7])
"""Direction (3,) from the skin to the camera at its first position (`CAMERA_POSITION` in page.py),
in the coordinates of the scene. The plane in which the head of an arrow lies is perpendicular to
this direction, so that the head is visible."""

RING_CORNERS = 48
"""Number of corners of the polygon that is drawn as the ring around a contact."""

ArrowLines = Callable[[CubePoses, Array, float], Array]
"""Function that returns tails and tips (N, 2, 3) of one arrow per cube.

Its arguments are the poses of N cubes, their values (N, 15), 6 stress components in Pa and 9
gradients in Pa/m, and the length of an arrow per Pa or Pa/m.
"""

TRACTION_LENGTH = 1.8
"""Length of the longest arrow of traction (force per area on the upper face of a cube), relative to
the unit length of arrows (about the pitch, which is the distance of neighbouring cubes)."""

GRADIENT_LENGTH = 1.2
"""Length of the longest arrow of the gradient of pressure, relative to the unit length of arrows
(about the pitch, which is the distance of neighbouring cubes)."""

MIN_RING = 0.01 * SPAN
"""Minimum radius of the ring around a contact, in units of the 3-D scene (the longest side of every
skin is 2 units long)."""

CROSS_HEIGHT = 0.75
"""Height of the crosses of the principal stresses above the centres of the cubes.

It is relative to the pitch (distance of neighbouring cubes). At this height the centres of the
crosses are outside of the cubes and can be seen.
"""


class Placement:
    """Transformation of the skin from its parent frame to the 3-D scene, and lengths in the scene.

    Attributes:
        poses: Poses of the cubes, in units of the scene.
        centre: (3,) origin of the scene in the parent frame, in metres.
        unit: Units of the scene per metre.
        pitch: Typical distance of neighbouring cubes, in units of the scene.
        arrow: Unit length to which the sizes of arrows are relative, in units of the scene.
    """

    def __init__(self, poses: CubePoses) -> None:
        """Compute the transformation that gives the longest side of a skin the length `SPAN`.

        Args:
            poses: Poses of the cubes in the parent frame, in metres.
        """
        # The skin ends half a pitch outside of the centres of its outer cubes.
        low = poses.position.min(axis=0)
        high = poses.position.max(axis=0)
        self.centre: Array = (low + high) / 2
        self.unit = float(SPAN / ((high - low).max() + poses.pitch))
        self.pitch = poses.pitch * self.unit
        self.arrow = max(self.pitch, MIN_ARROW_UNIT)
        self.poses = CubePoses(
            self.transform(poses.position),
            poses.rotation,
            poses.half_side * self.unit,
        )

    def transform(self, position: Array) -> Array:
        """Transform positions (..., 3) from the parent frame, in metres, to units of the scene."""
        return (position - self.centre) * self.unit


class Scene:
    """The skin in 3-D: its fixed geometry, which all browsers share, and what a scan changes.

    Attributes:
        first_cube: Index of the cube nearest to the centre of the skin.
        bar: Length of the scale bar beside the skin, in metres: the largest of 1, 2 or 5 times a
            power of ten that is at most a quarter of the skin's length.
    """

    def __init__(
        self,
        names: Sequence[str],
        poses: CubePoses,
        surface: Surface,
    ) -> None:
        """Compute the geometry.

        Args:
            names: Names of the cubes.
            poses: Poses of the cubes in the parent frame, in metres.
            surface: Grid of points around the cubes at which the field (pressure and shear) is
                drawn.
        """
        placement = Placement(poses)
        self._names, self._placement = names, placement
        self._is_solid = len(names) <= MAX_SOLID_CUBES
        self._squares = _make_squares(
            placement,
            surface,
            with_cubes=not self._is_solid,
        )
        # The points of the field are drawn at the lower faces of the cubes, so contacts are too.
        self._contact_depth = surface.depth * placement.unit + placement.poses.half_side.mean()
        points = placement.transform(surface.points)
        self._low = points.min(axis=0)
        self._high = points.max(axis=0)

        distance = np.linalg.norm(placement.poses.position, axis=1)
        self.first_cube = int(distance.argmin())
        self.bar = round_down(SPAN / placement.unit / 4)

    def add_to(
        self,
        api: viser.SceneApi,
        pick: Callable[[int], None],
    ) -> dict[str, object]:
        """Add all objects to the scene of a browser.

        Args:
            api: The scene of the browser.
            pick: Function that is called with the index of a cube when the user clicks it.

        Returns:
            The objects whose properties `draw` returns, by name.
        """
        _set_up_lights(api)
        self._add_scale_bar(api)
        if self._is_solid:
            self._add_edges(api)
        objects: dict[str, object] = {
            f"field/{step}": api.add_mesh_simple(
                f"/field/{step}",
                *NO_MESH,
                flat_shading=True,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
            for step in range(COLOUR_STEPS + 1)
        }
        for name, (colour, thickness) in LINES.items():
            objects[name] = api.add_line_segments(
                f"/{name}",
                NO_LINES,
                colour,
                thickness=max(MIN_THICKNESS, thickness * self._placement.arrow),
            )
        if self._is_solid:
            objects["cubes"] = self._add_cubes(api)
        objects["names"] = self._add_names(api)

        @api.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            start, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            # viser reports a click as a ray from the camera through the point that was clicked.
            placement = self._placement
            cube = find_hit_cube(
                placement.poses.position,
                placement.pitch,
                start,
                direction,
            )
            if cube is not None:
                pick(cube)

        return objects

    def draw(
        self,
        scan: Scan,
        colouring: Colouring,
        parts: set[str],
        chosen: int,
        ranges: scene.Ranges,
    ) -> Update:
        """Return the properties of all objects for one instant.

        Args:
            scan: Values of all cubes at the instant that is drawn.
            colouring: The values that are drawn as colours.
            parts: Those of `PARTS` (controls.py) that are drawn.
            chosen: Index of the chosen cube.
            ranges: Upper ends of the ranges of colours and arrows.
        """
        update = self._choose_colours(colouring, "field" in parts)
        update["names"] = {"visible": "names" in parts}
        lines = dict.fromkeys(LINES, NO_LINES)
        traction, gradient = self._find_arrow_lengths(ranges)
        arrows = {
            "traction": (scene.make_traction_arrows, traction),
            "gradient": (scene.make_gradient_arrows, gradient),
        }
        for name in parts & arrows.keys():
            lines[name] = self._draw_arrows(*arrows[name], scan.values)
        if "principal" in parts:
            lines |= self._draw_crosses(scan.values, ranges.traction)
        crosses = scene.make_fault_crosses(self._placement.poses, scan.health)
        for state in FAULT_COLOURS:
            lines[f"fault {state}"] = crosses[scan.health == state]
        lines["chosen"] = self._draw_chosen_cube(chosen)
        lines["contacts"] = self._draw_contacts(scan.contacts)
        for name, ends in lines.items():
            points = ends.reshape(-1, 2, 3) if len(ends) else NO_LINES
            update[name] = {"points": points.astype(np.float32)}
        return update

    def find_values_per_bar(self, ranges: scene.Ranges) -> tuple[float, float]:
        """Return the values whose arrows are as long as the scale bar.

        Args:
            ranges: Upper ends of the ranges of the picture.

        Returns:
            Traction (force per area on the upper face of a cube), in Pa; gradient of the pressure
            along the skin, in Pa/m.
        """
        bar = self.bar * self._placement.unit
        traction, gradient = self._find_arrow_lengths(ranges)
        return bar / traction, bar / gradient

    def _find_arrow_lengths(self, ranges: scene.Ranges) -> tuple[float, float]:
        """Return the lengths of the arrows of traction, in units of the scene per Pa, and of those
        of the gradient, in units of the scene per Pa/m."""
        unit = self._placement.arrow
        return TRACTION_LENGTH * unit / ranges.traction, GRADIENT_LENGTH * unit / ranges.gradient

    def _choose_colours(self, colouring: Colouring, with_field: bool) -> Update:
        """Return the properties of the objects that show values as colours: cubes and field.

        Args:
            colouring: The values that are drawn as colours.
            with_field: Whether the field (pressure and shear between the cubes) is visible.
        """
        quantity, top = colouring.quantity, colouring.top
        values, visible = colouring.field, np.full(len(colouring.field), with_field)
        update: Update = {}
        if self._is_solid:
            colours = scene.convert_to_linear_light(
                scene.choose_colours(quantity, colouring.cubes, top)
            )
            update["cubes"] = {"batched_colors": colours}
        else:
            values = np.append(values, colouring.cubes)
            visible = np.append(visible, np.full(len(colouring.cubes), True))

        meshes = paint_squares(
            self._squares,
            quantity,
            values,
            top,
            visible,
        )
        colours_of_steps = compute_step_colours(quantity).tolist()
        for step, mesh in enumerate(meshes):
            colour = tuple(colours_of_steps[step])
            vertices, faces = mesh
            update[f"field/{step}"] = {"vertices": vertices, "faces": faces, "color": colour}
        return update

    def _draw_arrows(
        self,
        lines: ArrowLines,
        length: float,
        values: Array,
    ) -> Array:
        """Return the lines of an arrow on the upper face of each cube.

        Args:
            lines: Function that returns tails and tips of the arrows.
            length: Length of the arrows, in units of the scene per SI unit of the values.
            values: (N, 15) 6 stress components in Pa and 9 gradients in Pa/m, in the frames of the
                cubes.
        """
        poses = self._placement.poses
        arrows = lines(poses, values, length)
        # Arrows shorter than `MIN_ARROW` are left out, because they would look like dots.
        vectors = arrows[:, 1] - arrows[:, 0]
        size = np.linalg.norm(vectors, axis=1)
        arrows = arrows[size > MIN_ARROW * self._placement.arrow]
        directions = np.broadcast_to(VIEW_DIRECTION, (len(arrows), 3))
        return scene.make_arrow_lines(arrows, directions)

    def _draw_crosses(self, values: Array, longest: float) -> dict[str, Array]:
        """Return the lines of the principal stresses: a cross of three lines above each cube.

        Each line lies along a principal direction; its colour tells tension from compression.

        Args:
            values: (N, 15) 6 stress components in Pa and 9 gradients in Pa/m, in the frames of the
                cubes.
            longest: Stress, in Pa, whose line is as long as the pitch (distance of neighbouring
                cubes).
        """
        placement, pitch = self._placement, self._placement.pitch
        poses = placement.poses
        lines, is_tension = scene.make_principal_crosses(
            poses,
            values,
            pitch / longest,
        )
        # The lines are centred on the upper faces of the cubes, which would hide a part of them, so
        # they are lifted to `CROSS_HEIGHT`.
        height = CROSS_HEIGHT * pitch - poses.half_side
        lift = height[:, None] * poses.rotation[:, :, 2]
        lines = lines + lift[:, None, None]
        return {"tension": lines[is_tension], "compression": lines[~is_tension]}

    def _draw_chosen_cube(self, cube: int) -> Array:
        """Return the lines of the marks at the corners of the chosen cube."""
        placement = self._placement
        # The square of the marks is larger than the face (2 half sides); on a large skin it has a
        # minimum size.
        half_side = float(placement.poses.half_side[cube])
        side = max(2.6 * half_side, 0.2 * placement.arrow)
        lines = make_corner_lines(placement.poses.rotation[cube], side)
        return np.asarray(lines + scene.compute_points_above(placement.poses, 1.1)[cube])

    def _draw_contacts(self, contacts: Sequence[Contact]) -> Array:
        """Return the lines of a ring around each contact; the ring encloses the contact's area."""
        placement = self._placement
        rings = [np.zeros((0, 2, 3))]
        for contact in contacts:
            radius_m = float(np.sqrt(contact.area / np.pi))
            radius = max(radius_m * placement.unit, MIN_RING)
            # The ring lies in the plane of the drawn field, so that it encloses the load there.
            centre = placement.transform(contact.position) - self._contact_depth * contact.normal
            rings.append(
                scene.make_ring(
                    centre,
                    contact.normal,
                    radius,
                    RING_CORNERS,
                )
            )
        return np.concatenate(rings)

    def _add_scale_bar(self, api: viser.SceneApi) -> None:
        """Add a scale bar in front of the skin, and the axes of its parent frame beside it."""
        placement, low, high = self._placement, self._low, self._high
        y = low[1] - 0.16 * SPAN
        z = low[2] - float(placement.poses.half_side.max())

        start = np.array([low[0], y, z])
        length = self.bar * placement.unit
        end = start + np.array([length, 0, 0])
        api.add_line_segments(
            "/bar",
            np.array([[start, end]]),
            DARK,
            thickness=0.012 * SPAN,
        )
        below = np.array([0, 0.03 * SPAN, 0])
        middle = tuple((start + end) / 2 - below)
        text = f"{1e3 * self.bar:g} mm"
        api.add_label(
            "/bar/label",
            text,
            position=middle,
            anchor="top-center",
        )

        corner = np.array([high[0] - 0.05 * SPAN, y, z])
        axis = 0.1 * SPAN
        api.add_frame(
            "/axes",
            axes_length=axis,
            axes_radius=0.006 * SPAN,
            origin_radius=0.01 * SPAN,
            position=tuple(corner),
        )
        for name, direction in zip("xyz", np.eye(3), strict=True):
            position = tuple(1.3 * axis * direction)
            api.add_label(
                f"/axes/{name}",
                name,
                position=position,
                anchor="center-center",
            )

    def _add_cubes(self, api: viser.SceneApi) -> viser.SceneNodeHandle:
        poses = self._placement.poses
        return api.add_batched_meshes_simple(
            "/cubes",
            *make_cube(),
            compute_quaternions(poses.rotation),
            poses.position,
            batched_scales=poses.half_side,
            batched_colors=np.full_like(poses.position, 200, np.uint8),
            flat_shading=True,
            # By default viser simplifies distant meshes, but a cube cannot have fewer triangles.
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )

    def _add_edges(self, api: viser.SceneApi) -> None:
        """Draw the edges of the cubes, which separate neighbours of the same colour."""
        poses = self._placement.poses
        edges = np.einsum("nij,eaj->neai", poses.rotation, CUBE_EDGES)
        offset = poses.half_side[:, None, None, None] * edges
        lines = poses.position[:, None, None] + offset
        api.add_line_segments(
            "/edges",
            lines.reshape(-1, 2, 3),
            EDGE_COLOUR,
            thickness=1.5,
            thickness_units="screen",
        )

    def _add_names(self, api: viser.SceneApi) -> viser.FrameHandle:
        """Add the names of the cubes, each in front of its cube; none above `MAX_NAMED_CUBES`."""
        # All names are children of one frame in viser, so that a single message to the browser,
        # which hides the frame, hides all names.
        frame = api.add_frame("/names", show_axes=False, visible=False)
        if len(self._names) > MAX_NAMED_CUBES:
            return frame
        poses = self._placement.poses
        front = poses.rotation @ np.array([0.0, -1.2, -1.0])
        points = poses.position + front * poses.half_side[:, None]
        for number, name in enumerate(self._names):
            path, position = f"/names/{number}", tuple(points[number])
            api.add_label(
                path,
                name,
                position=position,
                anchor="top-center",
                font_screen_scale=0.8,
            )
        return frame


def _make_squares(
    placement: Placement,
    surface: Surface,
    with_cubes: bool,
) -> AnyArray:
    """Return the corners (M, 4, 3) of the squares that draw the field and, on a large skin, cubes.

    Args:
        placement: Poses of the cubes in the scene.
        surface: Grid of points around the cubes at which the field is drawn.
        with_cubes: Whether the cubes are drawn as squares, instead of as solids.
    """
    poses, of_cube = placement.poses, surface.cube
    # The field is drawn at the lower faces of the cubes, so that it does not hide them.
    down = poses.rotation[of_cube, :, 2] * poses.half_side[of_cube, None]
    points = placement.transform(surface.points) - down
    rotation = poses.rotation[of_cube]
    side = np.full(len(points), surface.spacing * placement.unit)
    if with_cubes:
        points = np.concatenate([points, scene.compute_points_above(poses, 1.0)])
        rotation = np.concatenate([rotation, poses.rotation])
        side = np.append(side, 2 * poses.half_side)
    return compute_square_corners(points, rotation, side)


def _set_up_lights(api: viser.SceneApi) -> None:
    """Set up lights without shadows and reflections.

    A computer without a graphics card computes shadows and reflections slowly.
    """
    api.configure_default_lights(enabled=False)
    api.configure_environment_map(None)
    api.add_light_ambient("/light/all", intensity=AMBIENT_LIGHT)
    api.add_light_directional(
        "/light/above",
        intensity=DIRECT_LIGHT,
        position=(-0.4, -0.6, 1.0),
    )
