# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Poses of the cubes of a skin."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .arrays import Array
from .tensor import quaternion_from_rotation


class CubePoses(NamedTuple):
    """Position, rotation and size of the N cubes of a skin.

    Attributes:
        position: Centres of the cubes in the parent frame of the skin (N, 3), in m.
        rotation: Rotations from the frame of each cube to the parent frame (N, 3, 3).
        half_side: Half sides (N,), in m.
    """

    position: Array
    rotation: Array
    half_side: Array

    def __repr__(self) -> str:
        return f"CubePoses({len(self.position)} cubes, pitch {1e3 * self.pitch:.3g} mm)"

    @property
    def pitch(self) -> float:
        """Median distance of a cube to its nearest neighbour, in m.

        Drawings use it as their unit of length. It is at least the side of a cube; a skin of a
        single cube has three times the side.
        """
        side = 2.0 * float(np.median(self.half_side))
        if len(self.position) < 2:
            return 3.0 * side
        square = (self.position**2).sum(axis=1)
        products = self.position @ self.position.T
        # The form a² + b² - 2 ab of the squared distance |a - b|² saves the memory of an array of
        # all differences (N, N, 3).
        square_distance = square[:, None] + square - 2 * products
        np.fill_diagonal(square_distance, np.inf)
        nearest = np.median(square_distance.min(axis=1))
        # Rounding may make the difference of the squares negative.
        distance = np.sqrt(max(0.0, nearest))
        return max(side, float(distance))


def compute_quaternions(rotation: Array) -> Array:
    """Return the quaternions w, x, y, z (N, 4) of rotation matrices (N, 3, 3).

    The function loops over the matrices in Python, so it should be called once per skin and not
    for every picture.
    """
    in_ros_order = [quaternion_from_rotation(matrix) for matrix in rotation]
    xyzw = np.reshape(in_ros_order, (-1, 4))
    return np.roll(xyzw, 1, axis=1)
