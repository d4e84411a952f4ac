# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Layouts: the positions and face normals of the pads (capacitive sensors) of a cube.

Frame of the cube: z points out of the skin, x and y lie along it, the origin is the centre of the
cube. Lengths are in units of the half side d0 of the cube.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from .arguments import read_numbers
from .arrays import Array, Mask
from .errors import LayoutError

AXES = "xyz"
"""Names of the axes of the cube frame: z points out of the skin, x and y lie along it, the origin
is the centre of the cube."""

MAX_PADS = 32
"""Maximum number of pads of a cube, because a hub sends the faults of pads as a mask of 32 bits."""

PAD_OFFSET = 0.5
"""Distance of a pad's centre from the centre of its face, in the layouts quad, planar and cube, in
units of d0 (half the side of the cube)."""

PAD_SIZE = 0.4
"""Side of a square pad in a layout that does not state it, in units of d0 (half the side of the
cube)."""

TOLERANCE = 1e-9
"""Largest difference of two coordinates of pads that count as equal, in units of d0 (half the side
of the cube).

It is far above the rounding error of decimal numbers in a file, and far below any real distance.
"""


@dataclass(frozen=True, eq=False)
class Layout:
    """The pads of one kind of cube.

    A dummy pad is an oscillator whose capacitor does not change under a load. It only measures the
    drift that the oscillators of the cube have in common. Its position and its normal are 0.

    Attributes:
        name: Name that calibration and configuration files use.
        positions: Centres of the P pads (P, 3), relative to the centre of the cube, in units of d0
            (half the side of the cube).
        normals: Outward normals of the faces that carry the pads (P, 3), each plus or minus one
            axis; 0 for a dummy pad.
        pad_size: Side of a square pad, in units of d0.

    Raises:
        LayoutError: A pad is not on the face that its normal names, two pads coincide, or all pads
            are dummy pads.
    """

    name: str
    positions: Array
    normals: Array
    pad_size: float = PAD_SIZE

    def __post_init__(self) -> None:
        positions = read_numbers(
            self.positions,
            "layout: positions (x, y, z)",
            LayoutError,
        )
        n_pads = positions.size // 3
        if positions.shape != (n_pads, 3) or not 1 <= n_pads <= MAX_PADS:
            self._refuse(
                f"positions have shape {positions.shape}; they are a list of [x, y, z] for each of "
                f"1 to {MAX_PADS} pads"
            )
        normals = read_numbers(
            self.normals,
            "layout: normals (x, y, z)",
            LayoutError,
            positions.shape,
        )
        pad_size = float(
            read_numbers(
                self.pad_size,
                "layout: pad_size",
                LayoutError,
                (),
            )
        )
        if not 0 < pad_size <= 2:
            self._refuse(f"pad_size {pad_size}; allowed is above 0, up to 2")

        # A frozen dataclass refuses assignments, so the checked values replace the given ones by
        # way of the base class.
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "normals", normals)
        object.__setattr__(self, "pad_size", pad_size)
        if self.is_dummy.all():
            self._refuse("all normals are 0, which is for dummy pads; add pads on faces")
        for number in range(len(positions)):
            self._check_pad(number)

    def _check_pad(self, number: int) -> None:
        """Raise LayoutError if a pad is not on the face of its normal, or coincides with another.

        Args:
            number: Number of the pad (from 0); it is compared with the pads of lower numbers.
        """
        position = self.positions[number]
        normal = self.normals[number]
        pad = f"pad {number + 1}"
        if self.is_dummy[number] and not position.any():
            return
        if sorted(np.abs(normal)) != [0, 0, 1]:
            self._refuse(
                f"{pad} has normal {normal.tolist()}; a normal is one axis, such as [0, 0, -1], or "
                "0, like the position, for a dummy pad"
            )
        height = position @ normal
        if abs(height - 1) > TOLERANCE:
            self._refuse(
                f"{pad} at {position.tolist()} is not on the face {normal.tolist()}; "
                "its coordinate along the normal must be 1"
            )
        on_face = position - normal * height
        edge = np.max(np.abs(on_face)) + self.pad_size / 2
        if edge > 1 + TOLERANCE:
            self._refuse(f"{pad} reaches {edge:.3g} from the face's centre; the face ends at 1")
        for other in range(number):
            same_place = np.allclose(
                position,
                self.positions[other],
                atol=TOLERANCE,
            )
            if same_place and np.array_equal(normal, self.normals[other]):
                self._refuse(f"pads {other + 1} and {number + 1} coincide at {position.tolist()}")

    def _refuse(self, problem: str) -> None:
        raise LayoutError(f"layout {self.name!r}: {problem}")

    @property
    def n_pads(self) -> int:
        """Number of pads."""
        return len(self.positions)

    @cached_property
    def is_dummy(self) -> Mask:
        """Whether each pad (P,) is a dummy pad, whose frequency no load changes."""
        is_dummy: Mask = (self.normals == 0).all(axis=1)
        return is_dummy

    @cached_property
    def pads(self) -> tuple[str, ...]:
        """Names of the pads, such as "+z-x" for the pad on the face +z on the side of -x.

        A second pad on the same side of a face is "+z-x#2", and a dummy pad is "dummy". The names
        do not change if pads are added at the end of the layout.
        """
        names: list[str] = []
        places: list[str] = []
        for position, normal in zip(self.positions, self.normals, strict=True):
            side = position - normal * (position @ normal)
            place = _name_axes(normal) + _name_axes(side) or "dummy"
            earlier = places.count(place)
            places.append(place)
            names.append(f"{place}#{earlier + 1}" if earlier else place)
        return tuple(names)

    @property
    def planar(self) -> bool:
        """Whether all pads and normals lie in the plane y = 0."""
        y = self.positions[:, 1]
        is_off_plane = np.any(np.abs(y) > TOLERANCE)
        is_tilted = np.any(self.normals[:, 1])
        return not (is_off_plane or is_tilted)

    def has_same_pads(self, other: Layout) -> bool:
        """Return whether both layouts have the same pads in the same order."""
        return (
            self.positions.shape == other.positions.shape
            and self.pad_size == other.pad_size
            and np.allclose(self.positions, other.positions, atol=TOLERANCE)
            and np.array_equal(self.normals, other.normals)
        )

    def to_dict(self) -> dict[str, object]:
        """Return the layout in plain types, which `from_dict` reads."""
        return {
            "name": self.name,
            "pad_size": self.pad_size,
            "positions": self.positions.tolist(),
            "normals": self.normals.tolist(),
        }

    @classmethod
    def from_dict(cls, data: object) -> Layout:
        """Construct a layout from plain types, as a file holds them.

        Args:
            data: Table with the keys name, positions, normals and, optionally, pad_size.

        Raises:
            LayoutError: A key is missing or unknown, or a value is invalid.
        """
        allowed = [item.name for item in fields(cls)]
        required = {"name", "positions", "normals"}
        if not isinstance(data, Mapping) or not required <= set(data) <= set(allowed):
            raise LayoutError(f"layout: found {data!r}; it is a table of {', '.join(allowed)}")
        return cls(**data)


