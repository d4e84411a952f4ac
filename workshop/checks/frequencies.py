# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Check of the topic `frequencies`: every field of every row against what the hubs measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cube_tensor_driver.core.arrays import Index, Mask
from cube_tensor_driver.core.matching import NO_MATCH
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.core.status import STAMP

from .record import CUT_FAULTS, DRIVER_KILLS, DRIVER_STOPS, DROPPED_BY_HOST, UNFLUSHED_S
from .run import Findings, Run, agree, count, find_matched
from .sent_readings import Readings, split_in_chunks

RECOVERY_S = 6.0
"""Longest time, in seconds, from the end of a cut of a link until the link delivers again. The
driver tries to open a port at least every 5 s."""

IN_FLIGHT_S = 0.1
"""Length, in seconds, of the span before a cut of a link whose bytes may still be on their way and
are lost with it."""

RESTART_S = 3.0
"""Longest time, in seconds, from a start of the driver until all hubs deliver again."""


@dataclass(frozen=True)
class FrequencyFindings(Findings):
    """Findings about the topic `frequencies`, and what other checks need of them.

    Attributes:
        is_checked: Whether each of the S samples was taken in the span of the record (S,).
        missing: Number of rows of each sample that did not arrive (S,), including samples after the
            span of the record.
    """

    is_checked: Mask
    missing: Index


def check_frequencies(run: Run) -> FrequencyFindings:
    """Compare every row with its sample, and count the rows of every sample.

    The figures are: `wrong`, rows of which a field differs from the measurement, or which are of no
    sample; `repeated`, rows that arrived before; `lost`, rows sent and not received without an
    explanation, beyond those that the driver counts as dropped by a slow host.
    """
    record, samples, sample = run.record, run.samples, run.sample
    rows = record.frequencies.rows
    known = find_matched(sample)
    is_wrong = np.zeros(len(rows), bool)
    for part in split_in_chunks(known):
        chosen = rows.select(part)
        is_wrong[part] = _differs(chosen, run.sent.select(chosen.cube, sample[part]))

    # Rows with the same key are the same row, which arrived more than once.
    n_cubes = len(record.skin.cubes)
    keys = sample[known] * n_cubes + rows.cube[known]
    arrived = np.unique(keys)
    received = np.bincount(arrived // n_cubes, minlength=len(samples))
    is_checked = record.contains(samples.time_ns)
    # Samples before the start of the record are not missing: the driver was not active.
    is_recorded = samples.time_ns >= record.begin_ns
    missing = np.where(is_recorded, samples.row_count - received, 0)
    is_lost = is_checked & (missing > 0) & ~_may_be_missing(run)

    figures = {
        "samples_sent": int(samples.row_count[is_checked].sum()),
        "delivered": int(received[is_checked].sum()),
        "lost": max(0, int(missing[is_lost].sum()) - record.counters[DROPPED_BY_HOST]),
        "wrong": count(is_wrong | (sample == NO_MATCH)),
        "repeated": len(known) - len(arrived),
    }
    sampled_ns = samples.time_ns[np.maximum(sample, 0)]
    examples = run.describe_examples(
        "wrong: cube",
        rows.cube,
        sampled_ns,
        is_wrong,
    )
    examples += run.describe_examples("lost: link", samples.link, samples.time_ns, is_lost)
    return FrequencyFindings(figures, examples, is_checked, missing)


def _differs(rows: FrequencyRows, sent: Readings) -> Mask:
    """Find the rows (N,) with another frequency, temperature or pad fault than was sent, or with a
    wrong status."""
    differs = ~agree(rows.frequency, sent.frequency).all(axis=1)
    differs |= ~agree(rows.temperature, sent.temperature)
    differs |= rows.pad_fault != sent.pad_fault
    # Doubtful stamps are the only condition that a row of frequencies may have.
    differs |= rows.status & ~np.uint16(STAMP) != 0
    return differs


def _may_be_missing(run: Run) -> Mask:
    """Find the samples (S,) whose rows may be missing.

    They were damaged, their link was cut, the driver was stopped, or a message did not arrive here.
    """
    record, samples = run.record, run.samples
    explained = samples.is_damaged.copy()
    # A sample that is held back by a fault goes out together with the next one.
    explained[:-1] |= samples.is_damaged[1:]
    explained |= samples.is_near_fault(CUT_FAULTS, IN_FLIGHT_S, RECOVERY_S)
    explained |= record.is_during(DRIVER_STOPS, samples.time_ns, IN_FLIGHT_S, RESTART_S)
    explained |= record.is_during(DRIVER_KILLS, samples.time_ns, UNFLUSHED_S)
    explained |= record.frequencies.is_in_gap(samples.time_ns)
    return explained
