"""Contacts from the values of all cubes: discs that press, and a Gaussian process for the rest.

A contact is narrow, and a prior that is the same everywhere does not know that. So the traction is
the sum of Hertz contacts (force f, middle c, radius a) and of what is left, with the covariance
alpha^2 K of kernels.py. Given all (c, a) this is linear. The steps of c and ln a are those of
Gauss and Newton, with the covariance of what is left as weight::

    y = sum_j R(c_j, a_j) f_j + H rest + e,      W = (alpha^2 K + N)^-1

alpha has the greatest (restricted) likelihood: where contacts are no Hertz contacts, it grows, and
so do all standard deviations. Force, place and moment are functionals of the whole traction within
reach of the contact, discs and rest alike; their variance is that of universal kriging, with
k = cov(rest's part, y), J = the derivatives of y and b those of the functional by (f, c, ln a)::

    k_LL - k' W k + (b - J' W k)' (J' W J + prior)^-1 (b - J' W k)

Source: N. A. C. Cressie, Statistics for Spatial Data (1993), 3.4 (universal kriging) and 2.6.1
(restricted likelihood); K. L. Johnson, Contact Mechanics (1985), 4.2 (Hertz).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree

from .inverse import (
    AMPLITUDE,
    MODEL_ERROR,
    SurfaceInverse,
    TractionField,
    covariance_matrix,
    square,
)
from .kernels import LENGTHS, SHEAR, SIZES, hertz_pressure

Array = NDArray[np.float64]
Index = NDArray[np.intp]

NEAR = 16
"""Cubes next to a contact that it is computed from."""
MOST = 10
"""Contacts at a time."""
ADDED, DROPPED = 0.2, 0.1
"""A contact begins where what is left of the pressure exceeds this part of its greatest, and ends
where its own falls below that part: two limits, so that nothing flickers."""
APART, MERGED = 1.0, 0.7
"""Pitches between contacts from which on a second one begins, and below which two are one."""
VALLEY, NO_VALLEY = 0.8, 0.92
"""Between two contacts the pressure at the cubes' depth falls below this part of the fainter one's;
two between which it does not fall below the second number become one."""
USUAL_SIZE, SIZE_SPREAD = 0.8, 1.0
"""Radius of contacts over the depth, and the standard deviation of its logarithm, before anything
is measured."""
MUCH_LEFT = 0.02
"""Alpha over AMPLITUDE from which on a contact counts as no Hertz contact."""
GREATEST_FORCE = 1e3
"""Prior standard deviation of a force, N: none that matters, so that no force is possible, too."""
OF_OTHERS = 1.3
"""Part of the mean size of a cube's components that has the model's error in each of them, too: an
error of a pad's gain turns the great ones into the small ones."""
FINER = 8
"""Places along the side of a point's square over which a disc's traction is averaged."""
_REACH = 12.0
"""Depths beyond which a contact is not seen."""
_COLD, _WARM = 8, 3
"""Steps for a contact that has just begun, and for one that goes on."""
_TRIED_COLD = np.array([0.1, 0.3, 1.0, 3.0, 10.0])
_TRIED_WARM = np.array([0.5, 1.0, 2.0])
"""Factors of alpha that are compared at a time."""


class TrackedContact(NamedTuple):
    """One contact in the skin's parent frame, with standard deviations.

    id: the same from first touch to last; position: (3,) m, where the line of action of the normal
    force meets the surface; normal: (3,) out of the skin; force: (3,) N on the skin
    normal_force: N, pressing is positive; shear_force: N
    moment: about the normal, N m; area: of the Hertz contact that fits best, m^2
    """

    id: int
    position: Array
    normal: Array
    force: Array
    normal_force: float
    shear_force: float
    moment: float
    area: float
    position_uncertainty: float
    force_uncertainty: float
    shear_uncertainty: float
    moment_uncertainty: float
    area_uncertainty: float


