# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Warnings about poses in a skin file that are valid YAML but most likely typing errors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..core.arguments import join_names
from ..core.arrays import Array
from .skin import Skin

MAX_DISTANCE_M = 5.0
"""Largest credible coordinate, in m, of a cube in the parent frame of the skin.

Cubes are millimetres wide, so a larger coordinate was most likely typed in mm instead of m.
"""

MAX_SPACING_M = 1.0
"""Largest credible distance, in m, between the two closest cubes of a skin. A larger one suggests
that the positions were typed in mm instead of m."""

MIN_SPACED_CUBES = 3
"""Minimum number of cubes of a skin for which `MAX_SPACING_M` is checked. Two cubes alone may well
be mounted far apart."""

MAX_SPACED_CUBES = 500
"""Maximum number of cubes of a skin for which `MAX_SPACING_M` is checked. Every pair of cubes is
compared, so time and memory grow with the square of the number."""

POSITION_RESOLUTION_M = 1e-6
"""Resolution, in m, to which positions are rounded. Cubes with equal rounded positions are reported
as being at one position."""

MAX_NAMES = 4
"""Maximum number of cubes with the same position that a warning names; the others are counted."""


def find_pose_doubts(skin: Skin) -> Iterator[str]:
    """Yield a warning (one line) for each probable mistake in the poses of the cubes.

    Probable mistakes are several cubes at one position, and positions in mm instead of m.
    """
    positions = np.array([cube.xyz for cube in skin.cubes])
    yield from _find_shared_positions(skin, positions)
    if _seems_in_millimetres(positions):
        largest_coordinate = np.abs(positions).max(axis=1)
        most_distant = int(largest_coordinate.argmax())
        cube = skin.cubes[most_distant]
        yield (
            f"cubes: {cube.name!r} is at [{_format(cube.xyz)}] m, where no skin reaches: "
            "xyz is in m; divide by 1000 what was typed in mm"
        )


def _find_shared_positions(skin: Skin, positions: Array) -> Iterator[str]:
    """Yield a warning for each position that several cubes share.

    Args:
        skin: The skin.
        positions: Positions of the cubes in the parent frame, (cubes, 3), in m.
    """
    rounded = np.round(positions / POSITION_RESOLUTION_M)
    _, group, count = np.unique(
        rounded,
        axis=0,
        return_inverse=True,
        return_counts=True,
    )
    group = group.reshape(-1)  # numpy 2.0, but no other version, returns shape (cubes, 1)
    for number in np.flatnonzero(count > 1).tolist():
        members = [skin.cubes[member] for member in np.flatnonzero(group == number)]
        names = join_names([repr(cube.name) for cube in members], MAX_NAMES)
        yield f"cubes: {names} are at one place, [{_format(members[0].xyz)}] m; correct xyz"


def _seems_in_millimetres(positions: Array) -> bool:
    """Return whether positions (cubes, 3), which should be in m, are most likely in mm."""
    if np.abs(positions).max() > MAX_DISTANCE_M:
        return True
    # Coordinates of a small skin near the origin are below the limit even if they are in mm. Then
    # the distances of neighbouring cubes are too large.
    if not MIN_SPACED_CUBES <= len(positions) <= MAX_SPACED_CUBES:
        return False
    offsets = positions[:, np.newaxis] - positions
    distance = np.linalg.norm(offsets, axis=2)
    # The distance of a cube from itself, 0, must not count as the smallest one.
    np.fill_diagonal(distance, np.inf)
    return bool(distance.min() > MAX_SPACING_M)


def _format(xyz: tuple[float, float, float]) -> str:
    return ", ".join(f"{value:g}" for value in xyz)
