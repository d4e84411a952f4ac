"""Compares tensors that arrived with the load that the simulator's hubs were under: what only the
demo asks for, beyond the comparison of sent and received."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..config.skin import Skin
from ..core.arrays import Array
from ..core.defaults import CONTACT_PRESSURE
from ..core.errors import MessageError
from ..core.estimator import make_estimator
from ..core.modes import COMPONENTS
from ..core.rows import FrequencyRows, StressRows
from ..simulation.cubes import calibration_groups, skin_components
from ..simulation.load import AnyLoad
from ..simulation.sample_log import SampleLog
from ..touch.surface import Contact, Surface
from .verification import Arrivals, Comparison, compare, percentile

TIMES_COMPARED = 500
"""Times at most whose tensors are compared with the load: each costs a contact problem."""
RANGE_TIMES = 100
"""Times of a script at which the range of what it applies is taken."""


@dataclass(frozen=True)
class Forces:
    """Forces on the whole skin over T times, applied by the script and reconstructed from tensors.

    In the skin's parent frame; centres of pressure are NaN where nothing presses.

    seconds: (T,) simulated time
    force, centre, normal: (T, 3) N, m and out of the skin, as the script applies them
    measured_force, measured_centre: (T, 3) N and m, as reconstructed
    """

    seconds: Array
    force: Array
    centre: Array
    normal: Array
    measured_force: Array
    measured_centre: Array

    def figures(self) -> dict[str, object]:
        """Greatest force and root mean square error per axis, N; error of the centre along the
        skin while it is loaded, mm."""
        size = np.linalg.norm(self.force, axis=1)
        pressed = (size > 0.2 * size.max()) & np.isfinite(self.measured_centre).all(axis=1)
        error = np.sqrt(np.mean((self.measured_force - self.force) ** 2, axis=0))
        apart, normal = (self.measured_centre - self.centre)[pressed], self.normal[pressed]
        apart -= np.einsum("ti,ti->t", apart, normal)[:, None] * normal
        return {
            "force_peak_n": np.abs(self.force).max(axis=0).round(2).tolist(),
            "force_error_n": error.round(2).tolist(),
            "centre_error_mm": round(1e3 * float(np.sqrt(np.mean((apart**2).sum(axis=1)))), 2),
        }


class LoadVerification:
    """Collects rows as they arrive; `compare` then says which of them should have arrived."""

    def __init__(self, skin: Skin, load: AnyLoad) -> None:
        self._skin, self._load = skin, load
        self._frequencies, self._stress = Arrivals(skin), Arrivals(skin)
        self._components: list[NDArray[np.floating]] = []
        self._newest_ns = np.zeros(len(skin.cubes), np.int64)
        self._log = SampleLog(0, ())
        self._span_ns = (0, 0)

    def frequencies(self, rows: FrequencyRows) -> None:
        """Rows of one frequencies message."""
        self._frequencies.add(rows)

    def stress(self, rows: StressRows, received_ns: int) -> None:
        """Rows of one stress message, received at received_ns (wall clock)."""
        np.maximum.at(self._newest_ns, rows.cube, rows.stamp_ns)
        self._stress.add(rows, received_ns)
        self._components.append(np.concatenate([rows.stress, rows.gradient], axis=1))

    @property
    def sampled(self) -> bool:
        """Whether any frequencies have arrived."""
        return self._frequencies.rows > 0

    def beyond(self, end_ns: int) -> bool:
        """Whether a tensor of every cube has arrived that was sampled after end_ns, as far as
        stamps tell."""
        return bool(self._newest_ns.min() > end_ns)

    def compare(self, log: SampleLog, start_ns: int, end_ns: int) -> None:
        """Only samples that were taken from start_ns to before end_ns (wall clock) count from now
        on."""
        self._log, self._span_ns = log, (start_ns, end_ns)

    def complete(self) -> bool:
        """Whether a tensor of every sample sent has arrived."""
        comparison = self._compared(self._stress)
        return comparison.received >= comparison.sent

    def result(self) -> dict[str, object]:
        """Figures of the span: counts in rows (one cube, one sample), times in ms, errors relative
        to the range of the script, and relative to what the noise of the calibrations allows."""
        frequencies, stress = self._compared(self._frequencies), self._compared(self._stress)
        rms, worst, over_noise = self._errors(stress)
        return {
            "samples_sent": stress.sent,
            "samples_received": frequencies.received,
            "tensors_received": stress.received,
            "lost": stress.missing,
            "latency_p50_ms": percentile(stress.latency_ms, 50),
            "latency_p99_ms": percentile(stress.latency_ms, 99),
            "stamp_error_p99_ms": percentile(stress.stamp_error_ms, 99),
            "error_rel_rms": rms,
            "error_rel_worst": worst,
            "error_over_noise": over_noise,
        }

    def forces(self) -> Forces:
        """The force on the whole skin and its centre, from the tensors that arrived, beside the
        script's. MessageError: tensors of all cubes at one time never arrived."""
        cube, components, taken_ns = self._received(self._compared(self._stress))
        times, counts = np.unique(taken_ns, return_counts=True)
        times = _some(times[counts == len(self._skin.cubes)])
        if not len(times):
            raise MessageError(
                "no tensors of all cubes at one time have arrived: there are no forces to draw"
            )
        surface = Surface(self._load.poses, self._load.depth)
        seconds = (times - self._log.start_time_ns) * 1e-9
        applied = [self._load.total(time) for time in seconds.tolist()]
        found = []
        for time_ns in times:
            rows = np.flatnonzero(taken_ns == time_ns)
            of_cubes = np.full((len(self._skin.cubes), len(COMPONENTS)), np.nan)
            of_cubes[cube[rows]] = components[rows]
            found.append(_total(surface.contacts(of_cubes, CONTACT_PRESSURE)))
        force, centre, normal = (np.array(column) for column in zip(*applied, strict=True))
        measured_force, measured_centre = (np.array(column) for column in zip(*found, strict=True))
        return Forces(
            np.asarray(seconds, float), force, centre, normal, measured_force, measured_centre
        )

    def _compared(self, arrivals: Arrivals) -> Comparison:
        return compare(self._log, arrivals, *self._span_ns)

    def _received(
        self, comparison: Comparison
    ) -> tuple[NDArray[np.int64], NDArray[np.floating], NDArray[np.int64]]:
        """cube (K,), components (K, 15) and time (K,) of the rows of the span that arrived."""
        first = comparison.first
        if not len(first):
            return np.empty(0, np.int64), np.empty((0, len(COMPONENTS))), np.empty(0, np.int64)
        cube = self._stress.columns()[0]
        return cube[first], np.concatenate(self._components)[first], comparison.taken_ns[first]

    def _errors(self, comparison: Comparison) -> tuple[float, float, float]:
        """Root mean square and worst deviation of observed components, relative to the range that
        each has in the whole script; and the root mean square relative to the standard deviation
        that the noise of the calibrations makes."""
        cube, components, taken_ns = self._received(comparison)
        if not len(cube):
            return float("nan"), float("nan"), float("nan")
        found, applied, allowed = [], [], []
        noise = component_noise(self._skin)
        for time_ns in _some(np.unique(taken_ns)):
            rows = np.flatnonzero(taken_ns == time_ns)
            applied.append(self._truth((time_ns - self._log.start_time_ns) * 1e-9)[cube[rows]])
            found.append(components[rows])
            allowed.append(noise[cube[rows]])
        script = [self._truth(time) for time in np.linspace(0, self._load.period, RANGE_TIMES)]
        lowest = np.nanmin(script, axis=(0, 1))
        span = np.nanmax(script, axis=(0, 1)) - lowest
        deviation = np.concatenate(found) - np.concatenate(applied)
        relative = deviation[:, span > 0] / span[span > 0]
        over_noise = deviation / np.concatenate(allowed)
        return (
            float(np.sqrt(np.nanmean(relative**2))),
            float(np.nanmax(np.abs(relative))),
            float(np.sqrt(np.nanmean(over_noise**2))),
        )

    def _truth(self, seconds: float) -> Array:
        """Components (cubes, 15) that the load makes at a simulated time."""
        return skin_components(self._skin, *self._load.at(seconds))


