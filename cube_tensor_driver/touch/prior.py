"""Prior covariance of what several cubes see."""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Index
from ..mechanics.kernels import Kernels

AMPLITUDE = 20e3
"""Prior standard deviation of the pressure, Pa: that of a firm touch."""


def covariance_matrix(
    kernels: Kernels, columns: Index, place: Array, angle: Array, reading: Index
) -> Array:
    """(n C, n C) prior covariance of the components of cubes, for unit variance of the pressure."""
    n, width = len(place), len(columns)
    one, other = np.triu_indices(n)
    table = kernels.covariance(
        place[one] - place[other], angle[one], reading[one], angle[other], reading[other]
    )[:, columns][:, :, columns]
    matrix = np.empty((n, width, n, width))
    matrix[other, :, one] = table.swapaxes(1, 2)
    matrix[one, :, other] = table
    # A cube with itself is symmetric but for rounding.
    own = np.arange(n)
    matrix[own, :, own] = (table[one == other] + table[one == other].swapaxes(1, 2)) / 2
    return matrix.reshape(n * width, -1)


def positive(covariance: Array) -> Array:
    """The same with so much more variance of each component that all combinations have some. They
    lack it where cubes are so far apart that `Kernels` counts their covariance as zero."""
    for share in (1e-6, 1e-3, 1e-2, 1e-1):
        more = covariance + share * np.diag(np.diag(covariance))
        try:
            np.linalg.cholesky(more)
        except np.linalg.LinAlgError:
            continue
        break
    return more
