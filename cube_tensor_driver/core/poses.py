"""Where the cubes of a skin are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .tensor import quaternion_from_rotation


class CubePoses(NamedTuple):
    """Where cubes are: position (N, 3) m, rotation (N, 3, 3) cube to parent, half_side (N,) m."""

    position: np.ndarray
    rotation: np.ndarray
    half_side: np.ndarray

    @property
    def pitch(self) -> float:
        """Typical distance of neighbours in m, at least a cube's side: the measure of all that is
        drawn."""
        side = 2.0 * float(np.median(self.half_side))
        if len(self.position) < 2:
            return 3.0 * side
        square = (self.position**2).sum(axis=1)
        apart = square[:, None] + square - 2 * self.position @ self.position.T
        np.fill_diagonal(apart, np.inf)
        return max(side, float(np.sqrt(max(0.0, np.median(apart.min(axis=1))))))


def quaternions(rotation: np.ndarray) -> np.ndarray:
    """(N, 4) w, x, y, z of rotations (N, 3, 3). It loops: call it once per skin, not per
    picture."""
    return np.array([np.roll(quaternion_from_rotation(matrix), 1) for matrix in rotation])
