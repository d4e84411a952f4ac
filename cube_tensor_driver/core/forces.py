# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Forces on the cubes of a skin, in the frame of the skin."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from .arguments import check_number, check_skin
from .arrays import Array
from .poses import CubePoses
from .rows import StressRows
from .tensor import TRACTION_COMPONENTS, compute_face_force


class PlacedSkin(Protocol):
    """A skin that knows the positions, rotations and half sides of its cubes."""

    @property
    def poses(self) -> CubePoses: ...


class Forces:
    """Computes the force on the skin at each cube, in the parent frame of the skin, in N.

        F = R w² σ n

    σ n is the traction (force per area) on the face +z of the cube, w² the area that the traction
    acts on, and R the rotation from the frame of the cube to the parent frame. Where something
    presses on the skin, the force points into the skin.

    Components of the traction that the pads do not determine count as 0. If none of the three is
    determined, the force is NaN.

    Attributes:
        position: Positions of the cubes in the parent frame (cubes, 3), in m.
        side: Side w of the square on which the traction of each cube acts (cubes,), in m.
    """

    def __init__(self, skin: PlacedSkin, side: float | None = None) -> None:
        """Prepare the forces of a skin.

        Args:
            skin: The skin.
            side: Side w of the square area of each cube, in m. If it is the distance of
                neighbouring cubes, the squares cover the skin and the sum of the forces is the
                force on the whole skin. None stands for the side of the cube itself.

        Raises:
            ConfigError: The argument `skin` is no skin, or the side is not above 0.
        """
        check_skin(skin, "poses")
        if side is not None:
            allowed = "a number above 0, in m, or None"
            check_number(
                "side",
                side,
                lambda x: 0 < x < math.inf,
                allowed,
            )
        self.position, self._rotation, half_side = skin.poses
        self.side = 2 * half_side
        if side is not None:
            self.side[:] = side

    def __repr__(self) -> str:
        side_mm = 1e3 * np.median(self.side)
        return f"Forces({len(self.side)} cubes, on squares of {side_mm:.3g} mm)"

    def __call__(self, rows: StressRows) -> Array:
        """Compute the force on the skin at the cube of each row.

        Args:
            rows: Stresses of N samples, each of one cube.

        Returns:
            Forces (N, 3), in N, in the parent frame of the skin; NaN where the pads determine no
            component of the traction.
        """
        side = self.side[rows.cube, None]
        rotation = self._rotation[rows.cube]
        in_cube_frame = compute_face_force(rows.stress, side)
        force: Array = np.einsum("nij,nj->ni", rotation, in_cube_frame)
        traction = rows.stress[:, TRACTION_COMPONENTS]
        # `compute_face_force` counts unknown components of the traction as 0. If all three are
        # unknown, a force of 0 would claim that nothing presses.
        is_unobserved = np.isnan(traction).all(axis=1)
        force[is_unobserved] = np.nan
        return force

    def compute_in_parent_frame(self, rows: StressRows) -> Array:
        """Return the force at each cube (cubes, 3), in N, in the parent frame of the skin.

        Args:
            rows: Stresses of samples, each of one cube. The last sample of each cube is used; cubes
                without a sample have NaN.
        """
        force = np.full(self.position.shape, np.nan)
        # If a cube has several rows, numpy keeps the last assignment.
        force[rows.cube] = self(rows)
        return force
