"""Compares the periods at which hubs sampled with the rates that the driver was asked for."""

from __future__ import annotations

from cube_tensor_driver.simulation.faults import CUT_FAULTS
from cube_tensor_driver.simulation.sample_log import SampleLog

from .frequencies import RECOVERY_S
from .record import STOPPING, Record

WITHIN_NS = 1_000_000_000
"""After a rate was asked for, until each hub that is not cut samples at it."""


def judge_periods(record: Record, log: SampleLog) -> int:
    """How many hubs did not sample at the rate that was asked for, summed over all changes."""
    changes = [deed for deed in record.deeds if deed.kind == "rate" and deed.done]
    wrong = 0
    disturbing = [deed.begin_ns for deed in record.deeds if deed.kind in ("rate", *STOPPING)]
    for deed in changes:
        at_ns = deed.end_ns + WITHIN_NS
        at_us = (at_ns - log.start_time_ns) // 1000
        if any(deed.end_ns < other < at_ns for other in (*disturbing, record.end_ns)):
            continue
        wanted_us = round(1e6 / float(deed.answer))
        for link in log.links:
            cut = any(
                fault.fault.link == link.name
                and fault.fault.kind in CUT_FAULTS
                and fault.start_us - 1e6 <= at_us <= fault.end_us + 1e6 * RECOVERY_S
                for fault in log.faults
            )
            periods = {run.period_us for run in link.runs if run.start_us <= at_us < run.end_us}
            wrong += not cut and periods != {wanted_us}
    return wrong
