"""Compares the rows of `stress` with the rows of `frequencies` that they were made from.

The reference is the package's own pipeline in double precision, in this process: what a row says of
its pads (left_out) is taken as said, and judged in `verdicts.py`. Sound rows are compared with the
load itself as well, which needs no pipeline.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cube_tensor_driver.core.estimator import FALSE_ALARM, chi2_limit
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.core.status import INVALID, PAD_FAULT, RESIDUAL, STAMP, TEMPERATURE

from .expected import Expected
from .record import DOWN, LAST_WORDS_NS, NEW_DRIVER, Record
from .rest import RestEpochs
from .samples import CHUNK, NONE

TOLERANCE, OF_LOAD = 1e-4, 1e-3
"""Of a component's range, from the reference and from the load: float32 leaves 1e-6, rounding to
mHz 1e-5 and more where few pads are left; a tare that is wrong by 20 ppm, 4e-4."""
NOISE_SHARE = 0.1
"""Of the standard deviation that the noise of its pads gives a component: where few pads are left,
rounding is amplified as noise is."""
RESIDUAL_SHARE, RESIDUAL_LEAST = 1e-3, 0.05
"""A residual may differ by so much of itself, and by so much: rounding to mHz gives 1e-3."""
AT_LIMIT = 0.01
"""So near to its limit (relative) a residual may be above it or not."""
OF_ROW = PAD_FAULT | RESIDUAL | INVALID | TEMPERATURE | STAMP
"""Status bits of the row itself; the others are of its cube's pads."""
GAP_NS = 50_000_000
"""How far rows of a message that did not come here may be from those around it."""


@dataclass(frozen=True)
class TensorVerdict:
    """Counts are rows.

    source: (M,) which row of frequencies each row of stress was made from, NONE if none came
    tensors: that came
    wrong: differ from the reference, or from the load
    invented: made from no row that came; repeated: from one that had its tensor already
    missing: rows of frequencies without a tensor that nothing explains
    without: messages of frequencies of which no row has a tensor
    not_judged: rows of cubes whose rest frequencies nobody knows
    """

    source: NDArray[np.int64]
    tensors: int
    wrong: int
    invented: int
    repeated: int
    missing: int
    without: int
    not_judged: int
    examples: tuple[str, ...]


def judge_tensors(
    record: Record, sample: NDArray[np.int64], expected: Expected, start_time_ns: int
) -> TensorVerdict:
    """Compare every row. sample: (N,) of each row of frequencies."""
    frequencies, stress = record.frequencies.rows, record.stress.rows
    source = _find(_keys(frequencies), _keys(stress))
    invented = (source == NONE) & ~record.frequencies.in_gap(stress.stamp_ns, GAP_NS)
    # The last messages of a driver that was killed may have come to the reconstruction alone.
    invented &= ~record.near_death(record.stress.sent_ns, LAST_WORDS_NS)
    known = np.flatnonzero(source != NONE)
    times = np.bincount(source[known], minlength=len(frequencies))
    missing = _missing(record, times == 0)
    sent_ns = record.frequencies.sent_ns
    epochs = RestEpochs(record, expected, start_time_ns)
    reference = Reference(record, expected)
    bad, not_judged = np.zeros((2, len(stress)), bool)
    for at in range(0, len(known), CHUNK):
        chosen = known[at : at + CHUNK]
        made, measured = stress.select(chosen), frequencies.select(source[chosen])
        made_ns = record.stress.sent_ns[chosen]
        right = np.zeros(len(chosen), bool)
        for choice in epochs.choices(made_ns):
            unknown = ~choice.known[made.cube]
            right |= choice.applies & (unknown | reference.agrees(made, measured, choice.rest))
            not_judged[chosen] |= choice.applies & unknown
        right &= reference.agrees_with_load(
            made, sample[source[chosen]], epochs.untared(made.cube, made_ns)
        )
        bad[chosen] = ~right
    examples = [_say("wrong tensor", stress, row, start_time_ns) for row in np.flatnonzero(bad)[:4]]
    examples += [
        _say("tensor of nothing", stress, row, start_time_ns)
        for row in np.flatnonzero(invented)[:2]
    ]
    examples += [
        _say("no tensor", frequencies, row, start_time_ns) for row in np.flatnonzero(missing)[:2]
    ]
    return TensorVerdict(
        source,
        tensors=len(stress),
        wrong=int(np.count_nonzero(bad)),
        invented=int(np.count_nonzero(invented)),
        repeated=int(np.maximum(times - 1, 0).sum()),
        missing=int(np.count_nonzero(missing)),
        without=len(np.setdiff1d(sent_ns, sent_ns[times > 0])),
        not_judged=int(np.count_nonzero(not_judged)),
        examples=tuple(examples),
    )


