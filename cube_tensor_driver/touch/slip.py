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

A body that sticks keeps its place on the skin, also while the skin deforms and while the rim of the
contact slips (Cattaneo, Mindlin). When all of the contact slips (gross slip), Coulomb's law fixes
the ratio of shear and normal force, and the contact moves along the shear force that the body
exerts on the skin. So a contact slips if it moves in this direction while the ratio stays nearly
the same. If a sticking body is pulled at a point above the surface, its centre of pressure moves,
too, but in proportion to the change of the ratio. A body that rolls moves without a shear force
along its path.

While only the rim of the contact slips (partial slip), the shear force is distributed differently,
so that the values y of the cubes are not proportional to it. A least-squares fit, with the change n
of the normal force and the change q of the shear force, shows this by its last term::

    y = y0 + a n + B q + C |q| q

For a ball, |C |q| q| / |B q + C |q| q| is about 0.1 at 60 % of the largest shear force that
friction holds, and 0.2 at the largest one. For a flat punch, which has no partial slip, it is 0.
The linear terms take up errors of gains and elastomer.

Source: K. L. Johnson, Contact Mechanics (1985), 7.1 (sliding) and 7.2 (partial slip).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..core.arrays import Array, Index, Mask, Records
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

Field = tuple[str, type, tuple[int, ...]]
"""Name, type of the values and shape of a field of a structured array."""

N_CUBES = 16
"""Number of cubes nearest to a contact from whose values its force and position are computed in
every scan."""

LAGS = np.array([2, 4, 8, 16, 32, 64])
"""Durations, in scans (sets of values of all cubes), over which the motion of a contact is
tested. The short ones find fast slip early; the long ones find slow slip, whose motion the noise
hides over a short time."""

MIN_DISTANCE_M = 10e-6
"""Smallest motion in m that counts as slip; the noise of the position is 0.3 to 3 um for loads of
1 to 10 N."""

MIN_SPEED = 1e-3
"""Smallest speed of slip in m/s. Slower motion may be creep of the elastomer or drift."""

SIGNIFICANCE = 5.0
"""Smallest motion that counts as slip, divided by the standard deviation that the noise of the pads
causes. With Gaussian noise, 1000 scans a second and 6 lags (`LAGS`), the noise of one contact
exceeds it once in 47 s. For slip, the direction must also agree, and `MIN_DISTANCE_M` must be
exceeded: contacts that were held and shaken with 2 g gave no false alarm in 40 minutes."""

LEVER_M = 0.1
"""Largest height in m above the surface at which an external shear force on a sticking body acts.
The force tilts the body, which shifts the centre of pressure by the height times the ratio q of
shear and normal force. Such a shift must not count as slip.

The assumed height is `LEVER_M` / (1 + 2 q). It is smaller for larger ratios, because a body that is
pulled far above the surface tips over before the ratio gets large.
"""

LEAK_M = 0.01
"""Motion in m that is attributed to a change of the force ratio, or of the logarithm of the normal
force, by 1. Where the skin deviates from the model, changes of the force look like motion."""

MIN_RATIO = 0.1
"""Smallest ratio of shear and normal force of a contact that slips. With less shear, the direction
of the shear force is not known well enough, and rolling looks like slip."""

MIN_SHARE_OF_LARGEST = 0.5
"""Smallest ratio of shear to normal force at which a contact can slip, divided by the largest ratio
of this contact so far. Friction has held the largest ratio, and the coefficient of kinetic friction
is rarely less than half of the static one."""

MAX_RATIO_CHANGE = 0.2
"""Largest change of the ratio of shear and normal force of a contact that slips, divided by the
ratio. The change is taken over the same duration (`LAGS`) as the motion that shows the slip."""

MIN_COSINE = 0.8
"""Smallest cosine of the angle between motion and shear force of a contact that slips.

A body that slides pulls the skin along its motion. One that moves across its shear force rolls or
tilts.
"""

MIN_LATE_SHARE = 0.25
"""Smallest fraction of a contact's motion, during one of the durations `LAGS`, that must fall into
the second half of this duration for slip. If the fraction is smaller, the contact has stopped."""

