# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Unrolling of bent skins: neighbours of a cube are laid flat and keep their distance from it."""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Index
from ..core.poses import CubePoses


def unroll(
    poses: CubePoses,
    centres: Index,
    near: Index,
) -> tuple[Array, Array]:
    """Lay the neighbours of n cubes flat, each time in the x-y plane of the cube in the centre.

    The skin has to be laid flat, because the covariances between the cubes' values and the
    surface traction hold for a flat layer. A neighbour keeps its distance from the centre cube,
    and its direction within the x-y plane. On a flat skin, nothing changes.

    Args:
        poses: Poses of all cubes.
        centres: Indices (n,) of the cubes around which the skin is unrolled.
        near: Indices (n, W) of the neighbours of each centre cube that are laid flat.

    Returns:
        Positions (n, W, 2) in m and rotations (n, W) about z in rad of the neighbours, each in the
        frame of its centre cube, with the origin in the centre of this cube.
    """
    rotation = poses.rotation[centres]
    offset = poses.position[near] - poses.position[centres, None]
    x, y, z = np.einsum("nji,nkj->ink", rotation, offset)
    # The direction in the x-y plane stays, the length becomes the distance in space.
    length = np.hypot(x, y)
    distance = np.hypot(length, z)
    stretch = distance / np.where(length > 0, length, 1.0)
    place = np.stack([stretch * x, stretch * y], axis=2)

    # A tilted neighbour gets the rotation about z that is closest to its rotation in space.
    relative = np.einsum("nji,nkjl->ilnk", rotation, poses.rotation[near])
    sine = relative[1, 0] - relative[0, 1]
    cosine = relative[0, 0] + relative[1, 1]
    return place, np.arctan2(sine, cosine)
