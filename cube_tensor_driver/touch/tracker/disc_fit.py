"""Fits Hertz contacts to what some cubes see, beside a Gaussian process for all else.

With the forces f of discs whose middles c and radii a are given, this is linear. The steps of c and
ln a are those of Gauss and Newton, with the covariance of what is left as weight::

    y = sum_j (R(c_j, a_j) + sum_k s_jk D_k(c_j, a_j)) f_j + H rest + e
    W = (alpha^2 K + S + N)^-1

K is the prior of kernels.py, N the noise of pad_noise.py. D moves pressure within a contact and
leaves its force and place: it makes it longer along x or along a diagonal, and emptier or fuller at
its rim. The shapes s have the covariance S, see SHAPE. alpha has the greatest evidence, the
likelihood with forces, places and sizes integrated over their priors: where contacts are like none
of these, alpha grows, and so do all standard deviations.

Source: K. L. Johnson, Contact Mechanics (1985), 4.2 (Hertz); D. J. C. MacKay, Bayesian
interpolation, Neural Computation 4 (1992) 415 (evidence).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ...core.arrays import Array, Index
from ...core.modes import COMPONENTS
from ...mechanics.kernels import DISC_SIZES
from ..inverse import SurfaceInverse
from ..pad_noise import GAIN_ERROR, pad_stresses
from ..prior import AMPLITUDE

USUAL_SIZE, SIZE_SPREAD = 0.8, 1.0
"""Radius of contacts over the depth, and the standard deviation of its logarithm, before anything
is measured."""
GREATEST_FORCE = 1e3
"""Prior standard deviation of a force, N: none that matters, so that no force is possible, too."""
ROUGH_ERROR = 0.1
"""Of every pad over the rms of its cube's pads, as long as a contact is far from its place: there
the linear problem is off by more than the gains, for pads that feel little, too."""
SHAPE = np.array([0.7, 0.7, 1.0])
"""Standard deviation of a contact's shapes. Two balls that touch each other have 1.1 in length, a
rigid flat punch has 1 in flatness."""
SHIFT, WIDER = 0.5, 0.2
"""Parts of a contact's radius and of its logarithm by which D moves pressure."""
COLD, WARM, LOOK = 16, 3, 0
"""Steps for a contact that has just begun, for one that goes on, and to see how likely it is."""
FARTHEST = 1.5
"""Pitches by which a contact moves at most, each way. From the wrong side of a cube to the right
one it is up to one. A fit that is held up just before its place looks as likely as one that gets
there, as its evidence is that of the linear problem."""
FINE = 6
"""Of the steps of a contact that has just begun, those that are left for the fine noise."""
SETTLED = 0.02
"""A step that moves a contact by less, over the depth, and changes its size by a smaller part, is
the last but one: what follows it is of second order."""
_TRIED = {
    COLD: np.array([0.1, 0.3, 1.0, 3.0, 10.0]),
    WARM: np.array([0.5, 1.0, 2.0]),
    LOOK: np.array([1.0]),
}
"""Factors of alpha that are compared at a time."""
_STEPS = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], float)
_AROUND = np.concatenate([_STEPS[1:], np.array([[1, 1], [-1, -1], [1, -1], [-1, 1]]) / np.sqrt(2)])


class Scan:
    """What some cubes see: values, their noise and prior, laid flat.

    y: (D,) known values; noise, prior: (D, D); sees_all: nothing is unknown

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
        self.reading = inverse.reading[cubes]
        known = np.isfinite(values) & inverse.observed[cubes]
        self._known = known.ravel()
        self._by_pad = np.where(known[:, :, None], inverse.by_pad[cubes], 0.0)
        self._square = pad_stresses(self._by_pad, known, values)[..., None] ** 2
        self.y = values.ravel()[self._known]
        self.noise = self._covariance(GAIN_ERROR**2 * self._square)
        self.prior = prior[np.ix_(self._known, self._known)]
        self.size = len(self.y)
        self.sees_all = self.size == len(values) * len(COMPONENTS)

    @cached_property
    def rough(self) -> Array:
        """(D, D) noise with ROUGH_ERROR instead of the gains'."""
        return self._covariance(ROUGH_ERROR**2 * self._square.mean(axis=1, keepdims=True))

    def _covariance(self, errors: Array) -> Array:
        """(D, D) of pads with these variances (n, P, 1) beside their noise, over its variance."""
        own = self._by_pad @ ((1 + errors) * self._by_pad.swapaxes(1, 2))
        n, width, _ = own.shape
        blocks = np.zeros((n, width, n, width))
        blocks[np.arange(n), :, np.arange(n), :] = own
        return blocks.reshape(n * width, -1)[np.ix_(self._known, self._known)]

    def responses(self, middles: Array, size: float) -> Array:
        """(K, D, 3) of contacts with force 1 N at K places (K, 2)."""
        place = (self.place - middles[:, None]).reshape(-1, 2)
        angle, reading = np.tile(self.angle, len(middles)), np.tile(self.reading, len(middles))
        seen = self.kernels.response(place, angle, reading, size)
        return seen[:, self.columns].reshape(len(middles), -1, 3)[:, self._known]

    def cross(self, points: Array) -> Array:
        """(points, 3, D) covariance of the traction at points with the values."""
        offset = (self.place[None] - points[:, None]).reshape(-1, 2)
        angle, reading = np.tile(self.angle, len(points)), np.tile(self.reading, len(points))
        table = self.kernels.cross(offset, angle, reading)[:, self.columns]
        table = table.reshape(len(points), -1, 3)[:, self._known]
        return table.swapaxes(1, 2)


