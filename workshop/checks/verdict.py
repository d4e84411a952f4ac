"""All comparisons of the judge together: the figures of a torture."""

from __future__ import annotations

from typing import Any

import numpy as np

from cube_tensor_driver.simulation.sample_log import SampleLog

from .claims import miscounted
from .cube_topics import judge_cube_topics
from .expected import Expected
from .frequencies import judge_frequencies
from .periods import judge_periods
from .record import Record
from .samples import NONE, Samples
from .stamps import stamp_errors_ms
from .tensors import judge_tensors
from .verdicts import judge_verdicts

EXAMPLES = 8
RECONNECTS = ("unplug", "rename")


def judge(record: Record, log: SampleLog) -> dict[str, Any]:
    """Figures; counts are in rows, one cube, one sample."""
    samples = Samples(log)
    expected = Expected(record.skin, log, samples, record.instants)
    frequencies = judge_frequencies(record, log, samples, expected)
    tensors = judge_tensors(record, frequencies.sample, expected, log.start_time_ns)
    of_stress = np.where(
        tensors.source == NONE, NONE, np.append(frequencies.sample, NONE)[tensors.source]
    )
    health = judge_verdicts(record, samples, expected, of_stress, log.start_time_ns)
    stamps = stamp_errors_ms(record, log, samples, frequencies.sample)
    claims = miscounted(record, log, samples, frequencies, tensors)
    gaps = _reconnects_s(record, log, samples, frequencies.missing)
    examples = [*frequencies.examples, *tensors.examples, *health.examples]
    return {
        "samples_sent": frequencies.sent,
        "delivered": frequencies.received,
        **claims,
        "missed_by_judge": record.frequencies.missed + record.stress.missed,
        "unreadable": record.frequencies.unreadable + record.stress.unreadable,
        "lost": frequencies.lost,
        "wrong": frequencies.wrong + frequencies.invented,
        "repeated": frequencies.repeated + tensors.repeated,
        "tensors": tensors.tensors,
        "tensors_not_judged": tensors.not_judged,
        "missing_tensors": tensors.missing,
        "wrong_tensors": tensors.wrong + tensors.invented,
        "faults_to_flag": health.faults,
        "unflagged": health.unflagged,
        "false_alarms": health.false_alarms,
        **judge_cube_topics(record),
        "wrong_periods": judge_periods(record, log),
        "examples": examples[:EXAMPLES],
        "reconnects": len(gaps),
        "worst_reconnect_s": round(max(gaps, default=0.0), 3),
        "stamps_judged": len(stamps),
        "stamp_error_p50_ms": _percentile(np.abs(stamps), 50),
        "stamp_error_p90_ms": _percentile(np.abs(stamps), 90),
        "stamp_error_p99_ms": _percentile(np.abs(stamps), 99),
    }


def _percentile(values: Any, percent: float) -> float | None:
    return round(float(np.percentile(values, percent)), 3) if len(values) else None


def _reconnects_s(record: Record, log: SampleLog, samples: Samples, missing: Any) -> list[float]:
    """How long after each hub was plugged in again its first sample was taken that came, s."""
    gaps = []
    each = np.array([len(link.members) for link in log.links])[samples.link]
    came = (missing < each) & (samples.time_ns < record.end_ns)
    for number, link in enumerate(log.links):
        times_us = samples.time_us[came & (samples.link == number)]
        for fault in log.faults:
            if fault.fault.link == link.name and fault.fault.kind in RECONNECTS:
                after = times_us[times_us >= fault.end_us]
                gaps += [1e-6 * float(after.min() - fault.end_us)] if len(after) else []
    return gaps
