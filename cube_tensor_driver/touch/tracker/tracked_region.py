# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""One region of contact, followed from scan to scan, and the steps that fit its traction.

A scan is a set of values of all cubes. A fit is either one of Hertz contacts (hertz_fit.py), which
is tried first and suffices for balls, or one of grid contacts, small contacts on a grid whose sum
is the traction (grid_fit.py). Of the two, the one with the greater evidence (probability of the
values) is kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import IntEnum

import numpy as np

from ...core.arrays import Array, Index
from ..inverse import SurfaceInverse
from .contact_estimate import ContactEstimate, Discs, make_discs
from .grid_fit import GRID_STEP, MAX_GRID_CONTACTS, GridFit
from .hertz_fit import HertzFit, linearise
from .hertz_response import respond
from .local_values import MIN_FACING, CubeNoise, LocalValues

MAX_CUBES = 48
"""Largest number of cubes from whose values the traction in one region of contact is fitted. A
wider region, such as that of a palm, is not fitted: its force is the integral of the traction that
the linear inverse problem yields."""

NEAREST_CUBES = (21, 13, 9)
"""Numbers of cubes nearest to each cube below a region of contact that take part in the fit by grid
contacts (small contacts whose sum is the traction). In a square arrangement of cubes, the nearest
ones lie within 2.2, 2 and 1.4 pitches (distances of neighbouring cubes). The first number that does
not give more than `MAX_CUBES` cubes is used."""

MAX_CHANGE = 0.25
"""Largest relative change of a region of contact for which the last fit of its traction stays in
use. After a larger change, the traction is fitted again by grid contacts (small contacts on a
grid).

The change is the largest of three numbers: the relative change of the region's largest pressure,
the share of surface points that have joined the region, and the share that has left it. The fit
depends on the pressure, because the assumed noise includes errors of the pads' gains, which are
proportional to the stress.
"""

MAX_OTHERS_CHANGE = 0.3
"""Largest change of the stress from other regions after which a fit by grid contacts (small
contacts on a grid) stays in use. The change is the mean square over the cubes of the fit, divided
by the variance of the noise. After a larger change, the region is fitted again.

The first fits of regions that begin together each subtract an inexact estimate of the stress that
the other regions cause. A narrow prior that was found with this estimate (`GridFit.sharpen`) would
keep the traction at wrong places.
"""

MAX_MISFIT_GROWTH = 1.3
"""Ratio of the misfit (chi-squared per known value) to that of the last fit of a region, above
which the region is fitted again. The misfit grows when a contact moves or changes its shape."""

MAX_HERTZ_MISFIT = 1.5
"""Largest misfit (chi-squared per known value) of a fit of Hertz contacts at the cubes nearest to
them. Above it, a fit by grid contacts (small contacts on a grid) is used instead.

The misfit of the right model is 1 with a standard deviation of 0.12 for 9 cubes with 15 values
each, and of 0.2 for planar cubes, whose pads lie in one plane and determine fewer values.
"""

MAX_NEAR_MISFIT = 10.0
"""Largest misfit (chi-squared per known value) with which the first Hertz contact of a region is
kept if other regions are near. This limit is larger than `MAX_HERTZ_MISFIT`, because contacts of
these regions may cause the misfit. Misfits above the limit were seen when a Hertz contact was
fitted to a fingertip, or one contact to two balls."""

MAX_BAD_SCANS = 5
"""Number of successive scans (sets of values of all cubes) with too large a misfit (chi-squared per
known value) after which a fit by grid contacts (small contacts on a grid) is tried instead of
Hertz contacts.

A misfit is too large if it exceeds `MAX_MISFIT_GROWTH` times the misfit of the first fit. One such
scan does not suffice, because a new contact nearby also increases the misfit until the pressure of
this contact is large enough for it to be found.
"""

MAX_START_SIZE = 2.0
"""Largest radius of a Hertz contact at the start of its fit, divided by the depth of the cubes'
centres below the surface. From a radius that is much too large, Gauss-Newton steps do not converge
to a small one."""

