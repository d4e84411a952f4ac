# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Robust least squares: weights that suppress outliers, and parameters that data do not determine.

A residual is the difference of a measured and a predicted value. Residuals are divided by their
scatter (standard deviation) before weights are computed.

Source: Huber & Ronchetti, Robust Statistics, ch. 7, also for the covariance.
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Mask

HUBER_LIMIT = 1.345
"""Residual r, in units of the residuals' standard deviation, above which Huber's weight of a
measurement falls as 1 / |r|.

With this limit the estimate has 95 % of the efficiency of least squares for normal noise.
"""

TUKEY_LIMIT = 4.685
"""Residual, in units of the residuals' standard deviation, from which on Tukey's weight of a
measurement is 0, so that it counts as an outlier.

With this limit the estimate has 95 % of the efficiency of least squares for normal noise.
"""

MAX_STEPS = 100
"""Maximum number of Gauss-Newton steps in one stage of the fit (see `STAGES`)."""

STAGES = {
    "plain": 1e-10,
    "huber": 1e-3,
    "tukey": 1e-9,
}
"""Stages of the fit in their order, each with a tolerance: least squares with equal weights
("plain"), with Huber's weights, and with Tukey's weights. A stage ends when a step changes the
parameters by at most the tolerance times their norm.

With Huber's weights the fit has a single minimum, with Tukey's it has several. Huber's stage only
has to lead near the right minimum for Tukey's stage, so its tolerance is larger.
"""

DIRECTION_TOLERANCE = 1e-6
"""Smallest singular value of the Jacobian matrix (derivatives of predictions with respect to
parameters, columns scaled to length 1) that counts as not 0, relative to the largest.

Measurements do not determine a combination of parameters that belongs to a smaller singular value.
"""

NORMAL_MEDIAN_RATIO = 1.4826
"""Ratio of the standard deviation of normally distributed residuals r to the median of |r|."""


def estimate_scatter(r: Array) -> float:
    """Estimate the scatter (standard deviation) of residuals r (R,) from the median of |r|.

    The median is hardly changed by outliers. The result is at least 1e-12, so that residuals can be
    divided by it even if all of them are 0.
    """
    size = np.abs(r)
    median = float(np.median(size))
    return max(NORMAL_MEDIAN_RATIO * median, 1e-12)


def compute_weights(stage: str, r: Array) -> Array:
    """Compute the weights of measurements (R,), from 0 to 1.

    Args:
        stage: "huber" for Huber's weights, "tukey" for Tukey's.
        r: Residuals (R,), in units of their scatter (standard deviation).
    """
    size = np.abs(r)
    if stage == "huber":
        # A tiny number avoids a division by 0 where a residual is 0.
        divisor = np.maximum(size, 1e-300)
        weights: Array = np.minimum(1, HUBER_LIMIT / divisor)
        return weights
    u = (r / TUKEY_LIMIT) ** 2
    inside = (1 - u) ** 2
    return np.where(size < TUKEY_LIMIT, inside, 0)


def solve_least_squares(a: Array, b: Array) -> Array:
    """Solve the linear least squares problem |a x - b|² = min for x (C,).

    Args:
        a: Matrix (R, C).
        b: Vector (R,).

    Returns:
        The solution x. If there are several, it is the one with the smallest norm, where each
        parameter is multiplied by the length of its column of a.
    """
    scaled, size = _scale_columns(a)
    x, *_ = np.linalg.lstsq(scaled, b, rcond=DIRECTION_TOLERANCE)
    solution: Array = x / size
    return solution


def find_null_space(jacobian: Array) -> Array:
    """Return a basis (C, H) of the changes of the parameters that change no measured value.

    Args:
        jacobian: Derivatives (R, C) of the predicted values with respect to the parameters. Its
            columns are scaled to length 1 first, so the changes are of scaled parameters.
    """
    scaled, _ = _scale_columns(jacobian)
    _, s, vt = np.linalg.svd(scaled, full_matrices=True)
    limit = DIRECTION_TOLERANCE * s[0]
    # If no parameter changes a predicted value, the largest singular value s[0] is 0, and so is the
    # rank.
    rank = int(np.sum(s > limit))
    directions: Array = vt[rank:].T
    return directions


def find_undetermined(null: Array, count: int) -> Mask:
    """Find the parameters that the measurements do not determine.

    Args:
        null: Basis (C, H) of the changes of the parameters that change no measured value.
        count: Number of parameters to examine, from the first on.

    Returns:
        For each examined parameter, whether one of the changes in `null` alters it (count,).
    """
    examined = null[:count]
    part = np.linalg.norm(examined, axis=1)
    undetermined: Mask = part > DIRECTION_TOLERANCE
    return undetermined


def compute_robust_covariance(
    jacobian: Array,
    r: Array,
    scale: float,
) -> Array:
    """Compute the covariance of parameters that were fitted with Tukey's weights.

    It is Huber's formula scale^2 <psi^2> / <psi'>^2 (J'J)^-1, corrected for the number of
    parameters. psi(r) is the residual times its weight, psi' its derivative, <> the mean.

    Args:
        jacobian: Derivatives J (R, C) of the predicted values, divided by their noise, with respect
            to the parameters.
        r: Residuals (R,), in units of their scatter.
        scale: Scatter (standard deviation) of the residuals, in units of the noise.

    Returns:
        Covariance (C, C) of the parameters.
    """
    # Tukey's psi (residual times its weight) is r (1 - u)² with u = (r / TUKEY_LIMIT)². Setting u
    # to 1 for outliers makes psi and its derivative 0 for them.
    is_inlier = np.abs(r) < TUKEY_LIMIT
    ratio = r / TUKEY_LIMIT
    u = np.where(is_inlier, ratio**2, 1)
    psi = r * (1 - u) ** 2
    psi_squared = np.mean(psi**2)
    slope = (1 - u) * (1 - 5 * u)
    psi_slope = np.mean(slope)
    null = find_null_space(jacobian)
    rank = jacobian.shape[1] - null.shape[1]
    n_residuals = len(r)
    dof = max(n_residuals - rank, 1)
    factor = psi_squared / psi_slope**2 * n_residuals / dof

    scaled, size = _scale_columns(jacobian)
    # The singular values of J'J are the squares of those of J, so the tolerance is squared, too.
    normal_matrix = scaled.T @ scaled
    tolerance = DIRECTION_TOLERANCE**2
    inverse = np.linalg.pinv(normal_matrix, rcond=tolerance)
    of_scaled = scale**2 * factor * inverse
    covariance: Array = of_scaled / np.outer(size, size)
    return covariance


def _scale_columns(matrix: Array) -> tuple[Array, Array]:
    """Scale the columns of a matrix (R, C) to length 1.

    Without the scaling, the units of the parameters would decide which of them count as determined.

    Returns:
        Scaled matrix, and the lengths of the columns before (C,). A column of zeros is unchanged,
        and its length is returned as 1.
    """
    size = np.linalg.norm(matrix, axis=0)
    size[size == 0] = 1
    return matrix / size, size
