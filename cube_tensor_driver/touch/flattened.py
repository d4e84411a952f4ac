"""Bent skins laid flat: distances from a middle are kept."""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Index
from ..core.poses import CubePoses


def flattened(poses: CubePoses, middles: Index, near: Index) -> tuple[Array, Array]:
    """Places (n, W, 2) and angles (n, W) of near cubes (n, W) about middles (n,)."""
    rotation = poses.rotation[middles]
    apart = poses.position[near] - poses.position[middles][:, None]
    local = np.einsum("nji,nkj->nki", rotation, apart)
    distance, across = np.linalg.norm(local, axis=2), np.hypot(local[..., 0], local[..., 1])
    place = local[..., :2] * (distance / np.where(across > 0, across, 1.0))[..., None]
    relative = np.einsum("nji,nkjl->nkil", rotation, poses.rotation[near])
    sine = relative[..., 1, 0] - relative[..., 0, 1]
    angle = np.arctan2(sine, relative[..., 0, 0] + relative[..., 1, 1])
    return place, angle
