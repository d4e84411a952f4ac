# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of the tensors that arrived with the load on the simulated skin.

Only the demo needs this module. The module `verification`, which `./cube bench` and the tests use,
too, compares the samples that were sent with those that were received.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..config.skin import Skin
from ..core.arrays import Array, Index, Mask, Real
from ..core.defaults import CONTACT_PRESSURE
from ..core.errors import MessageError
from ..core.modes import COMPONENTS
from ..core.pipeline import Pipeline
from ..core.rows import StressRows
from ..simulation.cubes import compute_skin_components
from ..simulation.load import AnyLoad, compute_resultant
from ..simulation.sample_log import SampleLog
from ..touch.surface import Surface
from .verification import Arrivals, Comparison, compare, compute_percentile

MIN_TIMES_COMPARED = 500
"""Minimum number of sampling times that are compared with the load; a measurement with fewer times
is compared completely.

If a measurement has many more, only every n-th sampling time is compared, because computing the
load at each time takes long: it is the solution of a contact problem.
"""

RANGE_TIMES = 100
"""Number of equally spaced times in one period of the load from which the range (maximum minus
minimum) of each of the 15 stress and gradient components is computed. The errors of the measured
components are divided by this range."""

LOADED_SHARE = 0.2
"""Fraction of the largest force of a measurement above which the skin counts as loaded.

The centre of pressure of a smaller force is mostly noise and is not compared.
"""


@dataclass(frozen=True)
class ForceHistory:
    """Forces on the whole skin at T times, as applied and as computed from the tensors.

    All vectors are in the skin's parent frame. A centre of pressure is NaN at times without load.

    Attributes:
        seconds: (T,) simulated time, in seconds after the start of the simulator.
        force: (T, 3) force that the load applies, in N.
        centre: (T, 3) centre of pressure of the load, in metres.
        normal: (T, 3) unit normal out of the skin at the centre of pressure of the load.
        measured_force: (T, 3) force computed from the tensors, in N.
        measured_centre: (T, 3) centre of pressure computed from the tensors, in metres.
    """

    seconds: Array
    force: Array
    centre: Array
    normal: Array
    measured_force: Array
    measured_centre: Array

    def compute_errors(self) -> dict[str, object]:
        """Return peak and rms error of the force per axis (N), and rms error of the centre (mm).

        The error of the centre of pressure is computed from times at which the skin is loaded, and
        only from its part along the skin: the tensors, which are all measured at one depth, do not
        determine the height at which the force acts.
        """
        size = np.linalg.norm(self.force, axis=1)
        is_measured = np.isfinite(self.measured_centre).all(axis=1)
        is_loaded = size > LOADED_SHARE * size.max()
        compared = is_loaded & is_measured

        offset = (self.measured_centre - self.centre)[compared]
        normal = self.normal[compared]
        height = np.einsum("ti,ti->t", offset, normal)
        along_skin = offset - height[:, None] * normal
        distance = np.linalg.norm(along_skin, axis=1)

        peak = np.abs(self.force).max(axis=0)
        force_error = self.measured_force - self.force
        mean_square = (force_error**2).mean(axis=0)
        error = np.sqrt(mean_square)
        return {
            "force_peak_n": peak.round(2).tolist(),
            "force_error_n": error.round(2).tolist(),
            "centre_error_mm": round(1e3 * compute_rms(distance), 2),
        }


