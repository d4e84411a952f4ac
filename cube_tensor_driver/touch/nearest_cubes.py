# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The cubes of a skin that are nearest to each cube."""

from __future__ import annotations

import numpy as np

from ..core.arrays import Index
from ..core.poses import CubePoses


def find_nearest_cubes(
    poses: CubePoses,
    count: int,
    by_position: bool = False,
) -> Index:
    """Return the indices (cubes, W) of the cubes nearest to each cube, which itself comes first.

    Args:
        poses: Poses of the cubes.
        count: Number W of nearest cubes, the cube itself included. If the skin has fewer cubes, W
            is their number.
        by_position: Whether cubes at equal distances are sorted by their x and y in the frame of
            the cube, so that similar neighbourhoods list them in the same order. Otherwise they are
            sorted by index.
    """
    count = min(count, len(poses.position))
    pitch = poses.pitch
    near = []
    for position, rotation in zip(poses.position, poses.rotation, strict=True):
        offset = poses.position - position
        square = np.einsum("ni,ni->n", offset, offset)
        # Candidates are all cubes that are at most about as far away as the last of the W cubes.
        limit = 1.01 * np.partition(square, count - 1)[count - 1]
        candidates = np.flatnonzero(square <= limit)
        # Positions are rounded, because otherwise rounding errors would decide the order of equally
        # distant cubes.
        local = np.round(offset[candidates] @ rotation / pitch, 4)
        distance = np.linalg.norm(local, axis=1).round(4)
        x, y, _ = local.T
        keys = (y, x, distance) if by_position else (distance,)
        near.append(candidates[np.lexsort(keys)[:count]])
    return np.array(near)
