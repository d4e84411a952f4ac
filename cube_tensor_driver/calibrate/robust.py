"""Least squares that forget outliers and know what the data leave open: steps and weights of `fit`.

Source: Huber & Ronchetti, Robust Statistics, ch. 7, also for the covariance.
"""

from __future__ import annotations

import numpy as np

HUBER, TUKEY = 1.345, 4.685
"""95 % efficient on normal noise."""
STEPS = 100
"""Of one stage at most."""
STAGES = {"plain": 1e-10, "huber": 1e-3, "tukey": 1e-9}
"""In order: relative change that ends a stage; Huber's only leads on."""
DIRECTION_TOLERANCE = 1e-6
"""A direction of parameters below this part of the strongest is not determined."""


def scatter(r: np.ndarray) -> float:
    """Standard deviation by the median of |r|; never 0, so that perfect data have a scale too."""
    return max(1.4826 * float(np.median(np.abs(r))), 1e-12)


def weights_of(stage: str, r: np.ndarray) -> np.ndarray:
    """Weights of residuals in units of their scatter, by Huber or by Tukey; same shape."""
    if stage == "huber":
        return np.minimum(1, HUBER / np.maximum(np.abs(r), 1e-300))
    return np.where(np.abs(r) < TUKEY, (1 - (r / TUKEY) ** 2) ** 2, 0)


def least_squares(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """x of a x = b for a (R, C) and b (R,), the smallest; directions that a does not determine stay
    put."""
    size = np.linalg.norm(a, axis=0)
    size[size == 0] = 1
    return np.linalg.lstsq(a / size, b, rcond=DIRECTION_TOLERANCE)[0] / size


def hidden_directions(jacobian: np.ndarray) -> np.ndarray:
    """(parameters, H) directions that change no reading."""
    size = np.linalg.norm(jacobian, axis=0)
    size[size == 0] = 1
    _, s, vt = np.linalg.svd(jacobian / size, full_matrices=True)
    return vt[int(np.sum(s > DIRECTION_TOLERANCE * s[0])) :].T if s[0] > 0 else vt.T


def touched(hidden: np.ndarray, count: int) -> np.ndarray:
    """(count,) bool: which of the first parameters a hidden direction moves."""
    return np.linalg.norm(hidden[:count], axis=1) > DIRECTION_TOLERANCE


def robust_covariance(jacobian: np.ndarray, r: np.ndarray, scale: float) -> np.ndarray:
    """(C, C) by Huber: scale^2 <psi^2> / <psi'>^2 (J'J)^-1, with the loss of degrees of freedom."""
    u = np.where(np.abs(r) < TUKEY, (r / TUKEY) ** 2, 1)
    psi2, slope = np.mean((r * (1 - u) ** 2) ** 2), np.mean((1 - u) * (1 - 5 * u))
    rank = jacobian.shape[1] - hidden_directions(jacobian).shape[1]
    factor = psi2 / slope**2 * len(r) / max(len(r) - rank, 1)
    size = np.linalg.norm(jacobian, axis=0)
    size[size == 0] = 1
    return (
        scale**2
        * factor
        * np.linalg.pinv((jacobian / size).T @ (jacobian / size), rcond=DIRECTION_TOLERANCE**2)
        / np.outer(size, size)
    )