class LoadVerification:
    """Collects the rows (one cube at one sampling time) of messages, and compares them with what
    was simulated: the samples that the hubs took in a period, and the load on the skin.

    Call `set_sent_samples` when the simulator has ended, then `make_result` or `forces`.

    Attributes:
        load: The load on the skin.
        frequencies: The rows of the topic `frequencies` that arrived.
    """

    def __init__(self, skin: Skin, load: AnyLoad) -> None:
        """Start without rows.

        Args:
            skin: The simulated skin.
            load: The load on the skin over time, from which stress, force and contacts at any
                simulated time can be computed, as the simulator does.
        """
        self._skin = skin
        self.load = load
        self._n_cubes = len(skin.cubes)
        self.frequencies = Arrivals(skin)
        self._stress = Arrivals(skin)
        self._components: list[Real] = []
        self._newest_ns = np.zeros(self._n_cubes, np.int64)
        self._log = SampleLog(0, ())
        self._span_ns = (0, 0)

    def add_stress(self, rows: StressRows, received_ns: int) -> None:
        """Add the rows of one message of the topic `stress`.

        Args:
            rows: The rows.
            received_ns: Time of arrival, in ns since the Unix epoch.
        """
        newest_ns = self._newest_ns
        np.maximum.at(newest_ns, rows.cube, rows.stamp_ns)
        self._stress.add(rows, received_ns)
        # The rows are stored in the same order as in `Arrivals`, so that indices into its rows can
        # be used here, too.
        self._components.append(rows.components)

    def is_beyond(self, end_ns: int) -> bool:
        """Return whether a tensor with a stamp after `end_ns` has arrived from each cube.

        Args:
            end_ns: Time in ns since the Unix epoch.
        """
        return bool(self._newest_ns.min() > end_ns)

    def set_sent_samples(
        self,
        log: SampleLog,
        start_ns: int,
        end_ns: int,
    ) -> None:
        """Set the sent samples with which `make_result` and `forces` compare the received rows.

        Args:
            log: Log of the simulator, which contains the samples that its hubs took.
            start_ns: Beginning of the compared period, in ns since the Unix epoch.
            end_ns: End of the period; samples taken at this time or later do not count.
        """
        self._log, self._span_ns = log, (start_ns, end_ns)

    def is_complete(self) -> bool:
        """Return whether a tensor has arrived for every sample that was sent in the period."""
        comparison = self._compare(self._stress)
        return comparison.received >= comparison.sent

    def make_result(self) -> dict[str, object]:
        """Return counts, latencies and errors of the compared period, as the JSON file has them.

        Counts are rows (one cube at one sampling time), times are in ms. Errors of the tensors are
        relative to the range that each component has under the load, and relative to the standard
        deviation that the noise of the pads causes.
        """
        frequencies = self._compare(self.frequencies)
        stress = self._compare(self._stress)
        return {
            "samples_sent": stress.sent,
            "samples_received": frequencies.received,
            "tensors_received": stress.received,
            "lost": stress.missing,
            "latency_p50_ms": compute_percentile(stress.latency_ms, 50),
            "latency_p99_ms": compute_percentile(stress.latency_ms, 99),
            "stamp_error_p99_ms": compute_percentile(stress.stamp_error_ms, 99),
            **self._compute_errors(stress),
        }

    def compute_forces(self) -> ForceHistory:
        """Compute the force on the whole skin and its centre of pressure over time.

        Raises:
            MessageError: There is no time at which a tensor of every cube has arrived.
        """
        times_ns, values, is_complete = self._find_received(self._compare(self._stress))
        # The force on the whole skin can be computed at times with a tensor of every cube.
        times_ns = times_ns[is_complete]
        if not len(times_ns):
            raise MessageError(
                "no tensors of all cubes at one time have arrived: there are no forces to draw"
            )

        # The load is a function of simulated time, which is 0 at the start of the simulator.
        seconds = self._compute_seconds(times_ns)
        applied = map(self.load.compute_resultant, seconds.tolist())
        force, centre, normal = map(np.array, zip(*applied, strict=True))
        # The contacts are found by interpolating the pressure between the cubes, as the node
        # `contacts` does with the method `interpolation`.
        surface = Surface(self.load.poses, self.load.depth)
        contacts = [surface.find_contacts(one, CONTACT_PRESSURE) for one in values[is_complete]]
        measured = map(compute_resultant, contacts)
        measured_force, measured_centre, _ = map(np.array, zip(*measured, strict=True))
        return ForceHistory(
            seconds=seconds,
            force=force,
            centre=centre,
            normal=normal,
            measured_force=measured_force,
            measured_centre=measured_centre,
        )

    def _compare(self, arrivals: Arrivals) -> Comparison:
        return compare(self._log.table, arrivals, *self._span_ns)

    def _find_received(self, comparison: Comparison) -> tuple[Index, Array, Mask]:
        """Return the tensors that arrived; of a long measurement only those of every n-th time.

        Args:
            comparison: The samples that the hubs took, and which rows of stress arrived for them.

        Returns:
            T sampling times, in ns since the Unix epoch; components (T, cubes, 15) in Pa and Pa/m,
            NaN where no tensor arrived; whether a tensor of every cube arrived (T,).
        """
        sampled_ns = np.unique(comparison.taken_ns)
        step = max(1, len(sampled_ns) // MIN_TIMES_COMPARED)
        times_ns = sampled_ns[::step]
        is_chosen = np.isin(comparison.taken_ns, times_ns)
        time = np.searchsorted(times_ns, comparison.taken_ns[is_chosen])
        rows = comparison.first[is_chosen]
        cube = self._stress.collect_columns()[0][rows]
        shape = (len(times_ns), self._n_cubes, len(COMPONENTS))
        values = np.full(shape, np.nan)
        if len(rows):
            components = np.concatenate(self._components)
            values[time, cube] = components[rows]
        n_arrived = np.bincount(time, minlength=len(times_ns))
        return times_ns, values, n_arrived == self._n_cubes

    def _compute_seconds(self, times_ns: Index) -> Array:
        """Return the simulated times, in s after the start of the simulator, of times (T,) in ns
        since the Unix epoch."""
        return np.asarray(1e-9 * (times_ns - self._log.start_time_ns), float)

    def _compute_errors(self, comparison: Comparison) -> dict[str, object]:
        """Compute the errors of the tensors that arrived.

        Args:
            comparison: The samples that the hubs took, and which rows of stress arrived for them.

        Returns:
            Rms and largest error relative to the range of each component under the load, and rms
            error relative to the standard deviation that the noise of the pads causes. All are NaN
            if no tensor arrived.
        """
        times_ns, values, _ = self._find_received(comparison)
        if not len(times_ns):
            return dict.fromkeys(("error_rel_rms", "error_rel_worst", "error_over_noise"), np.nan)
        seconds = self._compute_seconds(times_ns)
        truth = [self._compute_truth(time) for time in seconds]
        error = values - np.array(truth)

        times = np.linspace(0, self.load.period, RANGE_TIMES)
        script = [self._compute_truth(time) for time in times]
        highest = np.nanmax(script, axis=(0, 1))
        lowest = np.nanmin(script, axis=(0, 1))
        span = highest - lowest
        # A component that is constant under the load has a range of 0 and is left out.
        varies = span > 0
        relative = error[..., varies] / span[varies]
        return {
            "error_rel_rms": compute_rms(relative),
            "error_rel_worst": float(np.nanmax(np.abs(relative))),
            "error_over_noise": compute_rms(error / compute_component_noise(self._skin)),
        }

    def _compute_truth(self, seconds: float) -> Array:
        """Return the components (cubes, 15), in Pa and Pa/m, under the load at a simulated time.

        Args:
            seconds: Time after the start of the simulator, in s.
        """
        return compute_skin_components(self._skin, *self.load.compute_stress_field(seconds))


def compute_rms(values: Real) -> float:
    """Return the root mean square of all values that are not NaN."""
    return float(np.sqrt(np.nanmean(values**2)))


def compute_component_noise(skin: Skin) -> Array:
    """Compute the standard deviation that the noise of the pads causes in each component.

    Args:
        skin: The skin, whose calibrations state the noise of each pad (standard deviation of its
            stress, in Pa).

    Returns:
        Standard deviations (cubes, 15) in Pa and Pa/m; NaN where a component is not observed.
    """
    pipeline = Pipeline(skin.calibrations)
    variances = []
    for cube in range(len(skin.cubes)):
        covariance = pipeline.compute_covariance(cube)
        variances.append(np.diag(covariance))
    return np.sqrt(np.array(variances))
