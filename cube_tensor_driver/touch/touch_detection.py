# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Detection of touch in every scan (one sample of every cube): whether, where and how hard.

The pressure p of a cube is -zz minus the slow part of -zz, an average that follows slow drift. The
sequential test is Page's CUSUM: a sum S of the pressure over its standard deviation sigma, with a
limit h::

    S <- max(0, S + p / sigma - REFERENCE),     touch begins when S > h and ends when S = 0

Of all components that a cube measures, zz falls off fastest with the distance r from a load (r^-5
below a point force; the others r^-3 or r^-4), so that a strong load does not look like touches of
cubes far away. The test only finds increases of the pressure, because the recovery of the elastomer
after a load looks like a decrease.

Source: D. C. Montgomery, Introduction to Statistical Quality Control (2013), 9.1 (CUSUM); D.
Siegmund, Sequential Analysis (1985), 2.6 (mean time between false alarms). numpy alone is used,
because the reconstruction node does not load scipy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..config.skin import Skin, as_skin
from ..core.arguments import check_number
from ..core.arrays import Array, Index, PadMasks
from ..core.modes import COMPONENTS
from ..core.pipeline import Pipeline
from ..core.rows import StressRows
from .nearest_cubes import find_nearest_cubes
from .pad_noise import GAIN_ERROR
from .touch_forces import estimate_forces

FALSE_ALARMS = 1.0
"""Default rate of touches found in noise alone, per hour, of the whole skin."""

MIN_RATE_HZ = 1000.0
"""Smallest sampling rate of each cube, in Hz, for which the limit of the CUSUM is computed. Lower
rates get the limit for this rate, which makes false alarms rarer than chosen. Recordings do not
state their rate. They get this limit, too, and so give the same touches as a sensor of up to this
rate."""

TIME_CONSTANT_S = 1.0
"""Time constant, in s, of the high-pass that removes slow drift from the pressure of a cube. The
high-pass also removes loads that grow slowly, by less than about 2.3 Pa/s on a cube with 24 pads.
"""

REFERENCE = 2.0
"""Reference value of the CUSUM, in standard deviations of the noise: half of the smallest change of
the pressure that is to be found in two scans (samples of every cube)."""

OVERSHOOT = 1.04
"""Correction of the limit of the CUSUM, in standard deviations of the noise. It is subtracted from
the limit that holds for a continuous sum, because a sum of samples jumps beyond the limit. With
`REFERENCE` = 2, the mean time between false alarms then is 1.05 to 1.15 times the time that the
user has chosen (`touch_false_alarms`)."""

SETTLING_ROWS = 10
"""Number of first samples of a cube, in which touch is not looked for. The slow part of the
pressure (the average that follows slow drift and is subtracted) starts as their mean. At first, the
error of this mean adds 5 % to the standard deviation of the remaining pressure."""

NEIGHBOURS = 9
"""Number of cubes that decide together where a touch is, and from which its force is estimated: the
cube of the touch and those nearest to it."""

SPREAD = 0.25
"""Largest ratio of the pressures that a distant load causes at two neighbouring cubes: the pressure
of the farther cube divided by that of the nearer one. An upper limit of the pressure that a load
can cause at other cubes follows from it. A touch there must have a larger pressure."""

MAX_DISTANT_RATIO = 1e-4
"""Largest pressure that a load can cause at a cube at least seven pitches (distances of
neighbouring cubes) away, divided by the largest pressure of all touched cubes. A touch there must
have a larger pressure. The value holds for a pitch of 8 mm, cubes 5 mm below the surface, and a
shear force of half the normal force."""

MAX_DRIFT = 0.5
"""Largest drift of the pressure, in Pa/s, at which false alarms are not more frequent than chosen.
The pressure drifts this fast if all pads of a cube drift together, by 1.3e-6 of their frequency per
second."""

REMAINDER = 0.02
"""Largest fraction of the pressure under a load that a cube still measures just after the load has
gone, because the foam of the pads creeps."""