@dataclass
class _Disc:
    """A Hertz contact in the frame of its home, the nearest cube.

    place: (2,) m; size: radius, m; force: (3,) N; alpha: Pa, of what is left around it
    result: what is published of it
    """

    id: int
    home: int
    place: Array
    size: float
    force: Array
    alpha: float
    result: TrackedContact | None = None


class Touches:
    """Follows the contacts of a skin from scan to scan.

    field: of the newest scan, discs included; deviation is that of what is left

    Parameters: inverse: of the skin. least: pressure at the cubes' depth that counts as contact,
    Pa.
    """

    def __init__(self, inverse: SurfaceInverse, least: float) -> None:
        self._inverse, self._least = inverse, least
        self._tree = cKDTree(inverse.poses.position)
        self._point_tree = cKDTree(inverse.points)
        self._discs: list[_Disc] = []
        self._next_id = 0
        self._memory: dict[tuple[int, ...], Array] = {}
        self.field: TractionField | None = None

    def update(self, values: Array) -> list[TrackedContact]:
        """Contacts of the newest values (cubes, 15), NaN where unknown; strongest first.

        Time is bounded: MOST contacts, and a fixed number of steps for each.
        """
        y = self._inverse.scaled(values)
        self._fit(y, self._discs, _WARM)
        self._sort_out()
        tried: list[Array] = []
        for _ in range(MOST + 1):
            rest = self._inverse.field_of(y - self._seen(self._discs))
            below = rest.below + self._below(self._discs)
            self.field = self._with_discs(rest, below)
            if self._merge(below, y):
                continue
            start = self._start(rest.below, below, tried)
            if start is None or len(self._discs) >= MOST:
                break
            tried.append(self._inverse.points[start])
            disc = self._new(start)
            group = self._group(disc)
            self._discs.append(disc)
            self._fit(y, [*group, disc], _COLD)
            self._sort_out()
        self._add_rest(rest, below)
        contacts = [disc.result for disc in self._discs if disc.result is not None]
        return sorted(contacts, key=lambda contact: -contact.normal_force)

    def _add_rest(self, rest: TractionField, below: Array) -> None:
        """Force and place of contacts that are no Hertz contacts: with all that is left nearby.

        The few cubes of a fit do not reach over a wide contact; the windows of the field do.
        """
        middles = np.array([self._middle(disc) for disc in self._discs])
        for number, disc in enumerate(self._discs):
            if disc.result is None or disc.alpha < MUCH_LEFT * AMPLITUDE:
                continue
            points, place, turn = self._points_around(disc)
            apart = np.linalg.norm(self._inverse.points[points][:, None] - middles, axis=2)
            mine = apart.argmin(axis=1) == number
            mine &= below[points] > DROPPED * below[points[mine]].max(initial=0.0)
            load = np.einsum("nji,nj->ni", turn[mine], rest.traction[points[mine]])
            load *= self._inverse.area
            force = disc.force + load.sum(axis=0)
            if not force[2] < 0:
                continue
            shift = place[mine].T @ load[:, 2] / force[2]
            rotation = self._inverse.poses.rotation[disc.home]
            disc.result = disc.result._replace(
                position=middles[number] + rotation[:, :2] @ shift,
                force=rotation @ force,
                normal_force=float(-force[2]),
                shear_force=float(np.hypot(force[0], force[1])),
            )

    def _merge(self, below: Array, y: Array) -> bool:
        """End the younger one of two contacts without a valley between them; whether there are."""
        for older, younger in itertools.combinations(self._discs, 2):
            if self._valley(self._middle(older), self._middle(younger), below) > NO_VALLEY:
                self._discs.remove(younger)
                self._fit(y, [older], _COLD)
                return True
        return False

    def _valley(self, here: Array, there: Array, below: Array) -> float:
        """The least pressure at the cubes' depth between two places, over the fainter one's."""
        places = here + np.linspace(0, 1, 9)[:, None] * (there - here)
        pressure = below[self._point_tree.query(places)[1]]
        return float(pressure.min() / max(min(pressure[0], pressure[-1]), 1e-9))

    def _start(self, rest: Array, below: Array, tried: list[Array]) -> int | None:
        """The point where the next contact begins: the highest of what is left, behind a valley
        from all others; None: nowhere."""
        limit = max(self._least, ADDED * float(below.max(initial=0.0)))
        allowed = rest > limit
        points = self._inverse.points
        middles = [self._middle(disc) for disc in self._discs]
        for middle in [*tried, *middles]:
            allowed &= np.linalg.norm(points - middle, axis=1) > APART * self._inverse.pitch
        for candidate in np.argsort(-np.where(allowed, rest, -np.inf))[: allowed.sum()].tolist():
            place = points[candidate]
            if all(self._valley(middle, place, below) < VALLEY for middle in middles):
                return int(candidate)
        return None

    def _new(self, point: int) -> _Disc:
        inverse = self._inverse
        home = int(inverse.cube[point])
        offset = inverse.poses.rotation[home].T @ (
            inverse.points[point] - inverse.poses.position[home]
        )
        size = USUAL_SIZE * inverse.depth
        self._next_id += 1
        return _Disc(self._next_id - 1, home, offset[:2], size, np.zeros(3), 0.05 * AMPLITUDE)

    def _group(self, disc: _Disc) -> list[_Disc]:
        """Other contacts that share cubes with this one."""
        reach, middle = 4 * self._inverse.pitch, self._middle(disc)
        return [o for o in self._discs if np.linalg.norm(self._middle(o) - middle) < reach]

    def _sort_out(self) -> None:
        """End contacts that pull, are faint or lie in another one."""
        strongest = 0.0
        peaks = {}
        for disc in self._discs:
            peak = self._inverse.kernels.disc_pressure(np.zeros((1, 2)), disc.size, disc.force)
            peaks[disc.id] = float(peak[0])
            strongest = max(strongest, peaks[disc.id])
        limit = max(self._least / 2, DROPPED * strongest)
        kept: list[_Disc] = []
        for disc in sorted(self._discs, key=lambda one: one.id):
            apart = [np.linalg.norm(self._middle(disc) - self._middle(one)) for one in kept]
            alone = min(apart, default=np.inf) >= MERGED * self._inverse.pitch
            if peaks[disc.id] > limit and alone:
                kept.append(disc)
        self._discs = kept

    def _middle(self, disc: _Disc) -> Array:
        """(3,) m on the surface."""
        poses = self._inverse.poses
        local = np.array([*disc.place, self._inverse.depth])
        return poses.position[disc.home] + poses.rotation[disc.home] @ local

    def _seen(self, discs: list[_Disc]) -> Array:
        """(cubes, C) what all cubes see of these contacts."""
        inverse = self._inverse
        seen = np.zeros((len(inverse.poses.position), len(inverse.columns)))
        for disc in discs:
            cubes, place, angle = self._around(disc.home)
            response = inverse.kernels.response(place - disc.place, angle, disc.size)
            seen[cubes] += response[:, inverse.columns] @ disc.force
        return seen

    def _below(self, discs: list[_Disc]) -> Array:
        """(M,) pressure of these contacts at the cubes' depth."""
        below = np.zeros(len(self._inverse.points))
        for disc in discs:
            points, place, _ = self._points_around(disc)
            below[points] += self._inverse.kernels.disc_pressure(place, disc.size, disc.force)
        return below

    def _with_discs(self, rest: TractionField, below: Array) -> TractionField:
        """What is left and the discs, these as the mean over the square of each point: so the sum
        over the points is the force, however narrow a contact is."""
        traction = rest.traction.copy()
        within = square(self._inverse.spacing / FINER, FINER)
        for disc in self._discs:
            points, place, turn = self._points_around(disc)
            distance = np.linalg.norm(place[:, None] + within, axis=2)
            share = hertz_pressure(distance, disc.size).mean(axis=1)
            traction[points] += share[:, None] * (turn @ disc.force)
        return rest._replace(traction=traction, below=below)

    def _points_around(self, disc: _Disc) -> tuple[Index, Array, Array]:
        """Points near a contact: which, their places (n, 2) from its middle in its home's frame,
        and rotations (n, 3, 3) from that frame to the point's."""
        inverse = self._inverse
        reach = _REACH / 2 * inverse.depth
        points = np.sort(self._point_tree.query_ball_point(self._middle(disc), reach))
        points = np.asarray(points, dtype=np.intp)
        rotation = inverse.poses.rotation
        local = (inverse.points[points] - self._middle(disc)) @ rotation[disc.home]
        turn = rotation[inverse.cube[points]].swapaxes(1, 2) @ rotation[disc.home]
        return points, local[:, :2], turn

    def _around(self, home: int) -> tuple[Index, Array, Array]:
        """Cubes that see contacts of this home: which, places and angles laid flat."""
        inverse = self._inverse
        reach = _REACH * inverse.depth
        cubes = np.sort(self._tree.query_ball_point(inverse.poses.position[home], reach))
        cubes = np.asarray(cubes, dtype=np.intp)
        facing = inverse.poses.rotation[cubes, :, 2] @ inverse.poses.rotation[home, :, 2] > 0.5
        cubes = cubes[facing]
        return cubes, *inverse.flattened(home, cubes)

    def _fit(self, y: Array, discs: list[_Disc], steps: int) -> None:
        """Fit contacts, those together that share cubes; the others stay as they are."""
        left = list(discs)
        while left:
            group = [left.pop(0)]
            for disc in group:  # grows while it is walked
                near = {id(other) for other in self._group(disc)}
                group += [other for other in left if id(other) in near]
                left = [other for other in left if id(other) not in near]
            others = [disc for disc in self._discs if all(disc is not one for one in group)]
            self._fit_group(y - self._seen(others), group, steps)

    def _fit_group(self, y: Array, discs: list[_Disc], steps: int) -> None:
        inverse = self._inverse
        home = discs[0].home
        near = [
            self._tree.query(self._middle(disc), min(NEAR, len(y)))[1].reshape(-1) for disc in discs
        ]
        cubes = np.unique(np.concatenate(near))
        place, angle = inverse.flattened(home, cubes)
        scan = _Scan(self, y[cubes], cubes, place, angle)
        if scan.size < 6 * len(discs):
            for disc in discs:
                disc.force = np.zeros(3)  # nothing is known here: `_sort_out` ends them
            return
        homes = np.array([disc.home for disc in discs])
        at, turned = inverse.flattened(home, homes)
        c, s = np.cos(turned), np.sin(turned)
        turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=-2)
        middles = at + np.einsum("jab,jb->ja", turn, np.array([disc.place for disc in discs]))
        sizes = np.array([disc.size for disc in discs])
        alpha = max(disc.alpha for disc in discs)
        fitted = _fit(scan, middles, sizes, alpha, steps)
        for j, disc in enumerate(discs):
            self._put(disc, fitted, j, cubes, place, angle)
            result = _result(scan, fitted, j)
            disc.result = self._tracked(disc.id, result, cubes, place, angle)

    def _put(
        self, disc: _Disc, fitted: _Fitted, j: int, cubes: Index, place: Array, angle: Array
    ) -> None:
        """Write what was fitted into a disc, in the frame of the cube that is now nearest."""
        nearest, back = _home(fitted.middles[j], place, angle)
        disc.home, disc.size = int(cubes[nearest]), float(fitted.sizes[j])
        disc.alpha = fitted.alpha
        disc.place = back[:2, :2] @ (fitted.middles[j] - place[nearest])
        disc.force = back @ fitted.forces[j]

    def _tracked(
        self, number: int, result: _Result, cubes: Index, place: Array, angle: Array
    ) -> TrackedContact:
        """A result in the skin's parent frame."""
        inverse = self._inverse
        nearest, back = _home(result.place, place, angle)
        home = int(cubes[nearest])
        rotation, origin = inverse.poses.rotation[home], inverse.poses.position[home]
        at = back[:2, :2] @ (result.place - place[nearest])
        force = back @ result.force
        shear = float(np.hypot(force[0], force[1]))
        direction = result.force[:2] / max(shear, 1e-300)
        return TrackedContact(
            id=number,
            position=origin + rotation @ np.array([*at, inverse.depth]),
            normal=rotation[:, 2].copy(),
            force=rotation @ force,
            normal_force=float(-force[2]),
            shear_force=shear,
            moment=result.moment,
            area=result.area,
            position_uncertainty=float(np.sqrt(result.place_variance.mean())),
            force_uncertainty=float(np.sqrt(result.force_variance[2])),
            shear_uncertainty=float(np.sqrt(direction**2 @ result.force_variance[:2])),
            moment_uncertainty=float(np.sqrt(result.moment_variance)),
            area_uncertainty=result.area_uncertainty,
        )

    def prior(self, cubes: Index, place: Array, angle: Array) -> Array:
        """(n C, n C) covariance of cubes; those of the last contacts are remembered."""
        key = tuple(cubes.tolist())
        if key not in self._memory:
            if len(self._memory) >= 2 * MOST:
                self._memory.pop(next(iter(self._memory)))
            inverse = self._inverse
            self._memory[key] = covariance_matrix(inverse.kernels, inverse.columns, place, angle)
        return self._memory[key]


