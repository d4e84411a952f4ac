# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Prior covariance of the values that several cubes measure under a random surface traction."""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Index
from ..mechanics.traction_prior import TractionPrior

AMPLITUDE = 20e3
"""Prior standard deviation of the pressure on the surface, in Pa, before any value is measured. The
value is the pressure of a firm touch."""


def compute_covariance_matrix(
    traction_prior: TractionPrior,
    columns: Index,
    place: Array,
    angle: Array,
    variant: Index,
) -> Array:
    """Compute the prior covariance of C components of n cubes.

    Args:
        traction_prior: Prior covariances of traction and measured components.
        columns: Indices (C,) of the components in `COMPONENTS`.
        place: Positions (n, 2) of the cubes in m, on the skin laid flat in the x-y plane of a cube.
        angle: Rotations (n,) of the cubes about z, the normal of this plane, in rad.
        variant: Index (n,) of each cube's calibration in the measurement model of `traction_prior`.

    Returns:
        Covariance matrix (n C, n C) for a surface pressure of variance 1 Pa^2; all components of
        the first cube come first.
    """
    n = len(place)
    width = len(columns)
    first, second = np.triu_indices(n)
    pairs = traction_prior.compute_covariance(
        place[first] - place[second],
        angle[first],
        variant[first],
        angle[second],
        variant[second],
    )
    pairs = pairs[:, columns][:, :, columns]

    matrix = np.empty((n, width, n, width))
    matrix[second, :, first] = pairs.swapaxes(1, 2)
    matrix[first, :, second] = pairs
    # The covariance of a cube with itself is symmetric only up to rounding errors, so the mean of
    # this matrix and its transpose is used.
    cube = np.arange(n)
    own = pairs[first == second]
    transposed = own.swapaxes(1, 2)
    matrix[cube, :, cube] = (own + transposed) / 2
    return matrix.reshape(n * width, -1)