class Reference:
    """The pipeline in double precision."""

    def __init__(self, record: Record, expected: Expected) -> None:
        calibrations = [cube.calibration for cube in record.skin.cubes]
        self._pipeline = Pipeline(calibrations, np.float64)
        self._expected = expected
        self._truth = expected.truth
        self._range = np.ptp(self._truth, axis=(0, 1))
        dofs = range(1, self._pipeline.n_pads + 1)
        self._limits = np.array([np.sqrt(chi2_limit(n, FALSE_ALARM) / n) for n in dofs])
        self._deviations: dict[tuple[int, int], NDArray[np.float64]] = {}

    def agrees(
        self, made: StressRows, measured: FrequencyRows, rest: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """(N,) whether rows are what the pipeline makes with these rest frequencies."""
        self._pipeline.rest_frequency = rest
        wanted = self._pipeline.process(measured, made.left_out)
        difference = np.abs(_components(made) - _components(wanted))
        allowed = TOLERANCE * self._range + NOISE_SHARE * self._deviation(made)
        near = (difference <= allowed) | (
            np.isnan(_components(made)) & np.isnan(_components(wanted))
        )
        residual = np.abs(made.residual - wanted.residual) <= (
            RESIDUAL_LEAST + RESIDUAL_SHARE * np.nan_to_num(wanted.residual)
        )
        residual |= np.isnan(made.residual) & np.isnan(wanted.residual)
        differs = (made.status ^ wanted.status) & OF_ROW
        at_limit = np.abs(wanted.residual[:, None] / self._limits - 1).min(axis=1) < AT_LIMIT
        status = (differs == 0) | ((differs == RESIDUAL) & at_limit)
        agrees: NDArray[np.bool_] = (
            near.all(axis=1) & residual & status & (made.observed == wanted.observed)
        )
        return agrees & (made.left_out == wanted.left_out)

    def agrees_with_load(
        self, made: StressRows, sample: NDArray[np.int64], untared: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """(N,) whether rows of sound cubes are what the load is; True for all others."""
        agrees = np.ones(len(made), bool)
        chosen = np.flatnonzero((sample != NONE) & untared & (made.left_out == 0))
        readings = self._expected.of(made.cube[chosen], sample[chosen])
        chosen, instant = chosen[readings.sound], readings.instant[readings.sound]
        certain = readings.certain[readings.sound].all(axis=1)
        part = made.select(chosen)
        near = np.abs(_components(part) - self._truth[instant, part.cube]) <= (
            OF_LOAD * self._range
        )
        hidden = part.observed[:, None] >> np.arange(near.shape[1]) & 1 == 0
        agrees[chosen] = (near | hidden).all(axis=1) | ~certain
        return agrees

    def _deviation(self, made: StressRows) -> NDArray[np.float64]:
        """(N, 15) standard deviation of each component, 0 where it is not observed."""
        key = made.cube.astype(np.int64) << 32 | made.left_out
        distinct, which = np.unique(key, return_inverse=True)
        rows = []
        for value in distinct.tolist():
            cube, left_out = value >> 32, value & 0xFFFFFFFF
            if (cube, left_out) not in self._deviations:
                covariance = self._pipeline.covariance(cube, left_out)
                self._deviations[cube, left_out] = np.sqrt(np.nan_to_num(np.diag(covariance)))
            rows.append(self._deviations[cube, left_out])
        return np.array(rows).reshape(-1, len(self._range))[which.ravel()]


def _components(rows: StressRows) -> NDArray[np.floating]:
    return np.concatenate([rows.stress, rows.gradient], axis=1)


def _keys(rows: FrequencyRows | StressRows) -> NDArray[np.uint64]:
    """(N,) one number for cube, sequence and stamp: stress says the same as its frequencies."""
    stamp = rows.stamp_ns.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    sequence = rows.sequence.astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
    return stamp ^ (sequence + rows.cube.astype(np.uint64) * np.uint64(0x165667B19E3779F9))


def _find(keys: NDArray[np.uint64], wanted: NDArray[np.uint64]) -> NDArray[np.int64]:
    """(M,) where each wanted key is, NONE where it is not."""
    if not len(keys):
        return np.full(len(wanted), NONE, np.int64)
    order = np.argsort(keys, kind="stable")
    place = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
    return np.where(keys[order[place]] == wanted, order[place], NONE)


def _missing(record: Record, without: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) rows of the judged time without a tensor that nothing explains.

    What explains them: messages that did not come here; a node that was down, for all that was sent
    since the last message before that had its tensor; and as many messages as the reconstruction
    says that it lost.
    """
    frequencies = record.frequencies.rows
    judged = (frequencies.stamp_ns >= record.begin_ns) & (frequencies.stamp_ns < record.end_ns)
    missing = without & judged & ~record.stress.in_gap(frequencies.stamp_ns, GAP_NS)
    sent_ns = record.frequencies.sent_ns
    for deed in record.deeds:
        if deed.kind in (*DOWN, *NEW_DRIVER):
            before = sent_ns[~without & (sent_ns <= deed.begin_ns)]
            missing &= (sent_ns <= before.max(initial=0)) | (sent_ns > deed.end_ns)
    # Rows of one message were sent at one time.
    messages = len(np.unique(sent_ns[missing]))
    if messages <= record.messages_lost:
        missing[:] = False
    return missing


def _say(what: str, rows: FrequencyRows | StressRows, row: int, start_time_ns: int) -> str:
    seconds = 1e-9 * (int(rows.stamp_ns[row]) - start_time_ns)
    return f"{what}: cube {rows.cube[row]}, {seconds:.3f} s"
