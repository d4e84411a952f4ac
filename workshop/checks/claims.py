"""Checks what the driver counts against what was sent and what came."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cube_tensor_driver.simulation.sample_log import LinkLog, SampleLog

from .frequencies import FrequencyVerdict
from .record import NEW_DRIVER, Record
from .samples import NONE, Samples
from .tensors import TensorVerdict

NEAR_ZERO = 1 << 20
"""A hub that begins to count above this has been made to wrap: its first samples are not counted
from 0."""


SAID_EVERY_NS = 1_500_000_000
"""What a driver counted so shortly before it was killed, it may not have said."""


def miscounted(
    record: Record,
    log: SampleLog,
    samples: Samples,
    verdict: FrequencyVerdict,
    tensors: TensorVerdict,
) -> dict[str, int]:
    """Rows that the driver counted wrongly, and messages that the reconstruction says it lost
    although it had them.

    The last samples of a hub before it lost its power or restarted are nobody's to know, nor those
    around the death of a driver; all others that did not come must be counted, and no more.
    """
    counters = record.counters
    each = len(record.skin.cubes) // len(record.skin.links)
    lost = each * (counters["lost_on_the_way"] + counters["dropped_in_hub"])
    counted = (
        lost + counters["rows of unknown cubes"] + counters["rows with another number of pads"]
    )
    # The driver counts on until it is stopped.
    known = verdict.judged & ~_between_drivers(record, samples, verdict)
    missing, at_end = int(verdict.missing[known].sum()), int(verdict.missing.sum())
    unknowable = _lost_with_power(record, log, samples, verdict)
    published, came = counters["rows published"], len(record.frequencies.rows)
    unsaid = int(np.count_nonzero(record.near_death(record.frequencies.sent_ns, SAID_EVERY_NS)))
    wrong = 0
    # Without a number of rows of what did not come here nobody can say how many there were.
    if not record.frequencies.missed:
        wrong += max(0, published - came) + max(0, came - unsaid - published)
        wrong += max(0, missing - unknowable - counted) + max(0, counted - at_end)
        wrong += max(0, record.messages_lost - tensors.without)
    return {
        "miscounted": wrong + counters["rows unaccounted"] + counters["rows lost by errors"],
        "messages_lost": record.messages_lost,
        "counted": counted,
        "missing": missing,
        "lost_with_power": unknowable,
    }


def _between_drivers(
    record: Record, samples: Samples, verdict: FrequencyVerdict
) -> NDArray[np.bool_]:
    """(S,) samples that no driver could say anything of: the last ones before it was killed, up to
    the first one of their hub that came to the next."""
    unknown = np.zeros(len(samples), bool)
    sent_ns = record.frequencies.sent_ns
    for deed in record.deeds:
        if deed.kind not in NEW_DRIVER:
            continue
        came = verdict.sample[(sent_ns > deed.begin_ns) & (verdict.sample != NONE)]
        came = came[samples.time_ns[came] > deed.begin_ns]
        for link in np.unique(samples.link).tolist():
            of_next = samples.time_ns[came[samples.link[came] == link]]
            first_ns = of_next.min(initial=np.iinfo(np.int64).max)
            of_link = samples.link == link
            last_ns = deed.begin_ns - SAID_EVERY_NS
            unknown |= of_link & (samples.time_ns > last_ns) & (samples.time_ns < first_ns)
    return unknown


def _lost_with_power(
    record: Record, log: SampleLog, samples: Samples, verdict: FrequencyVerdict
) -> int:
    """Rows taken that nobody can know of: those after the last one that came before a restart and,
    where the count did not begin at 0, those before the first one."""
    came = np.zeros(len(samples), bool)
    came[verdict.sample[verdict.sample != NONE]] = True
    return sum(
        len(link.members) * _unknowable(link, samples, came, np.flatnonzero(samples.link == number))
        for number, link in enumerate(log.links)
    )


def _unknowable(
    link: LinkLog, samples: Samples, came: NDArray[np.bool_], mine: NDArray[np.int64]
) -> int:
    """Of the samples `mine` of one link."""
    boots = np.unique(samples.boot[mine])
    count = 0
    for boot in boots.tolist():
        of_boot = mine[samples.boot[mine] == boot]
        arrived = of_boot[came[of_boot]]
        if boot != boots[-1]:
            count += int(np.count_nonzero(of_boot > arrived.max(initial=-1)))
        if len(arrived) and samples.number[of_boot[0]] > NEAR_ZERO:
            count += int(np.count_nonzero(of_boot < arrived.min()))
    return count
