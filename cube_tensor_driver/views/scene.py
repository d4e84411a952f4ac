"""What a skin looks like: colours, arrows and crosses of its cubes as arrays, for all viewers.

Values are (N, 15) in the order of COMPONENTS, Pa and Pa/m, in the cubes' frames, NaN where they are
not observed. Poses and what is drawn are in the skin's parent frame, m. Colours are (..., 3) from 0
to 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..core.latest_stress import FINE
from ..core.modes import COMPONENTS, STRESS
from ..core.poses import CubePoses
from ..core.tensor import principal_stresses

# ColorBrewer's YlOrRd, and RdBu reversed. Both are light at zero, and their lightness changes
# monotonically away from it: they can be read in grey, and a skin at rest is seen.
SEQUENTIAL = "ffffcc ffeda0 fed976 feb24c fd8d3c fc4e2a e31a1c bd0026 800026"
DIVERGING = "053061 2a71b2 6bacd1 c2ddec f7f6f6 fbccb4 e48066 ba2832 67001f"
GREY, RED, ORANGE, WHITE = (
    (0.55, 0.55, 0.55),
    (0.85, 0.1, 0.1),
    (0.95, 0.55, 0.0),
    (0.95, 0.95, 0.95),
)

MARK = np.array([GREY, ORANGE, RED, WHITE])
"""Colour of the cross over a cube by its health; a fine cube has none."""
FALL = 0.98
"""What an automatic range keeps of its top from one picture to the next."""


@dataclass(frozen=True)
class Quantity:
    """What can be shown as colour: name for people, unit and its size in SI, smallest top of an
    automatic range.

    signed: colours lie about zero. of: values (N, 15), residual (N,) -> (N,) in SI.
    """

    label: str
    unit: str
    size: float
    least: float
    signed: bool
    of: Callable[[np.ndarray, np.ndarray], np.ndarray]


def _component(name: str) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    column = COMPONENTS.index(name)
    return lambda values, residual: values[:, column]


def _length(*names: str) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    columns = [COMPONENTS.index(name) for name in names]

    def of(values: np.ndarray, residual: np.ndarray) -> np.ndarray:
        seen = np.isfinite(values[:, columns])
        length = np.sqrt((np.where(seen, values[:, columns], 0) ** 2).sum(axis=1))
        return np.where(seen.any(axis=1), length, np.nan)

    return of


QUANTITIES = {
    "pressure": Quantity(
        "pressure −σzz", "kPa", 1e3, 500.0, False, lambda values, residual: -values[:, 2]
    ),
    "shear": Quantity("shear |σzx, σyz|", "kPa", 1e3, 500.0, False, _length("zx", "yz")),
    "gradient": Quantity(
        "gradient |∂σzz/∂x, ∂σzz/∂y|", "kPa/mm", 1e6, 1e5, False, _length("zz_x", "zz_y")
    ),
    **{name: Quantity(f"σ{name}", "kPa", 1e3, 500.0, True, _component(name)) for name in STRESS},
    "residual": Quantity("residual", "σ", 1.0, 3.0, False, lambda values, residual: residual),
}


def automatic(quantity: Quantity, shown: np.ndarray, before: float = 0.0) -> float:
    """Top of the range for what is shown: follows a rise at once, falls slowly from `before`, never
    below the least."""
    finite = np.abs(shown[np.isfinite(shown)])
    return max(quantity.least, FALL * before, float(finite.max(initial=0.0)))


def colours(quantity: Quantity, shown: np.ndarray, top: float) -> np.ndarray:
    """(N, 3) of values in SI on the range 0 .. top, or −top .. top if signed; grey where NaN."""
    share = np.nan_to_num(shown) / top
    table = _table(DIVERGING if quantity.signed else SEQUENTIAL)
    at = np.clip(share / 2 + 0.5 if quantity.signed else share, 0, 1) * (len(table) - 1)
    low = np.minimum(at.astype(int), len(table) - 2)
    part = (at - low)[:, None]
    return np.where(
        np.isfinite(shown)[:, None], (1 - part) * table[low] + part * table[low + 1], GREY
    )


def _table(hexes: str) -> np.ndarray:
    return np.array([[int(text[i : i + 2], 16) / 255 for i in (0, 2, 4)] for text in hexes.split()])


def traction_arrows(poses: CubePoses, values: np.ndarray, length: float) -> np.ndarray:
    """(N, 2, 3) from tail to tip: the traction σ·n on the faces +z, `length` metres per Pa.

    It is how the load pushes: pressing points into the skin and ends on the face, pulling begins
    there. Unobserved parts count as 0.
    """
    t = np.nan_to_num(values[:, [4, 3, 2]]) * length
    arrow = np.einsum("nij,nj->ni", poses.rotation, t)
    face = poses.position + poses.rotation[:, :, 2] * poses.half_side[:, None]
    tail = np.where(t[:, 2:] < 0, face - arrow, face)
    return np.stack([tail, tail + arrow], axis=1)


def gradient_arrows(poses: CubePoses, values: np.ndarray, length: float) -> np.ndarray:
    """(N, 2, 3) on the faces +z: where pressure grows, `length` metres per Pa/m; unobserved parts
    count as 0."""
    g = -np.nan_to_num(values[:, [COMPONENTS.index("zz_x"), COMPONENTS.index("zz_y")]]) * length
    arrow = np.einsum("nij,nj->ni", poses.rotation[:, :, :2], g)
    tail = poses.position + poses.rotation[:, :, 2] * (1.15 * poses.half_side[:, None])
    return np.stack([tail, tail + arrow], axis=1)


def principal_crosses(
    poses: CubePoses, values: np.ndarray, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Lines (N, 3, 2, 3) along the principal stresses, `length` metres per Pa, and whether each
    pulls (N, 3).

    Unobserved components count as 0: a planar cube shows its section's cross.
    """
    principal, directions = principal_stresses(np.nan_to_num(values[:, : len(STRESS)]))
    half = (
        np.einsum("nij,nkj->nki", poses.rotation, directions)
        * (0.5 * length * np.abs(principal))[..., None]
    )
    centre = (
        poses.position[:, None] + poses.rotation[:, None, :, 2] * poses.half_side[:, None, None]
    )
    return np.stack([centre - half, centre + half], axis=2), principal > 0


def fault_crosses(poses: CubePoses, health: np.ndarray) -> np.ndarray:
    """(N, 2, 2, 3) two lines across the face +z of each cube that is not fine; lines of length 0
    where it is."""
    corner = np.array([[[-1, -1, 0.0], [1, 1, 0]], [[-1, 1, 0], [1, -1, 0]]]) * 1.3
    corner = np.where((health != FINE)[:, None, None, None], corner, 0) + np.array([0, 0, 1.2])
    return poses.position[:, None, None] + np.einsum(
        "nij,nabj->nabi", poses.rotation, corner * poses.half_side[:, None, None, None]
    )


def heads(arrows: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(N, 3, 2, 3) an arrow (N, 2, 3) as shaft and two barbs, for viewers that only know lines;
    normal (N, 3)."""
    tail, tip = arrows[:, 0], arrows[:, 1]
    back = 0.25 * (tail - tip)
    across = np.cross(
        back, normal + 1e-3 * np.roll(normal, 1, axis=1)
    )  # the small part: arrows along the normal
    size = np.linalg.norm(across, axis=1, keepdims=True)
    across *= 0.5 * np.linalg.norm(back, axis=1, keepdims=True) / np.where(size > 0, size, 1)
    return np.stack(
        [arrows, np.stack([tip, tip + back + across], 1), np.stack([tip, tip + back - across], 1)],
        axis=1,
    )
