"""Fits Hertz contacts to what some cubes see, beside a Gaussian process for all else.

With the forces f of discs whose middles c and radii a are given, this is linear. The steps of c and
ln a are those of Gauss and Newton, with the covariance of what is left as weight::

    y = sum_j R(c_j, a_j) f_j + H rest + e,      W = (alpha^2 K + N)^-1

K is the prior of kernels.py, N the noise. alpha has the greatest (restricted) likelihood: where
contacts are no Hertz contacts, it grows, and so do all standard deviations.

Source: K. L. Johnson, Contact Mechanics (1985), 4.2 (Hertz); N. A. C. Cressie, Statistics for
Spatial Data (1993), 2.6.1 (restricted likelihood).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from .inverse import AMPLITUDE, MODEL_ERROR, SurfaceInverse
from .kernels import SIZES

Array = NDArray[np.float64]
Index = NDArray[np.intp]

USUAL_SIZE, SIZE_SPREAD = 0.8, 1.0
"""Radius of contacts over the depth, and the standard deviation of its logarithm, before anything
is measured."""
GREATEST_FORCE = 1e3
"""Prior standard deviation of a force, N: none that matters, so that no force is possible, too."""
OF_OTHERS = 1.3
"""Part of the mean size of a cube's components that has the model's error in each of them, too: an
error of a pad's gain turns the great ones into the small ones."""
COLD, WARM = 8, 3
"""Steps for a contact that has just begun, and for one that goes on."""
_TRIED = {COLD: np.array([0.1, 0.3, 1.0, 3.0, 10.0]), WARM: np.array([0.5, 1.0, 2.0])}
"""Factors of alpha that are compared at a time."""


class Scan:
    """What some cubes see: values, their noise and prior, laid flat.

    y: (D,) known values; noise, prior: (D, D)

    Parameters: values: (n, C) of these cubes, NaN where unknown. prior: (n C, n C) their
    covariance. place: (n, 2) m, angle: (n,) rad, as `SurfaceInverse.flattened` gives them.
    """

    def __init__(
        self,
        inverse: SurfaceInverse,
        values: Array,
        prior: Array,
        cubes: Index,
        place: Array,
        angle: Array,
    ) -> None:
        self.kernels, self.columns = inverse.kernels, inverse.columns
        self.pitch, self.place, self.angle = inverse.pitch, place, angle
        known = np.isfinite(values) & inverse.observed[cubes]
        self._known = known.ravel()
        filled = np.where(known, values, 0.0)
        rms = np.sqrt((filled**2).sum(axis=1) / np.maximum(known.sum(axis=1), 1))
        error = MODEL_ERROR**2 * (filled**2 + (OF_OTHERS * rms[:, None]) ** 2)
        n, width = values.shape
        one = np.arange(n)
        blocks = np.zeros((n, width, n, width))
        blocks[one, :, one, :] = np.nan_to_num(inverse.noise[cubes])
        noise: Array = blocks.reshape(n * width, -1)
        noise[np.diag_indices(n * width)] += error.ravel()
        both = np.ix_(self._known, self._known)
        self.y, self.noise = filled.ravel()[self._known], noise[both]
        self.prior = prior[both]
        self.size = len(self.y)

    def response(self, middle: Array, size: float) -> Array:
        """(D, 3) of a contact with force 1 N."""
        seen = self.kernels.response(self.place - middle, self.angle, size)[:, self.columns]
        return seen.reshape(-1, 3)[self._known]

    def cross(self, points: Array) -> Array:
        """(points, 3, D) covariance of the traction at points with the values."""
        offset = (self.place[None] - points[:, None]).reshape(-1, 2)
        angle = np.tile(self.angle, len(points))
        table = self.kernels.cross(offset, angle)[:, self.columns]
        table = table.reshape(len(points), -1, 3)[:, self._known]
        return table.swapaxes(1, 2)


class Fitted(NamedTuple):
    """Contacts middles (J, 2), sizes (J,), forces (J, 3), what is left (alpha, factor, weighted
    rest W r) and the linearised problem: J (D, 6 contacts), J' W J + prior."""

    middles: Array
    sizes: Array
    forces: Array
    alpha: float
    factor: tuple[Array, bool]
    rest: Array
    jacobian: Array
    normal: Array


