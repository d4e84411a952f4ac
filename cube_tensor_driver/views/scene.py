# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Colours, arrows and crosses that show the stress of each cube, as arrays for all viewers.

The values of N cubes are an array (N, 15) in the order of COMPONENTS, in Pa and Pa/m, in the frames
of the cubes, NaN where a component is not observed. Poses and the coordinates of what is drawn are
in the parent frame of the skin, in metres. Colours are (..., 3) from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import AnyArray, Array, Mask
from ..core.latest_stress import FINE
from ..core.modes import COMPONENTS, STRESS
from ..core.poses import CubePoses
from ..core.tensor import TRACTION_COMPONENTS, compute_principal_stresses


def _make_colour_table(hexes: str) -> Array:
    colours = [tuple(bytes.fromhex(text)) for text in hexes.split()]
    return np.array(colours) / 255


SEQUENTIAL = _make_colour_table("ffffcc ffeda0 fed976 feb24c fd8d3c fc4e2a e31a1c bd0026 800026")
"""Colour scale (9, 3) of values that are never negative, from 0 to 1 (YlOrRd of ColorBrewer).

It is light at zero, so that a skin at rest is visible, and its lightness falls monotonically, so
that it can be read in grey.
"""

DIVERGING = _make_colour_table("053061 2a71b2 6bacd1 c2ddec f7f6f6 fbccb4 e48066 ba2832 67001f")
"""Colour scale (9, 3) of values on both sides of zero, from 0 to 1 (RdBu of ColorBrewer, reversed).

It is light at zero and becomes darker on both sides: blue for negative, red for positive values.
"""

GREY = (0.55, 0.55, 0.55)
"""Colour of unknown values, as red, green and blue from 0 to 1."""
RED = (0.85, 0.1, 0.1)
"""Colour of the cross over a cube whose stress is unknown because too many of its pads are broken,
as red, green and blue from 0 to 1."""
ORANGE = (0.95, 0.55, 0.0)
"""Colour of the cross over a cube whose stress is doubtful, as red, green and blue from 0 to 1."""
WHITE = (0.95, 0.95, 0.95)
"""Colour of the cross over a cube from which nothing arrives, as red, green and blue from 0 to 1.
"""

MARK = np.array([GREY, ORANGE, RED, WHITE])
"""Colours (4, 3) of the cross over a cube, indexed by its health (fine, doubtful, faulty, stale).

The entry for `FINE` is not used, because a cube that is fine has no cross.
"""

RANGE_DECAY = 0.98
"""Factor by which the upper end of an automatic range shrinks from one picture to the next, while
all values are smaller than it."""

CROSS_SIZE = 1.3
"""Half the width of the cross over a cube with a fault, relative to half the side of the cube."""

CROSS_HEIGHT = 1.2
"""Height of the cross over a cube with a fault above the cube's centre, relative to half the side
of the cube."""

BARB_LENGTH = 0.25
"""Length of the two barbs at the tip of an arrow that consists of lines, relative to the length of
the arrow."""


@dataclass(frozen=True)
class Quantity:
    """A quantity that can be shown in colours.

    Attributes:
        label: Name of the quantity that users see.
        unit: Name of the unit in which users see it.
        size: Size of that unit, in SI units.
        min_top: Minimum of the upper end of an automatic range, in SI units. It is so large that
            noise alone gets no strong colour.
        signed: Whether the range is symmetrical around zero; otherwise it begins at zero.
        compute: Function that computes the quantity (N,), in SI units, of N cubes from their values
            (N, 15), 6 stress components in Pa and 9 gradients in Pa/m, and residuals (N,).
    """

    label: str
    unit: str
    size: float
    min_top: float
    signed: bool
    compute: Callable[[Array, Array], Array]


def _select_component(name: str) -> Callable[[Array, Array], Array]:
    column = COMPONENTS.index(name)
    return lambda values, residual: values[:, column]


def _make_magnitude(*names: str) -> Callable[[Array, Array], Array]:
    """Return a function for `Quantity.compute`: the magnitude of the vector of some components.

    Args:
        names: Names of the components of the vector, such as "yz" and "zx".
    """
    columns = [COMPONENTS.index(name) for name in names]

    def compute(values: Array, residual: Array) -> Array:
        parts = values[:, columns]
        is_observed = np.isfinite(parts)
        # An unobserved component counts as 0; if all are unobserved, the magnitude is NaN.
        observed_parts = np.where(is_observed, parts, 0)
        magnitude = np.linalg.norm(observed_parts, axis=1)
        return np.where(is_observed.any(axis=1), magnitude, np.nan)

    return compute


