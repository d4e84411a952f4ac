# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of a skin as a serialised MarkerArray: cubes, arrows, crosses and contacts.

The pitch, in multiples of which many lengths are stated, is the distance of neighbouring cubes.
"""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Vector3
from visualization_msgs.msg import Marker

from ...core.arrays import Array, Index
from ...core.poses import CubePoses, compute_quaternions
from ...msg import SkinContacts
from ...views import scene
from .legend import (
    LINE_WIDTH,
    SCALES,
    UPSIDE_DOWN,
    LegendPlace,
    draw_arrows,
    draw_legend,
    format_in_four_characters,
)
from .serialised import Colour, Shape, make_lines, make_text, serialise

PLATE_SIDE = 2.04
"""Side of the square plate that shows the colour of a cube, divided by half the side of the cube.

The plate covers the upper face of the cube and is slightly larger: in this unit, the side of the
face is 2. RViz draws the cube itself from the URDF of the skin.
"""

PLATE_THICKNESS = 0.3
"""Thickness of the plate that shows the colour of a cube, divided by half the side of the cube."""

PLATE_HEIGHT = 0.9
"""Distance of the centre of a coloured plate from the centre of its cube, along the z axis of the
cube, divided by half the side of the cube."""

PULL_COLOUR: Colour = (0.9, 0.3, 0.2)
"""Colour of principal stresses that are positive (tension)."""

PUSH_COLOUR: Colour = (0.3, 0.5, 1.0)
"""Colour of principal stresses that are negative (compression)."""

CONTACT_COLOUR: Colour = (1.0, 0.45, 0.75)
"""Colour of the rings and texts of contacts."""

SLIP_COLOUR: Colour = (1.0, 0.1, 0.1)
"""Colour of the text of a contact that slips."""

COARSE_OPACITY = 0.5
"""Opacity of the text of a contact with coarse forces, from 0 to 1. Forces are coarse until the
first fit of the contact is ready; see the field `refined` of SkinContacts."""

MAX_CONTACTS = 8
"""Maximum number of contacts that are drawn: those with the largest normal forces, which a message
of contacts lists first."""

RING_CORNERS = 24
"""Number of corners of the polygon that is drawn as the ring around a contact."""

RING_WIDTH = 0.06
"""Width of the line of the ring around a contact, divided by the pitch (distance of neighbouring
cubes)."""

FORCE_TEXT_HEIGHT = 0.3
"""Height of the letters that show the force of a contact, divided by the pitch (distance of
neighbouring cubes)."""

MIN_TEXT_DISTANCE_M = 2e-3
"""Minimum distance, in m, between the centre of a contact and the text that shows its force."""

HIDDEN_OPACITY = 0.001
"""Opacity of a force text while its contact does not exist. It is not 0, because RViz logs a
warning for a colour with opacity 0."""


class Canvas:
    """Draws the picture of a skin as a MarkerArray message."""

    def __init__(
        self,
        frame_id: str,
        poses: CubePoses,
        *,
        crosses: bool,
    ) -> None:
        """Prepare what is the same in all pictures.

        Args:
            frame_id: Frame id of the parent frame of the skin.
            poses: Poses of the cubes in this frame.
            crosses: Whether the principal stresses of each cube are drawn.
        """
        self._frame_id = frame_id
        self._poses = poses
        self._pitch = poses.pitch
        self._has_crosses = crosses
        self._health: Index | None = None
        self._plates = _make_plates(poses)
        self._legend_place = LegendPlace.place_beside(poses)

    def draw(
        self,
        quantity: scene.Quantity,
        shown: Array,
        values: Array,
        ranges: scene.Ranges,
        health: Index,
        contacts: SkinContacts | None,
    ) -> bytes:
        """Return the serialised MarkerArray message of a picture.

        Args:
            quantity: The quantity that the colours of cubes show.
            shown: Its value for each cube, (cubes,), in SI units.
            values: 6 stress components (Pa) and 9 gradients (Pa/m) of each cube in its own frame,
                (cubes, 15).
            ranges: Values at the upper end of the colour scale and of the longest arrows.
            health: Health of each cube, (cubes,): fine, doubtful, faulty or stale, as
                `LatestStress.compute_health` returns it.
            contacts: The newest message of contacts; None: no contact is drawn.
        """
        colours = scene.choose_colours(quantity, shown, ranges.colours)
        shapes = [shape._replace(colours=colours[members]) for members, shape in self._plates]
        shapes += self._draw_arrows(values, ranges)
        shapes.append(self._draw_faults(health))
        if self._has_crosses:
            shapes.append(self._draw_crosses(values, ranges.traction))
        shapes += self._draw_contacts(contacts)
        shapes += draw_legend(
            self._legend_place,
            quantity,
            ranges,
            health,
        )
        return serialise(self._frame_id, shapes)

    def _draw_arrows(self, values: Array, ranges: scene.Ranges) -> list[Shape]:
        """Return the arrows of all cubes: traction (force per area on its upper face) and gradient.

        Args:
            values: 6 stress components (Pa) and 9 gradients (Pa/m) of each cube in its own frame,
                (cubes, 15).
            ranges: Traction and gradient of the longest arrows.
        """
        normal = self._poses.rotation[:, :, 2]
        functions = (scene.make_traction_arrows, scene.make_gradient_arrows)
        longest = (ranges.traction, ranges.gradient)
        shapes = []
        for scale, make_arrows, value in zip(SCALES, functions, longest, strict=True):
            arrows = make_arrows(
                self._poses,
                values,
                scale.length * self._pitch / value,
            )
            shapes.append(
                draw_arrows(
                    scale,
                    scale.name,
                    arrows,
                    normal,
                    self._pitch,
                )
            )
        return shapes

    def _draw_faults(self, health: Index) -> Shape:
        """Return crosses over the cubes whose health (cubes,) is not fine."""
        # Health seldom changes, so the last shape is kept.
        if self._health is None or not np.array_equal(health, self._health):
            self._health = health
            lines = scene.make_fault_crosses(self._poses, health)
            shape = make_lines("faults", lines, LINE_WIDTH * self._pitch)
            # A cross consists of two lines, thus of four end points, each of which has a colour.
            self._fault_crosses = shape._replace(colours=np.repeat(scene.MARK[health], 4, axis=0))
        return self._fault_crosses

    def _draw_crosses(self, values: Array, longest_pa: float) -> Shape:
        """Return the principal stresses of each cube as three lines.

        Args:
            values: 6 stress components (Pa) and 9 gradients (Pa/m) of each cube in its own frame,
                (cubes, 15).
            longest_pa: Stress, in Pa, whose line is as long as the pitch (distance of neighbouring
                cubes).
        """
        lines, is_pull = scene.make_principal_crosses(
            self._poses,
            values,
            self._pitch / longest_pa,
        )
        shape = make_lines("crosses", lines, LINE_WIDTH * self._pitch)
        colours = np.where(is_pull.reshape(-1, 1), PULL_COLOUR, PUSH_COLOUR)
        return shape._replace(colours=np.repeat(colours, 2, axis=0))

    def _draw_contacts(self, contacts: SkinContacts | None) -> list[Shape]:
        """Return a ring for each contact, and a text that states its normal and shear force.

        The text is red while the contact slips. It is pale (`COARSE_OPACITY`) until the first fit
        of the contact is ready.

        Args:
            contacts: The newest message of contacts; None: all rings and texts are hidden.
        """
        rings = np.zeros((MAX_CONTACTS, RING_CORNERS, 2, 3))
        count = 0 if contacts is None else len(contacts.position)
        labels = []
        for number in range(MAX_CONTACTS):
            label = make_text(
                f"contact {number}",
                " ",
                FORCE_TEXT_HEIGHT * self._pitch,
            )
            if contacts is None or number >= count:
                labels.append(label._replace(opacity=HIDDEN_OPACITY))
                continue
            position = _to_array(contacts.position[number])
            normal = _to_array(contacts.normal[number])
            # The message does not contain the shape of a contact, so a circle of equal area is
            # drawn.
            area = max(0.0, contacts.area[number])
            radius = float(np.sqrt(area / np.pi))
            rings[number] = scene.make_ring(
                position,
                normal,
                radius,
                RING_CORNERS,
            )
            # The arrays of slip and fits are empty for contacts that were found by interpolation.
            has_slip = number < len(contacts.slip)
            slips = has_slip and contacts.slip[number] == SkinContacts.SLIP
            has_fit_state = number < len(contacts.refined)
            is_coarse = has_fit_state and not contacts.refined[number]
            normal_n = format_in_four_characters(contacts.normal_force[number])
            # The shear force is NaN if it is not observed.
            shear_n = format_in_four_characters(contacts.shear_force[number])
            shown = label._replace(
                colour=SLIP_COLOUR if slips else CONTACT_COLOUR,
                opacity=COARSE_OPACITY if is_coarse else 1.0,
                position=position + max(radius, MIN_TEXT_DISTANCE_M) * normal,
                text=f"{normal_n} N, shear {shear_n} N",
            )
            labels.append(shown)
        width = RING_WIDTH * self._pitch
        return [make_lines("contacts", rings, width, CONTACT_COLOUR), *labels]


def _make_plates(poses: CubePoses) -> list[tuple[Index, Shape]]:
    """Return the coloured plates of the cubes, one shape for each group of parallel cubes.

    A marker of type CUBE_LIST has a single orientation and a single size for all its boxes.

    Returns:
        For each group, the indices of its cubes and the shape without colours.
    """
    plates = []
    centres = scene.compute_points_above(poses, PLATE_HEIGHT)
    groups, rotations = _group_by_orientation(poses.rotation)
    oriented = zip(
        groups,
        rotations,
        compute_quaternions(rotations),
        strict=True,
    )
    for number, (members, rotation, (w, x, y, z)) in enumerate(oriented):
        # All plates of a marker have the same size, so they get the size for the largest cube.
        half_side = float(poses.half_side[members].max())
        side = PLATE_SIDE * half_side
        shape = Shape(
            f"cubes {number}",
            Marker.CUBE_LIST,
            (side, side, PLATE_THICKNESS * half_side),
            # The points of a marker are given in the frame of the marker's pose, so the positions
            # of the plates are rotated from the parent frame into that frame.
            centres[members] @ rotation,
            rotation=(x, y, z, w),
        )
        plates.append((members, shape))
    return plates


def _group_by_orientation(rotation: Array) -> tuple[list[Index], Array]:
    """Group cubes by their orientation.

    Args:
        rotation: Rotation matrix of each cube, (cubes, 3, 3).

    Returns:
        The indices of the cubes of each group, and the rotation matrix of each group, turned upside
        down (see `UPSIDE_DOWN`), (groups, 3, 3).
    """
    # Matrices are rounded, because those of equal orientations may differ by rounding errors.
    flat = rotation.round(6).reshape(len(rotation), 9)
    unique, group = np.unique(flat, axis=0, return_inverse=True)
    group = group.ravel()  # numpy 2.0, but no other version, returns shape (cubes, 1)
    n_groups = len(unique)
    members = [np.flatnonzero(group == number) for number in range(n_groups)]
    orientations = unique.reshape(-1, 3, 3)
    return members, orientations * UPSIDE_DOWN


def _to_array(vector: Point | Vector3) -> Array:
    return np.array([vector.x, vector.y, vector.z])
