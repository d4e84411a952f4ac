"""The force view of a skin: one force per cube in the frame of the skin, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .rows import StressRows
from .tensor import face_force, rotation_from_rpy

SHEAR_AND_NORMAL = [4, 3, 2]
"""zx, yz, zz: the components that act on a face +z."""


class SkinLike(Protocol):
    """What is needed of a skin: its cubes, with their poses and calibrations."""

    @property
    def cubes(self) -> Sequence[Any]: ...


class Forces:
    """The force on the skin at each cube, N, in the skin's parent frame:

        F = R w² σ n

    σ n is the traction on the face +z of the cube, w² the area that it is taken for, R the rotation
    from the cube's frame to the parent's. A pressed skin has forces into the skin. Components that
    are not observed count as 0; a row that observes none of the traction has NaN.

    position: (cubes, 3) m, where the cubes are in the parent frame
    side: (cubes,) m, w of each cube
    """

    def __init__(self, skin: SkinLike, side: float | None = None) -> None:
        """side: w for all cubes, m; the distance of neighbours makes the sum the force on the whole
        skin. None: the side of each cube."""
        cubes = skin.cubes
        self.position = np.array([cube.xyz for cube in cubes], float)
        self.side = np.array([side or 2 * cube.calibration.half_side for cube in cubes])
        self._rotation = np.array([rotation_from_rpy(*cube.rpy) for cube in cubes])

    def __call__(self, rows: StressRows) -> NDArray[np.float64]:
        """(N, 3) of N rows."""
        force = face_force(rows.stress, self.side[rows.cube, None])
        force = np.einsum("nij,nj->ni", self._rotation[rows.cube], force)
        force[np.isnan(rows.stress[:, SHEAR_AND_NORMAL]).all(axis=1)] = np.nan
        return force

    def of_skin(self, rows: StressRows) -> NDArray[np.float64]:
        """(cubes, 3) of the last row of each cube; NaN for cubes without a row."""
        force = np.full(self.position.shape, np.nan)
        force[rows.cube] = self(rows)
        return force