MIN_FORCE_N = 0.05
"""Normal force, in N, that a contact must exceed for the state `STICK`. With a smaller force, its
state is `UNKNOWN` unless slip is detected."""

FOLLOWED_DEVIATION = 0.02
"""Relative standard deviation that is assumed for the ratio of shear and normal force between two
updates of the contact tracker, when the ratio is computed from changes of the cubes' values since
the last update. The relative error of the ratio was 1.6 % (rms) in simulations of 24-pad cubes, for
contacts that had moved by up to some millimetres since this update."""

MAX_SHIFT_DEPTHS = 0.2
"""Shift of a contact, divided by the depth of the cubes' centres below the surface, after which the
derivatives of the cubes' values by the contact's force and position are computed again. The shift
is counted from where the present derivatives hold. `MIN_SHIFT_DEPTHS` must be exceeded, too."""

MIN_SHIFT_DEPTHS = 0.1
"""Shift of a contact since the last fit of the contact tracker, divided by the depth of the cubes'
centres, up to which the derivatives of the cubes' values by the contact's force and position need
not be exact: only this small shift is computed with them. `MAX_SHIFT_DEPTHS` does not apply then.
"""

MAX_FITTED_SHIFT_DEPTHS = 0.5
"""Shift of a contact, divided by the depth of the cubes' centres, after which the derivatives of
the cubes' values by the contact's force and position are computed again, even if the contact
tracker has just fitted the contact (`MIN_SHIFT_DEPTHS`)."""

MAX_FORCE_CHANGE = 0.3
"""Change of the force of a contact, divided by the force, after which the derivatives of the cubes'
values by the contact's force and position are computed again, because the radius of the contact
changes with the force."""

MAX_JUMP = 0.6
"""Change of the force of a contact since the derivatives of the cubes' values by its force and
position were computed, divided by the force, above which the motion of the contact is unknown.
Because the derivatives are computed again above `MAX_FORCE_CHANGE`, only a sudden change, as of a
body that bounces, exceeds this limit. Linear extrapolation then gives no useful position."""

MAX_LINEARISATIONS = 2
"""Largest number of contacts per scan (set of values of all cubes) for which the derivatives of the
cubes' values by force and position are computed. Each contact takes about 1 ms."""

NEIGHBOUR_PITCHES = 3.0
"""Distance of two contacts, divided by the pitch (distance of neighbouring cubes), below which
changes of the cubes' values are attributed to changes of both contacts."""


MAX_NORMAL_CHANGE = 0.05
"""Largest change of the normal force of a contact during the fit of `Slip.partial` (measure of
partial slip), divided by the force; after a larger change, the fit starts again. The fit includes a
term for the normal force, so that changes of 2 % did not change the result."""

MAX_SHIFT_M = 2e-4
"""Largest motion of a contact, in m, during the fit of `Slip.partial` (measure of partial slip);
after a larger motion, the fit starts again. Motion changes the stresses like partial slip, by as
much if it is 1 mm. A motion of 0.1 mm gave values up to 0.05 in simulations of flat punches, which
have no partial slip."""

PARTIAL_DEVIATION = 0.01
"""Largest standard deviation of `Slip.partial` (measure of partial slip) due to the noise of the
pads. If it is larger, as it is while the shear force has changed little, the measure is unknown
(NaN)."""


NO_FITS: Mapping[int, HertzFit] = MappingProxyType({})
"""Fits by the ids of their contacts if none are known."""


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
            this file): of the change of the cubes' values that the shear force causes, the part
            that is not proportional to the change q of the shear force. NaN if the normal force
            changes, the contact moves, or the shear force has changed too little.
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