class _Scan:
    """What some cubes see: values, their noise and prior, laid flat.

    y: (D,) known values; noise, prior: (D, D)
    """

    def __init__(
        self, touches: Touches, y: Array, cubes: Index, place: Array, angle: Array
    ) -> None:
        inverse = touches._inverse
        self.kernels, self.columns = inverse.kernels, inverse.columns
        self.pitch, self.place, self.angle = inverse.pitch, place, angle
        known = np.isfinite(y) & inverse.observed[cubes]
        self._known = known.ravel()
        filled = np.where(known, y, 0.0)
        rms = np.sqrt((filled**2).sum(axis=1) / np.maximum(known.sum(axis=1), 1))
        error = MODEL_ERROR**2 * (filled**2 + (OF_OTHERS * rms[:, None]) ** 2)
        n, width = y.shape
        one = np.arange(n)
        blocks = np.zeros((n, width, n, width))
        blocks[one, :, one, :] = np.nan_to_num(inverse.noise[cubes])
        noise: Array = blocks.reshape(n * width, -1)
        noise[np.diag_indices(n * width)] += error.ravel()
        both = np.ix_(self._known, self._known)
        self.y, self.noise = filled.ravel()[self._known], noise[both]
        self.prior = touches.prior(cubes, place, angle)[both]
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