RESTART_MARGIN = 4.0
"""Pressure, in standard deviations of the noise, that does not count as touch after a cube's slow
part has started again under a load. The slow part is the average that follows slow drift and is
subtracted from the pressure. At first, the slow part is a mean of few samples, whose error looks
like a small touch."""

OTHER_LOADS = 1.0
"""Factor f in the error f F (pitch / distance)^3 that another load with the force F causes in an
estimated force. At pitches of 8 to 12 mm and depths of 4 and 5 mm, f is 0.5 to 1.7 for layouts of 8
and 24 pads at distances of two to three pitches, and less farther away."""

MIN_RELEASE = 8.0
"""Smallest fall of a cube's pressure below its slow part (the average that follows slow drift), in
standard deviations of the noise, at which the slow part starts again. So large a fall means that
the slow part had adapted to a load, which has ended now."""

STALE_NS = 1_000_000_000
"""Maximum time, in ns, from the last sample of a cube to the newest sample of all cubes. After a
longer time, the cube counts as untouched, and its next sample starts the detection again."""

NO_TOUCH = -1
"""Number that stands for "no touch" where otherwise the number of a touch (`Touches.id`) stands."""

ERRORS_PERIOD_NS = 100_000_000
"""Time, in ns, after which the errors that imperfect compensation and drift cause at touched cubes
are computed again. The compensation computes creep and the effect of temperature as often."""

PRESSURE = COMPONENTS.index("zz")
"""Index in `COMPONENTS` of the stress zz, whose negative is the pressure."""


class Touches(NamedTuple):
    """The m touches in one scan (sample of every cube), the one with the largest pressure first.

    Attributes:
        stamp_ns: Time of the earliest sample of the scan, in ns of the source's clock.
        cube: Indices (m,) of the cubes with a larger pressure than their neighbours.
        id: Numbers (m,) of the touches, which stay the same from start to end: `stamp_ns` of the
            first scan of the touch, plus 1, 2, ... if several touches begin in the same scan.
        pressure: Pressure (m,) in Pa at the centre of this cube, without its slow part (an average
            that follows slow drift).
        pressure_uncertainty: Standard deviation (m,) of `pressure`, in Pa.
        force: Force (m, 3) on the skin within about a pitch around this cube, along x, y and z of
            this cube's frame, in N. NaN if the skin file states no elastomer, or if a component of
            this cube or of a neighbour is missing.
        force_uncertainty: Standard deviation (m, 3) of `force`, in N.
    """

    stamp_ns: int
    cube: Index
    id: Index
    pressure: Array
    pressure_uncertainty: Array
    force: Array
    force_uncertainty: Array

    def __repr__(self) -> str:
        largest_kpa = 1e-3 * self.pressure.max(initial=0.0)
        return f"Touches({len(self.cube)} touches, pressure up to {largest_kpa:.3g} kPa)"


NO_TOUCHES = Touches(
    stamp_ns=0,
    cube=np.zeros(0, np.intp),
    id=np.zeros(0, np.intp),
    pressure=np.zeros(0),
    pressure_uncertainty=np.zeros(0),
    force=np.zeros((0, 3)),
    force_uncertainty=np.zeros((0, 3)),
)
"""Touches of a scan in which nothing touches, with the time 0."""


