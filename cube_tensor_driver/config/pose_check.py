"""Poses that no skin has: what can be read, but is most likely a slip of the hand."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .skin import Skin

FARTHEST_M = 5.0
"""From the parent frame. Cubes are millimetres wide: a skin beyond that was typed in mm."""
APART_M = 1.0
"""Neighbours in a skin of at least FEWEST cubes are closer than that."""
FEWEST = 3
MOST_COMPARED = 500
"""Cubes of which each is compared with each."""
SAME_M = 1e-6
"""Cubes so close are at one place."""


def pose_doubts(skin: Skin) -> Iterator[str]:
    """One line for each doubt about the poses of the cubes."""
    xyz = np.array([cube.xyz for cube in skin.cubes])
    yield from _at_one_place(skin, xyz)
    if _in_millimetres(xyz):
        farthest = int(np.abs(xyz).max(axis=1).argmax())
        place = ", ".join(f"{value:g}" for value in skin.cubes[farthest].xyz)
        yield (
            f"cubes: {skin.cubes[farthest].name!r} is at [{place}] m, where no skin reaches: "
            "xyz is in m; divide by 1000 what was typed in mm"
        )


def _at_one_place(skin: Skin, xyz: np.ndarray) -> Iterator[str]:
    """Cubes whose positions are equal: at most one cube can be there."""
    _, place, count = np.unique(
        np.round(xyz / SAME_M), axis=0, return_inverse=True, return_counts=True
    )
    place = place.reshape(-1)
    for number in np.flatnonzero(count > 1).tolist():
        members = np.flatnonzero(place == number).tolist()
        names = [repr(skin.cubes[member].name) for member in members[:4]]
        others = f" and {len(members) - 4} more" if len(members) > 4 else ""
        where = ", ".join(f"{value:g}" for value in skin.cubes[members[0]].xyz)
        yield f"cubes: {', '.join(names)}{others} are at one place, [{where}] m; correct xyz"


def _in_millimetres(xyz: np.ndarray) -> bool:
    if np.abs(xyz).max() > FARTHEST_M:
        return True
    if not FEWEST <= len(xyz) <= MOST_COMPARED:
        return False
    apart = np.linalg.norm(xyz[:, None] - xyz, axis=2)
    return bool(apart[~np.eye(len(xyz), dtype=bool)].min() > APART_M)