def _make_stress_quantity(
    label: str,
    compute: Callable[[Array, Array], Array],
    signed: bool = False,
) -> Quantity:
    return Quantity(
        label,
        unit="kPa",
        size=1e3,
        min_top=500.0,
        signed=signed,
        compute=compute,
    )


QUANTITIES = {
    "pressure": _make_stress_quantity("pressure −σzz", lambda values, residual: -values[:, 2]),
    "shear": _make_stress_quantity("shear |σzx, σyz|", _make_magnitude("zx", "yz")),
    "gradient": Quantity(
        "gradient |∂σzz/∂x, ∂σzz/∂y|",
        unit="kPa/mm",
        size=1e6,
        min_top=1e5,
        signed=False,
        compute=_make_magnitude("zz_x", "zz_y"),
    ),
    **{
        name: _make_stress_quantity(
            f"σ{name}",
            _select_component(name),
            signed=True,
        )
        for name in STRESS
    },
    "residual": Quantity(
        "residual",
        unit="σ",
        size=1.0,
        min_top=3.0,
        signed=False,
        compute=lambda values, residual: residual,
    ),
}
"""Name -> quantity, for all quantities that markers (RViz) and the page can show in colours.

The residual of a cube (rms deviation of its pads from the fitted stress field) has the unit σ, here
the standard deviation of the noise; σ with two indices, such as σzz, is a component of stress. The
attributes `size` and `min_top` are the size of the unit and the smallest upper end of an automatic
range of colours, in SI units.
"""


def find_component_unit(name: str) -> tuple[float, str]:
    """Return the unit in which users see a component of stress or gradient, or the residual.

    Returns:
        Size of the unit in SI units, and its name: (1000, "kPa") for a stress.
    """
    if name == "residual":
        return 1.0, "× noise"
    return (1e6, "kPa/mm") if "_" in name else (1e3, "kPa")


def choose_automatic_top(
    quantity: Quantity,
    values: Array,
    last_top: float = 0.0,
) -> float:
    """Return the upper end, in SI units, of an automatic range of colours or arrow lengths.

    If the values rise, the upper end rises at once. If they fall, it falls slowly (by the factor
    `RANGE_DECAY` per picture).

    Args:
        quantity: The quantity that is shown.
        values: Its values in this picture, in SI units; NaN is ignored.
        last_top: Upper end of the range in the picture before, in SI units.
    """
    finite = np.abs(values[np.isfinite(values)])
    return max(
        quantity.min_top,
        RANGE_DECAY * last_top,
        float(finite.max(initial=0.0)),
    )


class Ranges(NamedTuple):
    """Values, in SI units, at the upper ends of the automatic ranges of one picture.

    Attributes:
        colours: Value at the upper end of the colour scale.
        traction: Traction (force per area on the upper face), in Pa, that the longest arrow shows.
        gradient: Gradient of the pressure, in Pa/m, that the longest arrow shows.
    """

    colours: float = 0.0
    traction: float = 0.0
    gradient: float = 0.0

    def follow(
        self,
        values: Array,
        residual: Array,
        colours: float,
    ) -> Ranges:
        """Return the ranges of the next picture.

        Args:
            values: (N, 15) 6 stress components in Pa and 9 gradients in Pa/m, in the frames of the
                cubes.
            residual: (N,) residuals of the cubes.
            colours: Upper end of the colour scale of the next picture, in SI units.
        """
        # Columns 2 to 4 are the stress components zz, yz and zx, which act on the upper face.
        traction = choose_automatic_top(
            QUANTITIES["shear"],
            values[:, 2:5],
            self.traction,
        )
        gradient = QUANTITIES["gradient"]
        magnitude = gradient.compute(values, residual)
        longest_gradient = choose_automatic_top(
            gradient,
            magnitude,
            self.gradient,
        )
        return Ranges(colours, traction, longest_gradient)