def component_noise(skin: Skin) -> Array:
    """(cubes, 15) standard deviations, Pa and Pa/m, that the noise of its pads makes in what each
    cube reports; NaN: not observed."""
    deviations = np.empty((len(skin.cubes), len(COMPONENTS)))
    for calibration, rows in calibration_groups(skin.calibrations):
        estimator = make_estimator(
            calibration.response,
            calibration.noise,
            calibration.modes,
            neglect=calibration.neglect,
        )
        scale = np.where(np.arange(len(COMPONENTS)) < 6, 1.0, 1 / calibration.half_side)
        deviations[rows] = np.sqrt(np.diag(estimator.covariance)) * scale
    return deviations


def _some(times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """TIMES_COMPARED of the times, or up to twice as many, at equal intervals; all if there are
    fewer."""
    return times_ns[:: max(1, len(times_ns) // TIMES_COMPARED)]


def _total(contacts: list[Contact]) -> tuple[Array, Array]:
    """Force (3,) N and centre of pressure (3,) m of all contacts together."""
    if not contacts:
        return np.zeros(3), np.full(3, np.nan)
    weight = np.array([contact.normal_force for contact in contacts])
    positions = np.array([contact.position for contact in contacts])
    force = np.sum([contact.force for contact in contacts], axis=0)
    return force, weight @ positions / weight.sum()