def find_layout(name: str) -> Layout:
    """Return the built-in layout with a name.

    Raises:
        LayoutError: No built-in layout has this name.
    """
    try:
        return LAYOUTS[name]
    except (KeyError, TypeError):
        raise LayoutError(f"unknown layout {name!r}; built in are {', '.join(LAYOUTS)}") from None


def _name_axes(vector: Array) -> str:
    """Return sign and axis of each nonzero coordinate of a vector (3,): (-1, 1, 0) gives "-x+y"."""
    return "".join(
        ("+" if coordinate > 0 else "-") + axis
        for coordinate, axis in zip(vector, AXES, strict=True)
        if abs(coordinate) > TOLERANCE
    )


def _parse_axis(text: str) -> Array:
    """Return the unit vector of a direction such as "+z"."""
    sign = 1.0 if text[0] == "+" else -1.0
    axis = AXES.index(text[1])
    unit: Array = sign * np.eye(3)[axis]
    return unit


def _make_layout(name: str, pads: str) -> Layout:
    """Construct a layout from the names of its pads.

    Args:
        name: Name of the layout.
        pads: Names of the pads, such as "+z-x +z+x" for two pads on the face +z, on the sides of -x
            and +x.
    """
    names = pads.split()
    normals = np.array([_parse_axis(pad[:2]) for pad in names])
    sides = np.array([_parse_axis(pad[2:]) for pad in names])
    # Each face of the cube is at the distance 1 from its centre, in units of d0.
    positions = normals + PAD_OFFSET * sides
    return Layout(name, positions, normals)


_QUAD_PADS = "+z-x +z+x -z-x -z+x"
"""Names of the pads of the layout "quad": the face that carries the pad, then the side of this face
on which the pad lies."""
_PLANAR_PADS = f"{_QUAD_PADS} +x-z +x+z -x-z -x+z"
"""Names of the pads of the layout "planar": V1 to V8 of the paper by Kiyota & Shinoda, in that
order."""
_NEXT_AXES = str.maketrans("xyz", "yzx")
"""Table that renames the axes x, y, z in the name of a pad to y, z, x."""
# The layout "cube" has the eight pads of "planar" in each of the planes z-x, x-y and y-z. The names
# of the pads in the next plane follow by renaming the axes.
_SECOND_SECTION = _PLANAR_PADS.translate(_NEXT_AXES)
"""Names of the pads of the layout "cube" whose centres lie in the plane x-y of the cube frame."""
_THIRD_SECTION = _SECOND_SECTION.translate(_NEXT_AXES)
"""Names of the pads of the layout "cube" whose centres lie in the plane y-z of the cube frame."""

LAYOUTS = {
    "quad": _make_layout("quad", _QUAD_PADS),
    "planar": _make_layout("planar", _PLANAR_PADS),
    "cube": _make_layout("cube", f"{_PLANAR_PADS} {_SECOND_SECTION} {_THIRD_SECTION}"),
}
"""Built-in layouts by name: quad has 4 pads on 2 faces, planar 8 pads on 4 faces, and cube 24 pads
on all 6 faces."""
