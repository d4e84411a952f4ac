# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of time: stamps, sampling periods, and how fast the driver connects again."""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.matching import NO_MATCH
from cube_tensor_driver.core.status import STAMP

from .frequencies import RECOVERY_S, FrequencyFindings
from .record import CUT_FAULTS, DRIVER_KILLS, DRIVER_STOPS, LATEST_NS, NS_PER_S, Span
from .run import Run

MS_PER_NS = 1e-6
"""Factor from ns to ms."""

CLOCK_FAULTS = ("reset", "wrap", "unplug", "rename", "drift")
"""Kinds of faults after which the driver fits the clock of the hub from the start."""

BEFORE_FAULT_S = 0.1
"""Time, in seconds, before a fault of a hub's clock in which the stamps of samples may already be
affected."""

CLOCK_SETTLE_S = 6.0
"""Time, in seconds, after a restart of a hub or of the driver and after the first row (one cube at
one sampling time) of a link from which stamps are checked, because the rate of the hub's clock is
known then."""

RATE_CHANGE_S = 1.0
"""Longest time, in seconds, from a request until each hub whose link is not cut must sample at the
new rate."""

BEFORE_CUT_S = 1.0
"""Time, in seconds, before a cut of a link in which the hub may not have received a request."""


def measure_stamp_errors(run: Run) -> Array:
    """Compute the difference of stamp and sampling time (K,), in ms.

    The driver finds the offset of a hub's clock from requests (TIME) and their answers. Its error
    is half the difference of the smallest delays in both directions, however late single samples
    arrive. Only samples are used whose hub's clock has been undisturbed for `CLOCK_SETTLE_S`, and
    whose stamps the driver does not mark as doubtful.
    """
    record, samples = run.record, run.samples
    settled = ~samples.is_near_fault(CLOCK_FAULTS, BEFORE_FAULT_S, CLOCK_SETTLE_S)
    settled &= ~record.is_during(DRIVER_KILLS, samples.time_ns, after_s=CLOCK_SETTLE_S)

    # All cubes of a hub have the same stamp, so one of each is enough.
    rows = record.frequencies.rows
    first_cubes = [link.members[0] for link in samples.log.links]
    is_certain = rows.status & np.uint16(STAMP) == 0
    is_first = np.isin(rows.cube, first_cubes)
    chosen = np.flatnonzero(is_first & is_certain)
    chosen = chosen[run.sample[chosen] != NO_MATCH]
    # On a busy machine, the first row of a link comes seconds after the start of the driver.
    link = samples.link[run.sample[chosen]]
    first_ns = np.full(len(first_cubes), LATEST_NS)
    np.minimum.at(first_ns, link, record.frequencies.sent_ns[chosen])
    settled_rows = settled[run.sample[chosen]]
    taken_ns = samples.time_ns[run.sample[chosen]]
    settled_rows &= taken_ns - first_ns[link] > NS_PER_S * CLOCK_SETTLE_S
    chosen, taken_ns = chosen[settled_rows], taken_ns[settled_rows]
    return (rows.stamp_ns[chosen] - taken_ns) * MS_PER_NS


def measure_reconnects(run: Run, frequencies: FrequencyFindings) -> list[float]:
    """Compute the time, in seconds, from the end of each unplugging to the first sample after it
    that arrived."""
    samples = run.samples
    # A sample has arrived if at least one of its rows has.
    arrived = frequencies.missing < samples.row_count
    arrived &= samples.time_ns < run.record.end_ns
    gaps_s = []
    for fault in samples.select_faults("unplug", "rename"):
        is_after = samples.time_ns >= fault.end_ns
        is_of_link = samples.link == fault.link
        times_ns = samples.time_ns[arrived & is_after & is_of_link]
        if len(times_ns):
            gap_ns = times_ns.min() - fault.end_ns
            gaps_s.append(float(gap_ns) / NS_PER_S)
    return gaps_s


def count_wrong_periods(run: Run) -> int:
    """Count the hubs that did not sample at the rate that was asked for, over all changes."""
    record, samples = run.record, run.samples
    disturbing = record.select_actions("rate", *DRIVER_STOPS)
    disturbances = [action.begin_ns for action in disturbing]
    disturbances.append(record.end_ns)
    cuts = samples.select_faults(*CUT_FAULTS)
    wrong = 0
    for action in record.select_actions("rate"):
        settled = Span(action.end_ns, action.end_ns + round(NS_PER_S * RATE_CHANGE_S))
        # A later change within this time would have changed the period again.
        is_disturbed = settled.contains(np.array(disturbances)).any()
        if not action.succeeded or is_disturbed:
            continue
        wanted_us = round(1e6 / float(action.answer))
        time_us = (settled.end_ns - samples.log.start_time_ns) // 1000
        for link, log in enumerate(samples.log.links):
            is_cut = any(
                cut.link == link and cut.contains(settled.end_ns, BEFORE_CUT_S, RECOVERY_S)
                for cut in cuts
            )
            # A hub that skips samples on a busy machine may be between two runs of samples.
            begun = [run.period_us for run in log.runs if run.start_us <= time_us]
            wrong += not is_cut and begun[-1:] != [wanted_us]
    return wrong
