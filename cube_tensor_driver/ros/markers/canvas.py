# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of a skin as a serialised MarkerArray: cubes, arrows, crosses and contacts.

The pitch, in multiples of which many lengths are stated, is the distance of neighbouring cubes.
"""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Quaternion, Vector3
from visualization_msgs.msg import Marker

from ...core.arrays import Array, Index
from ...core.poses import CubePoses, quaternions
from ...msg import SkinContacts
from ...views import scene
from .legend import (
    GRADIENT_COLOUR,
    GRADIENT_LENGTH,
    TRACTION_COLOUR,
    TRACTION_LENGTH,
    UPSIDE_DOWN,
    Legend,
    LegendPlace,
    four_characters,
    legend_markers,
)
from .serialised import (
    WHITE,
    Colour,
    SerialisedMarkers,
    allocate,
    make_marker,
    make_text,
)

PLATE_SIDE = 2.04
"""Side of the square plate that shows the colour of a cube, divided by half the side of the cube.

The plate is slightly larger than the upper face of the cube (2), which it covers. RViz draws the
cube itself from the URDF of the skin.
"""

PLATE_THICKNESS = 0.3
"""Thickness of the plate that shows the colour of a cube, divided by half the side of the cube."""

PLATE_HEIGHT = 0.9
"""Distance of the centre of a coloured plate from the centre of its cube, along the z axis of the
cube, divided by half the side of the cube."""

LINE_WIDTH = 0.05
"""Width of the lines of arrows and crosses, divided by the pitch (distance of neighbouring cubes).
"""

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
    """The picture of a skin: a MarkerArray message that is changed in place by the draw methods.

    Attributes:
        legend: The legend beside the skin.
    """

    def __init__(
        self,
        frame_id: str,
        poses: CubePoses,
        *,
        crosses: bool,
        signed: bool,
    ) -> None:
        """Make the markers.

        Args:
            frame_id: Frame id of the parent frame of the skin.
            poses: Poses of the cubes in this frame.
            crosses: Whether the principal stresses of each cube are drawn.
            signed: Whether the quantity that the colours of cubes show can be negative. The middle
                of the colour scale is then 0.
        """
        self._poses = poses
        self._pitch = poses.pitch
        self._health: Index | None = None
        self._groups, rotations = _group_by_orientation(poses.rotation)
        place = LegendPlace.beside(poses)
        markers = [
            *self._make_cubes(frame_id, rotations),
            *self._make_lines(frame_id, crosses),
            *_make_contacts(frame_id, self._pitch),
            *legend_markers(frame_id, place, signed),
        ]
        self._markers = SerialisedMarkers(markers)
        plates = scene.above(poses, PLATE_HEIGHT)
        oriented = enumerate(zip(self._groups, rotations, strict=True))
        for group, (members, rotation) in oriented:
            # The points of a marker are given in the frame of the marker's pose, so the positions
            # of the plates are rotated from the parent frame into that frame.
            self._markers[f"cubes {group}"].points[:] = plates[members] @ rotation
        # The opacity of all points is set to 1 here. The draw methods change only red, green, blue.
        for marker in markers:
            self._markers[marker.ns].colours[:, 3] = 1.0
        self.legend = Legend(self._markers, place)
        # Until there is a contact, the texts of contacts hold placeholders, which must be hidden.
        self.draw_contacts(None)

    @property
    def data(self) -> bytearray:
        """The serialised MarkerArray message."""
        return self._markers.data

    def draw_cubes(self, colours: Array) -> None:
        """Set the colour of each cube.

        Args:
            colours: Red, green and blue of each cube, (cubes, 3), from 0 to 1.
        """
        for group, members in enumerate(self._groups):
            self._markers[f"cubes {group}"].colours[:, :3] = colours[members]

    def draw_arrows(self, values: Array, ranges: scene.Ranges) -> None:
        """Draw the arrows of each cube: traction (force per area on its upper face) and gradient.

        Args:
            values: 6 stress components (Pa) and 9 gradients (Pa/m) of each cube in its own frame,
                (cubes, 15).
            ranges: Traction and gradient of the longest arrows.
        """
        normal = self._poses.rotation[:, :, 2]
        longest_traction = TRACTION_LENGTH * self._pitch
        longest_gradient = GRADIENT_LENGTH * self._pitch
        arrows = {
            "traction": scene.traction_arrows(
                self._poses,
                values,
                longest_traction / ranges.traction,
            ),
            "gradient": scene.gradient_arrows(
                self._poses,
                values,
                longest_gradient / ranges.gradient,
            ),
        }
        for name, tails_and_tips in arrows.items():
            lines = scene.heads(tails_and_tips, normal)
            self._markers[name].points[:] = lines.reshape(-1, 3)

    def draw_faults(self, health: Index) -> None:
        """Draw crosses over cubes whose health is not fine. If no health has changed, do nothing.

        Args:
            health: Health of each cube, (cubes,): fine, doubtful, faulty or stale, as
                `LatestStress.health` returns it.
        """
        is_unchanged = self._health is not None and np.array_equal(health, self._health)
        if is_unchanged:
            return
        self._health = health
        faults = self._markers["faults"]
        crosses = scene.fault_crosses(self._poses, health)
        faults.points[:] = crosses.reshape(-1, 3)
        # A cross consists of two lines, thus of four end points, each of which has a colour.
        cube_colours = scene.MARK[health]
        faults.colours[:, :3] = np.repeat(cube_colours, 4, axis=0)

    def draw_crosses(self, values: Array, longest_pa: float) -> None:
        """Draw the principal stresses of each cube as three lines, if the picture shows them.

        Args:
            values: 6 stress components (Pa) and 9 gradients (Pa/m) of each cube in its own frame,
                (cubes, 15).
            longest_pa: Stress, in Pa, whose line is as long as the pitch (distance of neighbouring
                cubes).
        """
        if "crosses" not in self._markers:
            return
        crosses = self._markers["crosses"]
        scale = self._pitch / longest_pa
        lines, is_pull = scene.principal_crosses(self._poses, values, scale)
        crosses.points[:] = lines.reshape(-1, 3)
        colours = np.where(is_pull.reshape(-1, 1), PULL_COLOUR, PUSH_COLOUR)
        end_colours = np.repeat(colours, 2, axis=0)
        crosses.colours[:, :3] = end_colours

    def draw_contacts(self, contacts: SkinContacts | None) -> None:
        """Draw each contact as a ring with a text that states its normal and shear force.

        The text is red while the contact slips. It is pale (`COARSE_OPACITY`) until the first fit
        of the contact is ready.

        Args:
            contacts: The newest message of contacts; None: all rings and texts are hidden.
        """
        rings = np.zeros((MAX_CONTACTS, RING_CORNERS, 2, 3))
        count = 0 if contacts is None else len(contacts.position)
        for number in range(MAX_CONTACTS):
            label = self._markers[f"contact {number}"]
            label.colour[3] = HIDDEN_OPACITY
            if contacts is None or number >= count:
                continue
            position = _to_array(contacts.position[number])
            normal = _to_array(contacts.normal[number])
            # The message does not contain the shape of a contact, so a circle of equal area is
            # drawn.
            area = max(0.0, contacts.area[number])
            radius = float(np.sqrt(area / np.pi))
            rings[number] = scene.ring(position, normal, radius, RING_CORNERS)
            # The arrays of slip and fits are empty for contacts that were found by interpolation.
            has_slip = number < len(contacts.slip)
            slips = has_slip and contacts.slip[number] == SkinContacts.SLIP
            has_fit_state = number < len(contacts.refined)
            is_coarse = has_fit_state and not contacts.refined[number]
            colour = SLIP_COLOUR if slips else CONTACT_COLOUR
            opacity = COARSE_OPACITY if is_coarse else 1.0
            label.colour[:] = *colour, opacity
            distance = max(radius, MIN_TEXT_DISTANCE_M)
            label.position[:] = position + distance * normal
            normal_n = contacts.normal_force[number]
            shear_n = contacts.shear_force[number]
            text = _force_text(normal_n, shear_n)
            self._markers.write_text(f"contact {number}", text)
        self._markers["contacts"].points[:] = rings.reshape(-1, 3)

    def _make_cubes(self, frame_id: str, rotations: Array) -> list[Marker]:
        """Return the markers of the coloured plates of cubes, one for each group of parallel cubes.

        A marker of type CUBE_LIST has a single orientation and a single size for all its boxes.

        Args:
            frame_id: Frame id of the parent frame of the skin.
            rotations: Rotation matrix of each group of cubes, (groups, 3, 3).
        """
        markers = []
        orientations = quaternions(rotations).tolist()
        for group, (w, x, y, z) in enumerate(orientations):
            members = self._groups[group]
            # All boxes of a marker have the same size, so that of the largest cube is taken.
            half_side = float(self._poses.half_side[members].max())
            side = PLATE_SIDE * half_side
            thickness = PLATE_THICKNESS * half_side
            marker = make_marker(frame_id, f"cubes {group}", Marker.CUBE_LIST)
            marker.pose.orientation = Quaternion(
                x=x,
                y=y,
                z=z,
                w=w,
            )
            marker.scale = Vector3(
                x=side,
                y=side,
                z=thickness,
            )
            allocate(marker, len(members), with_colours=True)
            markers.append(marker)
        return markers

    def _make_lines(self, frame_id: str, crosses: bool) -> list[Marker]:
        """Return the markers that consist of lines: arrows, and crosses over faulty cubes.

        Args:
            frame_id: Frame id of the parent frame of the skin.
            crosses: Whether to add a marker with the principal stresses of each cube.
        """
        # Each entry contains the name of a marker, its number of points per cube, and its colour.
        # If the colour is None, each point of the marker has its own colour.
        kinds: list[tuple[str, int, Colour | None]] = [
            ("traction", 6, TRACTION_COLOUR),
            ("gradient", 6, GRADIENT_COLOUR),
            ("faults", 4, None),
        ]
        if crosses:
            kinds.append(("crosses", 6, None))
        n_cubes = len(self._poses.position)
        markers = []
        for name, n_points, colour in kinds:
            marker = make_marker(frame_id, name, Marker.LINE_LIST, colour or WHITE)
            marker.scale.x = LINE_WIDTH * self._pitch
            allocate(marker, n_points * n_cubes, with_colours=colour is None)
            markers.append(marker)
        return markers


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


def _make_contacts(frame_id: str, pitch: float) -> list[Marker]:
    """Return the marker of all rings and the text markers for contacts.

    Args:
        frame_id: Frame id of the parent frame of the skin.
        pitch: Distance of neighbouring cubes, in m.
    """
    rings = make_marker(
        frame_id,
        "contacts",
        Marker.LINE_LIST,
        CONTACT_COLOUR,
    )
    rings.scale.x = RING_WIDTH * pitch
    allocate(rings, 2 * MAX_CONTACTS * RING_CORNERS, with_colours=False)
    markers = [rings]
    for number in range(MAX_CONTACTS):
        height, placeholder = FORCE_TEXT_HEIGHT * pitch, _force_text(0.0, 0.0)
        text = make_text(
            frame_id,
            f"contact {number}",
            height,
            placeholder,
        )
        text.color.r, text.color.g, text.color.b = CONTACT_COLOUR
        markers.append(text)
    return markers


def _force_text(normal_n: float, shear_n: float) -> str:
    """Return a text of constant length with two forces.

    Args:
        normal_n: Normal force of a contact, in N.
        shear_n: Tangential force of a contact, in N; NaN if it is not observed.
    """
    return f"{four_characters(normal_n)} N, shear {four_characters(shear_n)} N"
