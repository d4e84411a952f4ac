"""Prior covariance of what several cubes measure under a random traction on the surface."""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Index
from ..mechanics.kernels import Kernels

AMPLITUDE = 20e3
"""Prior standard deviation of the pressure on the surface in Pa, that of a firm touch."""

_EXTRA_VARIANCES = (1e-6, 1e-3, 1e-2, 1e-1)
"""Relative increases of the variances that `make_positive_definite` tries in turn."""


def covariance_matrix(
    kernels: Kernels,
    columns: Index,
    place: Array,
    angle: Array,
    variant: Index,
) -> Array:
    """Compute the prior covariance of the components of n cubes, for a pressure of unit variance.

    Args:
        kernels: Kernels of the layer.
        columns: Indices (C,) of the components in `COMPONENTS`.
        place: Positions (n, 2) of the cubes on the unrolled skin, in m.
        angle: Rotations (n,) of the cubes about z, in rad.
        variant: Variants (n,) of the cubes in the measurement model.

    Returns:
        Covariance matrix (n C, n C).
    """
    n = len(place)
    width = len(columns)
    first, second = np.triu_indices(n)
    pairs = kernels.covariance(
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
    # The covariance of a cube with itself is symmetric only up to rounding.
    cube = np.arange(n)
    own = pairs[first == second]
    matrix[cube, :, cube] = (own + own.swapaxes(1, 2)) / 2
    return matrix.reshape(n * width, -1)


def make_positive_definite(covariance: Array) -> Array:
    """Increase the variances of a covariance matrix until it is positive definite.

    `Kernels` counts the covariance of cubes that are far apart as zero, and a matrix that is cut
    off in this way may have negative eigenvalues.
    """
    variances = np.diag(np.diag(covariance))
    for share in _EXTRA_VARIANCES:
        increased = covariance + share * variances
        try:
            np.linalg.cholesky(increased)
        except np.linalg.LinAlgError:
            continue
        break
    return np.asarray(increased)
