"""Compares the rows of `frequencies` with what the hubs measured: every field, every row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cube_tensor_driver.core.status import STAMP
from cube_tensor_driver.simulation.faults import CUT_FAULTS
from cube_tensor_driver.simulation.sample_log import SampleLog

from .expected import Expected
from .record import LAST_WORDS_NS, STOPPING, Record
from .samples import CHUNK, NONE, Samples

RECOVERY_S = 6.0
"""After a cut a link delivers again: a port is tried again every 5 s at the latest."""
BEFORE_S = 0.1
"""Bytes that are on their way when a link is cut are lost, too."""
RESTART_S = 3.0
"""Until the hubs deliver again after one."""
GAP_NS = 50_000_000
"""How far rows of a message that did not come here may be from those around it."""


@dataclass(frozen=True)
class FrequencyVerdict:
    """Counts are rows.

    sample: (N,) of each row that came, NONE for what no hub took
    sent, received: of the time that is judged
    wrong: a field differs from what the hub measured
    invented, repeated: of a sample that no hub took, or that had come already
    lost: sent and not received, and nothing that was done explains it
    judged: (S,) bool, samples of the time that is judged
    missing: (S,) rows of each sample that did not come, also those taken later
    """

    sample: NDArray[np.int64]
    sent: int
    received: int
    wrong: int
    invented: int
    repeated: int
    lost: int
    judged: NDArray[np.bool_]
    missing: NDArray[np.int64]
    examples: tuple[str, ...]


def judge_frequencies(
    record: Record, log: SampleLog, samples: Samples, expected: Expected
) -> FrequencyVerdict:
    """Compare every row and count every sample."""
    rows, examples = record.frequencies.rows, []
    sample = samples.match(rows, expected)
    wrong = 0
    for at in range(0, len(rows), CHUNK):
        part, of = rows.select(slice(at, at + CHUNK)), sample[at : at + CHUNK]
        known = np.flatnonzero(of != NONE)
        part, of = part.select(known), of[known]
        readings = expected.of(part.cube, of)
        certain = readings.certain
        bits = (part.pad_fault ^ readings.pad_fault)[:, None] >> np.arange(certain.shape[1]) & 1
        bad = (
            (certain & ~_same(part.frequency, readings.frequency)).any(axis=1)
            | (certain & (bits == 1)).any(axis=1)
            | (certain.all(axis=1) & ~_same(part.temperature, readings.temperature))
            | (part.status & ~np.uint16(STAMP) != 0)
        )
        wrong += int(np.count_nonzero(bad))
        examples += [
            f"wrong: cube {part.cube[row]}, {samples.time_us[of[row]] * 1e-6:.3f} s"
            for row in np.flatnonzero(bad)[:3]
        ]
    count, repeated = _count(record, log, samples, sample)
    judged = (samples.time_ns >= record.begin_ns) & (samples.time_ns < record.end_ns)
    each = np.array([len(link.members) for link in log.links])[samples.link]
    missing = np.where(samples.time_ns >= record.begin_ns, each - count, 0)
    unexplained = np.flatnonzero(judged & (missing > 0) & ~_explained(record, log, samples))
    examples += [
        f"lost: {missing[at]} rows of {log.links[samples.link[at]].name}, "
        f"{samples.time_us[at] * 1e-6:.3f} s"
        for at in unexplained[:3].tolist()
    ]
    return FrequencyVerdict(
        sample,
        sent=int(each[judged].sum()),
        received=int(count[judged].sum()),
        wrong=wrong,
        invented=int(np.count_nonzero(sample == NONE)),
        repeated=repeated,
        lost=int(missing[unexplained].sum()),
        judged=judged,
        missing=missing,
        examples=tuple(examples),
    )


def _same(one: NDArray[np.float32], other: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Equal to the bit; not measured is equal to not measured."""
    return (one == other) | (np.isnan(one) & np.isnan(other))


def _count(
    record: Record, log: SampleLog, samples: Samples, sample: NDArray[np.int64]
) -> tuple[NDArray[np.int64], int]:
    """(S,) rows of each sample that came, each cube once; and how many came once more."""
    n_cubes = len(record.skin.cubes)
    known = sample != NONE
    key = sample[known] * n_cubes + record.frequencies.rows.cube[known]
    first = np.unique(key)
    return np.bincount(first // n_cubes, minlength=len(samples)), len(key) - len(first)


def _explained(record: Record, log: SampleLog, samples: Samples) -> NDArray[np.bool_]:
    """(S,) whether rows of a sample may be missing: it was harmed, its link was cut, its hub was
    stopped, or its message did not come here."""
    explained = samples.damaged.copy()
    explained[:-1] |= samples.damaged[1:]  # a sample that is held back goes out with the next one
    seconds = 1e-6 * samples.time_us
    numbers = {link.name: number for number, link in enumerate(log.links)}
    for fault in log.faults:
        if fault.fault.kind in CUT_FAULTS:
            begin, end = 1e-6 * fault.start_us - BEFORE_S, 1e-6 * fault.end_us + RECOVERY_S
            mine = samples.link == numbers[fault.fault.link]
            explained |= mine & (seconds >= begin) & (seconds <= end)
    for deed in record.deeds:
        if deed.kind in STOPPING:
            begin_ns, end_ns = deed.begin_ns - 1e9 * BEFORE_S, deed.end_ns + 1e9 * RESTART_S
            explained |= (samples.time_ns >= begin_ns) & (samples.time_ns <= end_ns)
    explained |= record.near_death(samples.time_ns, LAST_WORDS_NS)
    return explained | record.frequencies.in_gap(samples.time_ns, GAP_NS)
