"""Contact tracker: finds contacts from the values of all cubes, follows them from scan to scan.

A Gaussian prior that is the same everywhere on the surface cannot describe that contacts are
narrow. Therefore, the traction is modelled as the sum of Hertz contacts and of a residual field, a
Gaussian process for what the contacts do not explain. contact_model.py computes the response to the
contacts, contact_fit.py fits them, contact_estimate.py computes force and position with standard
deviations, contact_selection.py decides how many contacts there are, and contact_split.py tests
whether one contact is really two.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from ...core.arrays import Array, Index
from ..inverse import FieldDeviation, SurfaceInverse, TractionField
from ..prior import AMPLITUDE, covariance_matrix, make_positive_definite
from .contact_estimate import ContactEstimate, estimate_contact
from .contact_fit import (
    STEPS_NEW,
    STEPS_TRACKED,
    USUAL_SIZE,
    ContactFit,
    Observations,
    fit_contacts,
)
from .contact_model import ContactModel, HertzContact
from .contact_selection import detect_contact, find_pair_to_merge, prune_contacts
from .contact_split import split_contact

CUBES_PER_CONTACT = 16
"""Number of cubes from whose values a contact is fitted: those nearest to it."""

MAX_CONTACTS = 10
"""Largest number of contacts tracked at the same time on one skin."""

MAX_CONTACTS_PER_FIT = 4
"""Largest number n of contacts that are fitted jointly; the time of a fit grows with n^3."""

JOINT_FIT_PITCHES = 4.0
"""Distance of two contacts, divided by the pitch (distance of neighbouring cubes), below which they
are fitted jointly, because many of their nearest cubes are the same."""

LARGE_RESIDUAL = 0.02
"""Residual scale (standard deviation of the pressure that the contacts do not explain), divided by
`AMPLITUDE`, above which a fit counts as possibly wrong and is repeated from other starts."""

WIDE_SIZE = 2.5
"""Start radius, divided by the depth of the cubes' centres, with which the fit of a contact is
repeated if it leaves a large residual. The true contact may be too wide to be found from the usual,
smaller start radius (`USUAL_SIZE`)."""

POSITION_TOLERANCE_PITCHES = 0.005
"""Standard deviation of the positions at which fits from different starts end, divided by the pitch
(distance of neighbouring cubes). Above it, the position of the contact counts as ambiguous, and the
other starts are tried again in the next scan."""

RESTART_CUBES = 4
"""Number of cubes around which a new contact is fitted again if its first fit leaves a large
residual (`LARGE_RESIDUAL`). The cubes nearest to the position found by this fit are chosen."""

START_SCALE = 0.05 * AMPLITUDE
"""Start value, in Pa, of the residual scale (standard deviation of the pressure that the contacts
do not explain) in the fit of a new contact."""

_MIN_VALUES_PER_CONTACT = 6
"""Smallest number of known values (of the cubes near the contacts) per contact for a fit. It is the
number of a contact's parameters: force (3), centre (2) and radius."""

_CORNERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
"""Signs (4, 2) of x and y for the four mirror images of a position about the axes of a cube."""