class Touch:
    """Finds touches in the stress of a skin, scan by scan (samples of every cube).

    The computing time of a scan has an upper limit, whatever touches the skin. No touch is found at
    cubes that do not observe the stress zz.

    Attributes:
        limit: Limit h of the CUSUM, in standard deviations of the noise.
    """

    def __init__(
        self,
        skin: Skin | str | Path,
        false_alarms: float = FALSE_ALARMS,
        find_errors: Callable[[Index, PadMasks], Array] | None = None,
    ) -> None:
        """Prepare the detection, which takes up to some seconds on a large bent skin.

        Args:
            skin: Skin as from `read_skin`, or the path of a skin file.
            false_alarms: Rate of touches found in noise alone, per hour, of the whole skin. It
                holds for noise as in the calibrations, for drift up to `MAX_DRIFT`, and at 1 kHz
                or a higher rate in the skin file.
            find_errors: `Reconstructor.errors` of the reconstructor that computes the stress. The
                stated deviations then contain errors of the compensation. None: they do not.

        Raises:
            ConfigError: The rate is not above 0.
            ElasticError: The elastomer of the skin file is impossible.
        """
        allowed = "a number above 0, per hour"
        check_number(
            "false_alarms",
            false_alarms,
            lambda x: 0 < x < math.inf,
            allowed,
        )
        skin = as_skin(skin)
        n = len(skin.calibrations)
        rate_hz = max(skin.rate or 0.0, MIN_RATE_HZ)
        tests_per_alarm = 3600 * rate_hz * n / false_alarms
        log_ratio = math.log(2 * REFERENCE**2 * tests_per_alarm)
        limit = log_ratio / (2 * REFERENCE)
        self.limit = max(0.0, limit - OVERSHOOT)

        self._pipeline = Pipeline(skin.calibrations)
        covariance = np.array([self._pipeline.compute_covariance(cube) for cube in range(n)])
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        self._unobserved = np.isnan(variance)
        self._deviation = np.sqrt(variance[:, PRESSURE])
        poses = skin.poses
        self._place = poses.position / poses.pitch
        near = find_nearest_cubes(poses, NEIGHBOURS)
        self._estimate = None
        if skin.elastomer is not None:
            self._estimate = estimate_forces(
                poses,
                skin.elastomer,
                near,
                covariance,
            )

        # The largest value among the neighbours is found faster if they are the first axis.
        self._near = near.T.copy()
        self._every_cube = np.arange(n)
        self._find_errors = find_errors
        self._errors = np.zeros((0, NEIGHBOURS, len(COMPONENTS), 0))
        self._errors_cube = np.zeros(0, np.intp)
        self._errors_ns = 0
        # `_slow` is the slow part of each value, the average that follows slow drift (NaN where
        # unknown); `_change` is the newest value minus its slow part.
        self._slow = np.full(variance.shape, np.nan)
        self._change = np.zeros(variance.shape)
        self._left_out = np.zeros(n, np.uint32)
        self._stamp_ns = np.zeros(n, np.int64)
        self._count = np.zeros(n, np.int64)
        self._margin = np.zeros(n)
        self._sum = np.zeros(n)
        self._touched = np.zeros(n, bool)
        # `_reach` is an upper limit of the pressure that touches cause at each cube. Where it is
        # above the noise, the slow part is held (`_held`), so that it does not adapt to the load.
        self._reach = np.zeros(n)
        self._held = np.zeros(n, bool)
        # The number of the touch that each cube belonged to in the last scan.
        self._id = np.full(n, NO_TOUCH)

    def __repr__(self) -> str:
        touched = np.count_nonzero(self._touched)
        return f"Touch({len(self._sum)} cubes, {touched} of them touched)"

    def restart(self) -> None:
        """Start the slow parts of all cubes again after a tare, which changes all values.

        A slow part is the average that follows slow drift. Pressures without their slow parts do
        not change, so that touches continue. New touches are only found after `SETTLING_ROWS`
        samples.
        """
        self._restart(self._every_cube)

    def update(self, rows: StressRows) -> list[Touches]:
        """Find the touches in rows (samples of one cube each).

        Args:
            rows: Rows of one scan, or of several scans one after the other. Within a scan, they are
                sorted by the number of the cube. Rows of other cubes than those of the skin are
                ignored.

        Returns:
            The touches of each scan. They do not depend on how many scans are given in one call.
        """
        is_known = rows.cube < len(self._sum)
        if not is_known.all():
            rows = rows.select(is_known)
        is_first = rows.cube[1:] <= rows.cube[:-1]
        starts = np.flatnonzero(is_first) + 1
        if not len(starts):
            return [self._update_scan(rows)] if len(rows) else []
        bounds = [0, *starts.tolist(), len(rows)]
        scans = [rows.select(slice(*ends)) for ends in pairwise(bounds)]
        return [self._update_scan(scan) for scan in scans]

    __call__ = update

    def _update_scan(self, rows: StressRows) -> Touches:
        # Most scans contain all cubes. Then a slice is used instead of indices, because it needs no
        # copies of the arrays.
        is_complete = len(rows) == len(self._sum)
        cube = slice(None) if is_complete else rows.cube.astype(np.intp)
        changed = rows.left_out != self._left_out[cube]
        if changed.any():
            self._use_pads(rows.cube[changed], rows.left_out[changed])

        oldest_ns = rows.stamp_ns.max() - STALE_NS
        stale = self._stamp_ns < oldest_ns
        if stale.any():
            self._slow[stale] = np.nan
            self._change[stale] = 0
            self._count[stale] = 0
            self._sum[stale] = 0
            self._touched[stale] = False

        elapsed_ns = rows.stamp_ns - self._stamp_ns[cube]
        elapsed_s = (1e-9 * elapsed_ns).clip(0, TIME_CONSTANT_S)
        self._stamp_ns[cube] = rows.stamp_ns

        values = np.hstack([rows.stress, rows.gradient], dtype=float)
        slow = self._slow[cube]
        is_unknown = np.isnan(slow)
        if not np.array_equal(is_unknown, self._unobserved[cube]):
            # An unknown slow part starts at the newest value minus the last known difference of
            # value and slow part. Otherwise a load that lasts would be taken for drift.
            load = np.nan_to_num(self._change[cube])
            slow = np.where(is_unknown, values - load, slow)
        change = values - slow
        self._change[cube] = change

        pressure = -change[:, PRESSURE]
        self._test(cube, pressure, elapsed_s)
        gain = self._compute_gain(cube, pressure, elapsed_s)
        self._slow[cube] = slow + gain[:, None] * change
        self._count[cube] += 1

        return self._locate(int(rows.stamp_ns.min()))

    def _restart(self, cubes: Index) -> None:
        """Let slow parts (averages that follow slow drift) of cubes start again at their next
        samples."""
        self._slow[cubes] = np.nan
        self._count[cubes] = 0
        # A slow part that is held because of a load is not averaged over more samples. After the
        # restart, it contains the noise of two samples: the one before and the one after it.
        margin = RESTART_MARGIN * self._deviation[cubes]
        self._margin[cubes] += self._held[cubes] * margin

    def _use_pads(self, cubes: Index, left_out: PadMasks) -> None:
        """Start the slow parts (averages that follow slow drift) of cubes with other pads again.

        Args:
            cubes: Indices (n,) of the cubes whose pads in use have changed.
            left_out: Bit masks (n,) of the pads that are not in use now.
        """
        self._restart(cubes)
        self._left_out[cubes] = left_out
        for cube, mask in zip(cubes.tolist(), left_out.tolist(), strict=True):
            covariance = self._pipeline.compute_covariance(cube, mask)
            self._deviation[cube] = np.sqrt(covariance[PRESSURE, PRESSURE])

    def _compute_gain(
        self,
        cube: Index | slice,
        pressure: Array,
        elapsed_s: Array,
    ) -> Array:
        """Return the gain (k,) of the low-pass filter that gives the slow parts of k cubes.

        `_test` has to be called before, with the same arguments.

        Returns:
            Fraction (k,) of the difference between value and slow part that is added to the slow
            part; 0 where the slow part is held.
        """
        if not self._touched.any():
            has_gone = pressure < -MIN_RELEASE * self._deviation[cube]
            self._count[cube] *= ~has_gone
        # With the gain 1 / n of the n-th sample, the slow part is the mean of the first samples.
        mean_gain = 1 / (self._count[cube] + 1)
        gain = np.maximum(elapsed_s / TIME_CONSTANT_S, mean_gain)
        is_kept = self._held | self._touched
        return np.where(is_kept[cube], 0, gain)

    def _test(
        self,
        cube: Index | slice,
        pressure: Array,
        elapsed_s: Array,
    ) -> None:
        """Add the pressures of k cubes to their CUSUM sums, and find which cubes are touched.

        Args:
            cube: Indices (k,) of the cubes; `slice(None)` if these are all cubes.
            pressure: Pressures (k,) without their slow part, in Pa, NaN where unknown.
            elapsed_s: Time (k,) since the previous sample of each cube, in s; at most
                `TIME_CONSTANT_S`.
        """
        margin = self._margin[cube]
        if self._held.any() or margin.any():
            # A load nearby stops the update of a cube's slow part (`_held`), so drift is no longer
            # removed from the pressure. A margin that grows with the time is subtracted instead, so
            # that neither drift nor what remains of an earlier load counts as touch.
            remainder = REMAINDER * np.abs(pressure)
            growing = np.fmax(margin, remainder) + MAX_DRIFT * elapsed_s
            fading = (1 - elapsed_s / TIME_CONSTANT_S) * margin
            margin = np.where(self._held[cube], growing, fading)
            self._margin[cube] = margin

        # The slow part of a pressure that drifts steadily lags behind the pressure by one time
        # constant. The difference of the two at the largest drift is subtracted.
        lag = MAX_DRIFT * TIME_CONSTANT_S
        score = (pressure - margin - lag) / self._deviation[cube]
        before = self._sum[cube]
        # The sum is limited from above, so that it falls to 0 within a few scans after any load.
        after = (before + score - REFERENCE).clip(0, self.limit + REFERENCE)
        is_settling = self._count[cube] < SETTLING_ROWS
        after = np.where(is_settling, before, after)
        self._sum[cube] = np.where(np.isnan(pressure), 0, after)

        begins = self._sum > self.limit
        lasts = self._touched & (self._sum > 0)
        self._touched = begins | lasts

    def _locate(self, stamp_ns: int) -> Touches:
        """Return the touches and their forces.

        A touch is reported at each touched cube whose pressure is at least that of each touched
        neighbour, and above the limit of the pressure that a load at another cube causes there.

        Args:
            stamp_ns: Time of the earliest sample of the scan, in ns.
        """
        if not self._touched.any():
            self._reach[:] = 0
            self._held[:] = False
            self._id[:] = NO_TOUCH
            return NO_TOUCHES._replace(stamp_ns=stamp_ns)
        pressure = -self._change[:, PRESSURE]
        strength = np.where(self._touched, pressure, 0)
        # `top` is the neighbour of each cube with the largest pressure, or the cube itself.
        largest = strength[self._near].argmax(axis=0)
        top = self._near[largest, self._every_cube]
        is_largest = self._touched & (top == self._every_cube)
        # In each scan, the upper limit of the pressure that touches cause (`_reach`) spreads from
        # each cube to its neighbours only. This is fast enough: slow parts change little in the
        # scans until the limit has reached all cubes.
        spread = SPREAD * self._reach[self._near].max(axis=0)
        felt = np.maximum(spread, MAX_DISTANT_RATIO * strength.max())
        self._reach = np.maximum(strength, spread)
        self._held = self._reach > self._deviation / 2

        cube = np.flatnonzero(is_largest & (strength > felt))
        cube = cube[np.argsort(-pressure[cube], kind="stable")]
        number = self._number(cube, top, stamp_ns)
        own = pressure[cube]
        margin = self._margin[cube]
        errors = self._update_errors(cube, stamp_ns)
        variance = self._deviation[cube] ** 2 + margin**2 + (GAIN_ERROR * own) ** 2
        variance += (errors[:, 0, PRESSURE] ** 2).sum(axis=1)
        share = np.clip(margin / np.maximum(own, 1e-9), 0, 1)
        force, force_deviation = self._estimate_forces(
            cube,
            share[:, None],
            errors,
        )
        return Touches(
            stamp_ns=stamp_ns,
            cube=cube,
            id=number,
            pressure=own,
            pressure_uncertainty=np.sqrt(variance),
            force=force,
            force_uncertainty=force_deviation,
        )

    def _number(self, cube: Index, top: Index, stamp_ns: int) -> Index:
        """Return the numbers (m,) of the touches of this scan.

        Each touched cube belongs to the touch that is reached by going repeatedly to the neighbour
        with the largest pressure. The number of this touch is stored for the cube. In the next
        scan, a touch at this cube takes the stored number, so that a touch that moves keeps its
        number.

        Args:
            cube: Indices (m,) of the cubes of the touches, the one with the largest pressure first.
            top: Index (cubes,) of the neighbour with the largest pressure of each cube.
            stamp_ns: Time of the earliest sample of the scan, in ns.
        """
        numbers: list[int] = []
        new = stamp_ns
        for number in self._id[cube].tolist():
            # Of several touches with the same number, the one with the largest pressure keeps it.
            is_new = number == NO_TOUCH or number in numbers
            numbers.append(new if is_new else number)
            new += is_new

        while (top[top] != top).any():
            top = top[top]
        self._id[~self._touched] = NO_TOUCH
        self._id[cube] = numbers
        self._id = self._id[top]
        return np.array(numbers, np.intp)

    def _update_errors(self, cube: Index, stamp_ns: int) -> Array:
        """Return the errors (m, W, 15, K) of the 15 values of the W cubes around each of m cubes.

        The errors have K independent causes other than noise. They are computed again if the cubes
        are not those of the last call, or if the errors are older than `ERRORS_PERIOD_NS`.

        Args:
            cube: Indices (m,) of the cubes.
            stamp_ns: Time of the earliest sample of the scan, in ns.
        """
        near = self._near[:, cube].T
        is_old = abs(stamp_ns - self._errors_ns) >= ERRORS_PERIOD_NS
        if is_old or not np.array_equal(cube, self._errors_cube):
            self._errors_cube = cube
            self._errors_ns = stamp_ns
            shape = *near.shape, len(COMPONENTS)
            self._errors = np.zeros((*shape, 0))
            if self._find_errors is not None and len(cube):
                cubes = near.ravel()
                errors = self._find_errors(cubes, self._left_out[cubes])
                self._errors = np.nan_to_num(errors).reshape(*shape, -1)
        return self._errors

    def _estimate_forces(
        self,
        cube: Index,
        share: Array,
        errors: Array,
    ) -> tuple[Array, Array]:
        """Return the forces (m, 3) at m cubes and their standard deviations (m, 3), in N.

        Args:
            cube: Indices (m,) of the cubes.
            share: Fraction (m, 1) of each force that may be due to drift and earlier loads.
            errors: Errors (m, W, 15, K) of the 15 values of the W cubes around each cube by K
                causes, as from `_update_errors`.
        """
        estimate = self._estimate
        if estimate is None:
            unknown = np.full((len(cube), 3), np.nan)
            return unknown, unknown
        near = self._near[:, cube].T
        kind = estimate.kind[cube]
        weights = estimate.weights[kind]
        values = self._change[near].reshape(len(cube), 1, weights.shape[1])
        values[np.isnan(values)] = 0
        force = (values @ weights)[:, 0]
        square = force**2

        place = self._place[cube]
        squared_distance = ((place[:, None] - place) ** 2).sum(axis=2)
        # The distance of a load from itself is set to infinity, because only other loads disturb
        # the estimate of its force.
        np.fill_diagonal(squared_distance, np.inf)
        # The errors due to other loads decrease with the distance^-3, their squares with ^-6.
        others = squared_distance**-3

        variance = estimate.noise_variance[kind] + (share * force) ** 2
        variance += GAIN_ERROR**2 * (values**2 @ weights**2)[:, 0]
        variance += (estimate.squared_error[kind] @ square[:, :, None])[:, :, 0]
        variance += OTHER_LOADS**2 * others @ square.sum(axis=1, keepdims=True)
        by_value = errors.reshape(
            len(cube),
            weights.shape[1],
            errors.shape[3],
        )
        variance += ((by_value.swapaxes(1, 2) @ weights) ** 2).sum(axis=1)

        is_missing = np.isnan(self._slow[near]) != self._unobserved[near]
        is_unknown = is_missing.any(axis=(1, 2))
        force[is_unknown] = variance[is_unknown] = np.nan
        return force, np.sqrt(variance)