class Fitted(NamedTuple):
    """Contacts middles (J, 2), sizes (J,), forces (J, 3), what is left (alpha, factor, weighted
    rest W r) and the linearised problem: J (D, 6 contacts), J' W J + prior, and what their shapes
    make, D f times SHAPE (D, 3 contacts).

    score: -2 ln of the evidence (Laplace), to compare fits of the same values, also with other
        numbers of contacts
    """

    middles: Array
    sizes: Array
    forces: Array
    alpha: float
    factor: tuple[Array, bool]
    rest: Array
    jacobian: Array
    shapes: Array
    normal: Array
    score: float

    def covariance(self, j: int) -> Array:
        """(9, 9) of contact j: force, place, ln a, and its shapes over SHAPE.

        The shapes s are a part of the noise in W; so with M = D f SHAPE and Q = M' W J::

            cov(x) = (J' W J + prior)^-1,   cov(s, x) = -Q cov(x),
            cov(s) = 1 - M' W M + Q cov(x) Q'
        """
        shapes = self.shapes[:, 3 * j : 3 * j + 3]
        weighted = cho_solve(self.factor, shapes)
        cross = weighted.T @ self.jacobian
        inverse = np.linalg.inv(self.normal)
        both = cross @ inverse
        own = slice(6 * j, 6 * j + 6)
        whole = np.empty((9, 9))
        whole[:6, :6] = inverse[own, own]
        whole[6:, :6] = -both[:, own]
        whole[:6, 6:] = whole[6:, :6].T
        whole[6:, 6:] = np.eye(3) - shapes.T @ weighted + both @ cross.T
        return whole


def fit(scan: Scan, middles: Array, sizes: Array, alpha: float, steps: int) -> Fitted:
    """Fit contacts, beginning at middles (J, 2) m, sizes (J,) m and alpha, Pa.

    Contacts that have just begun have the rough noise until they settle, or FINE steps are left.
    A step of ln a that takes back more than half of the last one goes half the way: size and
    fullness look alike, and S is that of the size before, so fits of flat punches swing.
    steps: COLD, WARM or LOOK. The columns of the problem are, per contact, f_x, f_y, f_z, c_x,
    c_y, ln a.
    """
    depth, count = scan.kernels.depth, len(middles)
    middles, logs = middles.copy(), np.log(sizes)
    start, farthest = middles.copy(), FARTHEST * scan.pitch
    low, high = np.log(np.array([DISC_SIZES[1], DISC_SIZES[-3]]) * depth)
    usual = np.log(USUAL_SIZE * depth)
    prior = np.zeros(6 * count)
    prior[5::6] = SIZE_SPREAD**-2
    prior[3::6] = prior[4::6] = scan.pitch**-2
    for axis in range(3):
        prior[axis::6] = GREATEST_FORCE**-2
    forces, before, score = np.zeros((count, 3)), np.inf, np.inf
    grown = np.zeros(count)
    last, rough = False, steps != WARM
    for step in range(steps + 1):
        last |= step == steps
        parts = [
            Parts.of(scan.responses, depth, m, np.exp(a))
            for m, a in zip(middles, logs, strict=True)
        ]
        response = np.concatenate([part.response for part in parts], axis=1)
        shapes = [part.shapes @ force for part, force in zip(parts, forces, strict=True)]
        shape = np.concatenate(shapes).T  # (D, 3 contacts)
        noise = (scan.rough if rough else scan.noise) + shape @ shape.T
        factor = _factor(scan, noise, alpha)
        weighted = cho_solve(factor, response)
        forces = np.linalg.lstsq(response.T @ weighted, weighted.T @ scan.y, rcond=None)[0]
        forces = forces.reshape(count, 3)
        jacobian = np.empty((scan.size, 6 * count))
        for j, (part, force) in enumerate(zip(parts, forces, strict=True)):
            jacobian[:, 6 * j : 6 * j + 3] = part.response
            jacobian[:, 6 * j + 3 : 6 * j + 6] = (part.slopes @ force).T
        residual = scan.y - response @ forces.ravel()
        if last or (steps == COLD and not rough and step % 2 == 0):
            before = alpha
            tried = alpha * _TRIED[steps]
            alpha, score, factor = _best_alpha(scan, noise, jacobian, residual, prior, tried)
        weighted = cho_solve(factor, jacobian)
        normal = jacobian.T @ weighted + np.diag(prior)
        normal[np.diag_indices(len(normal))] *= 1 + 1e-9
        if last:
            break
        right = weighted.T @ residual
        right[5::6] -= (logs - usual) * SIZE_SPREAD**-2
        change = np.linalg.lstsq(normal, right, rcond=None)[0].reshape(count, 6)
        moved = max(np.abs(change[:, 3:5]).max() / depth, np.abs(change[:, 5]).max())
        swings = change[:, 5] * grown < -(grown**2) / 2
        change[swings, 5] /= 2
        grown = change[:, 5].copy()
        settled = moved < SETTLED and (steps == WARM or rough or alpha == before)
        last = settled and not rough
        rough &= not settled and step < steps - FINE
        middles += np.clip(change[:, 3:5], -depth / 2, depth / 2)
        middles = np.clip(middles, start - farthest, start + farthest)
        logs = np.clip(logs + np.clip(change[:, 5], -0.5, 0.5), low, high)
    rest = cho_solve(factor, residual)
    return Fitted(
        middles, np.exp(logs), forces, alpha, factor, rest, jacobian, shape, normal, score
    )


