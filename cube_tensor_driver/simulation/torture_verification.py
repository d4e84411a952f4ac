"""Checks every row of a tortured skin against what the hubs measured and the faults that were
carried out.

Simulated hubs repeat a table of instants, one for each sample. A sample's instant is found from its
values, and checked later against the sample log. What differs from the table must be explained by a
fault of the log.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config.skin import Skin
from ..core.rows import FrequencyRows, StressRows
from ..core.status import STAMP
from .cubes import SimulatedCubes, skin_components
from .faults import PAD_FAULTS
from .load import Load, default_script
from .sample_log import NEVER, FaultRecord, LinkLog, SampleLog
from .verification import Arrivals, Comparison, compare, percentile

TOLERANCE = 1e-3
"""Of a component's range: float32 leaves 1e-6, a wrong sample 1e-1."""
SETTLE_S = 10.0
"""After a restart or a jump of a hub's clock, until its stamps are checked."""
BEFORE_S = 0.1
"""How much earlier than its record a fault may show: stamps are not exact."""
HOLD_S = 6.0
"""How long a pad that works again may still be left out: 2 s of rows, and its link may be cut for 2
s meanwhile."""
INSTANTS_KEPT = 40_000
"""Samples whose instants are remembered until their tensors come: 20 s of 4 hubs at 500 Hz, more
than queues hold."""
NEAR_ZERO = 1 << 20
"""A hub that begins to count above this has been made to wrap: its first samples are not counted
from 0."""
CLOCK_FAULTS = ("reset", "wrap", "unplug", "rename", "step", "drift")
"""What makes the driver fit a hub's clock from the start."""
RECONNECT_FAULTS = ("unplug", "rename")
NOT_FOUND = -1
"""Instant of a sample that is like none of the table."""


class What(IntEnum):
    """What of a row is not as it would be without faults."""

    FREQUENCY = 0
    TENSOR = 1
    STATUS = 2
    TENSOR_ALONE = 3
    """A tensor whose frequencies did not come."""


DEVIATION = np.dtype([("cube", "i8"), ("pads", "i8"), ("stamp_ns", "i8"), ("what", "i8")])
"""A row that differs; pads: bit p: pad p differs."""


@dataclass(frozen=True)
class Unexplained:
    """How many rows no fault explains, and (cube, s after the start) of some of them."""

    frequencies: int
    tensors: int
    statuses: int
    examples: list[tuple[int, float]]