class _Fitted(NamedTuple):
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


class _Result(NamedTuple):
    """A contact laid flat: units and meaning as in TrackedContact."""

    force: Array
    force_variance: Array
    place: Array
    place_variance: Array
    moment: float
    moment_variance: float
    area: float
    area_uncertainty: float


def _fit(scan: _Scan, middles: Array, sizes: Array, alpha: float, steps: int) -> _Fitted:
    """Gauss and Newton's steps; per contact the columns are f_x, f_y, f_z, c_x, c_y, ln a."""
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
        if step == steps or (steps == _COLD and step % 2 == 0):
            tried = _TRIED_COLD if steps == _COLD else _TRIED_WARM
            alpha = _best_alpha(scan, jacobian, residual, alpha * tried)
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
    return _Fitted(middles, np.exp(logs), forces, alpha, factor, rest, jacobian, normal)


def _factor(scan: _Scan, alpha: float) -> tuple[Array, bool]:
    return cho_factor(alpha**2 * scan.prior + scan.noise, lower=True)


def _slopes(scan: _Scan, middle: Array, log_size: float, force: Array) -> Array:
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


def _best_alpha(scan: _Scan, jacobian: Array, residual: Array, alphas: Array) -> float:
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


def _home(middle: Array, place: Array, angle: Array) -> tuple[int, Array]:
    """Which cube is nearest, and the rotation (3, 3) into its frame."""
    nearest = int(np.argmin(np.linalg.norm(place - middle, axis=1)))
    c, s = np.cos(angle[nearest]), np.sin(angle[nearest])
    return nearest, np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])


