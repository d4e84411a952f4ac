# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What cubes measure below point forces on a half space, by Boussinesq and Cerruti."""

from __future__ import annotations

import numpy as np

from cube_tensor_design.studies.field_study import compute_field_below
from cube_tensor_driver.core.defaults import POISSONS_RATIO
from cube_tensor_driver.core.modes import to_matrix
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.core.tensor import rotate_gradient, rotate_stress
from cube_tensor_driver.mechanics import contact


def in_cubes(field: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(N, 15) of fields (N, 6 + 18) in the frames of turned cubes."""
    slopes = to_matrix(field[:, 6:].reshape(-1, 6, 3).swapaxes(1, 2))
    into_cubes = rotation.swapaxes(1, 2)
    turned = rotate_gradient(np.moveaxis(slopes, 1, 3), into_cubes)
    normal = np.einsum("niik->nik", turned).reshape(-1, 9)
    return np.concatenate([rotate_stress(field[:, :6], into_cubes), normal], axis=1)


def below(poses: CubePoses, depth: float, load: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(cubes, 15) of each cube in its own frame. load: positions and forces (L, 3)."""
    field = compute_field_below(poses.position, depth, load, POISSONS_RATIO)
    return in_cubes(field, poses.rotation)


def below_ball(poses: CubePoses, depth: float, width: float, centre, force) -> np.ndarray:
    """`below` a ball with this width of its contact."""
    return below(poses, depth, contact.hertz(width / 2, force, centre, 12))