class SlipEstimator:
    """Estimates in every scan whether the contacts that the contact tracker has found slip.

    Attributes:
        slip: State and friction of the contacts in the newest scan, in the order of the contacts
            in the last call of `adopt`.
    """

    def __init__(self, inverse: SurfaceInverse) -> None:
        """Create an estimator without contacts.

        Args:
            inverse: Poses, noise and response of the cubes.
        """
        self._inverse = inverse
        self._noise = CubeNoise(inverse)
        poses = inverse.poses
        normals = poses.rotation[:, :, 2]
        self._above_cubes = poses.position + inverse.depth * normals

        count = min(N_CUBES, len(self._above_cubes))
        n_values = count * len(inverse.columns)
        n_scans = LAGS[-1] + 1
        # The following are the fields of one contact. A load is force (3) in N and position (3) in
        # m. The matrix `weights` converts changes of the cubes' values, in Pa, to changes of it.
        linear: list[Field] = [
            ("cubes", int, (count,)),
            ("weights", float, (6, n_values)),
            ("values", float, (n_values,)),
        ]
        fields: list[tuple[str, type | list[Field], tuple[int, ...]]] = [
            ("id", int, ()),
            ("normal", float, (3,)),
            ("radius", float, ()),
            ("ratio_deviation", float, ()),
            ("largest_ratio", float, ()),
            ("slips", bool, ()),
            ("is_fitted", bool, ()),
            # Sums over the scans in which the contact slipped, for the weighted mean of the ratios
            # of shear and normal force, which is the friction coefficient (`_add_ratio`).
            ("sums", float, (3,)),
            *linear,
            # Standard deviation of the position, in m.
            ("noise", float, ()),
            # Load at `values`, and load for which `weights` was computed.
            ("load", float, (6,)),
            ("linearised", float, (6,)),
            # Motion states (`_compute_motion_states`) in the last scans, newest first.
            ("past", float, (n_scans, 7)),
            # Least-squares fit of the cubes' values that shows partial slip (head of this file):
            # cubes, weights and values in its first scan, its result `Slip.partial`, and its terms
            # in the newest scan (1, n, q and |q| q).
            ("first", linear, ()),
            ("partial", float, ()),
            ("terms", float, (8,)),
            # Normal equations of this fit, summed over its scans: products of the terms with each
            # other, and of the terms with the changes of the values.
            ("gram", float, (8, 8)),
            ("moments", float, (8, n_values)),
        ]
        self._contacts: Records = np.zeros(0, fields)
        self._times = np.full(n_scans, -np.inf)
        self._fits = NO_FITS
        self.slip = NO_CONTACTS

    def adopt(
        self,
        found: Sequence[TrackedContact],
        values: Array,
        fits: Mapping[int, HertzFit] = NO_FITS,
    ) -> None:
        """Take over the contacts that the tracker has found; call `update` afterwards.

        Args:
            found: The contacts.
            values: Components (cubes, 15) in Pa and Pa/m in which they were found.
            fits: `ContactTracker.single_fits`, whose derivatives need not be computed again.
        """
        self._fits = fits
        scaled = self._inverse.scale_values(values)
        ids = self._contacts["id"].tolist()
        contacts = np.zeros(len(found), self._contacts.dtype)
        contacts["past"] = np.nan
        for number, one in enumerate(found):
            if one.id in ids:
                old_number = ids.index(one.id)
                contacts[number] = self._contacts[old_number]
            ratio = one.shear_force / one.normal_force
            by_normal_force = ratio * one.force_uncertainty
            shear_deviation = np.hypot(by_normal_force, one.shear_uncertainty)
            ratio_deviation = shear_deviation / one.normal_force
            certain_ratio = ratio - 3 * ratio_deviation
            row = contacts[number]
            row["id"] = one.id
            row["normal"] = one.normal
            row["radius"] = np.sqrt(one.area / np.pi)
            row["ratio_deviation"] = ratio_deviation
            row["largest_ratio"] = max(row["largest_ratio"], certain_ratio)
        self._contacts = contacts
        if not found:
            self.slip = NO_CONTACTS
            return

        contacts["partial"] = np.nan
        # Eight coefficients need as many scans. A contact that moves begins again in every scan.
        is_determined = contacts["gram"][:, 0, 0] >= 8
        if is_determined.any():
            contacts["partial"] = np.where(
                is_determined,
                self._estimate_partial_slip(),
                np.nan,
            )
        normal = contacts["normal"]
        followed = self._follow(scaled)
        before = _compute_motion_states(followed, normal)
        contacts["load"] = [[*one.force, *one.position] for one in found]
        contacts["values"] = self._gather(scaled)
        after = _compute_motion_states(contacts["load"], normal)
        # The tracker has fitted the loads again. This corrects the errors of the loads that were
        # computed from changes of the values since its last fit. The past states get the same
        # correction, so that it does not look like motion.
        correction = after - before
        contacts["past"] += correction[:, None]

        # The friction coefficient is a mean of force ratios during slip. When the tracker fits a
        # contact for the first time while it slips, earlier ratios are dropped, because they were
        # only computed from changes of the values.
        slips = contacts["slips"]
        is_new = slips & ~contacts["is_fitted"]
        contacts["sums"][is_new] = 0.0
        contacts["is_fitted"] |= slips
        shear_ratio = after[:, 3:6]
        ratios = _compute_lengths(shear_ratio)
        _add_ratio(
            contacts,
            slips,
            ratios,
            contacts["ratio_deviation"],
        )

    def update(self, time_s: float, values: Array) -> bool:
        """Estimate `slip` from the values of a scan.

        Args:
            time_s: Time of the scan in s. If it equals the time of the previous call, `values` must
                be those of the previous call, too.
            values: Components (cubes, 15) in Pa and Pa/m, NaN where unknown.

        Returns:
            Whether a contact has begun to slip.
        """
        contacts = self._contacts
        if not len(contacts):
            return False
        scaled = self._inverse.scale_values(values)
        loads = self._follow(scaled)
        self._linearise_changed(loads, scaled)
        self._fits = NO_FITS  # later, the contacts are elsewhere
        self._observe_shear(scaled)
        newest = _compute_motion_states(loads, contacts["normal"])
        self._remember(time_s, newest)

        earlier = contacts["past"][:, LAGS]
        change = newest[:, None] - earlier
        duration = time_s - self._times[LAGS]
        moves, slips = self._test_lags(newest, change, duration)
        slipped = slips.any(axis=1)
        begins = slipped & ~contacts["slips"]
        contacts["slips"] = slipped

        shear_ratio = newest[:, 3:6]
        ratio = _compute_lengths(shear_ratio)
        followed_deviation = FOLLOWED_DEVIATION * ratio
        deviation = np.hypot(contacts["ratio_deviation"], followed_deviation)
        is_followed = slipped & ~contacts["is_fitted"]
        _add_ratio(contacts, is_followed, ratio, deviation)

        log_force = newest[:, 6]
        is_strong = log_force > np.log(MIN_FORCE_N)
        has_past = np.isfinite(change[:, 0, 0])
        is_known = has_past & is_strong
        sticks = is_known & ~moves.any(axis=1)
        state = np.where(sticks, STICK, UNKNOWN)
        state[slipped] = SLIP

        shortest = slips.argmax(axis=1)
        each = np.arange(len(state))
        moved = change[each, shortest, :3]
        velocity = moved / duration[shortest, None]
        velocity[state == STICK] = 0.0
        velocity[state == UNKNOWN] = np.nan

        # Before the first slip of a contact all of its sums are 0, so that its friction coefficient
        # becomes NaN.
        with np.errstate(invalid="ignore"):
            inverse_sum, weight_sum, ratio_sum = contacts["sums"].T
            friction = ratio_sum / weight_sum
            uncertainty = inverse_sum / weight_sum
        self.slip = Slip(
            state=state,
            friction=friction,
            friction_uncertainty=uncertainty,
            friction_use=ratio / friction,
            velocity=velocity,
            partial=np.where(sticks, contacts["partial"], np.nan),
        )
        return bool(begins.any())

    def _observe_shear(self, scaled: Array) -> None:
        """Add the values (cubes, C) of a scan, in Pa, to the fits of `Slip.partial`.

        A fit starts again when the normal force or the position has changed, or the contact slips.
        """
        contacts = self._contacts
        # The weights of the first scan of a fit are used throughout, because other weights would
        # give another shear force even for the same values.
        first = contacts["first"]
        values = scaled[first["cubes"]].reshape(len(contacts), -1)
        change = np.nan_to_num(values - first["values"])
        load = np.einsum("nkm,nm->nk", first["weights"], change)
        normal = contacts["normal"]
        outward = np.einsum("nk,nk->n", load[:, :3], normal)[:, None]
        shear = load[:, :3] - outward * normal
        curved = _compute_lengths(shear)[:, None] * shear
        terms = np.hstack([np.ones_like(outward), outward, shear, curved])
        contacts["terms"] = terms
        contacts["gram"] += terms[:, :, None] * terms[:, None]
        contacts["moments"] += terms[:, :, None] * change[:, None]

        force = _compute_lengths(contacts["load"][:, :3])
        is_over = np.abs(outward[:, 0]) > MAX_NORMAL_CHANGE * force
        is_over |= _compute_lengths(load[:, 3:]) > MAX_SHIFT_M
        is_over |= contacts["slips"] | (contacts["gram"][:, 2, 2] == 0)
        for name in ("cubes", "weights", "values"):
            first[name][is_over] = contacts[name][is_over]
        contacts["gram"][is_over] = contacts["moments"][is_over] = 0

    def _estimate_partial_slip(self) -> Array:
        """Return `Slip.partial` (n,) by the least-squares fit at the head of this file."""
        contacts = self._contacts
        terms, curved = contacts["terms"], contacts["terms"][:, 5:]
        # The shear force has no component along the normal, and all sums are 0 at the start of a
        # fit. A small addition to the diagonal lets the matrix be inverted nevertheless.
        size = np.trace(contacts["gram"], axis1=1, axis2=2)[:, None, None]
        inverse = np.linalg.inv(contacts["gram"] + 1e-9 * (size + 1) * np.eye(8))
        parts = terms[:, :, None] * (inverse @ contacts["moments"])
        change = _compute_lengths(parts[:, 2:].sum(axis=1))
        by_pad = np.nan_to_num(self._inverse.by_pad[contacts["first"]["cubes"]])
        covariance = (by_pad**2).sum(axis=(1, 2, 3))[:, None, None] * inverse[:, 5:, 5:]
        variance = np.einsum("nk,nkl,nl->n", curved, covariance, curved)
        with np.errstate(invalid="ignore"):
            share = _compute_lengths(parts[:, 5:].sum(axis=1)) / change
        return np.where(
            variance < (PARTIAL_DEVIATION * change) ** 2,
            share,
            np.nan,
        )

    def _test_lags(
        self,
        newest: Array,
        change: Array,
        duration: Array,
    ) -> tuple[Mask, Mask]:
        """Test whether each contact has moved, and whether it has slipped, over each of the `LAGS`.

        Args:
            newest: Motion states (n, 7) in this scan, as from `_compute_motion_states`.
            change: Changes (n, lags, 7) of the motion states over each lag.
            duration: Durations (lags,) of the lags in s.

        Returns:
            Whether each contact has moved (n, lags), and whether it has slipped (n, lags).
        """
        moved = change[..., :3]
        turned = change[..., 3:6]
        distance = _compute_lengths(moved)
        shear_ratio = newest[:, 3:6]
        ratio = _compute_lengths(shear_ratio)[:, None]

        divisor = np.maximum(distance, 1e-12)
        scalar_product = np.einsum("nlk,nlk->nl", moved, turned)
        growth = scalar_product / divisor
        lever = LEVER_M / (1 + 2 * ratio)
        tilt = lever * np.maximum(growth, 0)
        force_change = change[..., 3:]
        leak = LEAK_M * _compute_lengths(force_change)
        # A force that changes and returns within a long lag shows no change over it, but may have
        # left the contact shifted. So each lag is allowed the largest shift of all shorter ones.
        explained = np.maximum.accumulate(tilt + leak, axis=1)
        noise = SIGNIFICANCE * np.sqrt(2) * self._contacts["noise"]
        threshold = np.maximum(noise, MIN_DISTANCE_M)
        min_distance = threshold[:, None] + explained
        moves = distance > min_distance
        moves &= distance > MIN_SPEED * duration
        # A lag is twice the one before. The motion over the lag before is therefore the motion in
        # the second half of a lag; if it is small, the contact has stopped.
        late = distance[:, :-1]
        min_late = MIN_LATE_SHARE * distance[:, 1:]
        moves[:, 1:] &= late > min_late

        along = np.einsum("nlk,nk->nl", moved, shear_ratio)
        is_along = along > MIN_COSINE * distance * ratio
        largest = MIN_SHARE_OF_LARGEST * self._contacts["largest_ratio"]
        min_ratio = np.maximum(MIN_RATIO, largest)
        ratio_change = _compute_lengths(turned)
        slips = moves & is_along
        slips &= ratio > min_ratio[:, None]
        slips &= ratio_change < MAX_RATIO_CHANGE * ratio
        return moves, slips

    def _remember(self, time_s: float, newest: Array) -> None:
        """Store the motion states `newest` (n, 7) of the scan at the time `time_s` (in s)."""
        past = self._contacts["past"]
        if time_s < self._times[0]:
            # The time has jumped back, as at the start of another recording.
            past[:] = np.nan
        if time_s != self._times[0]:
            past[:, 1:] = past[:, :-1].copy()
            self._times = np.roll(self._times, 1)
        past[:, 0] = newest
        self._times[0] = time_s

    def _gather(self, scaled: Array) -> Array:
        """Return the values (n, values) in Pa of the `N_CUBES` cubes near each of n contacts."""
        values: Array = scaled[self._contacts["cubes"]]
        return values.reshape(len(self._contacts), -1)

    def _follow(self, scaled: Array) -> Array:
        """Return force in N and position in m (n, 6) of each contact in a scan.

        They follow from the changes of the cubes' values, with the stored derivatives.

        Args:
            scaled: Components (cubes, C) in Pa of the scan, as from `SurfaceInverse.scale_values`.
        """
        contacts = self._contacts
        # A value that is missing counts as unchanged.
        change = self._gather(scaled) - contacts["values"]
        change = np.nan_to_num(change)
        load_change = np.einsum("nkm,nm->nk", contacts["weights"], change)
        loads: Array = contacts["load"] + load_change
        return loads

    def _linearise_changed(self, loads: Array, scaled: Array) -> None:
        """Linearise the response of the cubes again for contacts that are new or have changed.

        Args:
            loads: Force in N and position in m (n, 6) of the contacts.
            scaled: Values (cubes, C) in Pa.
        """
        contacts = self._contacts
        change = loads - contacts["linearised"]
        depth = self._inverse.depth
        force = _compute_lengths(loads[:, :3])
        force = np.maximum(force, MIN_FORCE_N)
        force_change = _compute_lengths(change[:, :3])
        shift = _compute_lengths(change[:, 3:])
        has_changed = force_change > MAX_FORCE_CHANGE * force
        since_fit = _compute_lengths(loads[:, 3:] - contacts["load"][:, 3:])
        is_inexact = since_fit > MIN_SHIFT_DEPTHS * depth
        has_changed |= is_inexact & (shift > MAX_SHIFT_DEPTHS * depth)
        has_changed |= shift > MAX_FITTED_SHIFT_DEPTHS * depth

        # After a sudden change, as of a body that bounces, linear extrapolation with the
        # derivatives gives no useful position. The contact then keeps the position of the last
        # linearisation, and its past counts as unknown.
        has_jumped = force_change > MAX_JUMP * force
        has_left = shift > depth
        is_linearised = contacts["noise"] > 0
        is_lost = (has_jumped | has_left) & is_linearised
        last_position = contacts["linearised"][:, 3:]
        loads[is_lost, 3:] = last_position[is_lost]
        contacts["past"][is_lost] = np.nan

        changed = np.flatnonzero(has_changed).tolist()
        for row in changed[:MAX_LINEARISATIONS]:
            self._linearise(row, loads, scaled)

    def _linearise(
        self,
        row: int,
        loads: Array,
        scaled: Array,
    ) -> None:
        """Compute the weights from changes of the cubes' values to changes of one contact's load.

        Args:
            row: Number of the contact.
            loads: Force in N and position in m (n, 6) of all contacts.
            scaled: Values (cubes, C) in Pa.
        """
        inverse = self._inverse
        poses = inverse.poses
        contact = self._contacts[row]
        positions = loads[:, 3:]
        place = positions[row]
        offset = self._above_cubes - place
        distance = _compute_lengths(offset)
        normals = poses.rotation[:, :, 2]
        cosines = normals @ contact["normal"]
        is_turned_away = cosines < MIN_FACING
        distance[is_turned_away] = np.inf
        n_cubes = len(contact["cubes"])
        by_distance = np.argsort(distance)
        cubes = by_distance[:n_cubes]
        home = int(cubes[0])
        rotation = poses.rotation[home]
        apart = _compute_lengths(positions - place)
        is_near = apart < NEIGHBOUR_PITCHES * inverse.pitch
        near = np.argsort(apart)[: is_near.sum()]
        # The tracker has just computed the derivatives for this contact alone.
        fit = self._fits.get(int(contact["id"]))
        if fit is None or fit.values.home != home or len(near) > 1:
            # Derivatives are computed in the frame of `home`, the cube nearest to the contact.
            # Contacts near this one take part. They are sorted by distance, so that this one comes
            # first.
            usable = np.where(is_turned_away[:, None], np.nan, scaled)
            self._noise.update(usable, cubes)
            local = LocalValues(inverse, self._noise, home, cubes)
            forces = loads[near, :3] @ rotation
            from_home = positions[near] - poses.position[home]
            centres = from_home @ rotation
            radii = self._contacts["radius"][near]
            discs = Discs(forces, centres[:, :2], np.log(radii))
            fit = HertzFit(inverse, local, discs)
            linearise(inverse, [fit])
        weights = fit.compute_weights(cubes)

        by_pad = np.nan_to_num(inverse.by_pad[cubes])
        position_weights = weights[3:]
        noise = np.einsum("knc,ncp->knp", position_weights, by_pad)
        mean_variance = (noise**2).sum() / 2
        to_parent = np.zeros((6, 5))
        to_parent[:3, :3] = rotation
        to_parent[3:, 3:] = rotation[:, :2]
        contact["noise"] = np.sqrt(mean_variance)
        contact["weights"] = to_parent @ weights.reshape(5, -1)
        contact["cubes"] = cubes
        contact["values"] = scaled[cubes].ravel()
        contact["load"] = loads[row]
        contact["linearised"] = loads[row]


