"""Robust least squares: weights that suppress outliers, and the directions that data leave open.

Source: Huber & Ronchetti, Robust Statistics, ch. 7, also for the covariance.
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Mask

HUBER_LIMIT = 1.345
"""Residual, in units of the scatter, above which Huber's weight falls as 1 / |r|.

The estimate is 95 % efficient for normal noise.
"""

TUKEY_LIMIT = 4.685
"""Residual, in units of the scatter, from which on Tukey's weight is 0.

The estimate is 95 % efficient for normal noise.
"""

MAX_STEPS = 100
"""Maximum number of Gauss-Newton steps in one stage."""

STAGES = {"plain": 1e-10, "huber": 1e-3, "tukey": 1e-9}
"""Stages of the fit in their order, each with the relative change of the parameters that ends it.

Huber's stage only has to lead into the neighbourhood of the solution. It has one minimum, while
Tukey's weights find the nearest of several.
"""

DIRECTION_TOLERANCE = 1e-6
"""Smallest singular value, relative to the largest, of a direction of the parameters that counts as
determined."""

NORMAL_MEDIAN_RATIO = 1.4826
"""Ratio of the standard deviation to the median of |r| for normal noise."""


def estimate_scatter(r: Array) -> float:
    """Estimate the scatter (standard deviation) of residuals from the median of |r|.

    The result is never 0, so that perfect data have a scale, too.
    """
    median = float(np.median(np.abs(r)))
    return max(NORMAL_MEDIAN_RATIO * median, 1e-12)


def compute_weights(stage: str, r: Array) -> Array:
    """Compute the weights, by Huber or by Tukey, of residuals in units of their scatter."""
    size = np.abs(r)
    if stage == "huber":
        # The smallest float above 0 avoids a division by 0 for a perfect fit.
        weights: Array = np.minimum(1, HUBER_LIMIT / np.maximum(size, 1e-300))
        return weights
    u = (r / TUKEY_LIMIT) ** 2
    return np.where(size < TUKEY_LIMIT, (1 - u) ** 2, 0)


def least_squares(a: Array, b: Array) -> Array:
    """Solve a x = b for a (R, C) and b (R,) in the sense of least squares.

    Directions that a does not determine are 0.
    """
    scaled, size = _scale_columns(a)
    x, *_ = np.linalg.lstsq(scaled, b, rcond=DIRECTION_TOLERANCE)
    solution: Array = x / size
    return solution


def null_space(jacobian: Array) -> Array:
    """Return a basis (parameters, H) of the changes of scaled parameters that no reading shows."""
    scaled, _ = _scale_columns(jacobian)
    _, s, vt = np.linalg.svd(scaled, full_matrices=True)
    # If no parameter changes a reading, every direction belongs to the null space.
    rank = 0
    if s[0] > 0:
        rank = int(np.sum(s > DIRECTION_TOLERANCE * s[0]))
    directions: Array = vt[rank:].T
    return directions


def find_undetermined(null: Array, count: int) -> Mask:
    """Return which of the first parameters (count,) the readings do not determine.

    These are the parameters that a direction of the null space changes.
    """
    part = np.linalg.norm(null[:count], axis=1)
    undetermined: Mask = part > DIRECTION_TOLERANCE
    return undetermined


def robust_covariance(
    jacobian: Array,
    r: Array,
    scale: float,
) -> Array:
    """Compute Huber's covariance scale^2 <psi^2> / <psi'>^2 (J'J)^-1 of Tukey's estimate.

    It is corrected for the number of parameters.

    Args:
        jacobian: Derivatives J (R, C) of the whitened predictions.
        r: Residuals (R,) in units of the scatter.
        scale: Scatter.

    Returns:
        Covariance (C, C).
    """
    # u is 1 for outliers, for which psi and its slope are then 0.
    is_inlier = np.abs(r) < TUKEY_LIMIT
    u = np.where(is_inlier, (r / TUKEY_LIMIT) ** 2, 1)
    psi_squared = np.mean((r * (1 - u) ** 2) ** 2)
    psi_slope = np.mean((1 - u) * (1 - 5 * u))
    rank = jacobian.shape[1] - null_space(jacobian).shape[1]
    dof = max(len(r) - rank, 1)
    factor = psi_squared / psi_slope**2 * len(r) / dof

    scaled, size = _scale_columns(jacobian)
    # The tolerance holds for singular values of J, which are squared in J'J.
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=DIRECTION_TOLERANCE**2)
    covariance: Array = scale**2 * factor * inverse / np.outer(size, size)
    return covariance


def _scale_columns(matrix: Array) -> tuple[Array, Array]:
    """Return a matrix with columns of length 1, and their lengths before; zero columns stay.

    Without it, the units of the parameters would decide which of them count as determined.
    """
    size = np.linalg.norm(matrix, axis=0)
    size[size == 0] = 1
    return matrix / size, size