class Parts(NamedTuple):
    """What a contact of force 1 N makes, and how that changes with its place and shape.

    response: (D, 3); slopes: (3, D, 3) by c_x, c_y and ln a
    shapes: (3, D, 3) D, each times its standard deviation
    """

    response: Array
    slopes: Array
    shapes: Array

    @classmethod
    def of(
        cls, responses: Callable[[Array, float], Array], depth: float, middle: Array, size: float
    ) -> Parts:
        """responses: (K, D, 3) of places (K, 2) and a radius, as `Scan.responses`."""
        step = depth / 50
        here = responses(middle + np.concatenate([step * _STEPS, SHIFT * size * _AROUND]), size)
        narrower, wider = (
            responses(middle[None], size * np.exp(share))[0] for share in (-WIDER, WIDER)
        )
        response = here[0]
        ahead = here[1:5].reshape(2, 2, *response.shape)
        along = (ahead[:, 0] - ahead[:, 1]) / (2 * step)
        slopes = np.concatenate([along, (wider - narrower)[None] / (2 * WIDER)])
        axes = here[5:].reshape(4, 2, *response.shape).sum(axis=1) / 4
        same_size = (1 - np.exp(-2 * WIDER)) / (np.exp(2 * WIDER) - np.exp(-2 * WIDER))
        mixed = same_size * wider + (1 - same_size) * narrower
        shapes = np.stack([axes[0] - axes[1], axes[2] - axes[3], response - mixed])
        return cls(response, slopes, SHAPE[:, None, None] * shapes)

    def by_parameters(self, force: Array) -> Array:
        """(D, 9) derivatives of a contact with this force, N, by f, c, ln a and its shapes."""
        moved = np.concatenate([self.slopes, self.shapes]) @ force
        return np.concatenate([self.response, moved.T], axis=1)


def _factor(scan: Scan, noise: Array, alpha: float) -> tuple[Array, bool]:
    # The transpose is the same matrix, in the order of LAPACK.
    matrix = (alpha**2 * scan.prior + noise).T
    return cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)


def _best_alpha(
    scan: Scan, noise: Array, jacobian: Array, residual: Array, prior: Array, alphas: Array
) -> tuple[float, float, tuple[Array, bool]]:
    """The one of some alphas with the greatest evidence, its score and its factor.

    prior: precisions (P,) of what the columns of the jacobian belong to
    """
    columns = jacobian / np.sqrt(prior)
    best = (AMPLITUDE, np.inf, (np.empty((0, 0)), True))
    for alpha in np.unique(np.clip(alphas, 1e-4 * AMPLITUDE, AMPLITUDE)).tolist():
        factor = _factor(scan, noise, alpha)
        weighted = cho_solve(factor, np.column_stack([columns, residual]))
        normal = columns.T @ weighted[:, :-1] + np.eye(columns.shape[1])
        projected = columns.T @ weighted[:, -1]
        misfit = residual @ weighted[:, -1] - projected @ np.linalg.solve(normal, projected)
        logs = 2 * np.log(np.diag(factor[0])).sum() + np.linalg.slogdet(normal)[1]
        if misfit + logs < best[1]:
            best = (alpha, float(misfit + logs), factor)
    return best