MAX_HERTZ_ASPECT = 4.0
"""Largest ratio of length to width of a contact for which the fit of a round Hertz contact is
tried. Length and width are those that the fit by grid contacts (small contacts on a grid) has
found."""

MAX_DIRECT_PITCH = 2.5
"""Largest pitch (distance of neighbouring cubes), divided by the depth of the cubes' centres, at
which the first fit of a region is that of a Hertz contact. This fit begins at the maximum of the
pressure. At a larger pitch, it may end in a local optimum, on the wrong side of a cube, so the
traction is fitted by grid contacts (small contacts on a grid) first."""

HOME_PITCHES = 0.55
"""Largest distance of Hertz contacts (of their mean centre) from their home cube, the cube around
which the skin is laid flat for the fit, in pitches (distances of neighbouring cubes). Beyond this
distance, the cube nearest to the contacts becomes the home cube."""

MAX_STALE_CHANGE = 0.06
"""Relative change of a region's contacts, divided by the relative standard deviation (`FIT_ERROR`
or `START_ERROR`) of the stress that they cause in distant cubes, from which on this stress is
computed again. After a smaller change, the stress is wrong by much less than its standard
deviation.

The relative change is the larger one of two numbers: the shift of a contact divided by the distance
of the nearest other region, and the change of a force divided by the largest force.
"""

COARSE_DEVIATION = 0.1
"""Relative standard deviation that is added, in quadrature, to the other deviations of the force of
a contact without a fit, or with a fit that is not refined, such as the Hertz contact of a fingertip
until its grid contacts are fitted. The same fraction of the pitch (distance of neighbouring cubes)
is added, likewise, to the standard deviation of the position.

The force without a fit is the integral of the pressure at the depth of the cubes, which the linear
inverse problem of elasticity yields from the values of all cubes. These integrals were off by 1 to
12 % (rms) for balls, punches and rods on skins whose cubes are two or three depths (of their
centres below the surface) apart, and Hertz contacts of fingertips by 9 %.
"""

START_ERROR = 0.15
"""Relative standard deviation of the stress that a contact without a fit causes in the cubes around
other contacts. The fits of these other contacts subtract the stress and count its error as noise.

The stress is inexact, because the force is only an estimate: the integral of the traction that the
linear inverse problem of elasticity yields from the values of all cubes.
"""

FIT_ERROR = 0.05
"""Relative standard deviation of the stress that a fitted contact causes in the cubes around other
contacts. The stress is computed for the stated depth, thickness and Poisson's ratio, whose errors
change it by 3 % each (sensitivity.py). With the value 1 % and an error of Poisson's ratio of 0.02,
forces of fourteen contacts were off by 2.2 stated deviations."""

MAX_STEPS = 10
"""Largest number of Gauss-Newton steps in the first fit of Hertz contacts.

Later, a fit makes one step in each scan (set of values of all cubes). While its contacts move or
its misfit has grown, it makes up to this number of further steps in the same scan.
"""

HOPELESS = 4.0
"""Smallest misfit (chi-squared per known value) after half of the `MAX_STEPS` steps with which the
first fit of a Hertz contact is given up, divided by the largest misfit with which such a fit is
kept after all steps."""

Respond = Callable[[Index], tuple[Array, Array]]
"""Function that takes the indices of n cubes and returns their response to all regions of contact:
changes, in Pa, of their C measured components, and the standard deviations of these changes, in Pa.
Both are arrays (cubes of the skin, C) that are 0 for all other cubes."""


class Work(IntEnum):
    """Kind of the next step of the fit of a region of contact. Steps with the smallest number are
    made first.

    MOVE makes a Gauss-Newton step of Hertz contacts. BEGIN makes the first fit of a Hertz contact.
    PREPARE places grid contacts (small contacts on a grid); SOLVE fits the traction by them. CHOOSE
    tries one Hertz contact for each contact instead. RENEW solves again on the same region.
    SHARPEN repeats the fit with a narrower prior or a finer grid, or with the newest stress of
    other regions if that has changed. NONE stands for a fit that needs no step.
    """

    MOVE = 0
    BEGIN = 1
    SOLVE = 2
    CHOOSE = 3
    PREPARE = 4
    RENEW = 5
    SHARPEN = 6
    NONE = 7


