# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Check of the counters of the nodes against what was sent and what arrived."""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.core.arrays import Mask

from .frequencies import FrequencyFindings
from .record import DRIVER_KILLS, DROPPED_BY_HOST, LATEST_NS, NS_PER_S
from .run import Findings, Run, count, find_matched
from .tensors import TensorFindings

WRAPPED_NUMBER = 1 << 20
"""Threshold for the number of a hub's first sample: a hub above it did not begin to count at 0.

The fault "wrap" makes a hub begin shortly before 2**32. The driver then cannot know how many
samples were lost before the first one that arrived.
"""

REPORT_PERIOD_S = 1.5
"""Longest time, in seconds, between two reports of the driver's counters. What the driver counted
within this time before it was killed may not have been reported."""


def check_counters(
    run: Run,
    frequencies: FrequencyFindings,
    tensors: TensorFindings,
) -> Findings:
    """Compare the counters with the rows that are missing and the rows that arrived.

    A row is one cube at one sampling time. The driver cannot know the last samples of a hub before
    the hub lost its power or restarted, nor samples around its own end. All other rows that did not
    arrive must be counted, each once. The reconstruction must not state that it lost messages
    whose tensors arrived.
    """
    record, counters = run.record, run.record.counters
    cubes_per_link = len(record.skin.cubes) // len(record.skin.links)
    counted = (
        cubes_per_link * (counters["lost_on_the_way"] + counters["dropped_in_hub"])
        + counters["rows of unknown cubes"]
        + counters["rows with another number of pads"]
    )
    # Some of these rows may have been dropped before the record began. So the counter may be larger
    # than the number of missing rows, but not smaller.
    dropped = counters[DROPPED_BY_HOST]
    is_countable = frequencies.is_checked & ~_is_between_drivers(run)
    missing = int(frequencies.missing[is_countable].sum())
    # The counters include samples after the checked span of time, so `counted` is compared with all
    # missing rows.
    missing_at_end = int(frequencies.missing.sum())
    is_lost_with_power = _is_lost_with_power(run)
    lost_with_power = int(run.samples.row_count[is_lost_with_power].sum())

    published, arrived = counters["rows published"], len(record.frequencies.rows)
    sent_ns = record.frequencies.sent_ns
    is_unreported = record.is_during(DRIVER_KILLS, sent_ns, REPORT_PERIOD_S)
    reported = arrived - count(is_unreported)

    wrong = counters["rows unaccounted"] + counters["rows lost by errors"]
    # If a message did not reach this process, the number of its rows is unknown, so the counters
    # cannot be checked.
    if not record.frequencies.missed:
        # Each of these differences is at most 0 when all counters are right.
        excesses = (
            published - arrived,
            reported - published,
            missing - lost_with_power - counted - dropped,
            counted - missing_at_end,
            record.messages_lost - tensors.messages_without,
        )
        wrong += sum(max(0, excess) for excess in excesses)
    figures = {
        "miscounted": wrong,
        "messages_lost": record.messages_lost,
        "counted": counted,
        "missing": missing,
        "lost_with_power": lost_with_power,
    }
    return Findings(figures, [])


def _is_between_drivers(run: Run) -> Mask:
    """Find the samples (S,) around the kill of a driver, which no driver can count as lost.

    For each hub, they begin `REPORT_PERIOD_S` before the driver was killed, and end with the first
    sample that reached the next driver.
    """
    samples, sent_ns = run.samples, run.record.frequencies.sent_ns
    between = np.zeros(len(samples), bool)
    for action in run.record.select_actions(*DRIVER_KILLS):
        later = find_matched(run.sample)
        arrived = run.sample[later[sent_ns[later] > action.begin_ns]]
        # Rows that were sampled before the kill came from the killed driver, although late.
        arrived = arrived[samples.time_ns[arrived] > action.begin_ns]
        last_ns = action.begin_ns - round(NS_PER_S * REPORT_PERIOD_S)
        first_ns = np.full(len(samples.log.links), LATEST_NS)
        np.minimum.at(
            first_ns,
            samples.link[arrived],
            samples.time_ns[arrived],
        )
        is_before_next = samples.time_ns < first_ns[samples.link]
        between |= (samples.time_ns > last_ns) & is_before_next
    return between


def _is_lost_with_power(run: Run) -> Mask:
    """Find the samples (S,) that the driver cannot count as lost, because the hub restarted.

    They are the samples between the last one that arrived and a restart. After a restart at which
    the hub did not begin to count at 0, they are also those before the first one that arrived.
    """
    samples = run.samples
    arrived = np.zeros(len(samples), bool)
    arrived[run.sample[find_matched(run.sample)]] = True
    lost = np.zeros(len(samples), bool)
    for link in range(len(samples.log.links)):
        of_link = samples.link == link
        boots = np.unique(samples.boot[of_link]).tolist()
        for boot in boots:
            # Samples are in the order of time, so the order of indices is that of time.
            mine = np.flatnonzero(of_link & (samples.boot == boot))
            mine_arrived = mine[arrived[mine]]
            # A hub that was not restarted still reports the samples that it has dropped.
            if boot != boots[-1]:
                last = mine_arrived.max(initial=-1)
                lost[mine[mine > last]] = True
            if len(mine_arrived) and samples.number[mine[0]] > WRAPPED_NUMBER:
                lost[mine[mine < mine_arrived[0]]] = True
    return lost
