"""Judges what came out of a running skin against the simulator's book: what was sent, when, and
under which load."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..config.skin import Skin
from ..core.defaults import CONTACT_PRESSURE
from ..core.errors import MessageError
from ..core.modes import COMPONENTS
from ..core.rows import StressRows
from ..elastic.surface import Surface
from .cubes import true_components
from .load import Load

TIMES_CHECKED = 500
"""Instants at most whose tensors are compared with the load: each costs a contact problem."""
RANGE_TIMES = 100
"""Times of a script at which the range of what it applies is taken."""


class Forces(NamedTuple):
    """Over T times: seconds (T,) of simulated time; force (T, 3) N on the skin and centre of
    pressure (T, 3) m.

    In the skin's parent frame, the script's, with the normal (T, 3) there, and as found; a centre
    is NaN where nothing presses.
    """

    seconds: NDArray[Any]
    force: NDArray[Any]
    centre: NDArray[Any]
    normal: NDArray[Any]
    found_force: NDArray[Any]
    found_centre: NDArray[Any]

    def figures(self) -> dict[str, object]:
        """Greatest force and root mean square error per axis, N; of the centre along the skin under
        load, mm."""
        size = np.linalg.norm(self.force, axis=1)
        pressed = (size > 0.2 * size.max()) & np.isfinite(self.found_centre).all(axis=1)
        error = np.sqrt(np.mean((self.found_force - self.force) ** 2, axis=0))
        apart, normal = (self.found_centre - self.centre)[pressed], self.normal[pressed]
        apart -= np.einsum("ti,ti->t", apart, normal)[:, None] * normal
        return {
            "force_peak_n": np.abs(self.force).max(axis=0).round(2).tolist(),
            "force_error_n": error.round(2).tolist(),
            "centre_error_mm": round(1e3 * float(np.sqrt(np.mean((apart**2).sum(axis=1)))), 2),
        }


class Judge:
    """Takes rows as they arrive; `read_book` then fixes what should have arrived in a span of
    time."""

    def __init__(self, skin: Skin, load: Load) -> None:
        self.contradictions = 0
        self._newest_ns = np.zeros(len(skin.cubes), np.int64)
        self._skin, self._load = skin, load
        self._tensors: list[tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], int]] = []
        self._samples: list[tuple[NDArray[Any], NDArray[Any]]] = []
        self._sent = 0
        self._time_ns: Callable[[NDArray[Any], NDArray[Any]], NDArray[np.int64]] | None = None
        self._span = (0, 0)
        self._book_start = 0

    def stress(
        self,
        cube: NDArray[Any],
        sequence: NDArray[Any],
        stamp_ns: NDArray[Any],
        rows: StressRows,
        received_ns: int,
    ) -> None:
        """Rows of one stress message, received at received_ns (wall clock)."""
        values = np.concatenate([rows.stress, rows.gradient], axis=1)
        np.maximum.at(self._newest_ns, cube, stamp_ns)
        self._tensors.append(
            (np.array(cube), np.array(sequence), np.array(stamp_ns), values, received_ns)
        )

    def frequencies(self, cube: ArrayLike, sequence: ArrayLike) -> None:
        """Rows of one frequencies message."""
        self._samples.append((np.array(cube), np.array(sequence)))

    def read_book(self, book: dict[str, Any], start_ns: int, end_ns: int) -> None:
        """What the simulator sampled; only samples taken from start_ns to end_ns (wall clock) are
        judged."""
        self._span = start_ns, end_ns
        self._book_start = book["start_time_ns"]
        link_of = np.zeros(len(self._skin.cubes), int)
        runs: list[tuple[int, int, int, int, int]] = []
        self._sent = 0
        for number, link in enumerate(book["links"].values()):
            members = [cube for cube in link["cubes"] if cube >= 0]
            link_of[members] = number
            for run in link["runs"]:
                runs.append((number, run["first"], run["last"], run["start_us"], run["period_us"]))
                times = self._book_start + 1000 * (
                    run["start_us"] + np.arange(run["last"] - run["first"] + 1) * run["period_us"]
                )
                self._sent += len(members) * int(
                    np.count_nonzero((times >= start_ns) & (times < end_ns))
                )

        def time_ns(cube: NDArray[Any], sequence: NDArray[Any]) -> NDArray[np.int64]:
            result = np.full(len(cube), -1, np.int64)
            for number, first, last, start_us, period_us in runs:
                there = (link_of[cube] == number) & (sequence >= first) & (sequence <= last)
                result[there] = self._book_start + 1000 * (
                    start_us + (sequence[there].astype(np.int64) - first) * period_us
                )
            return result

        self._time_ns = time_ns

    @property
    def sampled(self) -> bool:
        """Whether any frequencies have arrived."""
        return bool(self._samples)

    def beyond(self, end_ns: int) -> bool:
        """Whether of every cube a tensor has arrived that was sampled after end_ns, as far as
        stamps tell."""
        return bool(self._newest_ns.min() > end_ns)

    def complete(self) -> bool:
        """Whether a tensor of every sample sent has arrived."""
        return len(self._received()[0]) >= self._sent

    def result(self) -> dict[str, object]:
        """Figures of the span: counts in rows (one cube, one instant), times in ms, errors relative
        to the range."""
        cube, _, stamp_ns, values, received_ns, true_ns = self._received()
        samples = self._in_span(*_joined(self._samples, 2))[0]
        latency = (received_ns - true_ns) * 1e-6
        stamp_error = np.abs(stamp_ns - true_ns) * 1e-6
        rms, worst = self._errors(cube, values, true_ns)
        return {
            "samples_sent": self._sent,
            "samples_received": len(samples),
            "tensors_received": len(cube),
            "lost": self._sent - len(cube),
            "latency_p50_ms": _percentile(latency, 50),
            "latency_p99_ms": _percentile(latency, 99),
            "stamp_error_p99_ms": _percentile(stamp_error, 99),
            "error_rel_rms": rms,
            "error_rel_worst": worst,
        }

    def _in_span(
        self, cube: NDArray[Any], sequence: NDArray[Any], *others: NDArray[Any]
    ) -> tuple[NDArray[Any], ...]:
        """Of rows those of samples taken in the span, each once, with the times they were taken
        at."""
        if self._time_ns is None or not len(cube):
            return (*(a[:0] for a in (cube, sequence, *others)), np.empty(0, np.int64))
        true_ns = self._time_ns(cube, sequence)
        rows = np.flatnonzero((true_ns >= self._span[0]) & (true_ns < self._span[1]))
        key = cube[rows].astype(np.int64) << 32 | sequence[rows]
        rows = rows[np.sort(np.unique(key, return_index=True)[1])]
        return (*(a[rows] for a in (cube, sequence, *others)), true_ns[rows])

    def _received(self) -> tuple[NDArray[Any], ...]:
        cube, sequence, stamp_ns, values = _joined([part[:4] for part in self._tensors], 4)
        counts = [len(part[0]) for part in self._tensors]
        received_ns = np.repeat(np.array([part[4] for part in self._tensors], np.int64), counts)
        return self._in_span(cube, sequence, stamp_ns, values, received_ns)

    def _errors(
        self, cube: NDArray[Any], values: NDArray[Any], true_ns: NDArray[Any]
    ) -> tuple[float, float]:
        """Root mean square and worst deviation of observed components, relative to the range of the
        whole script."""
        found, applied = [], []
        for time_ns in _checked(true_ns):
            rows = np.flatnonzero(true_ns == time_ns)
            applied.append(self._truth((time_ns - self._book_start) * 1e-9)[cube[rows]])
            found.append(values[rows])
        if not found:
            return float("nan"), float("nan")
        got, want = np.concatenate(found), np.concatenate(applied)
        script = np.concatenate(
            [self._truth(time) for time in np.linspace(0, self._load.period, RANGE_TIMES)]
        )
        span = np.nanmax(script, axis=0) - np.nanmin(script, axis=0)
        relative = (got - want)[:, span > 0] / span[span > 0]
        return float(np.sqrt(np.nanmean(relative**2))), float(np.nanmax(np.abs(relative)))

    def _truth(self, seconds: float) -> NDArray[np.float64]:
        """Components (cubes, 15) that the load makes so many seconds after the start of the
        book."""
        stress, gradient = self._load.at(seconds)
        truth = np.empty((len(self._skin.cubes), len(COMPONENTS)))
        for calibration in {c.calibration.id: c.calibration for c in self._skin.cubes}.values():
            members = [
                i
                for i, cube in enumerate(self._skin.cubes)
                if cube.calibration.id == calibration.id
            ]
            truth[members] = true_components(calibration, stress[members], gradient[members])
        return truth

    def forces(self) -> Forces:
        """The force on the whole skin and its centre from the tensors that arrived, beside the
        script's."""
        cube, _, _, values, _, true_ns = self._received()
        times, counts = np.unique(true_ns, return_counts=True)
        times = _checked(times[counts == len(self._skin.cubes)])
        if not len(times):
            raise MessageError(
                "no tensors of all cubes at one time have arrived: there are no forces to draw"
            )
        surface = Surface(self._load.places, self._load.script.depth)
        seconds = (times - self._book_start) * 1e-9
        truth = [self._load.total(time) for time in seconds.tolist()]
        found = []
        for time_ns in times:
            rows = np.flatnonzero(true_ns == time_ns)
            of_cubes = np.full((len(self._skin.cubes), len(COMPONENTS)), np.nan)
            of_cubes[cube[rows]] = values[rows]
            contacts = surface.contacts(of_cubes, CONTACT_PRESSURE)
            weight = np.array([contact.normal_force for contact in contacts])
            places = np.reshape([contact.position for contact in contacts], (-1, 3))
            centre = weight @ places / weight.sum() if contacts else np.full(3, np.nan)
            found.append(
                (np.sum([np.zeros(3), *(contact.force for contact in contacts)], axis=0), centre)
            )
        sides = [
            np.reshape([one[part] for one in some], (-1, 3))
            for some in (truth, found)
            for part in range(len(some[0]))
        ]
        return Forces(seconds, *sides)


def _checked(true_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """At most TIMES_CHECKED of the times, or a few more, at equal intervals."""
    times = np.unique(true_ns)
    return times[:: max(1, len(times) // TIMES_CHECKED)]


def _joined(parts: list[tuple[Any, ...]], columns: int) -> list[NDArray[Any]]:
    if not parts:
        return [np.empty(0, np.int64) for _ in range(columns)]
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def _percentile(values: NDArray[Any], percent: float) -> float:
    return round(float(np.percentile(values, percent)), 3) if len(values) else float("nan")
