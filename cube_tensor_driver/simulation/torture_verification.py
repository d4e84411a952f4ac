"""Judges a tortured skin: every row that came against what the hubs measure and the book of what
was done to them.

Simulated hubs go round a table of instants, one a sample; where in it a hub stands is found from
the values themselves and later checked against the book. What differs from the table must be
explained by a fault in the book.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config.skin import Skin
from ..core.rows import StressRows
from .cubes import SimulatedCubes, true_components
from .faults import PAD
from .load import Load, default_script

TOLERANCE = 1e-3
"""Of a component's range: float32 leaves 1e-6, a wrong sample 1e-1."""
SETTLE_S = 10.0
"""After a restart or a jump of a hub's clock, until its stamps are judged."""
HOLD_S = 6.0
"""How long a pad that works again may still be left out: 2 s of rows, and its link may be cut for 2
s meanwhile."""
INDEX_KEPT = 40_000
"""Samples remembered until their tensors come: 20 s of 4 hubs at 500 Hz, more than queues hold."""
CLOCK = ("reset", "wrap", "unplug", "rename", "step", "drift")
CUT = ("unplug", "rename")
UNKNOWN = 3
"""Kind of an odd tensor whose frequencies did not come."""


class TortureVerification:
    """Takes rows as they come; `close` compares with the book. All hubs carry the same number of
    cubes, in order."""

    def __init__(self, skin: Skin, instants: int) -> None:
        n, hubs = len(skin.cubes), len(skin.links)
        self._hubs, self._each = hubs, n // hubs
        load = Load(skin, default_script())
        cubes = SimulatedCubes([cube.calibration for cube in skin.cubes])
        table, truth = [], []
        for number in range(instants):
            stress, gradient = load.at(number * load.period / instants)
            millihertz = cubes.frequency(stress, gradient, 0.0)
            table.append((millihertz * 1e-3).astype(np.float32))
            truth.append(true_components(skin.cubes[0].calibration, stress, gradient))
        self._table, self._truth = np.array(table), np.array(truth)
        self._span = np.ptp(self._truth, axis=(0, 1))
        self._offset = np.zeros(hubs, np.int64)
        self._index: dict[
            int, int
        ] = {}  # of the last samples: hub << 32 | sequence -> index in the table
        self._samples: list[
            NDArray[np.int64]
        ] = []  # (k, 4): hub, sequence, stamp, index in the table or -1
        self._odd: list[
            NDArray[np.int64]
        ] = []  # (k, 4): cube, bits of the pads that differ, stamp, kind
        self.rows = self.tensors = 0

    def frequencies(
        self,
        cube: NDArray[Any],
        sequence: NDArray[Any],
        stamp_ns: NDArray[Any],
        frequency: NDArray[np.float32],
    ) -> None:
        """Rows of one frequencies message."""
        self.rows += len(cube)
        hub, number = cube.astype(int) // self._each, sequence.astype(np.int64)
        index = (number + self._offset[hub]) % len(self._table)
        same = self._table[index, cube] == frequency
        first = np.flatnonzero(np.diff(hub << 32 | number, prepend=-1))
        if not same.all():
            share = np.add.reduceat(same.mean(axis=1), first) / np.diff(first, append=len(cube))
            ends = np.append(first[1:], len(cube))
            for start, end in np.stack([first, ends], axis=1)[share < 0.5].tolist():
                part = slice(start, end)
                index[part] = self._find(
                    int(hub[start]), int(number[start]), cube[part], frequency[part]
                )
                same[part] = (index[part] >= 0)[:, None] & (
                    self._table[index[part], cube[part]] == frequency[part]
                )
            bad = np.flatnonzero(~same.all(axis=1))
            bits = (~same[bad]) @ (1 << np.arange(same.shape[1]))
            self._odd.append(
                np.stack([cube[bad], bits, stamp_ns[bad], np.zeros(len(bad), int)], axis=1)
            )
        keys = hub[first] << 32 | number[first]
        for key, place in zip(keys.tolist(), index[first].tolist(), strict=True):
            self._index.pop(
                key, None
            )  # a number given again counts as new, else it were forgotten with the old
            self._index[key] = place
        if len(self._index) > 2 * INDEX_KEPT:
            self._index = dict(list(self._index.items())[-INDEX_KEPT:])
        self._samples.append(
            np.stack([hub[first], number[first], stamp_ns[first], index[first]], axis=1)
        )

    def stress(
        self, cube: NDArray[Any], sequence: NDArray[Any], stamp_ns: NDArray[Any], rows: StressRows
    ) -> None:
        """Rows of one stress message; give it some time after its frequencies."""
        self.tensors += len(cube)
        values = np.concatenate([rows.stress, rows.gradient], axis=1)
        hub, number = cube.astype(int) // self._each, sequence.astype(np.int64)
        key = hub << 32 | number
        first = np.flatnonzero(np.diff(key, prepend=-1))
        found = np.array([self._index.get(each, -1) for each in key[first].tolist()])
        index = np.repeat(found, np.diff(first, append=len(key)))
        want = self._truth[index, cube]
        near = np.abs(values - want) <= TOLERANCE * self._span
        right = (near | (rows.observed[:, None] >> np.arange(15) & 1 == 0)).all(axis=1) & (
            index >= 0
        )
        # A healthy cube tells all its components and has no status.
        bad = np.flatnonzero(~right | (rows.status != 0))
        if len(bad):
            kind = np.where(index[bad] < 0, UNKNOWN, 1 + right[bad])
            self._odd.append(
                np.stack([cube[bad], np.zeros(len(bad), int), stamp_ns[bad], kind], axis=1)
            )

    def _find(
        self, hub: int, number: int, cube: NDArray[Any], frequency: NDArray[np.float32]
    ) -> int:
        """Where in the table a hub stands now, -1 if nowhere."""
        known = (number + int(self._offset[hub])) % len(self._table)
        if (self._table[known, cube] == frequency).mean() >= 0.5:  # found for a sample before
            return known
        share = (self._table[:, cube] == frequency).mean(axis=(1, 2))
        best = int(share.argmax())
        if share[best] < 0.5:
            return -1
        self._offset[hub] = best - number
        return best

    def close(
        self, book: dict[str, Any], end_ns: int, counted: int, published: int
    ) -> dict[str, Any]:
        """Figures of all samples taken before end_ns (wall clock).

        counted: rows the driver says it did not deliver; published: rows it says it did. Counts are
        in rows (one cube, one sample). missed_by_judge: rows published that did not come here,
        because whoever calls got no processor for
        longer than queues last: of these nothing can be said. lost_with_power: rows a hub took last
        before it lost its power or restarted, which nobody can count; all others must be delivered
        or counted.
        """
        start_ns = book["start_time_ns"]
        samples = np.concatenate(self._samples) if self._samples else np.empty((0, 4), np.int64)
        odd = np.concatenate(self._odd) if self._odd else np.empty((0, 4), np.int64)
        missed = max(0, published - self.rows)
        if missed:  # tensors of rows that did not come cannot be judged; else they are of rows that never were
            odd = odd[odd[:, 3] != UNKNOWN]
        faults = book["faults"]
        sent = delivered = last = invented = misplaced = 0
        errors: list[NDArray[np.float64]] = []
        gaps: list[float] = []
        for hub, (name, link) in enumerate(book["links"].items()):
            mine = samples[samples[:, 0] == hub]
            true_ns, boot = _true_times(mine, link["runs"], start_ns)
            in_time = (true_ns >= 0) & (true_ns < end_ns)
            invented += int(np.count_nonzero(true_ns < 0))
            once = len(np.unique(true_ns[in_time]))
            delivered += once
            invented += int(np.count_nonzero(in_time)) - once
            placed = mine[:, 3] >= 0
            period_us = link["runs"][0]["period_us"]
            misplaced += int(
                np.count_nonzero(
                    placed
                    & (true_ns >= 0)
                    & (((true_ns - start_ns) // 1000 // period_us) % len(self._table) != mine[:, 3])
                )
            )
            taken, tail = _taken(link["runs"], start_ns, end_ns, true_ns[in_time], boot[in_time])
            sent, last = sent + taken, last + tail
            sane = in_time.copy()
            for begin_us, end_us, where, fault in faults:
                if where != name:
                    continue
                if fault["kind"] in CLOCK:
                    since = (true_ns - start_ns) * 1e-9
                    sane &= ~((since >= begin_us * 1e-6 - 0.1) & (since < end_us * 1e-6 + SETTLE_S))
                after = true_ns[in_time & (true_ns >= start_ns + 1000 * end_us)]
                if fault["kind"] in CUT and len(after):
                    gaps.append(float(after.min() - start_ns) * 1e-9 - end_us * 1e-6)
            sane &= true_ns - start_ns > SETTLE_S * 1e9 + (
                true_ns[in_time].min(initial=end_ns) - start_ns
            )
            errors.append(np.abs(mine[sane, 2] - true_ns[sane]) * 1e-6)
        unexplained = self._unexplained(odd, faults, start_ns)
        error = np.concatenate(errors) if errors else np.empty(0)
        left = sent * self._each - delivered * self._each - counted
        return {
            "samples_sent": sent * self._each,
            "delivered": delivered * self._each,
            "counted": counted,
            "missed_by_judge": missed,
            "unaccounted": max(0, left - last * self._each - missed) + max(0, -left),
            "lost_with_power": max(0, min(left, last * self._each)),
            "wrong": unexplained[0] + (invented + misplaced) * self._each,
            "wrong_tensors": unexplained[1],
            "false_alarms": unexplained[2],
            "unexplained": unexplained[3],
            "tensors": self.tensors,
            "reconnects": len(gaps),
            "worst_reconnect_s": round(max(gaps, default=0.0), 3),
            "stamp_error_p99_ms": round(float(np.percentile(error, 99)), 3) if len(error) else None,
            "stamps_judged": len(error),
        }

    def _unexplained(
        self, odd: NDArray[np.int64], faults: list[Any], start_ns: int
    ) -> tuple[int, int, int, list[Any]]:
        """How many odd rows no fault explains: of frequencies, of tensors, of status alone; and
        cube and s of some."""
        open_bits = odd[:, 1].copy()
        explained = np.zeros(len(odd), bool)
        seconds = (odd[:, 2] - start_ns) * 1e-9
        for begin_us, end_us, where, fault in faults:
            hub = int(where.removeprefix("hub"))
            begin, end = begin_us * 1e-6 - 0.1, end_us * 1e-6 + HOLD_S
            if fault["kind"] == "temperature":
                # It lasts until the next one of its link, which may be back to 0.
                later = [
                    b * 1e-6
                    for b, _, w, f in faults
                    if w == where and f["kind"] == "temperature" and b > begin_us
                ]
                end = min(later, default=np.inf) + HOLD_S
                explained |= (
                    (odd[:, 0] // self._each == hub) & (seconds >= begin) & (seconds <= end)
                )
            elif fault["kind"] in PAD:
                near = (
                    (odd[:, 0] == hub * self._each + fault["cube"])
                    & (seconds >= begin)
                    & (seconds <= end)
                )
                open_bits[near] &= ~(1 << fault["pad"])
                explained |= near & (open_bits == 0)
        left = np.flatnonzero(~explained)
        kinds = ((0,), (1, UNKNOWN), (2,))
        frequency, tensor, status = (int(np.isin(odd[left, 3], kind).sum()) for kind in kinds)
        some = [
            (int(odd[row, 0]), round(float(seconds[row]), 3))
            for row in left[:: max(1, len(left) // 8)][:8]
        ]
        return frequency, tensor, status, some


def _true_times(
    samples: NDArray[np.int64], runs: list[dict[str, int]], start_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """When samples (k, 4) were taken, wall clock ns, and the hub's boot; -1 of what was never
    taken.

    A number may have been given again after a restart: the run nearest to the stamp is meant.
    """
    best = np.full(len(samples), -1, np.int64)
    boot = np.full(len(samples), -1, np.int64)
    for run in runs:
        ahead = (samples[:, 1] - run["first"]) % 2**32
        time_ns = start_ns + 1000 * (run["start_us"] + ahead * run["period_us"])
        there = ahead <= run["last"] - run["first"]
        nearer = there & (
            (best < 0) | (np.abs(time_ns - samples[:, 2]) < np.abs(best - samples[:, 2]))
        )
        best[nearer], boot[nearer] = time_ns[nearer], run["boot"]
    return best, boot


def _taken(
    runs: list[dict[str, int]],
    start_ns: int,
    end_ns: int,
    true_ns: NDArray[np.int64],
    boot: NDArray[np.int64],
) -> tuple[int, int]:
    """Samples taken before end_ns, and how many of them nobody can know of.

    Those are the ones after the last delivered of each boot but the last, and, where the count did
    not begin at 0, before the first.
    """
    taken = unknown = 0
    last_boot = max(run["boot"] for run in runs)
    for number in sorted({run["boot"] for run in runs}):
        parts = [run for run in runs if run["boot"] == number]
        times = np.concatenate(
            [
                start_ns
                + 1000
                * (run["start_us"] + np.arange(run["last"] - run["first"] + 1) * run["period_us"])
                for run in parts
            ]
        )
        times = times[times < end_ns]
        taken += len(times)
        mine = true_ns[boot == number]
        if not len(mine):
            unknown += len(times) if number != last_boot else 0
            continue
        if number != last_boot:
            unknown += int(np.count_nonzero(times > mine.max()))
        if parts[0]["first"] > 2**20:
            unknown += int(np.count_nonzero(times < mine.min()))
    return taken, unknown
