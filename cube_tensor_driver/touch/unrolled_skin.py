"""Unrolling of bent skins: a surface is laid flat around one cube, distances from it are kept."""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Index
from ..core.poses import CubePoses


def unroll(
    poses: CubePoses,
    centres: Index,
    near: Index,
) -> tuple[Array, Array]:
    """Lay the surroundings of n cubes flat, each in the x-y plane of its own frame.

    The kernels hold for a flat layer. A neighbour keeps its distance from the centre and the
    direction in which it lies; on a flat skin, nothing changes.

    Args:
        poses: Poses of all cubes.
        centres: Indices (n,) of the cubes around which the skin is unrolled.
        near: Indices (n, W) of the cubes in the surroundings of each centre.

    Returns:
        Positions (n, W, 2) in m and rotations (n, W) about z in rad, in the frame of the centre.
    """
    to_centre = poses.rotation[centres]
    offset = poses.position[near] - poses.position[centres][:, None]
    local = np.einsum("nji,nkj->nki", to_centre, offset)

    # The direction in the plane stays, the length becomes the distance in space.
    distance = np.linalg.norm(local, axis=2)
    in_plane = np.hypot(local[..., 0], local[..., 1])
    stretch = distance / np.where(in_plane > 0, in_plane, 1.0)
    place = local[..., :2] * stretch[..., None]

    # The rotation about z that is closest to the relative rotation.
    relative = np.einsum("nji,nkjl->nkil", to_centre, poses.rotation[near])
    sine = relative[..., 1, 0] - relative[..., 0, 1]
    cosine = relative[..., 0, 0] + relative[..., 1, 1]
    return place, np.arctan2(sine, cosine)