def choose_colours(
    quantity: Quantity,
    values: Array,
    top: float,
) -> Array:
    """Return the colours (N, 3) of values: red, green and blue from 0 to 1.

    Args:
        quantity: The quantity that is shown.
        values: (N,) its values, in SI units; NaN is grey.
        top: Upper end of the range, in SI units. The range begins at 0, or at −top if the quantity
            is signed.
    """
    share = np.nan_to_num(values) / top
    table = SEQUENTIAL
    if quantity.signed:
        share = share / 2 + 0.5
        table = DIVERGING
    entries = np.linspace(0, 1, len(table))
    channels = [np.interp(share, entries, channel) for channel in table.T]
    mixed = np.stack(channels, axis=1)
    is_known = np.isfinite(values)
    return np.where(is_known[:, None], mixed, GREY)


def convert_to_linear_light(colours: Array) -> NDArray[np.uint8]:
    """Convert sRGB colours (N, 3) from 0 to 1 into linear intensities from 0 to 255.

    The browser interprets the colours of batched meshes as linear intensities of light. The
    conversion is the transfer function of sRGB (IEC 61966-2-1).
    """
    curved = ((colours + 0.055) / 1.055) ** 2.4
    linear = np.where(colours <= 0.04045, colours / 12.92, curved)
    return (255 * linear).astype(np.uint8)


def compute_points_above(poses: CubePoses, factor: float) -> Array:
    """Return one point above the centre of each cube (N, 3), along its z axis.

    Args:
        poses: Poses of the N cubes.
        factor: Height of the points, relative to half the side of the cube; 1 is the upper face.
    """
    height = factor * poses.half_side[:, None]
    z_axis = poses.rotation[:, :, 2]
    return np.asarray(poses.position + height * z_axis)


def make_traction_arrows(
    poses: CubePoses,
    values: Array,
    length: float,
) -> Array:
    """Return one arrow per cube for the traction σ·n on its upper face (+z).

    An arrow points in the direction in which the load pushes or pulls. If the load presses, the
    arrow ends on the face; otherwise it begins there. Components that are not observed count as 0.

    Args:
        poses: Poses of the N cubes (position of the centre, rotation, half the side) in the parent
            frame of the skin, in metres.
        values: (N, 15) 6 stress components in Pa and 9 gradients in Pa/m, in the frames of the
            cubes.
        length: Length of the arrows, in metres per Pa.

    Returns:
        Tails and tips (N, 2, 3), in metres.
    """
    traction = np.nan_to_num(values[:, TRACTION_COMPONENTS])
    in_cube = traction * length
    arrow = np.einsum("nij,nj->ni", poses.rotation, in_cube)
    face = compute_points_above(poses, 1.0)
    presses = in_cube[:, 2:] < 0
    tail = np.where(presses, face - arrow, face)
    return np.stack([tail, tail + arrow], axis=1)


def make_gradient_arrows(
    poses: CubePoses,
    values: Array,
    length: float,
) -> Array:
    """Return one arrow per cube, on its upper face (+z), in the direction in which pressure grows.

    Args:
        poses: Poses of the N cubes (position of the centre, rotation, half the side) in the parent
            frame of the skin, in metres.
        values: (N, 15) 6 stress components in Pa and 9 gradients in Pa/m, in the frames of the
            cubes; unobserved components count as 0.
        length: Length of the arrows, in metres per Pa/m.

    Returns:
        Tails and tips (N, 2, 3), in metres.
    """
    # Pressure is −σzz, so it grows in the direction opposite to the gradient of σzz.
    columns = [COMPONENTS.index("zz_x"), COMPONENTS.index("zz_y")]
    gradient = -np.nan_to_num(values[:, columns])
    in_cube = gradient * length
    arrow = np.einsum("nij,nj->ni", poses.rotation[:, :, :2], in_cube)
    # The arrows lie a little above the upper faces, so that the faces do not hide the arrows.
    tail = compute_points_above(poses, 1.15)
    return np.stack([tail, tail + arrow], axis=1)


