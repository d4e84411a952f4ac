"""Comparison of the tensors that arrived with the load on the simulated skin.

Only the demo needs it. The comparison of the samples that were sent and received, which bench and
tests need as well, is in `verification`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..config.skin import Skin
from ..core.arrays import AnyArray, Array, Index
from ..core.defaults import CONTACT_PRESSURE
from ..core.errors import MessageError
from ..core.estimator import make_estimator
from ..core.modes import COMPONENTS, STRESS
from ..core.rows import FrequencyRows, StressRows
from ..simulation.cubes import calibration_groups, skin_components
from ..simulation.load import AnyLoad
from ..simulation.sample_log import SampleLog
from ..touch.surface import Contact, Surface
from .verification import Arrivals, Comparison, compare, percentile

MIN_TIMES_COMPARED = 500
"""Number of sampling times above which only some, at equal intervals, are compared with the load:
each costs the solution of a contact problem."""

RANGE_TIMES = 100
"""Number of times within a load script from which the range of each component is computed."""

LOADED_SHARE = 0.2
"""Share of the largest force above which the skin counts as loaded. The centre of pressure of a
smaller force is mostly noise."""


@dataclass(frozen=True)
class ForceHistory:
    """Forces on the whole skin at T times, as applied and as reconstructed from tensors.

    All vectors are in the skin's parent frame. Centres of pressure are NaN where nothing presses.

    Attributes:
        seconds: (T,) simulated time, in seconds.
        force: (T, 3) force that the load applies, in N.
        centre: (T, 3) its centre of pressure, in metres.
        normal: (T, 3) direction out of the skin at that centre.
        measured_force: (T, 3) reconstructed force, in N.
        measured_centre: (T, 3) reconstructed centre of pressure, in metres.
    """

    seconds: Array
    force: Array
    centre: Array
    normal: Array
    measured_force: Array
    measured_centre: Array

    def figures(self) -> dict[str, object]:
        """Return peak and rms error of the force per axis (N), and the error of the centre (mm).

        The error of the centre is taken along the skin, while it is loaded: tensors at one depth
        say nothing about the height at which the force acts.
        """
        size = np.linalg.norm(self.force, axis=1)
        is_measured = np.isfinite(self.measured_centre).all(axis=1)
        loaded = (size > LOADED_SHARE * size.max()) & is_measured
        force_error = np.sqrt(np.mean((self.measured_force - self.force) ** 2, axis=0))

        offset, normal = (self.measured_centre - self.centre)[loaded], self.normal[loaded]
        height = np.einsum("ti,ti->t", offset, normal)
        along_skin = offset - height[:, None] * normal
        distance = np.linalg.norm(along_skin, axis=1)
        return {
            "force_peak_n": np.abs(self.force).max(axis=0).round(2).tolist(),
            "force_error_n": force_error.round(2).tolist(),
            "centre_error_mm": round(1e3 * rms(distance), 2),
        }


class LoadVerification:
    """Collects rows as they arrive; after `compare` it gives the figures of a span of time."""

    def __init__(self, skin: Skin, load: AnyLoad) -> None:
        self._skin, self._load = skin, load
        self._frequencies, self._stress = Arrivals(skin), Arrivals(skin)
        self._components: list[AnyArray] = []
        self._newest_ns = np.zeros(len(skin.cubes), np.int64)
        self._log = SampleLog(0, ())
        self._span_ns = (0, 0)

    def add_frequencies(self, rows: FrequencyRows) -> None:
        """Add the rows of one message of frequencies."""
        self._frequencies.add(rows)

    def add_stress(self, rows: StressRows, received_ns: int) -> None:
        """Add the rows of one message of stress, received at `received_ns` of the wall clock."""
        np.maximum.at(self._newest_ns, rows.cube, rows.stamp_ns)
        self._stress.add(rows, received_ns)
        # The order is that of `Arrivals`, so that its indices fit.
        self._components.append(np.concatenate([rows.stress, rows.gradient], axis=1))

    @property
    def sampled(self) -> bool:
        """Whether any frequencies have arrived."""
        return self._frequencies.rows > 0

    def is_beyond(self, end_ns: int) -> bool:
        """Return whether each cube has a tensor whose stamp is after `end_ns`."""
        return bool(self._newest_ns.min() > end_ns)

    def compare(
        self,
        log: SampleLog,
        start_ns: int,
        end_ns: int,
    ) -> None:
        """Set what is compared: samples taken from `start_ns` to before `end_ns` (wall clock)."""
        self._log, self._span_ns = log, (start_ns, end_ns)

    def is_complete(self) -> bool:
        """Return whether a tensor of every sample that was sent has arrived."""
        comparison = self._comparison(self._stress)
        return comparison.received >= comparison.sent

    def result(self) -> dict[str, object]:
        """Return the figures of the span.

        Counts are rows (one cube, one sample), times are in ms. Errors are relative to the range
        of the script, and to the standard deviation that the noise of the pads causes.
        """
        frequencies = self._comparison(self._frequencies)
        stress = self._comparison(self._stress)
        return {
            "samples_sent": stress.sent,
            "samples_received": frequencies.received,
            "tensors_received": stress.received,
            "lost": stress.missing,
            "latency_p50_ms": percentile(stress.latency_ms, 50),
            "latency_p99_ms": percentile(stress.latency_ms, 99),
            "stamp_error_p99_ms": percentile(stress.stamp_error_ms, 99),
            **self._errors(stress),
        }

    def forces(self) -> ForceHistory:
        """Return the force on the whole skin and its centre of pressure over time.

        Raises:
            MessageError: There is no time at which a tensor of every cube has arrived.
        """
        cube, components, taken_ns = self._received(self._comparison(self._stress))
        times_ns, counts = np.unique(taken_ns, return_counts=True)
        # A force on the whole skin needs a tensor of every cube at the same time.
        times_ns = thin_out(times_ns[counts == len(self._skin.cubes)])
        if not len(times_ns):
            raise MessageError(
                "no tensors of all cubes at one time have arrived: there are no forces to draw"
            )

        # The load script runs in simulated time, which began with the simulator.
        seconds = (times_ns - self._log.start_time_ns) * 1e-9
        applied = [self._load.total(time) for time in seconds.tolist()]
        # The contacts are computed as the page and the node `contacts` do without the inverse.
        surface = Surface(self._load.poses, self._load.depth)
        measured = []
        for time_ns in times_ns:
            rows = np.flatnonzero(taken_ns == time_ns)
            values = np.full((len(self._skin.cubes), len(COMPONENTS)), np.nan)
            values[cube[rows]] = components[rows]
            measured.append(total_force(surface.contacts(values, CONTACT_PRESSURE)))

        force, centre, normal = (np.array(column) for column in zip(*applied, strict=True))
        measured_force, measured_centre = map(np.array, zip(*measured, strict=True))
        return ForceHistory(
            seconds=np.asarray(seconds, float),
            force=force,
            centre=centre,
            normal=normal,
            measured_force=measured_force,
            measured_centre=measured_centre,
        )

    def _comparison(self, arrivals: Arrivals) -> Comparison:
        return compare(self._log.table, arrivals, *self._span_ns)

    def _received(self, comparison: Comparison) -> tuple[Index, AnyArray, Index]:
        """Return cube (K,), components (K, 15) and time (K,) in ns of the rows that arrived."""
        first = comparison.first
        if not len(first):
            return np.empty(0, np.intp), np.empty((0, len(COMPONENTS))), np.empty(0, np.int64)
        cube = self._stress.columns()[0]
        return cube[first], np.concatenate(self._components)[first], comparison.taken_ns

    def _errors(self, comparison: Comparison) -> dict[str, object]:
        """Return rms and largest error relative to the range of each component in the script, and
        the rms relative to the standard deviation that the noise of the pads causes."""
        cube, components, taken_ns = self._received(comparison)
        if not len(cube):
            return dict.fromkeys(("error_rel_rms", "error_rel_worst", "error_over_noise"), np.nan)
        errors, allowed = [], []
        noise = component_noise(self._skin)
        for time_ns in thin_out(np.unique(taken_ns)):
            rows = np.flatnonzero(taken_ns == time_ns)
            seconds = (time_ns - self._log.start_time_ns) * 1e-9
            truth = self._truth(seconds)
            errors.append(components[rows] - truth[cube[rows]])
            allowed.append(noise[cube[rows]])

        times = np.linspace(0, self._load.period, RANGE_TIMES)
        script = [self._truth(time) for time in times]
        lowest = np.nanmin(script, axis=(0, 1))
        span = np.nanmax(script, axis=(0, 1)) - lowest
        error = np.concatenate(errors)
        # A component that the script never changes has no range to compare with.
        relative = error[:, span > 0] / span[span > 0]
        over_noise = error / np.concatenate(allowed)
        return {
            "error_rel_rms": rms(relative),
            "error_rel_worst": float(np.nanmax(np.abs(relative))),
            "error_over_noise": rms(over_noise),
        }

    def _truth(self, seconds: float) -> Array:
        """Return the components (cubes, 15) that the load causes at a simulated time."""
        return skin_components(self._skin, *self._load.at(seconds))


def rms(values: AnyArray) -> float:
    """Return the root mean square, without values that are NaN."""
    return float(np.sqrt(np.nanmean(values**2)))


def component_noise(skin: Skin) -> Array:
    """Return the standard deviations that the noise of its pads causes in what each cube reports.

    Returns:
        (cubes, 15) in Pa and Pa/m; NaN where a component is not observed.
    """
    deviations = np.empty((len(skin.cubes), len(COMPONENTS)))
    is_stress = np.arange(len(COMPONENTS)) < len(STRESS)
    for calibration, rows in calibration_groups(skin.calibrations):
        estimator = make_estimator(
            calibration.response,
            calibration.noise,
            calibration.modes,
            neglect=calibration.neglect,
        )
        # The estimator's gradients are multiplied by the half side, so that all are in Pa.
        scale = np.where(is_stress, 1.0, 1 / calibration.half_side)
        deviations[rows] = np.sqrt(np.diag(estimator.covariance)) * scale
    return deviations


def thin_out(times_ns: Index) -> Index:
    """Return about `MIN_TIMES_COMPARED` of the times at equal intervals, or all of fewer."""
    return times_ns[:: max(1, len(times_ns) // MIN_TIMES_COMPARED)]


def total_force(contacts: list[Contact]) -> tuple[Array, Array]:
    """Return force (3,) in N and centre of pressure (3,) in metres of all contacts together."""
    if not contacts:
        return np.zeros(3), np.full(3, np.nan)
    # The centre of pressure is weighted by the normal force.
    weight = np.array([contact.normal_force for contact in contacts])
    positions = np.array([contact.position for contact in contacts])
    force = np.sum([contact.force for contact in contacts], axis=0)
    return force, weight @ positions / weight.sum()
