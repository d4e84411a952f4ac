"""Contacts from the values of all cubes, followed from scan to scan.

A contact is narrow, and a prior that is the same everywhere does not know that. So the traction is
the sum of Hertz contacts and of a Gaussian process for what is left. disc.py says what the contacts
make, disc_fit.py fits them, disc_load.py gives their force and place with standard deviations,
disc_choice.py decides how many there are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from ...core.arrays import Array, Index
from ..inverse import FieldDeviation, SurfaceInverse, TractionField
from ..prior import AMPLITUDE, covariance_matrix, positive
from .disc import Disc, DiscModel
from .disc_choice import beginning, remaining, same
from .disc_fit import COLD, USUAL_SIZE, WARM, Fitted, Scan, fit
from .disc_load import Load, load_of
from .disc_split import split

NEAR = 16
"""Cubes next to a contact that it is computed from."""
MOST, TOGETHER = 10, 4
"""Contacts at a time, and of these in one fit, whose time grows with the cube of their number."""
MUCH_LEFT, WIDE_SIZE = 0.02, 2.5
"""Alpha over AMPLITUDE from which on a contact is fitted once more, beginning with this radius over
the depth."""
CERTAIN = 0.005
"""Pitches by which a place may be in doubt without that it is asked again where the contact is."""
ROUND = 4
"""Cubes next to a contact around which it is looked for, if it has just begun and leaves much."""
_CORNERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
FIRST_ALPHA = 0.05
"""Alpha over AMPLITUDE from which the fit of a new contact begins."""


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


class Touches:
    """Follows the contacts of a skin from scan to scan.

    field: traction of the newest scan, contacts included; 0 before the first

    Parameters: inverse: of the skin. least: pressure at the cubes' depth that counts as contact,
    Pa.
    """

    def __init__(self, inverse: SurfaceInverse, least: float) -> None:
        self._inverse, self._least = inverse, least
        self._model = DiscModel(inverse)
        self._discs: list[Disc] = []
        self._contacts: dict[int, TrackedContact] = {}
        self._next_id = 0
        self._priors: dict[tuple[int, ...], Array] = {}
        count = len(inverse.points)
        self.field = TractionField(np.zeros((count, 3)), np.zeros(count))
        self._left = np.full((len(inverse.poses.position), len(inverse.columns)), np.nan)

    def update(self, values: Array) -> list[TrackedContact]:
        """Contacts of the newest values (cubes, 15), NaN where unknown; strongest first.

        Time is bounded: MOST contacts, and a fixed number of steps for each.
        """
        model, y = self._model, self._inverse.scaled(values)
        self._contacts = {}
        self._fit(y, self._discs, WARM)
        self._discs = remaining(model, self._discs, self._least)
        tried: list[Array] = []
        for _ in range(MOST + 1):
            self._left = y - model.seen(self._discs)
            rest = self._inverse.field_of(self._left)
            below = rest.below + model.below(self._discs)
            self.field = model.with_discs(rest, below, self._discs)
            pair = same(model, self._discs, below)
            if pair is not None:
                older, younger = pair
                self._discs.remove(younger)
                self._fit(y, [older], COLD)
                continue
            start = beginning(model, self._discs, rest.below, below, tried, self._least)
            if start is None or len(self._discs) >= MOST:
                break
            tried.append(self._inverse.points[start])
            disc = self._new(start)
            others = self._near(disc, self._discs)
            self._discs.append(disc)
            self._fit(y, [disc, *others], COLD)
            self._discs = remaining(model, self._discs, self._least)
        contacts = [self._contacts[disc.id] for disc in self._discs if disc.id in self._contacts]
        return sorted(contacts, key=lambda contact: -contact.normal_force)

    def deviation(self, values: Array) -> FieldDeviation:
        """How far the `field` of these values may be off: by what is left, and by all that is not
        sure of the contacts."""
        of_rest = np.stack(self._inverse.deviation_of(self._left, self._inverse.scaled(values)), 1)
        of_discs = self._model.variance(self._discs)
        return FieldDeviation(*np.sqrt(of_rest**2 + of_discs).T)

    def _new(self, point: int) -> Disc:
        inverse = self._inverse
        home = int(inverse.cube[point])
        offset = inverse.poses.rotation[home].T @ (
            inverse.points[point] - inverse.poses.position[home]
        )
        size = USUAL_SIZE * inverse.depth
        self._next_id += 1
        return Disc(self._next_id - 1, home, offset[:2], size, np.zeros(3), FIRST_ALPHA * AMPLITUDE)

    def _near(self, disc: Disc, others: list[Disc]) -> list[Disc]:
        """Those of other contacts that share cubes with this one, the nearest first."""
        middle, reach = self._model.middle(disc), 4 * self._inverse.pitch
        apart = [float(np.linalg.norm(self._model.middle(other) - middle)) for other in others]
        return [others[k] for k in np.argsort(apart) if apart[k] < reach]

    def _fit(self, y: Array, discs: list[Disc], steps: int) -> None:
        """Fit contacts, those together that share cubes; the others stay as they are."""
        left = list(discs)
        while left:
            first = left.pop(0)
            group = [first, *self._near(first, left)[: TOGETHER - 1]]
            left = [disc for disc in left if all(disc is not one for one in group)]
            others = [disc for disc in self._discs if all(disc is not one for one in group)]
            self._fit_group(y - self._model.seen(others), group, steps)

    def _fit_group(self, y: Array, discs: list[Disc], steps: int) -> None:
        inverse = self._inverse
        home = discs[0].home
        near = [self._model.nearest_cubes(disc, NEAR) for disc in discs]
        cubes = np.unique(np.concatenate(near))
        place, angle = inverse.flattened(home, cubes)
        scan = Scan(inverse, y[cubes], self._prior(cubes, place, angle), cubes, place, angle)
        if scan.size < 6 * len(discs):
            for disc in discs:
                disc.force = np.zeros(3)  # nothing is known here: `remaining` drops them
            return
        homes = np.array([disc.home for disc in discs])
        at, turned = inverse.flattened(home, homes)
        c, s = np.cos(turned), np.sin(turned)
        turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=-2)
        middles = at + np.einsum("jab,jb->ja", turn, np.array([disc.place for disc in discs]))
        sizes = np.array([disc.size for disc in discs])
        alpha = max(disc.alpha for disc in discs)
        fitted = fit(scan, middles, sizes, alpha, steps)
        for j, disc in enumerate(discs):
            fitted = self._otherwise(scan, fitted, disc, j, at[j], turn[j])
        fitted = self._split(scan, fitted, discs)
        for j, disc in enumerate(discs):
            self._put(disc, fitted, j, cubes, place, angle)
            load = load_of(scan, fitted, j)
            load = load._replace(
                place_variance=load.place_variance + disc.doubt / 2,
                force_variance=load.force_variance + disc.force_doubt,
            )
            self._contacts[disc.id] = self._tracked(disc.id, load, cubes, place, angle)

    def _otherwise(
        self, scan: Scan, fitted: Fitted, disc: Disc, j: int, at: Array, turn: Array
    ) -> Fitted:
        """The best of this fit and of others that begin where it does not find its way to.

        at, turn: (2,), (2, 2) of the home of contact j. Much that is left may be a wide contact. On
        another side of a cube that does not see all components, a contact looks nearly the same.
        Both are tried for those that are new or were in doubt. Between wide pitches the field may
        point at the wrong cube: a new one that leaves much is looked for around others, too.
        """
        tried = [fitted]

        def begin(middle: Array, size: float) -> None:
            middles, sizes = fitted.middles.copy(), fitted.sizes.copy()
            middles[j], sizes[j] = middle, size
            tried.append(fit(scan, middles, sizes, FIRST_ALPHA * AMPLITUDE, COLD))

        limit = MUCH_LEFT * AMPLITUDE
        if fitted.alpha > limit and (disc.doubt > 0 or disc.alpha <= limit):
            begin(fitted.middles[j], WIDE_SIZE * self._inverse.depth)
        if disc.doubt > 0 and not scan.sees_all:
            best = min(tried, key=lambda one: one.score)
            away = np.abs(turn.T @ (best.middles[j] - at))
            away = np.maximum(away, self._inverse.pitch / 4)
            middles = [at]
            if best.alpha > limit and np.isinf(disc.doubt):
                apart = np.linalg.norm(scan.place - best.middles[j], axis=1)
                middles = list(scan.place[np.argsort(apart)[:ROUND]])
            for middle in middles:
                for corner in _CORNERS:
                    begin(middle + turn @ (corner * away), USUAL_SIZE * self._inverse.depth)
        best = min(tried, key=lambda one: one.score)
        weight = np.exp([(best.score - one.score) / 2 for one in tried])
        weight /= weight.sum()
        squares = [((one.middles[j] - best.middles[j]) ** 2).sum() for one in tried]
        disc.force_doubt = weight @ [(one.forces[j] - best.forces[j]) ** 2 for one in tried]
        doubt = float(weight @ squares)
        disc.doubt = doubt if doubt > (CERTAIN * self._inverse.pitch) ** 2 else 0.0
        return best

    def _split(self, scan: Scan, fitted: Fitted, discs: list[Disc]) -> Fitted:
        """Contacts that are two each become two, also in `discs`. Asked again where twice as much
        is left."""
        limit = MUCH_LEFT * AMPLITUDE
        for j, disc in enumerate(list(discs)):
            if fitted.alpha <= limit:
                disc.asked = 0.0
            elif fitted.alpha > 2 * disc.asked and len(self._discs) < MOST:
                disc.asked = fitted.alpha
                two = split(scan, fitted, j, FIRST_ALPHA * AMPLITUDE, limit)
                if two is not None:
                    fitted, disc.told_apart = two, True
                    twin = replace(disc, id=self._next_id)
                    self._next_id += 1
                    discs.append(twin)
                    self._discs.append(twin)
        return fitted

    def _put(
        self, disc: Disc, fitted: Fitted, j: int, cubes: Index, place: Array, angle: Array
    ) -> None:
        """Write what was fitted into a disc, in the frame of the cube that is now nearest."""
        nearest, back = _home(fitted.middles[j], place, angle)
        disc.home, disc.size = int(cubes[nearest]), float(fitted.sizes[j])
        disc.alpha = fitted.alpha
        disc.place = back[:2, :2] @ (fitted.middles[j] - place[nearest])
        disc.force = back @ fitted.forces[j]
        # Both shapes that make a contact longer turn twice as fast as it does.
        turn = block_diag(back, back[:2, :2], 1.0, (back @ back)[:2, :2], 1.0)
        doubts = np.diag([*disc.force_doubt, *[disc.doubt / 2] * 2, *np.zeros(4)])
        disc.covariance = turn @ (fitted.covariance(j) + doubts) @ turn.T

    def _tracked(
        self, number: int, load: Load, cubes: Index, place: Array, angle: Array
    ) -> TrackedContact:
        """A load in the skin's parent frame."""
        inverse = self._inverse
        nearest, back = _home(load.place, place, angle)
        home = int(cubes[nearest])
        rotation, origin = inverse.poses.rotation[home], inverse.poses.position[home]
        at = back[:2, :2] @ (load.place - place[nearest])
        force = back @ load.force
        shear = float(np.hypot(force[0], force[1]))
        direction = load.force[:2] / max(shear, 1e-300)
        return TrackedContact(
            id=number,
            position=origin + rotation @ np.array([*at, inverse.depth]),
            normal=rotation[:, 2].copy(),
            force=rotation @ force,
            normal_force=float(-force[2]),
            shear_force=shear,
            moment=load.moment,
            area=load.area,
            position_uncertainty=float(np.sqrt(load.place_variance.mean())),
            force_uncertainty=float(np.sqrt(load.force_variance[2])),
            shear_uncertainty=float(np.sqrt(direction**2 @ load.force_variance[:2])),
            moment_uncertainty=float(np.sqrt(load.moment_variance)),
            area_uncertainty=load.area_uncertainty,
        )

    def _prior(self, cubes: Index, place: Array, angle: Array) -> Array:
        """(n C, n C) covariance of cubes; those of the last contacts are remembered."""
        key = (*cubes.tolist(), *self._inverse.reading[cubes].tolist())
        if key not in self._priors:
            if len(self._priors) >= 2 * MOST:
                self._priors.pop(next(iter(self._priors)))
            inverse = self._inverse
            self._priors[key] = positive(
                covariance_matrix(
                    inverse.kernels, inverse.columns, place, angle, inverse.reading[cubes]
                )
            )
        return self._priors[key]


def _home(middle: Array, place: Array, angle: Array) -> tuple[int, Array]:
    """Which cube is nearest, and the rotation (3, 3) into its frame."""
    nearest = int(np.argmin(np.linalg.norm(place - middle, axis=1)))
    c, s = np.cos(angle[nearest]), np.sin(angle[nearest])
    return nearest, np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
