"""Compares what the reconstruction says of pads with the faults that they had.

Each fault must be flagged on its pad within its stated time, with its own bit, and no other pad may
be flagged. An impossible reading is flagged in the same row; what needs statistics, within two of
their windows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cube_tensor_driver.core.health.statistics import WINDOW_S
from cube_tensor_driver.core.oscillator import stress_slope
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.core.status import DRIFT, NOISY, OPEN, RANGE, REPORTED, SHORT, STUCK
from cube_tensor_driver.simulation.faults import CUT_FAULTS, PAD_FAULTS
from cube_tensor_driver.simulation.sample_log import FaultRecord

from .expected import EDGE_US, Expected
from .record import DOWN, NEW_DRIVER, Record
from .samples import NONE, Samples

BIT = {"open": OPEN, "short": SHORT, "stuck": STUCK, "noisy": NOISY, "report": REPORTED}
"""What each fault of a pad is called in the status."""
ALSO = NOISY | RANGE | DRIFT
"""What a broken pad may be called as well: it jumps when its fault begins and ends."""
AT_ONCE = ("open", "short", "report")
WITHIN_S = 2 * WINDOW_S + 0.1
"""Two windows, and the scan that shows that the second one is over."""
HOLD_S = 6.0
"""How long a pad that works again may still be left out: 2 s of rows, and its link may be cut for 2
s meanwhile. No rows come while there is no driver."""
COMPLETE = 0.9
"""Of the rows of a cube must have come, or nobody could have found the fault."""
MOVED = 10.0
"""Times its noise that the cube's pads must have moved in each window for a stuck pad to show:
twice what the diagnosis needs."""


@dataclass(frozen=True)
class HealthVerdict:
    """faults: of pads that had to be flagged; unflagged: rows of them that were not;
    false_alarms: rows that flag a pad, or name a condition, without a fault."""

    faults: int
    unflagged: int
    false_alarms: int
    examples: tuple[str, ...]


def judge_verdicts(
    record: Record,
    samples: Samples,
    expected: Expected,
    sample: NDArray[np.int64],
    start_time_ns: int,
) -> HealthVerdict:
    """Judge all rows of stress. sample: (M,) which sample each of them is of, NONE for unknown."""
    rows = record.stress.rows
    known = np.flatnonzero(sample != NONE)
    rows, sample = rows.select(known), sample[known]
    time_us = samples.time_us[sample]
    allowed_pads = np.zeros(len(rows), np.uint32)
    allowed_status = np.zeros(len(rows), np.uint16)
    evidence = _Evidence(record, samples, expected, start_time_ns)
    examples, required, unflagged = [], 0, 0
    for _, fault in expected.records(*PAD_FAULTS):
        cube, kind, bit = expected.cube_of(fault), fault.fault.kind, BIT[fault.fault.kind]
        mine = np.flatnonzero(rows.cube == cube)
        mine_us = time_us[mine]
        near = (mine_us >= fault.start_us - EDGE_US) & (mine_us <= evidence.held_until_us(fault))
        allowed_pads[mine[near]] |= np.uint32(1 << fault.fault.pad)
        allowed_status[mine[near]] |= np.uint16(bit | ALSO)
        since_us = fault.start_us + (EDGE_US if kind in AT_ONCE else round(1e6 * WITHIN_S))
        must = mine[(mine_us >= since_us) & (mine_us < fault.end_us - EDGE_US)]
        if not len(must) or not evidence.suffices(fault, cube):
            continue
        flagged = _flags(rows, must, fault.fault.pad, bit)
        required += 1
        unflagged += int(np.count_nonzero(~flagged))
        if not flagged.all():
            first = time_us[must[~flagged]][0] * 1e-6
            examples.append(
                f"not flagged: {kind}, cube {cube} pad {fault.fault.pad}, {first:.3f} s, "
                f"{np.count_nonzero(~flagged)} of {len(must)} rows"
            )
    of_pads = rows.status & np.uint16(sum(BIT.values()) | RANGE | DRIFT)
    false = (rows.left_out & ~allowed_pads != 0) | (of_pads & ~allowed_status != 0)
    examples += [
        f"false alarm: cube {rows.cube[row]}, {time_us[row] * 1e-6:.3f} s, "
        f"left out {rows.left_out[row]:#x}, status {rows.status[row]:#x}"
        for row in np.flatnonzero(false)[:4]
    ]
    return HealthVerdict(required, unflagged, int(np.count_nonzero(false)), tuple(examples[:8]))


def _flags(rows: StressRows, chosen: NDArray[np.int64], pad: int, bit: int) -> NDArray[np.bool_]:
    """Whether rows leave the pad out and name its condition."""
    left_out = rows.left_out[chosen] >> np.uint32(pad) & 1 == 1
    named: NDArray[np.bool_] = rows.status[chosen] & bit != 0
    return left_out & named


class _Evidence:
    """Says whether enough came of a cube for its fault to be found, and for its end."""

    def __init__(
        self, record: Record, samples: Samples, expected: Expected, start_time_ns: int
    ) -> None:
        self._record, self._samples, self._expected = record, samples, expected
        self._start_time_ns = start_time_ns
        calibrations = [cube.calibration for cube in record.skin.cubes]
        self._noise = [
            calibration.noise
            / stress_slope(
                calibration.rest_frequency,
                calibration.rest_frequency,
                calibration.beta,
                calibration.modulus,
            )
            for calibration in calibrations
        ]

    def held_until_us(self, fault: FaultRecord) -> float:
        """Until when the pad may be left out."""
        until_us = fault.end_us + 1e6 * HOLD_S
        for deed in self._record.deeds:
            begin_us, end_us = (
                1e-3 * (time_ns - self._start_time_ns) for time_ns in (deed.begin_ns, deed.end_ns)
            )
            if deed.kind in NEW_DRIVER and fault.start_us < end_us and begin_us < until_us:
                until_us += end_us - begin_us
        return until_us

    def suffices(self, fault: FaultRecord, cube: int) -> bool:
        """Faults that show in the row itself need nothing. Others need all rows of two windows,
        windows that nothing disturbs, and for a stuck pad others that move."""
        if fault.fault.kind in AT_ONCE:
            return True
        begin_us, end_us = fault.start_us, fault.start_us + round(1e6 * WITHIN_S)
        if self._is_disturbed(begin_us, end_us) or not self._is_complete(cube, begin_us, end_us):
            return False
        return fault.fault.kind != "stuck" or self._moves(cube, begin_us, end_us)

    def _is_disturbed(self, begin_us: int, end_us: int) -> bool:
        """Whether statistics began anew: rows that come late, after a cut of any link, end a
        window; a node that starts has none."""
        margin_us = 1_000_000
        cuts = self._expected.records(*CUT_FAULTS)
        if any(
            cut.start_us - margin_us < end_us and cut.end_us + margin_us > begin_us
            for _, cut in cuts
        ):
            return True
        begin_ns, end_ns = (self._start_time_ns + 1000 * time for time in (begin_us, end_us))
        return any(
            deed.begin_ns - 2e9 < end_ns and deed.end_ns + 2e9 > begin_ns
            for deed in self._record.deeds
            if deed.kind in (*DOWN, *NEW_DRIVER)
        )

    def _is_complete(self, cube: int, begin_us: int, end_us: int) -> bool:
        rows = self._record.stress.rows
        begin_ns, end_ns = (self._start_time_ns + 1000 * time for time in (begin_us, end_us))
        came = (rows.cube == cube) & (rows.stamp_ns >= begin_ns) & (rows.stamp_ns < end_ns)
        period_us = self._period_us(begin_us)
        return int(np.count_nonzero(came)) >= COMPLETE * (end_us - begin_us) / period_us

    def _moves(self, cube: int, begin_us: int, end_us: int) -> bool:
        link = self._expected.link_of(cube)
        samples = self._samples
        chosen = np.flatnonzero(
            (samples.link == link) & (samples.time_us >= begin_us) & (samples.time_us < end_us)
        )
        readings = self._expected.of(np.full(len(chosen), cube), chosen)
        time_us = samples.time_us[chosen]
        for window_us in range(begin_us, end_us - round(1e6 * WINDOW_S), 100_000):
            within = (time_us >= window_us) & (time_us < window_us + 1e6 * WINDOW_S)
            if not within.any():
                return False
            frequency = readings.frequency[within]
            span = (frequency.max(axis=0) - frequency.min(axis=0)) / self._noise[cube]
            if np.sort(span)[(len(span) - 1) // 2] < MOVED:
                return False
        return True

    def _period_us(self, time_us: int) -> int:
        """The longest period of any hub near a time."""
        near = np.abs(self._samples.time_us - time_us) < 1_500_000
        return int(self._samples.period_us[near].max(initial=1))
