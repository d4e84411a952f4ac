# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""All checks together: the figures of a torture."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from cube_tensor_driver.core.arrays import Records
from cube_tensor_driver.core.matching import NO_MATCH
from cube_tensor_driver.demo.verification import compute_percentile
from cube_tensor_driver.simulation.sample_log import SampleLog

from .counters import check_counters
from .frequencies import check_frequencies
from .health import check_health
from .record import Record
from .run import Run
from .tensors import check_tensors
from .timing import count_wrong_periods, measure_reconnects, measure_stamp_errors

MAX_EXAMPLES = 8
"""Maximum number of examples of wrong rows (one cube at one sampling time) that are printed."""

PERCENTILES = (50, 90, 99)
"""Percentiles that are printed of the stamp errors: absolute difference between the time of a
sample and its stamp."""


def check_all(
    record: Record,
    log: SampleLog,
    readings: Records,
) -> dict[str, Any]:
    """Run all checks and return their figures; counts are rows (one sample of one cube each).

    Args:
        record: What arrived and what was done.
        log: The sample log.
        readings: What the hubs sent in each sample, see `read_readings`.
    """
    run = Run(record, log, readings)
    frequencies = check_frequencies(run)
    tensors = check_tensors(run)
    # A row of stress whose source is `NO_MATCH`, the index -1, gets the appended `NO_MATCH`.
    samples = np.append(run.sample, NO_MATCH)
    health = check_health(run, samples[tensors.source])
    counters = check_counters(run, frequencies, tensors)

    figures = Counter[str]()
    examples: list[str] = []
    for findings in (frequencies, counters, tensors, health):
        figures.update(findings.figures)
        examples += findings.examples
    topics = (record.frequencies, record.stress)
    reconnects_s = measure_reconnects(run, frequencies)
    stamp_errors_ms = np.abs(measure_stamp_errors(run))
    return {
        **figures,
        "missed_by_judge": sum(topic.missed for topic in topics),
        "unreadable": sum(topic.unreadable for topic in topics),
        "wrong_periods": count_wrong_periods(run),
        "examples": examples[:MAX_EXAMPLES],
        "reconnects": len(reconnects_s),
        "worst_reconnect_s": round(max(reconnects_s, default=0.0), 3),
        "stamps_judged": len(stamp_errors_ms),
        **{
            f"stamp_error_p{percent}_ms": compute_percentile(stamp_errors_ms, percent)
            for percent in PERCENTILES
        },
    }