def make_principal_crosses(
    poses: CubePoses,
    values: Array,
    length: float,
) -> tuple[Array, Mask]:
    """Return three lines per cube along its principal stresses, centred on its upper face.

    Components that are not observed count as 0, so a planar cube shows the principal stresses in
    the plane that it measures.

    Args:
        poses: Poses of the N cubes (position of the centre, rotation, half the side) in the parent
            frame of the skin, in metres.
        values: (N, 15) 6 stress components in Pa and 9 gradients in Pa/m, in the frames of the
            cubes.
        length: Length of the lines, in metres per Pa.

    Returns:
        Both ends of each line (N, 3, 2, 3), in metres; and for each line whether its principal
        stress is tension (N, 3).
    """
    stress = np.nan_to_num(values[:, : len(STRESS)])
    # Each row of `directions` is one principal direction, in the frame of the cube.
    principal, directions = compute_principal_stresses(stress)
    in_parent = np.einsum("nij,nkj->nki", poses.rotation, directions)
    half_length = 0.5 * length * np.abs(principal)
    half = in_parent * half_length[..., None]
    centre = compute_points_above(poses, 1.0)[:, None]
    lines = np.stack([centre - half, centre + half], axis=2)
    return lines, np.asarray(principal > 0)


def make_fault_crosses(poses: CubePoses, health: AnyArray) -> Array:
    """Return two crossed lines over the upper face (+z) of each cube whose health is not `FINE`.

    Args:
        poses: Poses of the N cubes (position of the centre, rotation, half the side) in the parent
            frame of the skin, in metres.
        health: (N,) health of the cubes (fine, doubtful, faulty or stale), coded as in
            core/latest_stress.py.

    Returns:
        Both ends of both lines (N, 2, 2, 3), in metres; the lines of a fine cube have no length.
    """
    falling = [[-1, 1, 0], [1, -1, 0]]
    rising = [[-1, -1, 0], [1, 1, 0]]
    cross = CROSS_SIZE * np.array([rising, falling])
    has_fault = health != FINE
    ends = np.where(has_fault[:, None, None, None], cross, 0.0)
    scaled = ends * poses.half_side[:, None, None, None]
    in_parent = np.einsum("nij,nabj->nabi", poses.rotation, scaled)
    # The crosses lie a little above the upper faces, so that the faces do not hide the crosses.
    centre = compute_points_above(poses, CROSS_HEIGHT)
    return np.asarray(centre[:, None, None] + in_parent)


def make_arrow_lines(arrows: Array, normal: Array) -> Array:
    """Return three lines per arrow, shaft and two barbs, for viewers that can only draw lines.

    Args:
        arrows: (N, 2, 3) tails and tips of the arrows.
        normal: (N, 3) direction perpendicular to the plane in which shaft and barbs lie.

    Returns:
        Both ends of each line (N, 3, 2, 3).
    """
    tail, tip = arrows[:, 0], arrows[:, 1]
    back = BARB_LENGTH * (tail - tip)
    # The barbs are perpendicular to the normal. The cross product of an arrow and the normal would
    # be 0 for an arrow along the normal, so a small vector in another direction is added to it.
    tilted = normal + 1e-3 * np.roll(normal, 1, axis=1)
    across = np.cross(back, tilted)
    size = np.linalg.norm(across, axis=1, keepdims=True)
    half_width = 0.5 * np.linalg.norm(back, axis=1, keepdims=True)
    size_safe = np.where(size > 0, size, 1)
    across *= half_width / size_safe
    ends = (tip + back + across, tip + back - across)
    barbs = [np.stack([tip, end], axis=1) for end in ends]
    return np.stack([arrows, *barbs], axis=1)


def make_ring(
    centre: Array,
    normal: Array,
    radius: float,
    corners: int,
) -> Array:
    """Return the sides (corners, 2, 3) of a polygon that approximates a circle.

    Args:
        centre: (3,) centre of the circle.
        normal: (3,) unit vector perpendicular to the plane of the circle.
        radius: Radius of the circle, in the unit of the centre.
        corners: Number of corners of the polygon.
    """
    # `first` and `second` span the plane of the circle. The cross product is taken with the
    # coordinate axis that is least parallel to the normal, so that its length is not close to 0.
    least_parallel = np.abs(normal).argmin()
    axis = np.eye(3)[least_parallel]
    first = np.cross(normal, axis)
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    angle = 2 * np.pi * np.arange(corners) / corners
    along_first = np.outer(np.cos(angle), first)
    along_second = np.outer(np.sin(angle), second)
    unit_circle = along_first + along_second
    points = centre + radius * unit_circle
    next_points = np.roll(points, -1, axis=0)
    return np.stack([points, next_points], axis=1)
