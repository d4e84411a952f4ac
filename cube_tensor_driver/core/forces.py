"""Forces on the cubes of a skin, in the frame of the skin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from .arrays import Array
from .rows import StressRows
from .tensor import face_force, rotation_from_rpy

TRACTION_COMPONENTS = [4, 3, 2]
"""Columns of a stress that act on a face +z: zx, yz and zz."""


class PlacedSkin(Protocol):
    """A skin whose cubes have `xyz`, `rpy` and `calibration`."""

    @property
    def cubes(self) -> Sequence[Any]: ...


class Forces:
    """The force on the skin at each cube, in the parent frame of the skin, in N.

        F = R w² σ n

    σ n is the traction on the face +z of the cube, w² the area that it acts on, and R the rotation
    from the frame of the cube to the parent frame. A pressed skin has forces into the skin.

    Components that are not observed count as 0. A row that observes no component of the traction
    gives NaN.

    Attributes:
        position: Positions of the cubes in the parent frame (cubes, 3), in m.
        side: Side w of the area of each cube (cubes,), in m.
    """

    def __init__(self, skin: PlacedSkin, side: float | None = None) -> None:
        """Prepare the forces of a skin.

        Args:
            skin: The skin.
            side: Side w for all cubes, in m. With the distance of neighbouring cubes, the sum of
                the forces is the force on the whole skin. None stands for the side of each cube.
        """
        cubes = skin.cubes
        positions = [cube.xyz for cube in cubes]
        sides = [side or 2 * cube.calibration.half_side for cube in cubes]
        rotations = [rotation_from_rpy(*cube.rpy) for cube in cubes]
        self.position = np.array(positions, float)
        self.side = np.array(sides)
        self._rotation = np.array(rotations)

    def __call__(self, rows: StressRows) -> Array:
        """Compute the force of each row (N, 3)."""
        side = self.side[rows.cube, None]
        rotation = self._rotation[rows.cube]
        in_cube_frame = face_force(rows.stress, side)
        force: Array = np.einsum("nij,nj->ni", rotation, in_cube_frame)
        traction = rows.stress[:, TRACTION_COMPONENTS]
        # Zero would claim that nothing presses.
        is_unobserved = np.isnan(traction).all(axis=1)
        force[is_unobserved] = np.nan
        return force

    def of_skin(self, rows: StressRows) -> Array:
        """Return the force of the last row of each cube (cubes, 3), NaN for cubes without a row."""
        force = np.full(self.position.shape, np.nan)
        # If a cube has several rows, numpy keeps the last assignment.
        force[rows.cube] = self(rows)
        return force