class TortureVerification:
    """Collects rows as they come; `result` compares them with the log.

    All hubs carry the same number of cubes, in the order of the skin.
    rows, tensors: of frequencies and of stress that came
    table: (instants, cubes, pads) Hz that sound pads measure
    """

    def __init__(self, skin: Skin, instants: int) -> None:
        self._each = len(skin.cubes) // len(skin.links)
        load = Load(skin, default_script())
        cubes = SimulatedCubes([cube.calibration for cube in skin.cubes])
        table, truth = [], []
        for number in range(instants):
            stress, gradient = load.at(number * load.period / instants)
            millihertz = cubes.frequency(stress, gradient, 0.0)
            table.append((millihertz * 1e-3).astype(np.float32))
            truth.append(skin_components(skin, stress, gradient))
        self.table, self._truth = np.array(table), np.array(truth)
        self._range = np.ptp(self._truth, axis=(0, 1))
        # Instant of a hub's sample 0, as far as it is known.
        self._offset = np.zeros(len(skin.links), np.int64)
        self._instant_of: dict[int, int] = {}  # by sample (see `_sample`), of the newest ones
        self._arrivals = Arrivals(skin, one_per_hub=True)
        self._instants: list[NDArray[np.int64]] = []  # of the rows that `_arrivals` keeps
        self._deviations: list[NDArray[Any]] = []
        self.tensors = 0

    @property
    def rows(self) -> int:
        return self._arrivals.rows

    def frequencies(self, rows: FrequencyRows) -> None:
        """Rows of whole samples, in the order in which they arrived."""
        cube, sample = rows.cube.astype(np.int64), self._sample(rows)
        start = np.flatnonzero(np.diff(sample, prepend=-1))
        end = np.append(start[1:], len(rows))
        hub, sequence = cube // self._each, rows.sequence.astype(np.int64)
        instant = (sequence + self._offset[hub]) % len(self.table)
        same = self.table[instant, cube] == rows.frequency
        if not same.all():
            matching = np.add.reduceat(same.mean(axis=1), start) / (end - start)
            for number in np.flatnonzero(matching < 0.5).tolist():
                part = slice(start[number], end[number])
                found = self._find(rows.select(part))
                instant[part] = found
                same[part] = self.table[found, cube[part]] == rows.frequency[part]
                same[part] &= found != NOT_FOUND
            bad = np.flatnonzero(~same.all(axis=1))
            pads = (~same[bad]) @ (1 << np.arange(same.shape[1]))
            self._deviate(rows.select(bad), pads, np.full(len(bad), What.FREQUENCY))
        for key, found in zip(sample[start].tolist(), instant[start].tolist(), strict=True):
            # A number that is given again goes to the end: the oldest are forgotten first.
            self._instant_of.pop(key, None)
            self._instant_of[key] = found
        if len(self._instant_of) > 2 * INSTANTS_KEPT:
            self._instant_of = dict(list(self._instant_of.items())[-INSTANTS_KEPT:])
        self._arrivals.add(rows)
        self._instants.append(instant[self._arrivals.keeps(rows.cube)])

    def stress(self, rows: StressRows) -> None:
        """Rows of whole samples whose frequencies came before."""
        self.tensors += len(rows)
        values = np.concatenate([rows.stress, rows.gradient], axis=1)
        sample = self._sample(rows)
        start = np.flatnonzero(np.diff(sample, prepend=-1))
        found = [self._instant_of.get(key, NOT_FOUND) for key in sample[start].tolist()]
        instant = np.repeat(found, np.diff(start, append=len(rows)))
        near = np.abs(values - self._truth[instant, rows.cube]) <= TOLERANCE * self._range
        not_observed = rows.observed[:, None] >> np.arange(values.shape[1]) & 1 == 0
        right = (near | not_observed).all(axis=1) & (instant != NOT_FOUND)
        # A sound cube has a status of 0. Doubt of the stamp is about the hub's clock.
        bad = np.flatnonzero(~right | (rows.status & ~np.uint16(STAMP) != 0))
        what = np.where(right[bad], What.STATUS, What.TENSOR)
        what[instant[bad] == NOT_FOUND] = What.TENSOR_ALONE
        self._deviate(rows.select(bad), np.zeros(len(bad), np.int64), what)

    def result(
        self, log: SampleLog, end_ns: int, *, counted: int, published: int
    ) -> dict[str, Any]:
        """Figures of all samples taken before end_ns (wall clock); counts are in rows.

        counted: rows the driver says it did not deliver
        published: rows it says it published

        missed_by_judge are rows published that did not come here, because this process got no
        processor for longer than queues last: nothing can be said of them. lost_with_power are the
        last rows that a hub took before it lost its power or restarted, which nobody can count. All
        others must be delivered or counted.
        """
        comparison = compare(log, self._arrivals, log.start_time_ns, end_ns, counted=counted)
        last = self._lost_with_power(log, comparison, end_ns)
        missed = max(0, published - self.rows)
        missing = comparison.missing
        invented = comparison.never_taken + comparison.repeated
        misplaced = self._misplaced(log, comparison)
        unexplained = self._unexplained(log, missed > 0)
        gaps = self._reconnects(log, comparison)
        errors = self._stamp_errors(log, comparison)
        return {
            "samples_sent": comparison.sent,
            "delivered": comparison.received,
            "counted": counted,
            "missed_by_judge": missed,
            "unaccounted": max(0, missing - last - missed) + max(0, -missing),
            "lost_with_power": max(0, min(missing, last)),
            "wrong": unexplained.frequencies + invented + misplaced,
            "wrong_tensors": unexplained.tensors,
            "false_alarms": unexplained.statuses,
            "unexplained": unexplained.examples,
            "tensors": self.tensors,
            "reconnects": len(gaps),
            "worst_reconnect_s": round(max(gaps, default=0.0), 3),
            "stamp_error_p99_ms": percentile(errors, 99) if len(errors) else None,
            "stamps_judged": len(errors),
        }

    def _sample(self, rows: FrequencyRows | StressRows) -> NDArray[np.int64]:
        """(N,) hub and sequence number of each row in one number."""
        hub = rows.cube.astype(np.int64) // self._each
        return hub << 32 | rows.sequence.astype(np.int64)

    def _find(self, rows: FrequencyRows) -> int:
        """Which instant one sample is of."""
        hub, sequence = int(rows.cube[0]) // self._each, int(rows.sequence[0])
        known = (sequence + int(self._offset[hub])) % len(self.table)
        if (self.table[known, rows.cube] == rows.frequency).mean() >= 0.5:
            return known
        matching = (self.table[:, rows.cube] == rows.frequency).mean(axis=(1, 2))
        best = int(matching.argmax())
        if matching[best] < 0.5:
            return NOT_FOUND
        self._offset[hub] = best - sequence
        return best

    def _deviate(
        self, rows: FrequencyRows | StressRows, pads: NDArray[Any], what: NDArray[Any]
    ) -> None:
        deviations = np.empty(len(rows), DEVIATION)
        columns = (rows.cube, pads, rows.stamp_ns, what)
        for name, column in zip(DEVIATION.names or (), columns, strict=True):
            deviations[name] = column
        self._deviations.append(deviations)

    def _of_link(self, link: LinkLog) -> NDArray[np.bool_]:
        """(N,) which rows that arrived are of a link."""
        return np.isin(self._arrivals.columns()[0], link.members)

    def _lost_with_power(self, log: SampleLog, comparison: Comparison, end_ns: int) -> int:
        """Rows taken before end_ns that nobody can know of: those after the last one delivered
        before a restart and, where the count did not begin at 0, those before the first one."""
        rows = 0
        delivered = np.zeros(len(comparison.taken_ns), bool)
        delivered[comparison.first] = True
        for link in log.links:
            mine = self._of_link(link) & delivered
            last_boot = max(run.boot for run in link.runs)
            for boot in sorted({run.boot for run in link.runs}):
                runs = [run for run in link.runs if run.boot == boot]
                times = np.concatenate([log.times_ns(run) for run in runs])
                times = times[times < end_ns]
                arrived = comparison.taken_ns[mine & (comparison.boot == boot)]
                unknown = np.zeros(len(times), bool)
                if boot != last_boot:
                    unknown |= times > arrived.max(initial=0)
                if len(arrived) and runs[0].first > NEAR_ZERO:
                    unknown |= times < arrived.min()
                rows += len(link.members) * int(np.count_nonzero(unknown))
        return rows

    def _misplaced(self, log: SampleLog, comparison: Comparison) -> int:
        """Rows with the values of another instant than the log says."""
        if not self._instants:
            return 0
        instant, taken_ns = np.concatenate(self._instants), comparison.taken_ns
        rows = 0
        for link in log.links:
            time_us = (taken_ns - log.start_time_ns) // 1000
            expected = time_us // link.runs[0].period_us % len(self.table)
            wrong = (instant != expected) & (instant != NOT_FOUND) & (taken_ns != NEVER)
            rows += len(link.members) * int(np.count_nonzero(wrong & self._of_link(link)))
        return rows

    def _reconnects(self, log: SampleLog, comparison: Comparison) -> list[float]:
        """How long after each hub was plugged in again its first sample was taken that came, s."""
        gaps = []
        for link in log.links:
            taken_ns = comparison.taken_ns[comparison.first]
            taken_ns = taken_ns[self._of_link(link)[comparison.first]]
            for record in log.faults:
                back_ns = log.start_time_ns + 1000 * record.end_us
                after = taken_ns[taken_ns >= back_ns]
                if record.fault.link == link.name and record.fault.kind in RECONNECT_FAULTS:
                    gaps += [1e-9 * float(after.min() - back_ns)] if len(after) else []
        return gaps

    def _stamp_errors(self, log: SampleLog, comparison: Comparison) -> NDArray[np.float64]:
        """(K,) ms, of samples whose hub's clock has been undisturbed for a while."""
        seconds = 1e-9 * (comparison.taken_ns[comparison.first] - log.start_time_ns)
        settled = np.zeros(len(seconds), bool)
        for link in log.links:
            mine = self._of_link(link)[comparison.first]
            begin = seconds[mine].min(initial=np.inf)
            settled |= mine & (seconds > begin + SETTLE_S)
            for record in log.faults:
                if record.fault.link == link.name and record.fault.kind in CLOCK_FAULTS:
                    settled &= ~(mine & _during(record, seconds, SETTLE_S))
        return comparison.stamp_error_ms[settled]

    def _unexplained(self, log: SampleLog, some_missed: bool) -> Unexplained:
        """What no fault explains."""
        deviations = np.concatenate([np.empty(0, DEVIATION), *self._deviations])
        if some_missed:
            # Then nobody can say whether these tensors are of rows that never were.
            deviations = deviations[deviations["what"] != What.TENSOR_ALONE]
        pads = deviations["pads"].copy()
        explained = np.zeros(len(deviations), bool)
        seconds = (deviations["stamp_ns"] - log.start_time_ns) * 1e-9
        cubes = {link.name: link.members for link in log.links}
        for record in log.faults:
            fault = record.fault
            if fault.kind == "temperature":
                mine = np.isin(deviations["cube"], cubes[fault.link])
                until = _next_temperature_s(record, log.faults) + HOLD_S
                explained |= (
                    mine & (seconds >= 1e-6 * record.start_us - BEFORE_S) & (seconds <= until)
                )
            elif fault.kind in PAD_FAULTS:
                mine = deviations["cube"] == cubes[fault.link][fault.cube]
                near = mine & _during(record, seconds, HOLD_S)
                pads[near] &= ~(1 << fault.pad)
                explained |= near & (pads == 0)
        left, times = deviations[~explained], seconds[~explained]
        count = np.bincount(left["what"], minlength=len(What)).tolist()
        some = slice(None, None, max(1, len(left) // 8))
        examples = zip(left["cube"][some].tolist(), times[some].round(3).tolist(), strict=True)
        return Unexplained(
            frequencies=count[What.FREQUENCY],
            tensors=count[What.TENSOR] + count[What.TENSOR_ALONE],
            statuses=count[What.STATUS],
            examples=list(examples)[:8],
        )


def _during(record: FaultRecord, seconds: NDArray[Any], after_s: float) -> NDArray[np.bool_]:
    """Whether times (s) are within a fault, or at most so long after it."""
    begin, end = 1e-6 * record.start_us, 1e-6 * record.end_us
    return (seconds >= begin - BEFORE_S) & (seconds <= end + after_s)


def _next_temperature_s(record: FaultRecord, records: tuple[FaultRecord, ...]) -> float:
    """When the next temperature of the link came, which may be back to 0; inf if none did."""
    later = [
        1e-6 * other.start_us
        for other in records
        if other.fault.kind == "temperature"
        and other.fault.link == record.fault.link
        and other.start_us > record.start_us
    ]
    return min(later, default=np.inf)