def _compute_lengths(vectors: Array) -> Array:
    """Return the lengths (...) of vectors (..., n)."""
    lengths: Array = np.linalg.norm(vectors, axis=-1)
    return lengths


def _compute_motion_states(loads: Array, normal: Array) -> Array:
    """Return the motion states (n, 7) of contacts: the quantities whose changes show slip.

    They are the position (3) in m, the shear force divided by the normal force (3), and the natural
    logarithm of the normal force in N.

    Args:
        loads: Force in N and position in m (n, 6) of the contacts.
        normal: Normals (n, 3) out of the skin.
    """
    force = loads[:, :3]
    outward = np.einsum("nk,nk->n", force, normal)
    outward = outward[:, None]
    pressing = np.maximum(-outward, 1e-3 * MIN_FORCE_N)
    shear = force - outward * normal
    position = loads[:, 3:]
    shear_ratio = shear / pressing
    log_force = np.log(pressing)
    return np.concatenate([position, shear_ratio, log_force], axis=1)


def _add_ratio(
    contacts: Records,
    chosen: Mask,
    ratio: Array,
    deviation: Array,
) -> None:
    """Add force ratios of slipping contacts to the weighted mean that is the friction coefficient.

    The pads' gains cause the same error in all ratios. So the deviation of the mean is the mean of
    the deviations s, with the same weights 1 / s^2.

    Args:
        contacts: The contacts; `sums` are those of 1 / s, 1 / s^2 and ratio / s^2.
        chosen: Contacts (n,) that slip.
        ratio: Ratios (n,) of shear and normal force.
        deviation: Standard deviations s (n,) of the ratios.
    """
    weight = deviation**-2
    columns = [1 / deviation, weight, ratio * weight]
    sums = np.stack(columns, axis=1)
    contacts["sums"] += np.where(chosen[:, None], sums, 0.0)