WORK_MS = {
    Work.MOVE: 0.2,
    Work.BEGIN: 1.6,
    Work.SOLVE: 7.0,
    Work.CHOOSE: 0.7,
    Work.PREPARE: 6.0,
    Work.RENEW: 7.0,
    Work.SHARPEN: 7.5,
}
"""Approximate CPU time, in ms, of each kind of step of a region's fit; for a fit by grid contacts
(small contacts on a grid), with `MAX_GRID_CONTACTS` of them. The work in a scan (set of values of
all cubes) is counted with these numbers, not with a clock, so that a recording gives the same
contacts again. The times were measured with 24-pad cubes and the functions in C
(hertz_response.py). BEGIN took 1.2 ms for a single region and 1.3 to 2.2 ms if there were nineteen
others.
"""


class TrackedRegion:
    """A region of contact on the surface, and the fit of the traction (force per area) in it.

    The response of a cube is what contacts add to its C components: those components of stress and
    gradient (times d0, half the side of a cube), in Pa, that the pads determine.

    Attributes:
        points: Indices (k,) of the k points of the surface in the region, in the newest scan.
        peak: Largest pressure in Pa in the region, at the depth of the cubes' centres.
        near: Other regions within `NEIGHBOUR_REACH_PITCHES`. Their contacts change the values of
            the same cubes, so the fit of this region subtracts the response to them.
        fit: Fit of the traction to n cubes around the region; None: not fitted yet.
        others: Response (n, C), in Pa, of the n cubes of the fit to all other regions.
        gap: Distance from the nearest other region in m.
        response: Response (cubes, C), in Pa, of all cubes of the skin to this region.
        integral: Estimate of the contact from integrals of the traction field, used until there is
            a fit. The estimate is in the frame of the cube that was `home` when it was computed.
        waited: Number of scans (sets of values of all cubes) since the fit was last improved.
    """

    def __init__(
        self,
        inverse: SurfaceInverse,
        noise: CubeNoise,
        respond: Respond,
    ) -> None:
        self.points: Index = np.zeros(0, np.intp)
        self.peak = 0.0
        self.near: list[TrackedRegion] = []
        self.fit: HertzFit | GridFit | None = None
        self.gap = np.inf
        n_cubes = len(inverse.variant)
        self.response = np.zeros((n_cubes, len(inverse.columns)))
        self._responding = np.zeros(n_cubes, bool)
        self.waited = 0
        self._inverse = inverse
        self._noise = noise
        self._respond = respond
        self._fitted_points = self.points
        self._fitted_peak = 0.0
        self._fitted_others: Array
        # `_others_change` is the sum of squares whose mean `MAX_OTHERS_CHANGE` limits, as computed
        # when `others` was `_compared_others`.
        self._compared_others: Array | None = None
        self._others_change = 0.0
        self._first_misfit = 1.0
        self._is_direct = inverse.pitch < MAX_DIRECT_PITCH * inverse.depth
        self._is_hertz_due = self._is_direct
        self._prepared: GridFit | None = None
        self._is_tried = False
        self._bad_scans = 0
        self._steps = 0
        self.integral: ContactEstimate
        self.others: Array
        # `_checked` are the contacts that `find_stale_cubes` has compared last. `_responded` are
        # the home cube and the contacts for which `response` was last computed.
        self._checked: Discs | None = None
        self._responded = (
            -1,
            Discs(
                np.zeros((0, 3)),
                np.zeros((0, 2)),
                np.zeros(0),
            ),
        )

    def begin_scan(self, points: Index, peak: float) -> None:
        """Begin a new scan (set of values of all cubes), and move Hertz contacts to where they are
        expected in it.

        A Hertz fit is dropped if its contacts have left the region or pull at the surface.

        Args:
            points: Indices of the points of the surface that form the region in this scan.
            peak: Largest pressure in Pa at these points, at the depth of the cubes' centres.
        """
        self.points = points
        self.peak = peak
        self.waited += 1
        self._is_tried = False
        self._steps = 0
        fit = self.fit
        is_bad = self._is_misfit_larger and self.has_fitted_neighbours
        self._bad_scans = self._bad_scans + 1 if is_bad else 0
        if isinstance(fit, HertzFit):
            # Each of two fits near each other subtracts the response to the contacts of the other.
            # If both extrapolated, changes of these responses would be amplified in every scan.
            fit.predict(extrapolates=not self.near)
            self._follow_home(fit)

    def drop_grid_of_other_values(self) -> None:
        """Drop a fit by grid contacts if its cubes have lost or regained values.

        The covariance of the forces was computed for the values that were known before.
        """
        if isinstance(self.fit, GridFit) and not self.fit.values.has_same_values:
            self.fit = None

    @property
    def cubes(self) -> Index:
        """Indices (m,) of the cubes below the points of the region."""
        return np.unique(self._inverse.cube[self.points])

    @property
    def home(self) -> int:
        """Index of the cube in the middle of the region, around which the skin is laid flat."""
        positions = self._inverse.points[self.points]
        from_middle = positions - positions.mean(axis=0)
        middle = (from_middle**2).sum(axis=1).argmin()
        return int(self._inverse.cube[self.points[middle]])

    @property
    def frame(self) -> int:
        """Index of the cube in whose frame `estimate_contacts` states the contacts."""
        return self.home if self.fit is None else self.fit.values.home

    def estimate_contacts(self, is_refined: bool) -> list[ContactEstimate]:
        """Return force, position, moment and area of each contact of the region.

        Args:
            is_refined: Value of the property `is_refined`. If it is false, larger variances are
                returned (`COARSE_DEVIATION`).
        """
        if self.fit is None:
            return [self.integral]
        contacts = self.fit.estimate_contacts()
        if is_refined:
            return contacts
        place_variance = (COARSE_DEVIATION * self._inverse.pitch) ** 2
        coarse = []
        for one in contacts:
            force_variance = (COARSE_DEVIATION * one.force[2]) ** 2
            widened = one._replace(
                force_covariance=one.force_covariance + force_variance * np.eye(3),
                place_variance=one.place_variance + place_variance,
            )
            coarse.append(widened)
        return coarse

    @property
    def _is_misfit_larger(self) -> bool:
        """Whether the misfit has grown by more than `MAX_MISFIT_GROWTH` since the fit was made."""
        limit = MAX_MISFIT_GROWTH * self._first_misfit
        return self.fit is not None and self.fit.shape_misfit > limit

    def _have_others_changed(self, fit: GridFit) -> bool:
        """Whether the stress that other regions cause in the cubes of a fit has changed by more
        than `MAX_OTHERS_CHANGE` since the fit was made."""
        values = fit.values
        if self._compared_others is not self.others:
            self._compared_others = self.others
            change = self.others - self._fitted_others
            white = (values.whitening @ change[:, :, None]).ravel()
            self._others_change = float(white @ white)
        return self._others_change > MAX_OTHERS_CHANGE * values.count

    def _follow_home(self, fit: HertzFit) -> None:
        """Choose a new home cube if the contacts have moved away from the present one, or drop the
        fit.

        The home cube is the cube around which the curved skin is laid flat for the fit. The fit is
        dropped if one of its contacts has left the region or pulls at the surface.
        """
        inverse = self._inverse
        values = fit.values
        found = fit.found
        below = values.find_nearest_cubes(found.centres)
        around = inverse.near[inverse.cube[self.points], : NEAREST_CUBES[-1]]
        is_around = all((around == cube).any() for cube in below)
        if not (is_around and fit.is_pressing):
            self.fit = None
            return
        # The home cube is the origin of the frame of the contacts.
        mean_centre = found.centres.sum(axis=0) / len(below)
        from_home = math.hypot(*mean_centre.tolist())
        if from_home > HOME_PITCHES * inverse.pitch:
            home = int(values.find_nearest_cubes(mean_centre[None])[0])
            if home != values.home:
                centre_cubes = np.append(below, home)
                cubes = np.unique(inverse.near[centre_cubes])
                fit.move_home(self._collect(home, cubes))

    def _collect(self, home: int, cubes: Index) -> LocalValues:
        """Return noise and positions of the cubes from whose values a region is fitted.

        They respond to contacts above the home cube of the fit.

        Args:
            home: Index of the home cube, around which the skin is laid flat for the fit.
            cubes: Indices (n,) of the cubes from which those that respond are chosen: their outward
                normals and that of the home cube have a cosine above `MIN_FACING`.
        """
        normals = self._inverse.poses.rotation[:, :, 2]
        cosines = normals[cubes] @ normals[home]
        facing = cubes[cosines > MIN_FACING]
        return LocalValues(self._inverse, self._noise, home, facing)

    def _whiten_newest(self, values: LocalValues) -> Array:
        """Return the newest values as from `_whiten`, after updates of the noise of the cubes and
        of their response to other regions."""
        self._noise.update(self._noise.scaled, values.cubes)
        self.subtract_others(values, *self._respond(values.cubes))
        values.refresh()
        return self._whiten(values)

    @property
    def has_fitted_neighbours(self) -> bool:
        """Whether all regions in `near` have a fit, so that the response to them is well known."""
        return all(other.fit is not None for other in self.near)

    @property
    def is_refined(self) -> bool:
        """Whether the fits of this region and of all regions near agree with the newest values.

        They do not agree if one of them is missing, if a misfit has grown, or if the traction in
        this region must be fitted (again) first. If the response to other regions has changed, a
        new fit is required only after `GridFit.sharpen`, which has adapted the prior to the old
        response. Before, the prior is the same for all grid contacts, and the present fit follows
        the newest response.
        """
        is_worse = any(one._is_misfit_larger for one in (self, *self.near))
        if self.fit is None or is_worse or not self.has_fitted_neighbours:
            return False
        return self.next_work in (Work.MOVE, Work.CHOOSE, Work.SHARPEN, Work.NONE)

    @property
    def relative_error(self) -> float:
        """Relative standard deviation of the stress that the contacts of this region cause in the
        cubes around other regions."""
        return START_ERROR if self.fit is None else FIT_ERROR

    @property
    def discs(self) -> tuple[int, Discs]:
        """Index of the home cube of this region, and Hertz contacts that replace its traction.

        The contacts cause nearly the same stress in distant cubes as the traction. They are in the
        frame of the home cube, around which the skin is laid flat.
        """
        return self.frame, self._start if self.fit is None else self.fit.discs

    def take_integral(self, integral: ContactEstimate) -> None:
        """Store the estimate from integrals of the field, at which the first fit begins."""
        self.integral = integral
        # `integral.area` is the area of the pressure at the depth of the cubes. The squared radius
        # of this area is larger than that at the surface by about the squared depth.
        depth = self._inverse.depth
        squared_radius = integral.area / math.pi - depth**2
        largest = MAX_START_SIZE * depth
        squared_radius = min(max(squared_radius, (depth / 2) ** 2), largest**2)
        self._start = make_discs([integral._replace(area=math.pi * squared_radius)])

    def find_stale_cubes(self, cubes: Index) -> Index:
        """Return those of some cubes for which the stored response to this region is out of date.

        If the contacts of the region have changed by more than `MAX_STALE_CHANGE` since responses
        were computed, these are all of the cubes. If not, they are the cubes whose response has not
        been computed for these contacts. The cubes of the fit are never among them, because the
        fit itself predicts their response.

        Args:
            cubes: Indices (n,) of the cubes.
        """
        home, discs = self.discs
        old_home, old = self._responded
        is_changed = home != old_home or len(old.forces) != len(discs.forces)
        if not is_changed and discs is not self._checked:
            relative_shift = np.abs(discs.centres - old.centres).max() / self.gap
            force_change = np.abs(discs.forces - old.forces).max()
            relative_change = force_change / np.abs(discs.forces).max()
            limit = MAX_STALE_CHANGE * self.relative_error
            is_changed = max(relative_shift, relative_change) >= limit
        self._checked = discs
        if is_changed:
            self._responding[:] = False
            self._responded = home, discs
        if self.fit is not None:
            self._responding[self.fit.values.cubes] = True
        return cubes[~self._responding.take(cubes)]

    def take_response(self, cubes: Index, response: Array) -> None:
        """Store the newest response of some cubes to this region.

        Args:
            cubes: Indices (n,) of the cubes.
            response: Change (n, C), in Pa, of their C measured components by this region.
        """
        self.response[cubes] = response
        self._responding[cubes] = True

    @property
    def _moved_share(self) -> float:
        """Share of the points that have joined the region since its last fit, or that have left it;
        the larger one of the two."""
        new, old = self.points, self._fitted_points
        if new is old:
            return 0.0
        common = np.intersect1d(new, old, assume_unique=True)
        return 1 - len(common) / max(len(new), len(old))

    @property
    def next_work(self) -> Work:
        """Next step of the fit of this region."""
        fit = self.fit
        if fit is None and self._is_hertz_due:
            return Work.BEGIN
        if self._prepared is not None:
            return Work.SOLVE
        is_worse = self._is_misfit_larger
        may_prepare = not self._is_tried
        if isinstance(fit, HertzFit):
            is_moving = fit.is_unsettled or (is_worse and fit.needs_linearisation)
            if is_moving and self._steps < MAX_STEPS:
                return Work.MOVE
            is_lastingly_worse = is_worse and self._bad_scans >= MAX_BAD_SCANS
            may_prepare &= is_lastingly_worse and self.has_fitted_neighbours
        elif fit is not None:
            if self._is_hertz_due:
                return Work.CHOOSE
            if may_prepare and self._moved_share <= MAX_CHANGE:
                peak_change = abs(self.peak / self._fitted_peak - 1)
                have_others_changed = fit.is_sharpened and self._have_others_changed(fit)
                if peak_change > MAX_CHANGE or is_worse or have_others_changed:
                    return Work.RENEW
                may_prepare = False
            if not may_prepare:
                return Work.NONE if fit.is_sharp else Work.SHARPEN
        return Work.PREPARE if may_prepare else Work.NONE

    def estimate_ms(self, work: Work) -> float:
        """Return the computing time, in ms, of a step of the kind `work` of this region's fit."""
        if work in (Work.MOVE, Work.BEGIN, Work.CHOOSE):
            return WORK_MS[work]
        fit = self._prepared or self.fit
        if isinstance(fit, GridFit):
            n_grid_contacts = float(len(fit.places))
        else:
            area = len(self.points) * self._inverse.area
            n_grid_contacts = area / (GRID_STEP * self._inverse.depth) ** 2
        return WORK_MS[work] * min(n_grid_contacts / MAX_GRID_CONTACTS, 1.0)

    def improve(self, work: Work) -> None:
        """Make the next step of the fit, for the newest values.

        Args:
            work: Kind of the step (`next_work`).
        """
        self.waited = 0
        fit = self.fit
        if work == Work.BEGIN:
            self._begin_hertz()
        elif work == Work.PREPARE:
            self._prepare_grid()
        elif work in (Work.SOLVE, Work.RENEW):
            self._solve_grid()
        elif isinstance(fit, HertzFit):
            self._steps += 1
            before = fit.found
            fit.values.refresh_if_stale()
            iterate(self._inverse, fit, self._whiten(fit.values), 1)
            if not fit.is_pressing:
                fit.found = before
        elif isinstance(fit, GridFit) and work == Work.CHOOSE:
            self._replace_by_hertz(fit)
        elif isinstance(fit, GridFit) and self._have_others_changed(fit):
            self._solve_grid()
        elif isinstance(fit, GridFit):
            fit = fit.sharpen(self._whiten(fit.values))
            self.fit = fit
            self._is_hertz_due = fit.is_sharp
            self._first_misfit = fit.misfit

    def step(self) -> None:
        """Compute the fit of this region for the newest values. A `HertzFit` makes a Gauss-Newton
        step; the fit is dropped if one of its contacts then pulls at the surface."""
        fit = self.fit
        if fit is None:
            return
        fit.step(self._whiten(fit.values))
        if isinstance(fit, HertzFit) and not fit.is_pressing:
            self.fit = None
        elif np.isfinite(self.gap):
            self.store_response()

    def store_response(self) -> None:
        """Store the response to this region in the cubes of its fit, as predicted by the fit. The
        fits of other regions subtract it."""
        if self.fit is not None:
            self.response[self.fit.values.cubes] = self.fit.explained

    def _whiten(self, values: LocalValues) -> Array:
        """Return the newest values (n C,) of the cubes of a fit, whitened (noise of variance 1).

        The response of these cubes to the contacts of other regions is subtracted first.
        """
        return values.whiten(self._noise.scaled, self.others)

    def _begin_hertz(self) -> None:
        """Fit one Hertz contact, from the contact that the linear inverse problem found.

        The fit is kept if the contact presses, the steps have converged and the misfit is small. If
        other regions are near, their contacts may cause the misfit, which then falls when these
        regions are fitted, too. So the fit is then kept up to a misfit of `MAX_NEAR_MISFIT`, even
        if its steps have not converged.
        """
        self._is_hertz_due = False
        home = self.home
        values = self._collect(home, self._inverse.near[home])
        white = self._whiten_newest(values)
        fit = HertzFit(self._inverse, values, self._start)
        iterate(self._inverse, fit, white, MAX_STEPS // 2)
        max_misfit = MAX_NEAR_MISFIT if self.near else MAX_HERTZ_MISFIT
        if fit.needs_linearisation and fit.shape_misfit < HOPELESS * max_misfit:
            iterate(self._inverse, fit, white, MAX_STEPS // 2)
        is_plausible = fit.is_pressing and fit.shape_misfit < max_misfit
        is_settled = not fit.is_unsettled or self.near
        if fit.values.count and is_plausible and is_settled:
            self._accept(fit)
            self._first_misfit = MAX_HERTZ_MISFIT / MAX_MISFIT_GROWTH

    def subtract_others(
        self,
        values: LocalValues,
        total: Array,
        deviation: Array,
    ) -> Array:
        """Set and return `others`, the response to all other regions.

        The fit of this region subtracts it from the C measured components of each of its cubes.

        Args:
            values: Cubes of the fit. Its attribute `disturbance` is set to the standard deviation
                of `others`.
            total: Response (cubes, C), in Pa, of all cubes to all regions, this one included. Only
                the rows of the cubes of the fit are used.
            deviation: Standard deviation (cubes, C) of this response, in Pa.
        """
        cubes = values.cubes
        own = self.response.take(cubes, axis=0)
        self.others = total.take(cubes, axis=0) - own
        own_deviation = self.relative_error * np.abs(own)
        values.disturbance = deviation.take(cubes, axis=0) - own_deviation
        return self.others

    def _prepare_grid(self) -> None:
        """Prepare a fit of the traction by grid contacts (small contacts on a grid).

        If there are too many cubes or no known values, nothing is prepared.
        """
        self._is_tried = True
        inverse = self._inverse
        for count in NEAREST_CUBES:
            cubes = np.unique(inverse.near[self.cubes, :count])
            if len(cubes) <= MAX_CUBES:
                self._noise.update(self._noise.scaled, cubes)
                values = self._collect(self.home, cubes)
                if values.count:
                    self._prepared = GridFit.cover(
                        inverse,
                        self.points,
                        values,
                    )
                return

    def _solve_grid(self) -> None:
        """Fit the forces of grid contacts: those prepared or, if there are none, those of `fit`."""
        self._is_tried = True
        fit = self._prepared or self.fit
        self._prepared = None
        if isinstance(fit, GridFit) and fit.values.has_same_values:
            fit = fit.of_region
            fit.solve(self._whiten_newest(fit.values))
            self._is_hertz_due = not self._is_direct
            self._accept(fit)

    def _replace_by_hertz(self, grid_fit: GridFit) -> None:
        """Replace the fit by grid contacts by one Hertz contact for each of its contacts, if that
        increases the evidence (probability of the values)."""
        self._is_hertz_due = False
        starts = grid_fit.estimate_contacts()
        largest_aspect = max(one.aspect for one in starts)
        if largest_aspect > MAX_HERTZ_ASPECT:
            return
        discs = make_discs(starts)
        largest_size = MAX_START_SIZE * self._inverse.depth
        log_sizes = np.minimum(discs.log_sizes, np.log(largest_size))
        discs = discs._replace(log_sizes=log_sizes)
        fit = HertzFit(self._inverse, grid_fit.values, discs)
        iterate(self._inverse, fit, self._whiten(fit.values), MAX_STEPS)
        # The evidence of all cubes can hide a misfit of the nearest cubes. So their misfit is
        # tested, too, except if there are other regions, whose contacts may cause it.
        is_round = fit.shape_misfit < MAX_HERTZ_MISFIT or np.isfinite(self.gap)
        if is_round and not fit.is_unsettled and fit.score < grid_fit.score:
            self._accept(fit)

    def _accept(self, fit: HertzFit | GridFit) -> None:
        """Make `fit` the fit of this region, and store the state of the region at this fit.

        The state consists of the points of the surface, the largest pressure, the response to other
        regions and the misfit. If the state of a later scan differs too much, the region is fitted
        again.
        """
        self.fit = fit
        self._responded = -1, fit.discs
        self.store_response()
        self._fitted_points = self.points
        self._fitted_peak = self.peak
        self._fitted_others = self.others
        self._compared_others = None
        lowest_misfit = MAX_HERTZ_MISFIT / MAX_MISFIT_GROWTH
        self._first_misfit = max(fit.shape_misfit, lowest_misfit)


def iterate(
    inverse: SurfaceInverse,
    fit: HertzFit,
    white: Array,
    steps: int,
) -> None:
    """Make Gauss-Newton steps until the fit has converged, but at most a number of them.

    Args:
        inverse: Responses of the skin.
        fit: The fit.
        white: Whitened values (n C,), as for `HertzFit.step`.
        steps: Largest number of steps.
    """
    for _ in range(steps):
        linearise(inverse, fit)
        fit.step(white)
        if not fit.is_inexact:
            break


def update_responses(
    inverse: SurfaceInverse,
    regions: Sequence[TrackedRegion],
    cubes: Index,
) -> None:
    """Compute the response of cubes (change of their components, in Pa) to regions of contact.

    The response is only computed again for regions whose contacts have changed. It is computed for
    round Hertz contacts, because the stress in distant cubes hardly depends on the shape of a
    contact.

    Args:
        inverse: Poses and responses of the skin.
        regions: Regions whose `response` is computed.
        cubes: Indices (n,) of the cubes.
    """
    normals = inverse.poses.rotation[:, :, 2]
    for region in regions:
        stale = region.find_stale_cubes(cubes)
        if len(stale):
            home, discs = region.discs
            place, angle = inverse.unroll(home, stale)
            response = respond(
                inverse,
                place,
                angle,
                inverse.variant[stale],
                discs,
            )
            # On a bent skin, cubes that face away from a contact do not respond to it.
            is_facing = normals[stale] @ normals[home] > MIN_FACING
            region.take_response(stale, response * is_facing[:, None])
