"""Doubts about the poses of a skin: they can be read, but are most likely a slip of the hand."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..core.arrays import Array
from .skin import Skin

MAX_DISTANCE_M = 5.0
"""Largest credible distance, in m, of a cube from the origin of the parent frame along an axis.

Cubes are millimetres wide, so a skin that reaches farther was most likely typed in mm.
"""

MAX_SPACING_M = 1.0
"""Largest credible distance, in m, between the two closest cubes of a skin."""

MIN_SPACED_CUBES = 3
"""Minimum number of cubes for which their spacing is checked. Two may well be far apart."""

MAX_SPACED_CUBES = 500
"""Maximum number of cubes for which their spacing is checked, as every pair is compared."""

POSITION_RESOLUTION_M = 1e-6
"""Cubes closer than this, in m, count as being at one position."""

MAX_NAMES = 4
"""Maximum number of cubes at one position that a message names."""


def pose_doubts(skin: Skin) -> Iterator[str]:
    """Yield one line for each doubt about the poses of the cubes."""
    positions = np.array([cube.xyz for cube in skin.cubes])
    yield from _find_shared_positions(skin, positions)
    if _seems_in_millimetres(positions):
        farthest = int(np.abs(positions).max(axis=1).argmax())
        cube = skin.cubes[farthest]
        yield (
            f"cubes: {cube.name!r} is at [{_format(cube.xyz)}] m, where no skin reaches: "
            "xyz is in m; divide by 1000 what was typed in mm"
        )


def _find_shared_positions(skin: Skin, positions: Array) -> Iterator[str]:
    """Yield a line for each position with several cubes, because at most one can be there."""
    rounded = np.round(positions / POSITION_RESOLUTION_M)
    _, group, count = np.unique(
        rounded,
        axis=0,
        return_inverse=True,
        return_counts=True,
    )
    group = group.reshape(-1)  # numpy 2.0 alone gives it a second axis
    for number in np.flatnonzero(count > 1).tolist():
        members = [skin.cubes[member] for member in np.flatnonzero(group == number)]
        names = ", ".join(repr(cube.name) for cube in members[:MAX_NAMES])
        if len(members) > MAX_NAMES:
            names += f" and {len(members) - MAX_NAMES} more"
        yield f"cubes: {names} are at one place, [{_format(members[0].xyz)}] m; correct xyz"


def _seems_in_millimetres(positions: Array) -> bool:
    if np.abs(positions).max() > MAX_DISTANCE_M:
        return True
    # A skin in mm near the origin betrays itself only by the distance of its cubes.
    if not MIN_SPACED_CUBES <= len(positions) <= MAX_SPACED_CUBES:
        return False
    distance = np.linalg.norm(positions[:, np.newaxis] - positions, axis=2)
    # A cube is no neighbour of itself.
    np.fill_diagonal(distance, np.inf)
    return bool(distance.min() > MAX_SPACING_M)


def _format(xyz: tuple[float, float, float]) -> str:
    return ", ".join(f"{value:g}" for value in xyz)