class TrackedContact(NamedTuple):
    """One contact in the skin's parent frame, with standard deviations.

    Attributes:
        id: Number that stays the same from the first touch to the last.
        position: Position (3,) in m, where the line of action of the normal force meets the
            surface.
        normal: Unit normal (3,) out of the skin.
        force: Force (3,) in N on the skin.
        normal_force: Normal force in N, positive for a body that presses on the skin.
        shear_force: Length of the tangential force in N.
        moment: Moment of the traction about the normal through `position`, in N m.
        area: Area of the Hertz contact that fits best, in m^2.
        position_uncertainty: Standard deviation of the position along each axis, in m.
        force_uncertainty: Standard deviation of the normal force, in N.
        shear_uncertainty: Standard deviation of `shear_force`, in N.
        moment_uncertainty: Standard deviation of the moment, in N m.
        area_uncertainty: Standard deviation of the area, in m^2.
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


class ContactTracker:
    """Follows the contacts of a skin from scan to scan (a scan is one set of values of all cubes).

    Attributes:
        field: Traction on the surface in the newest scan, contacts included; 0 before the first
            scan.
    """

    def __init__(self, inverse: SurfaceInverse, min_pressure: float) -> None:
        """Create a tracker without contacts.

        Args:
            inverse: Computes the traction on the surface of this skin.
            min_pressure: Smallest pressure of a new contact at the depth of the cubes, in Pa.
        """
        self._inverse = inverse
        self._min_pressure = min_pressure
        self._model = ContactModel(inverse)
        self._contacts: list[HertzContact] = []
        self._results: dict[int, TrackedContact] = {}
        self._next_id = 0
        self._priors: dict[tuple[int, ...], Array] = {}
        n_points = len(inverse.points)
        self.field = TractionField(np.zeros((n_points, 3)), np.zeros(n_points))
        self._residual = np.full(
            (len(inverse.poses.position), len(inverse.columns)),
            np.nan,
        )

    def update(self, values: Array) -> list[TrackedContact]:
        """Fit the contacts to the newest values, and find, merge and remove contacts.

        The computing time is bounded by `MAX_CONTACTS` and by the number of steps of each fit.

        Args:
            values: Components (cubes, 15) in Pa and Pa/m, NaN where unknown.

        Returns:
            Contacts, strongest first.
        """
        model = self._model
        y = self._inverse.scaled(values)
        self._results = {}
        self._fit(y, self._contacts, STEPS_TRACKED)
        self._contacts = prune_contacts(model, self._contacts, self._min_pressure)

        # Merge or add one contact at a time until the residual shows no further one.
        tried: list[Array] = []
        for _ in range(MAX_CONTACTS + 1):
            self._residual = y - model.response(self._contacts)
            residual = self._inverse.field_of_scaled(self._residual)
            pressure = residual.depth_pressure + model.depth_pressure(self._contacts)
            self.field = model.add_contacts(residual, pressure, self._contacts)

            pair = find_pair_to_merge(model, self._contacts, pressure)
            if pair is not None:
                # The older contact keeps its id and replaces both contacts in a new fit.
                older, younger = pair
                self._contacts.remove(younger)
                self._fit(y, [older], STEPS_NEW)
                continue

            point = detect_contact(
                model,
                self._contacts,
                residual.depth_pressure,
                pressure,
                tried,
                self._min_pressure,
            )
            if point is None or len(self._contacts) >= MAX_CONTACTS:
                break
            tried.append(self._inverse.points[point])
            # The neighbours are fitted again, because so far they were fitted to values to which
            # the new contact contributes.
            contact = self._start_contact(point)
            neighbours = self._neighbours(contact, self._contacts)
            self._contacts.append(contact)
            self._fit(y, [contact, *neighbours], STEPS_NEW)
            self._contacts = prune_contacts(model, self._contacts, self._min_pressure)

        fitted = [one.id for one in self._contacts if one.id in self._results]
        results = [self._results[number] for number in fitted]
        return sorted(results, key=lambda contact: -contact.normal_force)

    def deviation(self, values: Array) -> FieldDeviation:
        """Compute the standard deviations of `field`.

        Each variance is the sum of two: that of the residual field (traction that the contacts do
        not explain) and the variance that the uncertain parameters of the contacts cause.

        Args:
            values: Components (cubes, 15) in Pa and Pa/m that the last `update` was called with.
        """
        scaled = self._inverse.scaled(values)
        residual = self._inverse.residual_deviation(self._residual, scaled)
        contact_variance = self._model.pressure_variance(self._contacts)
        variance = np.stack(residual, axis=1) ** 2 + contact_variance
        return FieldDeviation(*np.sqrt(variance).T)

    def _start_contact(self, point: int) -> HertzContact:
        """Create a contact with force 0 and the usual radius, from which its fit starts.

        Args:
            point: Index of the surface point (in `SurfaceInverse.points`) at its centre.
        """
        inverse = self._inverse
        home = int(inverse.cube[point])
        offset = inverse.points[point] - inverse.poses.position[home]
        local = inverse.poses.rotation[home].T @ offset
        return HertzContact(
            id=self._take_id(),
            home=home,
            place=local[:2],
            size=USUAL_SIZE * inverse.depth,
            force=np.zeros(3),
            residual_scale=START_SCALE,
        )

    def _take_id(self) -> int:
        """Return a number (id) for a new contact, which no contact of this tracker had before."""
        self._next_id += 1
        return self._next_id - 1

    def _neighbours(self, contact: HertzContact, others: list[HertzContact]) -> list[HertzContact]:
        """Return the contacts among `others` that should be fitted jointly with a contact.

        These are the contacts at distances below `JOINT_FIT_PITCHES` pitches (distances of
        neighbouring cubes) from `contact`, the nearest first.
        """
        centre = self._model.centre(contact)
        centres = [self._model.centre(one) for one in others]
        distances = [float(np.linalg.norm(one - centre)) for one in centres]
        reach = JOINT_FIT_PITCHES * self._inverse.pitch
        return [others[k] for k in np.argsort(distances) if distances[k] < reach]

    def _fit(
        self,
        y: Array,
        contacts: list[HertzContact],
        steps: int,
    ) -> None:
        """Fit some contacts in groups of neighbours; the tracker's other contacts do not change.

        Args:
            y: Values (cubes, C) in Pa as from `SurfaceInverse.scaled`.
            contacts: Contacts to fit, which are changed.
            steps: Number of Gauss-Newton steps, as in `fit_contacts`.
        """
        remaining = list(contacts)
        while remaining:
            first = remaining.pop(0)
            group = [first, *self._neighbours(first, remaining)[: MAX_CONTACTS_PER_FIT - 1]]
            # Contacts are compared by identity: `==` would compare all attributes, arrays included.
            members = {id(one) for one in group}
            remaining = [one for one in remaining if id(one) not in members]
            others = [one for one in self._contacts if id(one) not in members]
            self._fit_group(y - self._model.response(others), group, steps)

    def _fit_group(
        self,
        y: Array,
        contacts: list[HertzContact],
        steps: int,
    ) -> None:
        """Fit contacts jointly and store the results in the contacts and in `_results`.

        For the fit, the skin is laid flat in the x-y plane of the cube nearest to the first contact
        (flattened skin), because the response of the elastic layer holds for a plane.

        Args:
            y: Values (cubes, C) in Pa minus the response to all contacts that are not fitted here.
            contacts: Contacts to fit, which are changed.
            steps: Number of Gauss-Newton steps, as in `fit_contacts`.
        """
        inverse = self._inverse
        home = contacts[0].home
        near = [self._model.nearest_cubes(contact, CUBES_PER_CONTACT) for contact in contacts]
        cubes = np.unique(np.concatenate(near))
        place, angle = inverse.unroll(home, cubes)
        prior = self._prior(cubes, place, angle)
        observations = Observations(inverse, y[cubes], prior, cubes, place, angle)
        if observations.size < _MIN_VALUES_PER_CONTACT * len(contacts):
            for contact in contacts:
                # Too few values are known for a fit. `prune_contacts` removes contacts without
                # force.
                contact.force = np.zeros(3)
            return

        # Centres of the contacts on the skin laid flat around the home cube of the first contact.
        homes = np.array([contact.home for contact in contacts])
        origins, angles = inverse.unroll(home, homes)
        rotations = _plane_rotations(angles)
        places = np.array([contact.place for contact in contacts])
        centres = origins + np.einsum("jab,jb->ja", rotations, places)
        sizes = np.array([contact.size for contact in contacts])
        scale = max(contact.residual_scale for contact in contacts)
        fit = fit_contacts(observations, centres, sizes, scale, steps)
        for j, contact in enumerate(contacts):
            fit = self._refit_from_other_starts(
                observations,
                fit,
                contact,
                j,
                origins[j],
                rotations[j],
            )
        fit = self._split_contacts(observations, fit, contacts)

        for j, contact in enumerate(contacts):
            self._store_fit(contact, fit, j, cubes, place, angle)
            estimate = estimate_contact(observations, fit, j)
            # `place_ambiguity` is the sum of the variances along x and y; each gets half of it.
            estimate = estimate._replace(
                place_variance=estimate.place_variance + contact.place_ambiguity / 2,
                force_variance=estimate.force_variance + contact.force_ambiguity,
            )
            result = self._to_parent_frame(contact.id, estimate, cubes, place, angle)
            self._results[contact.id] = result

    def _refit_from_other_starts(
        self,
        observations: Observations,
        fit: ContactFit,
        contact: HertzContact,
        j: int,
        origin: Array,
        rotation: Array,
    ) -> ContactFit:
        """Restart the fit of one contact from other positions and radii, keep the most likely fit.

        Gauss-Newton can end in a local optimum: a wide contact looks like a narrow one with a large
        residual, and beside a cube that does not observe all components, mirrored positions have
        almost the same response. So a fit with a large residual is restarted with a wide radius,
        and a contact that is new or was ambiguous is restarted at the mirrored positions. If cubes
        are far apart, the largest pressure may be found above the wrong cube. Therefore, a new
        contact with a large residual is restarted around other cubes, too.

        Args:
            observations: Known values of the cubes, their noise and prior covariance.
            fit: Fit from the usual start.
            contact: Contact to fit again; its `place_ambiguity` and `force_ambiguity` (variances
                over the fits from all starts) are changed.
            j: Index of this contact in `fit`.
            origin: Position (2,) in m of the contact's home (nearest cube) on the flattened skin.
            rotation: Rotation (2, 2) from the frame of the home to the flattened skin.

        Returns:
            The most likely of all these fits, which has the smallest `ContactFit.score`.
        """
        fits = [fit]

        def start_at(centre: Array, size: float) -> None:
            centres = fit.centres.copy()
            sizes = fit.sizes.copy()
            centres[j] = centre
            sizes[j] = size
            fits.append(fit_contacts(observations, centres, sizes, START_SCALE, STEPS_NEW))

        # A fit from another start takes long. It is not repeated in every scan for a contact whose
        # residual was large before, unless its position is ambiguous.
        limit = LARGE_RESIDUAL * AMPLITUDE
        depth = self._inverse.depth
        was_ambiguous = contact.place_ambiguity > 0
        if fit.residual_scale > limit and (was_ambiguous or contact.residual_scale <= limit):
            start_at(fit.centres[j], WIDE_SIZE * depth)

        if was_ambiguous and not observations.sees_all:
            # Starts at the mirror images of the position about the axes of the contact's cube, and,
            # for a new contact with a large residual, of other cubes.
            best = min(fits, key=lambda one: one.score)
            offset = np.abs(rotation.T @ (best.centres[j] - origin))
            offset = np.maximum(offset, self._inverse.pitch / 4)
            homes = [origin]
            if best.residual_scale > limit and np.isinf(contact.place_ambiguity):
                distance = np.linalg.norm(observations.place - best.centres[j], axis=1)
                homes = list(observations.place[np.argsort(distance)[:RESTART_CUBES]])
            for home in homes:
                for corner in _CORNERS:
                    start_at(home + rotation @ (corner * offset), USUAL_SIZE * depth)

        # Variance of position and force over all fits, weighted with their evidence.
        best = min(fits, key=lambda one: one.score)
        # The score is -2 ln of the evidence, so this is the evidence relative to the best fit.
        weight = np.exp([(best.score - one.score) / 2 for one in fits])
        weight /= weight.sum()
        shifts = [one.centres[j] - best.centres[j] for one in fits]
        place_squares = [(shift**2).sum() for shift in shifts]
        force_changes = [one.forces[j] - best.forces[j] for one in fits]
        force_squares = [change**2 for change in force_changes]
        contact.force_ambiguity = weight @ force_squares
        ambiguity = float(weight @ place_squares)
        tolerance = POSITION_TOLERANCE_PITCHES * self._inverse.pitch
        contact.place_ambiguity = ambiguity if ambiguity > tolerance**2 else 0.0
        return best

    def _split_contacts(
        self,
        observations: Observations,
        fit: ContactFit,
        contacts: list[HertzContact],
    ) -> ContactFit:
        """Test contacts with a large residual and split those that are really two contacts.

        A test takes long. So a contact is tested again only when its residual has become twice as
        large as at the last test.

        Args:
            observations: Known values of the cubes, their noise and prior covariance.
            fit: Joint fit of the contacts.
            contacts: Contacts of the fit, in its order. The second contact of each split is
                appended to this list and to the tracker's contacts.

        Returns:
            Fit of all contacts in the list; `fit` itself if no contact was split.
        """
        limit = LARGE_RESIDUAL * AMPLITUDE
        for j, contact in enumerate(list(contacts)):
            if fit.residual_scale <= limit:
                contact.split_tested_at = 0.0
                continue
            has_doubled = fit.residual_scale > 2 * contact.split_tested_at
            if not has_doubled or len(self._contacts) >= MAX_CONTACTS:
                continue

            contact.split_tested_at = fit.residual_scale
            two = split_contact(observations, fit, j, START_SCALE, limit)
            if two is not None:
                fit = two
                contact.was_split = True
                twin = replace(contact, id=self._take_id())
                contacts.append(twin)
                self._contacts.append(twin)
        return fit

    def _store_fit(
        self,
        contact: HertzContact,
        fit: ContactFit,
        j: int,
        cubes: Index,
        place: Array,
        angle: Array,
    ) -> None:
        """Store the result of a fit in a contact, in the frame of the cube that is now nearest.

        Args:
            contact: Contact to change.
            fit: Result of the fit.
            j: Index of the contact in the fit.
            cubes: Indices (n,) of the cubes whose values were fitted.
            place: Positions (n, 2) of these cubes in m on the flattened skin, the plane in which
                the skin is laid out for the fit.
            angle: Rotations (n,) of these cubes about z (normal of the skin), in rad.
        """
        nearest, to_home = _nearest_home(fit.centres[j], place, angle)
        in_plane = to_home[:2, :2]
        contact.home = int(cubes[nearest])
        contact.place = in_plane @ (fit.centres[j] - place[nearest])
        contact.size = float(fit.sizes[j])
        contact.force = to_home @ fit.forces[j]
        contact.residual_scale = fit.residual_scale

        # The coefficients of the two elongation shapes (x, diagonal) rotate by twice the angle,
        # because an ellipse looks the same after a rotation by 180°.
        double = (to_home @ to_home)[:2, :2]
        rotation = block_diag(to_home, in_plane, 1.0, double, 1.0)
        place_ambiguities = [contact.place_ambiguity / 2] * 2
        ambiguities = np.diag(
            [
                *contact.force_ambiguity,
                *place_ambiguities,
                *np.zeros(4),
            ]
        )
        contact.covariance = rotation @ (fit.covariance(j) + ambiguities) @ rotation.T

    def _to_parent_frame(
        self,
        number: int,
        estimate: ContactEstimate,
        cubes: Index,
        place: Array,
        angle: Array,
    ) -> TrackedContact:
        """Convert an estimate from the flattened skin to the skin's parent frame.

        The flattened skin is the plane in which the skin was laid out for the fit.

        Args:
            number: Number (id) of the contact.
            estimate: Force and position of the contact, with variances, on the flattened skin.
            cubes: Indices (n,) of the cubes whose values were fitted.
            place: Positions (n, 2) of these cubes on the flattened skin, in m.
            angle: Rotations (n,) of these cubes about z, in rad.
        """
        inverse = self._inverse
        nearest, to_home = _nearest_home(estimate.place, place, angle)
        home = int(cubes[nearest])
        rotation = inverse.poses.rotation[home]
        local = to_home[:2, :2] @ (estimate.place - place[nearest])
        offset = np.array([*local, inverse.depth])
        position = inverse.poses.position[home] + rotation @ offset
        force = to_home @ estimate.force
        shear = float(np.hypot(force[0], force[1]))
        # The variance of the length of the shear force is the variance along its direction.
        direction = estimate.force[:2] / max(shear, 1e-300)
        shear_variance = direction**2 @ estimate.force_variance[:2]
        return TrackedContact(
            id=number,
            position=position,
            normal=rotation[:, 2].copy(),
            force=rotation @ force,
            normal_force=float(-force[2]),
            shear_force=shear,
            moment=estimate.moment,
            area=estimate.area,
            position_uncertainty=float(np.sqrt(estimate.place_variance.mean())),
            force_uncertainty=float(np.sqrt(estimate.force_variance[2])),
            shear_uncertainty=float(np.sqrt(shear_variance)),
            moment_uncertainty=float(np.sqrt(estimate.moment_variance)),
            area_uncertainty=estimate.area_uncertainty,
        )

    def _prior(
        self,
        cubes: Index,
        place: Array,
        angle: Array,
    ) -> Array:
        """Return the prior covariance of the values of some cubes, from memory if possible.

        The flattened skin is the plane in which the skin is laid out for a fit.

        Args:
            cubes: Indices (n,) of the cubes.
            place: Positions (n, 2) of the cubes on the flattened skin, in m.
            angle: Rotations (n,) of the cubes about z, in rad.

        Returns:
            Covariance (n C, n C) for a surface pressure of variance 1 Pa^2.
        """
        inverse = self._inverse
        # The last covariances are kept, because computing one takes longer than a fit and a contact
        # rarely moves to other cubes.
        variant = inverse.variant[cubes]
        key = (*cubes.tolist(), *variant.tolist())
        if key not in self._priors:
            if len(self._priors) >= 2 * MAX_CONTACTS:
                oldest = next(iter(self._priors))
                self._priors.pop(oldest)
            covariance = covariance_matrix(inverse.kernels, inverse.columns, place, angle, variant)
            self._priors[key] = make_positive_definite(covariance)
        return self._priors[key]


def _plane_rotations(angle: Array) -> Array:
    """Return the matrices (J, 2, 2) of rotations in the plane by J angles (J,) in rad."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    first_row = np.stack([cosine, -sine], axis=-1)
    second_row = np.stack([sine, cosine], axis=-1)
    return np.stack([first_row, second_row], axis=-2)


def _nearest_home(
    centre: Array,
    place: Array,
    angle: Array,
) -> tuple[int, Array]:
    """Find the cube nearest to a position on the flattened skin (laid out in a plane for a fit).

    Args:
        centre: Position (2,) on the flattened skin, in m.
        place: Positions (n, 2) of the cubes on the flattened skin, in m.
        angle: Rotations (n,) of the cubes about z, in rad.

    Returns:
        Index of the cube in `place`, and the rotation (3, 3) from the axes of the flattened skin to
        the frame of this cube.
    """
    distance = np.linalg.norm(place - centre, axis=1)
    nearest = int(np.argmin(distance))
    c = np.cos(angle[nearest])
    s = np.sin(angle[nearest])
    return nearest, np.array(
        [
            [c, s, 0],
            [-s, c, 0],
            [0, 0, 1.0],
        ]
    )
