# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Stick, slip and friction coefficient of the contacts of a skin.

The contact tracker takes several milliseconds, too long for every scan (set of values of all cubes)
at 1 kHz. Between its updates, force and position of each contact are computed in every scan from
the changes of the cubes' values. Let J be the derivatives of the values, divided by their noise, by
the parameters of a Hertz contact (force, position, radius, flatness), and P the prior precision of
these parameters. A change dy of the values, divided by their noise, then means a change dp of the
parameters::

    dp = (J' J + P)^-1 J' dy

The matrix (J' J + P)^-1 J' contains the derivatives of force and position by the values. To
linearise a contact means to compute them. This is repeated when the contact has moved or its force
has changed by more than a limit.

A body that sticks keeps its place on the skin, also while the skin deforms and while the rim of the
contact slips (Cattaneo, Mindlin). When all of the contact slips (gross slip), Coulomb's law fixes
the ratio of shear and normal force, and the contact moves along the shear force that the body
exerts on the skin. So a contact slips if it moves in this direction while the ratio stays nearly
the same. If a sticking body is pulled at a point above the surface, its centre of pressure moves,
too, but in proportion to the change of the ratio. A body that rolls moves without a shear force
along its path.

While only the rim of the contact slips (partial slip), the shear force is distributed differently,
so that the values y of the cubes are not proportional to it. A least-squares fit of y0, a, B and C,
with the change f of the normal force and the change q (3) of the shear force since the start of the
fit, shows this by its last term::

    y = y0 + a f + B q + C |q| q

For a ball, |C |q| q| / |B q + C |q| q| is about 0.1 at 60 % of the largest shear force that
friction holds, and 0.2 at the largest one. For a flat punch, which has no partial slip, it is 0.
Errors of the pads' gains and of the elastomer's properties appear in the linear terms.

Source: K. L. Johnson, Contact Mechanics (1985), 7.1 (sliding) and 7.2 (partial slip).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..core.arrays import Array, Index, Mask
from .inverse import SurfaceInverse
from .tracker.contact_estimate import Discs
from .tracker.contact_tracker import TrackedContact
from .tracker.hertz_fit import HertzFit, linearise
from .tracker.local_values import MIN_FACING, CubeNoise, LocalValues

UNKNOWN = 0
"""State of a contact that is neither known to stick nor to slip: it is new, its force is below
`MIN_FORCE_N`, or it moves as a rolling or tilting body does."""
STICK = 1
"""State of a contact that keeps its place on the skin; its rim may slip."""
SLIP = 2
"""State of a contact whose whole area slides over the skin (gross slip)."""

N_CUBES = 16
"""Number of cubes nearest to a contact from whose values its force and position are computed in
every scan."""

LAGS = np.array([2, 4, 8, 16, 32, 64])
"""Durations, in scans, over which the motion of a contact is tested. The short ones find fast slip
early; the long ones find slow slip, whose motion the noise hides over a short time."""

N_SCANS = int(LAGS[-1]) + 1
"""Number of scans whose motion states (position and forces of each contact) are stored: the newest
scan and those before it, as many as the longest of the `LAGS`."""

MIN_DISTANCE_M = 10e-6
"""Smallest motion in m that counts as slip; the noise of the position is 0.3 to 3 um for loads of
1 to 10 N."""

MIN_SPEED = 1e-3
"""Smallest speed of slip in m/s. Slower motion may be creep of the elastomer or drift."""

SIGNIFICANCE = 5.0
"""Smallest motion that counts as slip, divided by the standard deviation that the noise of the pads
causes. With Gaussian noise, 1000 scans a second and 6 lags (`LAGS`), the noise of one contact
exceeds this limit once in 47 s. A motion that counts as slip must also have the direction of the
shear force and exceed `MIN_DISTANCE_M`: contacts that were held and shaken with 2 g gave no false
alarm in 40 minutes."""

LEVER_M = 0.1
"""Largest height, in m above the surface, at which an external shear force is assumed to act on a
sticking body. The force tilts the body, which shifts the centre of pressure by the height times the
ratio r of shear and normal force. Such a shift must not count as slip.

The assumed height is `LEVER_M` / (1 + 2 r). It is smaller for larger ratios, because a body that is
pulled far above the surface tips over before the ratio gets large.
"""

LEAK_M = 0.01
"""Apparent motion, in m, for a change by 1 of the ratio of shear and normal force, or of the
logarithm of the normal force. Where the skin deviates from the model, changes of the force look
like motion, which must not count as slip."""

MIN_RATIO = 0.1
"""Smallest ratio of shear and normal force of a contact that slips. With less shear, the direction
of the shear force is not known well enough, and rolling looks like slip."""

MIN_SHARE_OF_LARGEST = 0.5
"""Smallest ratio of shear to normal force at which a contact can slip, divided by the largest ratio
of this contact so far. Friction has held the largest ratio, and the coefficient of kinetic friction
is rarely less than half of the static one."""

MAX_RATIO_CHANGE = 0.2
"""Largest change of the ratio of shear and normal force, divided by the ratio, during a motion that
counts as slip. A motion with a larger change may be that of a sticking body that tilts."""

MIN_COSINE = 0.8
"""Smallest cosine of the angle between motion and shear force of a contact that slips. A body that
moves across its shear force rolls or tilts."""

MIN_LATE_SHARE = 0.25
"""Smallest fraction of a contact's motion, during one of the durations `LAGS`, that must fall into
the second half of this duration for slip. If the fraction is smaller, the contact has stopped."""

MIN_FORCE_N = 0.05
"""Normal force, in N, that a contact must exceed for the state `STICK`. With a smaller force, its
state is `UNKNOWN` unless slip is detected."""

FOLLOWED_DEVIATION = 0.02
"""Relative standard deviation of the ratio of shear and normal force that is computed from changes
of the cubes' values since the last fit of the contact tracker. The error was 1.6 % (rms) in
simulations of 24-pad cubes, for contacts that had moved by up to some millimetres since this fit.
"""

MAX_SHIFT_DEPTHS = 0.2
"""Shift of a contact since it was linearised, divided by the depth of the cubes' centres below the
surface, after which it is linearised again: the derivatives of its force and position by the cubes'
values are computed for its new position."""

MIN_SHIFT_DEPTHS = 0.1
"""Smallest shift of a contact since the last fit of the contact tracker, divided by the depth of
the cubes' centres, for which `MAX_SHIFT_DEPTHS` applies. A smaller shift is computed well enough
with inexact derivatives, for which `MAX_FITTED_SHIFT_DEPTHS` is the limit."""

MAX_FITTED_SHIFT_DEPTHS = 0.5
"""Shift of a contact since it was linearised, divided by the depth of the cubes' centres, after
which it is linearised again (`MAX_SHIFT_DEPTHS`) even if the contact tracker has just fitted it, so
that its position is known."""

MAX_FORCE_CHANGE = 0.3
"""Change of the force of a contact, divided by the force, after which the derivatives of its force
and position by the cubes' values are computed again. The derivatives depend on the radius of the
contact, which changes with the force."""

MAX_JUMP = 0.6
"""Change of the force of a contact since the derivatives of its force and position by the cubes'
values were computed, divided by the force, above which its motion is unknown, because linear
extrapolation gives no useful position. Only a sudden change, as of a body that bounces, exceeds
this limit: after slower changes, the derivatives are computed again earlier (`MAX_FORCE_CHANGE`).
"""

MAX_LINEARISATIONS = 2
"""Largest number of contacts for which the derivatives of force and position by the cubes' values
are computed in one scan. Each contact takes up to 1 ms."""

NEIGHBOUR_PITCHES = 3.0
"""Distance of two contacts, divided by the pitch (distance of neighbouring cubes), below which
changes of the cubes' values are attributed to changes of both contacts."""

MAX_NORMAL_CHANGE = 0.05
"""Change of the normal force of a contact, divided by the whole force, after which the fit of
`Slip.partial` (measure of partial slip) starts again. The fit includes a term for the normal force,
so that changes of 2 % did not change the result."""

MAX_SHIFT_M = 2e-4
"""Motion of a contact, in m, after which the fit of `Slip.partial` (measure of partial slip) starts
again. Motion changes the stresses like partial slip; a motion of 1 mm changes them by as much. In
simulations of flat punches, which have no partial slip, a motion of 0.1 mm gave a `Slip.partial` of
up to 0.05."""

PARTIAL_DEVIATION = 0.01
"""Largest standard deviation of `Slip.partial`, a ratio that measures partial slip, due to the
noise of the pads. While it is larger, because the shear force has changed little, `Slip.partial` is
unknown (NaN)."""

_NEWEST = 0
"""Index, on the second axis of arrays of `_Contacts`, of the newest linearisation: derivatives of a
contact's load (force and position) by the values of the cubes."""

_FIRST = 1
"""Index, on the second axis of arrays of `_Contacts`, of the linearisation for the fit of
`Slip.partial` (measure of partial slip). This fit needs the same derivatives in all of its scans,
so those from its first scan are kept."""

_SHEAR_TERMS = np.repeat([[0, 0, 1, 1], [0, 0, 0, 1]], [1, 1, 3, 3], axis=1)
"""Masks (2, 8) of the terms 1, f, q and |q| q of the fit of `Slip.partial` (head of this file): of
both terms with the shear force, q and |q| q, and of |q| q alone."""


Fits = Mapping[int, HertzFit]
"""Fits of one Hertz contact each, by the ids of the contacts (`ContactTracker.single_fits`)."""

NO_FITS: Fits = MappingProxyType({})
"""Empty mapping, for scans in which the contact tracker has fitted no contact."""


class Slip(NamedTuple):
    """State and friction of n contacts.

    Attributes:
        state: `UNKNOWN`, `STICK` or `SLIP` of each contact (n,).
        friction: Friction coefficient (n,); NaN before the first slip.
        friction_uncertainty: Standard deviation of the friction coefficient (n,).
        friction_use: Ratio of shear and normal force, divided by the friction coefficient (n,); NaN
            before the first slip.
        velocity: Velocity (n, 3) of slip in m/s, in the skin's parent frame; 0 without slip, NaN if
            the state is unknown.
        partial: Measure (n,) of partial slip. It is the ratio |C |q| q| / |B q + C |q| q| (head of
            this file): the part of the change of the cubes' values that is not proportional to the
            change q of the shear force, divided by the whole change that the shear force causes.
            NaN if the normal force changes, the contact moves, or the shear force has changed too
            little.
    """

    state: Index
    friction: Array
    friction_uncertainty: Array
    friction_use: Array
    velocity: Array
    partial: Array


NO_CONTACTS = Slip(
    state=np.zeros(0, np.intp),
    friction=np.zeros(0),
    friction_uncertainty=np.zeros(0),
    friction_use=np.zeros(0),
    velocity=np.zeros((0, 3)),
    partial=np.zeros(0),
)
"""State and friction if nothing presses on the skin: empty arrays."""


@dataclass
class _Contacts:
    """The n contacts that the tracker has found last. The first axis of each array counts them.

    V values of the cubes near a contact determine its load (2, 3): force in N and position in m.
    The second axis (2) of `cubes`, `weights`, `values` and `pad_variance` stands for two
    linearisations (derivatives of the load by the values): the newest one (`_NEWEST`), and the one
    that was the newest when the fit of `Slip.partial` began (`_FIRST`). The latter is used for the
    whole fit, because other derivatives would give another shear force even for the same values.

    Attributes:
        normal: Unit normals (n, 3) out of the skin.
        ratio_deviation: Standard deviations s (n,) of the ratio of shear and normal force.
        largest_ratio: Largest value (n,) so far of the ratio of shear and normal force minus 3 s.
        slips: Whether each contact slips (n,).
        is_fitted: Whether the ratios in `sums` are of loads that the tracker has found (n,).
        sums: Sums (n, 3) of 1 / s, 1 / s^2 and ratio / s^2 over the scans in which a contact slips.
        cubes: Indices (n, 2, cubes) of the nearest cubes.
        weights: Derivatives (n, 2, 6, V) of the load by the values in Pa.
        values: Values (n, 2, V) in Pa from which changes are counted.
        pad_variance: Sums (n, 2) of the variances of the noise of the V values, in Pa^2.
        noise: Standard deviations (n,) of the position in m; 0 before the first linearisation.
        load: Loads (n, 2, 3) at the newest `values`.
        linearised: Loads (n, 2, 3) for which the newest `weights` were computed.
        past: Motion states (n, scans, 7) of the last scans, from `_compute_motion_states`.
        terms: Terms (n, 8) of the fit of `Slip.partial` in the newest scan: 1, f, q and |q| q, with
            the changes f of the normal force and q of the shear force (head of this file).
        equations: Normal equations (n, 8, 8 + V) of this fit: sums over its scans of the products
            of the terms with the terms and with the changes of the values.
        partial: Results (n,) of this fit, as in `Slip.partial`.
    """

    normal: Array
    ratio_deviation: Array
    largest_ratio: Array
    slips: Mask
    is_fitted: Mask
    sums: Array
    cubes: Index
    weights: Array
    values: Array
    pad_variance: Array
    noise: Array
    load: Array
    linearised: Array
    past: Array
    terms: Array
    equations: Array
    partial: Array

    @classmethod
    def make_new(cls, n_cubes: int, n_values: int) -> _Contacts:
        """Return one contact of which nothing is known."""

        def zeros(*shape: int) -> Array:
            return np.zeros((1, *shape))

        return cls(
            normal=zeros(3),
            ratio_deviation=zeros(),
            largest_ratio=zeros(),
            slips=zeros() > 0,
            is_fitted=zeros() > 0,
            sums=zeros(3),
            cubes=zeros(2, n_cubes).astype(np.intp),
            weights=zeros(2, 6, n_values),
            values=zeros(2, n_values),
            pad_variance=zeros(2),
            noise=zeros(),
            load=zeros(2, 3),
            linearised=zeros(2, 3),
            past=zeros(N_SCANS, 7) + np.nan,
            terms=zeros(8),
            equations=zeros(8, 8 + n_values),
            partial=zeros(),
        )

    def select(self, numbers: list[int], new: _Contacts) -> _Contacts:
        """Return the contacts with these numbers; the number -1 stands for the contact `new`."""
        pairs = zip(vars(self).values(), vars(new).values(), strict=True)
        return _Contacts(*(np.concatenate(pair)[numbers] for pair in pairs))

    def describe(self, found: Sequence[TrackedContact]) -> None:
        """Take over normals and ratios of shear and normal force, and compute `partial`."""
        for row, one in enumerate(found):
            ratio = one.shear_force / one.normal_force
            by_normal_force = ratio * one.force_uncertainty
            deviation = math.hypot(by_normal_force, one.shear_uncertainty) / one.normal_force
            self.normal[row] = one.normal
            self.ratio_deviation[row] = deviation
            self.largest_ratio[row] = max(self.largest_ratio[row], ratio - 3 * deviation)
        self.partial = self.estimate_partial_slip()

    def correct(self, found: Sequence[TrackedContact], followed: Array) -> Array:
        """Take over and return the loads (n, 2, 3) that the tracker has found.

        Args:
            found: The contacts.
            followed: Their loads in the same scan, computed from changes of the cubes' values.
        """
        loads = np.array([(one.force, one.position) for one in found])
        self.load = loads.copy()
        # The tracker has fitted the loads again, which corrects the errors that `followed` has
        # gathered since the last fit. The past states get the same correction, so that the
        # correction does not look like motion.
        both = np.stack([followed, loads])
        before, after = _compute_motion_states(both, self.normal)
        self.past += (after - before)[:, None]

        # The friction coefficient is a mean of ratios of shear and normal force during slip. When
        # the tracker fits a contact for the first time while it slips, earlier ratios are dropped,
        # because they were only computed from changes of the values.
        slips = self.slips
        if slips.any():
            self.sums[slips & ~self.is_fitted] = 0.0
            self.is_fitted |= slips
            self.add_ratios(
                slips,
                _compute_lengths(after[:, 3:6]),
                self.ratio_deviation,
            )
        return loads

    def add_ratios(self, chosen: Mask, ratio: Array, deviation: Array) -> None:
        """Add force ratios of slipping contacts to the weighted mean, the friction coefficient.

        The pads' gains cause the same error in all ratios. So the deviation of the mean is the mean
        of the deviations s, with the same weights 1 / s^2.

        Args:
            chosen: Contacts (n,) that slip.
            ratio: Ratios (n,) of shear and normal force.
            deviation: Standard deviations s (n,) of the ratios.
        """
        weight = deviation**-2
        added = np.stack([1 / deviation, weight, ratio * weight], axis=1)
        self.sums[chosen] += added[chosen]

    def observe_shear(self, change: Array, load_change: Array) -> None:
        """Add the values of a scan to the fits of `Slip.partial`.

        A fit starts again when the normal force or the position has changed, or the contact slips.

        Args:
            change: Changes (n, V) of the values in Pa since the first scan of each fit.
            load_change: Changes (n, 2, 3) of the loads that follow from them.
        """
        outward, shear = _split_force(load_change[:, 0], self.normal)
        curved = _compute_lengths(shear)[:, None] * shear
        one = np.ones_like(outward)
        terms = np.concatenate([one, outward, shear, curved], axis=1)
        factors = np.concatenate([terms, change], axis=1)
        self.terms = terms

        force = _compute_lengths(self.load[:, 0])
        is_over = np.abs(outward[:, 0]) > MAX_NORMAL_CHANGE * force
        is_over |= _compute_lengths(load_change[:, 1]) > MAX_SHIFT_M
        # Before the first linearisation, the derivatives of the loads and so the shear forces of
        # all scans are 0. The fit only begins after this linearisation.
        has_no_shear = self.equations[:, 2, 2] + shear[:, 0] ** 2 == 0
        is_over |= self.slips | has_no_shear
        linear = self.cubes, self.weights, self.values, self.pad_variance
        for row, restarts in enumerate(is_over.tolist()):
            if restarts:
                for array in linear:
                    array[row, _FIRST] = array[row, _NEWEST]
                self.equations[row] = 0.0
            else:
                self.equations[row] += terms[row, :, None] * factors[row]

    def estimate_partial_slip(self) -> Array:
        """Return the measure (n,) of partial slip, `Slip.partial`, from the least-squares fit of
        the cubes' values (head of this file)."""
        partial = np.full(len(self.terms), np.nan)
        # The fit of 8 coefficients needs at least 8 scans, whose number is the first diagonal
        # element of the normal equations. While a contact moves, the fit starts again in each scan.
        rows = np.flatnonzero(self.equations[:, 0, 0] >= 8)
        if len(rows):
            gram, moments = np.split(self.equations[rows], [8], axis=2)
            # The matrix is singular, because the shear force has no component along the normal. A
            # small addition to the diagonal makes it invertible.
            size = np.trace(gram, axis1=1, axis2=2)[:, None, None]
            inverse = np.linalg.inv(gram + 1e-9 * (size + 1) * np.eye(8))
            terms = self.terms[rows, None] * _SHEAR_TERMS
            weights = terms @ inverse
            change, curved = _compute_lengths(weights @ moments).T
            variance = (weights[:, 1] * terms[:, 1]).sum(axis=1)
            variance *= self.pad_variance[rows, _FIRST]
            is_known = variance < (PARTIAL_DEVIATION * change) ** 2
            partial[rows[is_known]] = curved[is_known] / change[is_known]
        return partial

    def test_lags(
        self,
        motion: Array,
        duration: Array,
        shear_ratio: Array,
        ratio: Array,
    ) -> tuple[Mask, Mask]:
        """Test whether each contact has moved, and whether it has slipped, over each of the `LAGS`.

        Args:
            motion: Changes (n, lags, 7) over each lag of position, force ratio and logarithm of the
                normal force (`_compute_motion_states`).
            duration: Durations (lags,) of the lags in s.
            shear_ratio: Shear forces (n, 3) in this scan, divided by the normal forces.
            ratio: Lengths (n,) of `shear_ratio`.

        Returns:
            Whether each contact has moved (n, lags), and whether it has slipped (n, lags).
        """
        moved, turned = motion[..., :3], motion[..., 3:6]
        distance = _compute_lengths(moved)
        moves = distance > MIN_DISTANCE_M
        if not moves.any():
            return moves, moves

        # `tilt` is the largest motion of a sticking body that tilts (`LEVER_M`); it is proportional
        # to the growth of the force ratio along the motion. `leak` is apparent motion (`LEAK_M`).
        ratio = ratio[:, None]
        growth = np.einsum("nlk,nlk->nl", moved, turned) / np.maximum(distance, 1e-12)
        lever = LEVER_M / (1 + 2 * ratio)
        tilt = lever * np.maximum(growth, 0)
        leak = LEAK_M * _compute_lengths(motion[..., 3:])
        # A force that changes and returns within a long lag shows no change over this lag, but may
        # have left the contact shifted. So the motion that the force explains over a lag is at
        # least that over each shorter lag.
        explained = np.maximum.accumulate(tilt + leak, axis=1)
        noise = SIGNIFICANCE * np.sqrt(2) * self.noise[:, None]
        moves = distance > np.maximum(noise, MIN_DISTANCE_M) + explained
        moves &= distance > MIN_SPEED * duration
        # Each lag is twice the next shorter one. The motion over the shorter lag is therefore that
        # in the second half of the longer lag; if it is small, the contact has stopped.
        moves[:, 1:] &= distance[:, :-1] > MIN_LATE_SHARE * distance[:, 1:]

        along = np.einsum("nlk,nk->nl", moved, shear_ratio)
        largest = MIN_SHARE_OF_LARGEST * self.largest_ratio
        slips = moves & (along > MIN_COSINE * distance * ratio)
        slips &= ratio > np.maximum(MIN_RATIO, largest)[:, None]
        slips &= _compute_lengths(turned) < MAX_RATIO_CHANGE * ratio
        return moves, slips


class SlipEstimator:
    """Estimates in every scan whether the contacts that the contact tracker has found slip.

    Attributes:
        slip: State and friction of the contacts in the newest scan, in the order in which the
            tracker has found them.
    """

    def __init__(self, inverse: SurfaceInverse) -> None:
        """Create an estimator without contacts.

        Args:
            inverse: Poses, noise and response of the cubes.
        """
        self._inverse = inverse
        self._noise = CubeNoise(inverse)
        poses = inverse.poses
        self._normals = poses.rotation[:, :, 2]
        self._above_cubes = poses.position + inverse.depth * self._normals
        n_cubes = min(N_CUBES, len(self._above_cubes))
        self._new = _Contacts.make_new(n_cubes, n_cubes * len(inverse.columns))
        self._contacts = self._new.select([], self._new)
        self._found: list[TrackedContact] = []
        # `past` and `_times` are ring buffers, in which the newest scan has the index `_place`.
        self._times = np.full(N_SCANS, -np.inf)
        self._place = 0
        self.slip = NO_CONTACTS

    def update(
        self,
        time_s: float,
        values: Array,
        found: Sequence[TrackedContact] | None = None,
        fits: Fits = NO_FITS,
    ) -> bool:
        """Estimate `slip` from the values of a scan.

        Args:
            time_s: Time of the scan in s. If it equals the time of the previous call, `values` must
                be those of the previous call, too.
            values: Components (cubes, 15) in Pa and Pa/m, NaN where unknown.
            found: Contacts that the tracker has found in these values. None: it has not looked for
                them in this scan, and the contacts are the same as in the previous call.
            fits: Fits of this scan, which contain the derivatives of force and position by the
                values, so that they need not be computed again.

        Returns:
            Whether a contact has begun to slip.
        """
        if found is None:
            fits = NO_FITS  # Fits in an earlier scan hold for other positions.
        else:
            self._match(found)
        contacts = self._contacts
        if not self._found:
            self.slip = NO_CONTACTS
            return False
        scaled = self._inverse.scale_values(values)
        near = scaled[contacts.cubes].reshape(contacts.values.shape)
        change = near - contacts.values
        change[np.isnan(change)] = 0.0  # A value that is missing counts as unchanged.
        load_change = (contacts.weights @ change[..., None]).reshape(
            -1,
            2,
            2,
            3,
        )
        loads = contacts.load + load_change[:, _NEWEST]
        if found is not None:
            contacts.values[:, _NEWEST] = near[:, _NEWEST]
            loads = contacts.correct(found, loads)
        for row in self._find_changed(loads):
            self._linearise(row, loads, scaled, fits)
        contacts.observe_shear(change[:, _FIRST], load_change[:, _FIRST])
        newest = _compute_motion_states(loads, contacts.normal)
        if time_s < self._times[self._place]:
            # The time has jumped back, as at the start of another recording.
            contacts.past[:] = np.nan
        if time_s != self._times[self._place]:
            self._place = (self._place + 1) % N_SCANS
        contacts.past[:, self._place] = newest
        self._times[self._place] = time_s

        places = (self._place - LAGS) % N_SCANS
        motion = newest[:, None] - contacts.past[:, places]
        duration = time_s - self._times[places]
        shear_ratio = newest[:, 3:6]
        ratio = _compute_lengths(shear_ratio)
        moves, slips = contacts.test_lags(
            motion,
            duration,
            shear_ratio,
            ratio,
        )
        slipped: Mask = np.any(slips, axis=1)
        begins = slipped & ~contacts.slips
        contacts.slips = slipped
        is_followed = slipped & ~contacts.is_fitted
        if is_followed.any():
            deviation = np.hypot(contacts.ratio_deviation, FOLLOWED_DEVIATION * ratio)
            contacts.add_ratios(is_followed, ratio, deviation)
        inverse_sum, weight_sum, ratio_sum = contacts.sums.T
        # The friction coefficient is NaN before the first slip of a contact.
        divisor = np.where(weight_sum > 0, weight_sum, np.nan)
        friction = ratio_sum / divisor

        has_past = np.isfinite(motion[:, 0, 0])
        is_strong = newest[:, 6] > np.log(MIN_FORCE_N)
        sticks = has_past & is_strong & ~moves.any(axis=1)
        state = np.where(sticks, STICK, UNKNOWN)
        state[slipped] = SLIP
        velocity = np.zeros((len(state), 3))
        velocity[~sticks] = np.nan
        for row in np.flatnonzero(slipped).tolist():
            shortest = slips[row].argmax()
            velocity[row] = motion[row, shortest, :3] / duration[shortest]
        self.slip = Slip(
            state=state,
            friction=friction,
            friction_uncertainty=inverse_sum / divisor,
            friction_use=ratio / friction,
            velocity=velocity,
            partial=np.where(sticks, contacts.partial, np.nan),
        )
        return bool(begins.any())

    def _match(self, found: Sequence[TrackedContact]) -> None:
        """Take over the contacts that the tracker has found, except for their loads."""
        known = {one.id: number for number, one in enumerate(self._found)}
        numbers = [known.get(one.id, -1) for one in found]
        if numbers != list(range(len(known))):
            self._contacts = self._contacts.select(numbers, self._new)
        self._contacts.describe(found)
        self._found = list(found)

    def _find_changed(self, loads: Array) -> list[int]:
        """Return the numbers of contacts that are to be linearised again.

        Args:
            loads: Force in N and position in m (n, 2, 3) of the contacts. The position of a contact
                that has changed suddenly is replaced by that of its last linearisation.
        """
        contacts = self._contacts
        depth = self._inverse.depth
        force = np.maximum(_compute_lengths(loads[:, 0]), MIN_FORCE_N)
        force_change, shift = _compute_lengths(loads - contacts.linearised).T
        since_fit = _compute_lengths(loads[:, 1] - contacts.load[:, 1])
        is_near_fit = since_fit <= MIN_SHIFT_DEPTHS * depth
        max_shift = np.where(
            is_near_fit,
            MAX_FITTED_SHIFT_DEPTHS,
            MAX_SHIFT_DEPTHS,
        )
        has_changed = (force_change > MAX_FORCE_CHANGE * force) | (shift > max_shift * depth)
        changed: list[int] = np.flatnonzero(has_changed)[:MAX_LINEARISATIONS].tolist()
        if not changed:
            return changed

        # After a sudden change, as of a body that bounces, linear extrapolation with the
        # derivatives gives no useful position. The contact then keeps the position of the last
        # linearisation, and its past counts as unknown.
        has_jumped = (force_change > MAX_JUMP * force) | (shift > depth)
        is_lost = has_jumped & (contacts.noise > 0)
        loads[is_lost, 1] = contacts.linearised[is_lost, 1]
        contacts.past[is_lost] = np.nan
        return changed

    def _linearise(
        self,
        row: int,
        loads: Array,
        scaled: Array,
        fits: Fits,
    ) -> None:
        """Compute the derivatives of one contact's load by the values of the cubes nearest to it.

        Args:
            row: Number of the contact.
            loads: Force in N and position in m (n, 2, 3) of all contacts.
            scaled: Values (cubes, C) in Pa.
            fits: As in `update`.
        """
        inverse = self._inverse
        poses = inverse.poses
        contacts = self._contacts
        positions = loads[:, 1]
        place = positions[row]
        distance = _compute_lengths(self._above_cubes - place)
        is_turned_away = self._normals @ contacts.normal[row] < MIN_FACING
        distance[is_turned_away] = np.inf
        cubes = np.argsort(distance)[: contacts.cubes.shape[2]]
        home = int(cubes[0])
        rotation = poses.rotation[home]
        apart = _compute_lengths(positions - place)
        is_near = apart < NEIGHBOUR_PITCHES * inverse.pitch
        near = np.argsort(apart)[: is_near.sum()]
        # A fit by the tracker in this scan already contains the derivatives. They are used if they
        # hold for the same home cube and no other contact is near.
        fit = fits.get(self._found[row].id)
        if fit is None or fit.values.home != home or len(near) > 1:
            # Derivatives are computed in the frame of `home`, the cube nearest to the contact. The
            # linearised fit consists of this contact and those near it, sorted by distance:
            # `compute_weights` gives the derivatives for the first contact, which is this one.
            usable = np.where(is_turned_away[:, None], np.nan, scaled)
            self._noise.update(usable, cubes)
            local = LocalValues(inverse, self._noise, home, cubes)
            forces = loads[near, 0] @ rotation
            centres = (positions[near] - poses.position[home]) @ rotation
            areas = [self._found[number].area for number in near.tolist()]
            discs = Discs(
                forces,
                centres[:, :2],
                np.log(np.divide(areas, np.pi)) / 2,
            )
            fit = HertzFit(inverse, local, discs)
            linearise(inverse, fit)
        weights = fit.compute_weights(cubes)

        by_pad = inverse.by_pad[cubes]
        by_pad[np.isnan(by_pad)] = 0.0
        noise = weights[3:].swapaxes(0, 1) @ by_pad
        by_force, by_position = np.split(weights.reshape(5, -1), [3])
        contacts.noise[row] = np.sqrt((noise**2).sum() / 2)
        contacts.pad_variance[row, _NEWEST] = (by_pad**2).sum()
        contacts.weights[row, _NEWEST, :3] = rotation @ by_force
        contacts.weights[row, _NEWEST, 3:] = rotation[:, :2] @ by_position
        contacts.cubes[row, _NEWEST] = cubes
        contacts.values[row, _NEWEST] = scaled[cubes].ravel()
        contacts.load[row] = contacts.linearised[row] = loads[row]


def _compute_lengths(vectors: Array) -> Array:
    """Return the lengths (...) of vectors (..., n)."""
    lengths: Array = np.sqrt((vectors * vectors).sum(axis=-1))
    return lengths


def _split_force(force: Array, normal: Array) -> tuple[Array, Array]:
    """Split forces (..., n, 3) into their components (..., n, 1) along the normals (n, 3) and their
    shear forces (..., n, 3)."""
    outward = (force * normal).sum(axis=-1, keepdims=True)
    return outward, force - outward * normal


def _compute_motion_states(loads: Array, normal: Array) -> Array:
    """Return the motion states (..., n, 7) of contacts: the quantities whose changes show slip.

    They are the position (3) in m, the shear force divided by the normal force (3), and the natural
    logarithm of the normal force in N.

    Args:
        loads: Force in N and position in m (..., n, 2, 3) of the contacts.
        normal: Normals (n, 3) out of the skin.
    """
    outward, shear = _split_force(loads[..., 0, :], normal)
    pressing = np.maximum(-outward, 1e-3 * MIN_FORCE_N)
    return np.concatenate([loads[..., 1, :], shear / pressing, np.log(pressing)], axis=-1)