def _result(scan: _Scan, fitted: _Fitted, j: int) -> _Result:
    """Force, place and moment of the contact at a disc, with variances."""
    depth = scan.kernels.depth
    middle, size, disc_force = fitted.middles[j], float(fitted.sizes[j]), fitted.forces[j]
    apart = np.linalg.norm(np.delete(fitted.middles, j, axis=0) - middle, axis=1)
    radius = min(size + depth, float(apart.min(initial=np.inf)) / 2)
    offset, weight = _quadrature(radius)
    cross = fitted.alpha**2 * scan.cross(middle + offset) * weight[:, None, None]
    total = cross.sum(axis=0)  # (3, D)
    force = disc_force + total @ fitted.rest
    pressing = force[2] if abs(force[2]) > 1e-12 else -1e-12
    of_rest = np.einsum("pa,pd->ad", offset, cross[:, 2])
    shift = of_rest @ fitted.rest / pressing
    lever = (of_rest - np.outer(shift, total[2])) / pressing
    around = offset - shift
    twist = around[:, 0] @ cross[:, 1] - around[:, 1] @ cross[:, 0]
    moment = shift[1] * disc_force[0] - shift[0] * disc_force[1] + twist @ fitted.rest
    functionals = np.concatenate([total, lever, twist[None]])  # (6, D)
    first = 6 * j
    slopes = np.zeros((6, fitted.jacobian.shape[1]))
    slopes[:3, first : first + 3] = np.eye(3)
    slopes[3:5, first + 2] = -shift / pressing
    slopes[3:5, first + 3 : first + 5] = np.eye(2) * (disc_force[2] / pressing)
    slopes[5, first : first + 2] = shift[1], -shift[0]
    # Variance of an integral of what is left, of pressure, per area.
    density = fitted.alpha**2 * np.mean([2 * np.pi * (l * depth) ** 2 for l in LENGTHS])
    levers = [radius**2 / 4 / pressing**2] * 2
    shape = np.array([SHEAR**2, SHEAR**2, 1.0, *levers, SHEAR**2 * radius**2 / 2])
    own = density * np.pi * radius**2 * shape
    weighted = cho_solve(fitted.factor, functionals.T)
    known = np.einsum("fd,df->f", functionals, weighted)
    open_ = slopes - weighted.T @ fitted.jacobian
    inverse = np.linalg.inv(fitted.normal)
    variance = np.maximum(own - known, 0) + np.einsum("fp,pq,fq->f", open_, inverse, open_)
    area = np.pi * size**2
    return _Result(
        force=force,
        force_variance=variance[:3],
        place=middle + shift,
        place_variance=variance[3:5],
        moment=float(moment),
        moment_variance=float(variance[5]),
        area=area,
        area_uncertainty=2 * area * float(np.sqrt(inverse[first + 5, first + 5])),
    )


def _quadrature(radius: float) -> tuple[Array, Array]:
    """Points (Q, 2) on a disc and their areas (Q,): Gauss points in r^2 times angles."""
    t, weight = np.polynomial.legendre.leggauss(5)
    r, count = radius * np.sqrt((t + 1) / 2), 10
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count
    points = np.stack([np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()], 1)
    return points, np.repeat(weight / 2, count) * np.pi * radius**2 / count
