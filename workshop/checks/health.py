# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Check of the health of pads: flags of the reconstruction against the faults that pads had.

Each fault must be flagged on its pad within its stated time, with its own bit, and no other pad may
be flagged. An impossible reading is flagged in the same row. What needs statistics is flagged
within two of their windows.
"""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.core.arrays import Array, Index, Mask
from cube_tensor_driver.core.health.statistics import WINDOW_S
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.core.status import DRIFT, NOISY, OPEN, RANGE, REPORTED, SHORT, STUCK
from cube_tensor_driver.simulation.cubes import compute_frequency_noise
from cube_tensor_driver.simulation.faults import PAD_FAULTS

from .record import CUT_FAULTS, DRIVER_KILLS, NODE_STARTS, NS_PER_S, HubFault, Span
from .run import Findings, Run, count, find_matched

EDGE_NS = 5_000_000
"""Time, in nanoseconds, around the start and around the end of a fault of a pad. A sample within it
may have the fault or not, because the simulator sometimes carries faults out late."""

STATUS_OF_FAULT = {
    "open": OPEN,
    "short": SHORT,
    "stuck": STUCK,
    "noisy": NOISY,
    "report": REPORTED,
}
"""Status bit of the reconstruction that names each kind of fault of a pad."""

PERMITTED_STATUS = NOISY | RANGE | DRIFT
"""Status bits that any broken pad may cause as well, because its reading jumps when its fault
begins and ends."""

IMMEDIATE_FAULTS = ("open", "short", "report")
"""Kinds of faults of a pad that a single row (one sampling time) shows, without statistics."""

DETECTION_NS = round(NS_PER_S * (2 * WINDOW_S + 0.1))
"""Longest time, in nanoseconds, from the start of a fault until it must be flagged, if finding it
needs statistics.

The time is two windows of the statistics (0.5 s each), and the scan that ends the second one.
"""

RELEASE_S = 6.0
"""Longest time, in seconds, for which a pad that works again may still be left out.