def fit(scan: Scan, middles: Array, sizes: Array, alpha: float, steps: int) -> Fitted:
    """Fit contacts, beginning at middles (J, 2) m, sizes (J,) m and alpha, Pa.

    steps: COLD or WARM. The columns of the problem are, per contact, f_x, f_y, f_z, c_x, c_y, ln a.
    """
    depth, count = scan.kernels.depth, len(middles)
    middles, logs = middles.copy(), np.log(sizes)
    start = middles.copy()
    low, high = np.log(np.array([SIZES[1], SIZES[-3]]) * depth)
    usual = np.log(USUAL_SIZE * depth)
    prior = np.zeros(6 * count)
    prior[5::6] = SIZE_SPREAD**-2
    prior[3::6] = prior[4::6] = scan.pitch**-2
    for axis in range(3):
        prior[axis::6] = GREATEST_FORCE**-2
    for step in range(steps + 1):
        response = np.concatenate(
            [scan.response(m, np.exp(a)) for m, a in zip(middles, logs, strict=True)], axis=1
        )
        factor = _factor(scan, alpha)
        weighted = cho_solve(factor, response)
        forces = np.linalg.lstsq(response.T @ weighted, weighted.T @ scan.y, rcond=None)[0]
        forces = forces.reshape(count, 3)
        jacobian = np.empty((scan.size, 6 * count))
        for j in range(count):
            jacobian[:, 6 * j : 6 * j + 3] = response[:, 3 * j : 3 * j + 3]
            jacobian[:, 6 * j + 3 : 6 * j + 6] = _slopes(scan, middles[j], logs[j], forces[j])
        residual = scan.y - response @ forces.ravel()
        if step == steps or (steps == COLD and step % 2 == 0):
            alpha = _best_alpha(scan, jacobian, residual, alpha * _TRIED[steps])
            factor = _factor(scan, alpha)
        weighted = cho_solve(factor, jacobian)
        normal = jacobian.T @ weighted + np.diag(prior)
        normal[np.diag_indices(len(normal))] *= 1 + 1e-9
        if step == steps:
            break
        right = weighted.T @ residual
        right[5::6] -= (logs - usual) * SIZE_SPREAD**-2
        change = np.linalg.lstsq(normal, right, rcond=None)[0].reshape(count, 6)
        middles += np.clip(change[:, 3:5], -depth / 2, depth / 2)
        middles = np.clip(middles, start - scan.pitch, start + scan.pitch)
        logs = np.clip(logs + np.clip(change[:, 5], -0.5, 0.5), low, high)
    rest = cho_solve(factor, residual)
    return Fitted(middles, np.exp(logs), forces, alpha, factor, rest, jacobian, normal)


def _factor(scan: Scan, alpha: float) -> tuple[Array, bool]:
    return cho_factor(alpha**2 * scan.prior + scan.noise, lower=True)


def _slopes(scan: Scan, middle: Array, log_size: float, force: Array) -> Array:
    """(D, 3) derivatives of what a contact makes by c_x, c_y and ln a."""
    step, share = scan.kernels.depth / 50, 0.02
    slopes = np.empty((scan.size, 3))
    for axis in (0, 1):
        ahead = step * np.eye(2)[axis]
        difference = scan.response(middle + ahead, np.exp(log_size)) - scan.response(
            middle - ahead, np.exp(log_size)
        )
        slopes[:, axis] = difference @ force / (2 * step)
    wider, narrower = (scan.response(middle, np.exp(log_size + d)) for d in (share, -share))
    slopes[:, 2] = (wider - narrower) @ force / (2 * share)
    return slopes


def _best_alpha(scan: Scan, jacobian: Array, residual: Array, alphas: Array) -> float:
    """The one of some alphas with the greatest restricted likelihood."""
    tried = np.clip(alphas, 1e-4 * AMPLITUDE, AMPLITUDE)
    scale = np.linalg.norm(jacobian, axis=0)
    columns = jacobian / np.where(scale > 0, scale, 1.0)
    scores = []
    for one in tried:
        factor = _factor(scan, one)
        weighted = cho_solve(factor, np.column_stack([columns, residual]))
        normal = columns.T @ weighted[:, :-1] + 1e-12 * np.eye(columns.shape[1])
        projected = columns.T @ weighted[:, -1]
        misfit = (
            residual @ weighted[:, -1]
            - projected @ np.linalg.lstsq(normal, projected, rcond=None)[0]
        )
        logs = 2 * np.log(np.diag(factor[0])).sum() + np.linalg.slogdet(normal)[1]
        scores.append(misfit + logs)
    return float(tried[int(np.argmin(scores))])
