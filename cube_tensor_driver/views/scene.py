"""What a skin looks like: colours, arrows and crosses of its cubes as arrays, for all viewers.

Values are (N, 15) in the order of COMPONENTS, in Pa and Pa/m, in the frames of the cubes, NaN where
they are not observed. Poses and what is drawn are in the parent frame of the skin, in metres.
Colours are (..., 3) from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..core.arrays import AnyArray, Array, Mask
from ..core.latest_stress import FINE
from ..core.modes import COMPONENTS, STRESS
from ..core.poses import CubePoses
from ..core.tensor import principal_stresses

SEQUENTIAL = "ffffcc ffeda0 fed976 feb24c fd8d3c fc4e2a e31a1c bd0026 800026"
"""Colours of values from zero on: YlOrRd of ColorBrewer.

Like `DIVERGING` it is light at zero, and its lightness changes monotonically away from it: so it
can be read in grey, and a skin at rest is visible.
"""

DIVERGING = "053061 2a71b2 6bacd1 c2ddec f7f6f6 fbccb4 e48066 ba2832 67001f"
"""Colours of values on both sides of zero: RdBu of ColorBrewer, reversed."""

GREY = (0.55, 0.55, 0.55)
RED = (0.85, 0.1, 0.1)
ORANGE = (0.95, 0.55, 0.0)
WHITE = (0.95, 0.95, 0.95)

MARK = np.array([GREY, ORANGE, RED, WHITE])
"""Colour of the cross over a cube by its health; a fine cube has no cross."""

RANGE_DECAY = 0.98
"""Share of its top that an automatic range keeps from one picture to the next, while the values
are smaller."""

CROSS_SIZE = 1.3
"""Half the width of the cross over a cube with a fault, in half sides of the cube."""

CROSS_HEIGHT = 1.2
"""Height of that cross above the centre of the cube, in half sides of the cube."""

BARB_LENGTH = 0.25
"""Length of the barbs of an arrow that is drawn as lines, relative to the arrow."""


@dataclass(frozen=True)
class Quantity:
    """A quantity that can be shown in colours.

    Attributes:
        label: Name for people.
        unit: Name of its unit.
        size: Size of that unit, in SI units.
        min_top: Smallest top of an automatic range, in SI units; noise alone gets no strong colour.
        signed: Whether the colours lie about zero.
        of: Function of values (N, 15) and residual (N,) that returns (N,) in SI units.
    """

    label: str
    unit: str
    size: float
    min_top: float
    signed: bool
    of: Callable[[Array, Array], Array]


def _component(name: str) -> Callable[[Array, Array], Array]:
    column = COMPONENTS.index(name)
    return lambda values, residual: values[:, column]


def _length(*names: str) -> Callable[[Array, Array], Array]:
    """Return a function for the length of the vector of some components."""
    columns = [COMPONENTS.index(name) for name in names]

    def of(values: Array, residual: Array) -> Array:
        parts = values[:, columns]
        is_observed = np.isfinite(parts)
        # A part that is not observed counts as 0; without any there is no length.
        length = np.linalg.norm(np.where(is_observed, parts, 0), axis=1)
        return np.where(is_observed.any(axis=1), length, np.nan)

    return of


def _stress(label: str, of: Callable[[Array, Array], Array], signed: bool = False) -> Quantity:
    return Quantity(
        label,
        unit="kPa",
        size=1e3,
        min_top=500.0,
        signed=signed,
        of=of,
    )


QUANTITIES = {
    "pressure": _stress("pressure −σzz", lambda values, residual: -values[:, 2]),
    "shear": _stress("shear |σzx, σyz|", _length("zx", "yz")),
    "gradient": Quantity(
        "gradient |∂σzz/∂x, ∂σzz/∂y|",
        unit="kPa/mm",
        size=1e6,
        min_top=1e5,
        signed=False,
        of=_length("zz_x", "zz_y"),
    ),
    **{name: _stress(f"σ{name}", _component(name), signed=True) for name in STRESS},
    "residual": Quantity(
        "residual",
        unit="σ",
        size=1.0,
        min_top=3.0,
        signed=False,
        of=lambda values, residual: residual,
    ),
}
"""Name -> quantity, of all that markers and the page can show."""


def automatic(quantity: Quantity, values: Array, last_top: float = 0.0) -> float:
    """Return the top of an automatic range, which follows a rise at once and falls slowly.

    Args:
        quantity: The quantity.
        values: What is shown, in SI units.
        last_top: The top in the picture before.
    """
    finite = np.abs(values[np.isfinite(values)])
    return max(quantity.min_top, RANGE_DECAY * last_top, float(finite.max(initial=0.0)))


def colours(quantity: Quantity, values: Array, top: float) -> Array:
    """Return the colours (N, 3) of values on the range 0 .. top, or −top .. top if signed.

    Values are in SI units; NaN is grey.
    """
    share = np.nan_to_num(values) / top
    if quantity.signed:
        share = share / 2 + 0.5
    table = _colour_table(DIVERGING if quantity.signed else SEQUENTIAL)
    # Colours between two entries of the table are interpolated linearly.
    place = np.clip(share, 0, 1) * (len(table) - 1)
    low = np.minimum(place.astype(int), len(table) - 2)
    part = (place - low)[:, None]
    mixed = (1 - part) * table[low] + part * table[low + 1]
    return np.where(np.isfinite(values)[:, None], mixed, GREY)


def _colour_table(hexes: str) -> Array:
    return np.array([tuple(bytes.fromhex(text)) for text in hexes.split()]) / 255


def traction_arrows(poses: CubePoses, values: Array, length: float) -> Array:
    """Return arrows of the traction σ·n on the faces +z, the way the load pushes or pulls.

    Pressing arrows point into the skin and end on the face, pulling arrows begin there.
    Components that are not observed count as 0.

    Args:
        poses: The cubes.
        values: (N, 15).
        length: Length in metres per Pa.

    Returns:
        (N, 2, 3) tails and tips.
    """
    traction = np.nan_to_num(values[:, [4, 3, 2]]) * length
    arrow = np.einsum("nij,nj->ni", poses.rotation, traction)
    face = poses.position + poses.rotation[:, :, 2] * poses.half_side[:, None]
    presses = traction[:, 2:] < 0
    tail = np.where(presses, face - arrow, face)
    return np.stack([tail, tail + arrow], axis=1)


def gradient_arrows(poses: CubePoses, values: Array, length: float) -> Array:
    """Return arrows (N, 2, 3) on the faces +z that point to where the pressure grows.

    Args:
        poses: The cubes.
        values: (N, 15); components that are not observed count as 0.
        length: Length in metres per Pa/m.
    """
    # Pressure is −σzz, so that it grows against the gradient of σzz.
    columns = [COMPONENTS.index("zz_x"), COMPONENTS.index("zz_y")]
    gradient = -np.nan_to_num(values[:, columns]) * length
    arrow = np.einsum("nij,nj->ni", poses.rotation[:, :, :2], gradient)
    tail = poses.position + poses.rotation[:, :, 2] * (1.15 * poses.half_side[:, None])
    return np.stack([tail, tail + arrow], axis=1)


def principal_crosses(poses: CubePoses, values: Array, length: float) -> tuple[Array, Mask]:
    """Return lines along the principal stresses, above the cubes.

    Components that are not observed count as 0, so that a planar cube shows the cross of its
    section.

    Args:
        poses: The cubes.
        values: (N, 15).
        length: Length of the lines in metres per Pa.

    Returns:
        Lines (N, 3, 2, 3), and whether each is tension (N, 3).
    """
    # Directions are rows in the frame of the cube.
    principal, directions = principal_stresses(np.nan_to_num(values[:, : len(STRESS)]))
    in_parent = np.einsum("nij,nkj->nki", poses.rotation, directions)
    half = in_parent * (0.5 * length * np.abs(principal))[..., None]
    up = poses.rotation[:, None, :, 2] * poses.half_side[:, None, None]
    centre = poses.position[:, None] + up
    return np.stack([centre - half, centre + half], axis=2), np.asarray(principal > 0)


def fault_crosses(poses: CubePoses, health: AnyArray) -> Array:
    """Return two lines (N, 2, 2, 3) across the face +z of each cube that is not fine.

    The lines of a fine cube have a length of 0.
    """
    diagonals = [[[-1, -1, 0], [1, 1, 0]], [[-1, 1, 0], [1, -1, 0]]]
    has_fault = (health != FINE)[:, None, None, None]
    # The crosses float a little above the face, and have no size over a fine cube.
    corner = np.where(has_fault, CROSS_SIZE * np.array(diagonals), 0.0)
    corner += np.array([0, 0, CROSS_HEIGHT])
    scaled = corner * poses.half_side[:, None, None, None]
    in_parent = np.einsum("nij,nabj->nabi", poses.rotation, scaled)
    return np.asarray(poses.position[:, None, None] + in_parent)


def heads(arrows: Array, normal: Array) -> Array:
    """Return shaft and two barbs (N, 3, 2, 3) of arrows, for viewers that only draw lines.

    Args:
        arrows: (N, 2, 3) tails and tips.
        normal: (N, 3) direction across which the barbs lie.
    """
    tail, tip = arrows[:, 0], arrows[:, 1]
    back = BARB_LENGTH * (tail - tip)
    # The small part gives a direction to arrows along the normal.
    across = np.cross(back, normal + 1e-3 * np.roll(normal, 1, axis=1))
    size = np.linalg.norm(across, axis=1, keepdims=True)
    half_width = 0.5 * np.linalg.norm(back, axis=1, keepdims=True)
    across *= half_width / np.where(size > 0, size, 1)
    barbs = [np.stack([tip, tip + back + side], axis=1) for side in (across, -across)]
    return np.stack([arrows, *barbs], axis=1)