The reconstruction waits for 2 s of rows, and the link may be cut for 2 s meanwhile.
"""

MIN_COMPLETENESS = 0.9
"""Share of the rows of a cube that must have arrived for its fault to be detectable."""

MIN_MOVEMENT = 10.0
"""Smallest movement of the cube's other pads in each window, as a multiple of their noise, for a
stuck pad to be detectable. The diagnosis needs half of it."""

DISTURBANCE_S = 1.0
"""Time, in seconds, before and after a cut of a link in which rows come late and end a window of
the statistics early."""

RESTART_S = 2.0
"""Time, in seconds, before and after a start of a node in which its statistics are not complete."""

NOMINAL_PERIOD_S = 1.5
"""Time, in seconds, before and after the start of a fault. The longest sampling period of the hubs
within it gives the number of rows that are expected."""

WINDOW_STEP_NS = 100_000_000
"""Time, in nanoseconds, between the starts of two windows in which movement of pads is looked
for."""

EXAMPLES = 4
"""Maximum number of false alarms that are described as examples."""


def check_health(run: Run, sample: Index) -> Findings:
    """Check the flags of all rows of stress.

    The figures are: `faults_to_flag`, faults that had to be flagged; `unflagged`, rows of them that
    were not; `false_alarms`, rows that flag a pad or name a condition without a fault.

    Args:
        run: The torture.
        sample: Index of the sample of each row of stress (M,), or `NO_MATCH`.
    """
    known = find_matched(sample)
    rows = run.record.stress.rows.select(known)
    time_ns = run.samples.time_ns[sample[known]]
    permitted_pads = np.zeros(len(rows), np.uint32)
    permitted_status = np.zeros(len(rows), np.uint16)
    evidence = _Evidence(run)
    examples, n_faults, n_unflagged = [], 0, 0

    for fault in run.samples.select_faults(*PAD_FAULTS):
        pad = fault.fault.pad
        bit = STATUS_OF_FAULT[fault.kind]
        mine = np.flatnonzero(rows.cube == fault.cube)
        permitted = evidence.find_flagged_span(fault)
        may_be_flagged = mine[permitted.contains(time_ns[mine])]
        permitted_pads[may_be_flagged] |= np.uint32(1 << pad)
        permitted_status[may_be_flagged] |= np.uint16(bit | PERMITTED_STATUS)

        delay_ns = EDGE_NS if fault.kind in IMMEDIATE_FAULTS else DETECTION_NS
        required = Span(fault.begin_ns + delay_ns, fault.end_ns - EDGE_NS)
        must_be_flagged = mine[required.contains(time_ns[mine])]
        # A short fault may be over before it must be flagged.
        if not len(must_be_flagged) or not evidence.suffices(fault):
            continue
        is_flagged = _is_flagged(rows.select(must_be_flagged), pad, bit)
        unflagged = must_be_flagged[~is_flagged]
        n_faults += 1
        n_unflagged += len(unflagged)
        if len(unflagged):
            what = f"not flagged: {fault.kind}, cube {fault.cube} pad {pad}, {len(unflagged)} rows"
            examples.append(run.describe(what, time_ns[unflagged[0]]))

    conditions = np.uint16(sum(STATUS_OF_FAULT.values()) | RANGE | DRIFT)
    is_false = rows.left_out & ~permitted_pads != 0
    is_false |= rows.status & conditions & ~permitted_status != 0
    for row in np.flatnonzero(is_false)[:EXAMPLES]:
        flags = f"left out {rows.left_out[row]:#x}, status {rows.status[row]:#x}"
        examples.append(run.describe(f"false alarm: cube {rows.cube[row]}, {flags}", time_ns[row]))
    figures = {
        "faults_to_flag": n_faults,
        "unflagged": n_unflagged,
        "false_alarms": count(is_false),
    }
    return Findings(figures, examples)


def _is_flagged(
    rows: StressRows,
    pad: int,
    bit: int,
) -> Mask:
    """Find the rows (N,) that leave a pad out and have the status bit of its condition."""
    is_left_out = rows.left_out >> np.uint32(pad) & 1 == 1
    return is_left_out & (rows.status & bit != 0)


class _Evidence:
    """Decides whether enough rows arrived to detect a pad's fault, and when it may be flagged."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._noise: list[Array] = []  # Standard deviation of each pad's frequency, in Hz.
        for calibration in run.record.skin.calibrations:
            self._noise.append(calibration.rest_frequency * compute_frequency_noise(calibration))

    def find_flagged_span(self, fault: HubFault) -> Span:
        """Return the span of time in which the pad of a fault may be flagged."""
        end_ns = fault.end_ns + round(NS_PER_S * RELEASE_S)
        for action in self._run.record.select_actions(*DRIVER_KILLS):
            # No rows arrive while there is no driver, so the pad is released later.
            if fault.begin_ns < action.end_ns and action.begin_ns < end_ns:
                end_ns += action.end_ns - action.begin_ns
        return Span(fault.begin_ns - EDGE_NS, end_ns)

    def suffices(self, fault: HubFault) -> bool:
        """Return whether a fault is detectable.

        Faults that show in the row itself always are. Others need all rows of two windows that
        nothing disturbs, and a stuck pad needs other pads that move.
        """
        if fault.kind in IMMEDIATE_FAULTS:
            return True
        span = Span(fault.begin_ns, fault.begin_ns + DETECTION_NS)
        if self._is_disturbed(span):
            return False
        if not self._is_complete(fault.cube, span):
            return False
        return fault.kind != "stuck" or self._moves(fault, span)

    def _is_disturbed(self, span: Span) -> bool:
        """Return whether the statistics of the pads were disturbed in a span of time: by a cut of
        any link, or by the start of a node."""
        cuts = self._run.samples.select_faults(*CUT_FAULTS)
        starts = self._run.record.select_actions(*NODE_STARTS)
        is_cut = any(cut.overlaps(span, DISTURBANCE_S) for cut in cuts)
        return is_cut or any(start.overlaps(span, RESTART_S) for start in starts)

    def _is_complete(self, cube: int, span: Span) -> bool:
        """Return whether nearly all rows of a cube arrived in a span of time."""
        samples = self._run.samples
        rows = self._run.record.stress.rows
        has_arrived = (rows.cube == cube) & span.contains(rows.stamp_ns)
        begin = Span(span.begin_ns, span.begin_ns)
        is_near = begin.contains(
            samples.time_ns,
            NOMINAL_PERIOD_S,
            NOMINAL_PERIOD_S,
        )
        # If the rate changes in this time, the longest period gives the smallest number of rows.
        period_us = int(samples.period_us[is_near].max(initial=1))
        expected = (span.end_ns - span.begin_ns) / (1000 * period_us)
        return count(has_arrived) >= MIN_COMPLETENESS * expected

    def _moves(self, fault: HubFault, span: Span) -> bool:
        """Return whether half of the pads of the faulty pad's cube move in every window of a
        span."""
        samples = self._run.samples
        is_chosen = (samples.link == fault.link) & span.contains(samples.time_ns)
        chosen = np.flatnonzero(is_chosen)
        cubes = np.full(len(chosen), fault.cube)
        readings = self._run.sent.select(cubes, chosen)
        window_ns = round(NS_PER_S * WINDOW_S)
        for begin_ns in range(span.begin_ns, span.end_ns - window_ns, WINDOW_STEP_NS):
            window = Span(begin_ns, begin_ns + window_ns)
            is_within = window.contains(samples.time_ns[chosen])
            frequency = readings.frequency[is_within]
            if not len(frequency):
                return False
            # At least half of the pads move as much as the lower median, or more.
            movement = np.ptp(frequency, axis=0) / self._noise[fault.cube]
            movement.sort()
            if movement[(len(movement) - 1) // 2] < MIN_MOVEMENT:
                return False
        return True
