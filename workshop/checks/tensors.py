# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Check of the topic `stress`: each row against the row of frequencies that it was made from.

The reference is the package's own pipeline in double precision, in this process. Which pads a row
leaves out is taken as stated here, and checked in `health.py`. Whether tensors are those of the
load is for `./cube demo` to check.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cube_tensor_driver.core.arrays import Array, Index, Mask
from cube_tensor_driver.core.estimator import compute_chi2_limit
from cube_tensor_driver.core.matching import NO_MATCH, match_rows
from cube_tensor_driver.core.modes import COMPONENTS
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.core.status import INVALID, PAD_FAULT, RESIDUAL, STAMP, TEMPERATURE

from .record import DRIVER_KILLS, NODE_STARTS, UNFLUSHED_S
from .rest import RestFrequencies, RestHistory
from .run import Findings, Run, agree, count, find_matched
from .sent_readings import split_in_chunks

MAX_NOISE_SHARE = 0.1
"""Largest difference of a component (stress or gradient) from the pipeline in double precision, as
a share of the component's standard deviation from the noise of the pads.

That noise is 8e-6 of a frequency. Computing in float32 causes 0.01 of it, a tare that is wrong by
20 ppm more than 2.
"""

MAX_RESIDUAL_ERROR = 0.05
"""Largest error of a residual, which has no unit. Rounding to mHz gives 1e-3."""

MAX_RELATIVE_RESIDUAL_ERROR = 1e-3
"""Error of a residual that is allowed in addition to `MAX_RESIDUAL_ERROR`, as a share of the
residual."""

LIMIT_MARGIN = 0.01
"""Relative distance between a residual and its false-alarm limit below which the status may state
either that the residual is above the limit or that it is not."""

ROW_STATUS = PAD_FAULT | RESIDUAL | INVALID | TEMPERATURE | STAMP
"""Status bits of the row itself; the others describe the condition of the cube's pads."""


@dataclass(frozen=True)
class TensorFindings(Findings):
    """Findings about the topic `stress`, and what other checks need of them.

    Attributes:
        source: Row of frequencies that each row of stress was made from (M,), or `NO_MATCH`.
        messages_without: Number of messages of `frequencies` whose rows all have no tensor.
    """

    source: Index
    messages_without: int


def check_tensors(run: Run) -> TensorFindings:
    """Compare every row (one cube at one sampling time) of stress.

    The figures are: `wrong_tensors`, rows that differ from the reference, or that were made from no
    row that arrived; `repeated`, rows made from a row that had its tensor already;
    `missing_tensors`, rows of frequencies without a tensor and without an explanation;
    `tensors_not_judged`, rows whose rest frequencies are unknown.
    """
    record = run.record
    frequencies, stress = record.frequencies.rows, record.stress.rows
    source = _find_sources(frequencies, stress)
    known = find_matched(source)
    # A row of frequencies should be the source of exactly one row of stress.
    n_tensors = np.bincount(source[known], minlength=len(frequencies))
    is_missing = _find_missing(run, has_tensor=n_tensors > 0)

    is_invented = source == NO_MATCH
    is_invented &= ~record.frequencies.is_in_gap(stress.stamp_ns)
    # The last messages of a driver that was killed may have reached the reconstruction only.
    is_invented &= ~record.is_during(DRIVER_KILLS, record.stress.sent_ns, UNFLUSHED_S)

    history = RestHistory(run)
    reference = _Reference(run)
    is_wrong, is_unknown = np.zeros((2, len(stress)), bool)
    for part in split_in_chunks(known):
        made = stress.select(part)
        measured = frequencies.select(source[part])
        sent_ns = record.stress.sent_ns[part]
        agrees = np.zeros(len(part), bool)
        # Around a change of the rest frequencies, a row may be made with the old or the new ones.
        for is_candidate, rest in history.select_candidates(sent_ns):
            has_no_reference = ~rest.is_known[made.cube]
            is_right = reference.agrees(made, measured, rest)
            agrees |= is_candidate & (has_no_reference | is_right)
            is_unknown[part] |= is_candidate & has_no_reference
        is_wrong[part] = ~agrees

    sent_ns = record.frequencies.sent_ns
    figures = {
        "tensors": len(stress),
        "tensors_not_judged": count(is_unknown),
        "missing_tensors": count(is_missing),
        "wrong_tensors": count(is_wrong | is_invented),
        "repeated": int(np.maximum(n_tensors - 1, 0).sum()),
    }
    examples = []
    for what, rows, is_found in (
        ("wrong tensor", stress, is_wrong),
        ("tensor of nothing", stress, is_invented),
        ("no tensor", frequencies, is_missing),
    ):
        examples += run.describe_examples(f"{what}: cube", rows.cube, rows.stamp_ns, is_found)
    without = np.setdiff1d(sent_ns, sent_ns[n_tensors > 0])
    return TensorFindings(figures, examples, source, len(without))


def _find_sources(frequencies: FrequencyRows, stress: StressRows) -> Index:
    """Find the row of frequencies with the cube, number and stamp of each row of stress (M,)."""
    source = match_rows(frequencies, stress)
    found = find_matched(source)
    source_stamp_ns = frequencies.stamp_ns[source[found]]
    has_other_stamp = source_stamp_ns != stress.stamp_ns[found]
    source[found[has_other_stamp]] = NO_MATCH
    return source


def _find_missing(run: Run, has_tensor: Mask) -> Mask:
    """Find the rows of frequencies (N,) without a tensor and without an explanation.

    There are three explanations. A message of `stress` did not reach this process. A node was down;
    this includes what was sent after the last message that got a tensor before. The reconstruction
    reports lost messages; as many messages may be without tensors.
    """
    record = run.record
    stamp_ns, sent_ns = record.frequencies.rows.stamp_ns, record.frequencies.sent_ns
    is_missing = ~has_tensor & record.contains(stamp_ns)
    is_missing &= ~record.stress.is_in_gap(stamp_ns)
    for action in record.select_actions(*NODE_STARTS):
        was_up = has_tensor & (sent_ns <= action.begin_ns)
        before_ns = sent_ns[was_up].max(initial=0)
        is_missing &= (sent_ns <= before_ns) | (sent_ns > action.end_ns)
    # All rows of a message have the same time of sending, so different times count messages.
    messages = np.unique(sent_ns[is_missing])
    if len(messages) <= record.messages_lost:
        is_missing[:] = False
    return is_missing


class _Reference:
    """Computes the right tensors with the pipeline in double precision."""

    def __init__(self, run: Run) -> None:
        self._pipeline = Pipeline(run.record.skin.calibrations, np.float64)
        # The limit of the residual depends on its degrees of freedom, which are at most the number
        # of pads.
        degrees = range(1, self._pipeline.n_pads + 1)
        chi2_limits = [compute_chi2_limit(degree) for degree in degrees]
        self._limits = np.sqrt(np.array(chi2_limits) / degrees)
        self._deviations: dict[tuple[int, int], Array] = {}

    def agrees(
        self,
        made: StressRows,
        measured: FrequencyRows,
        rest: RestFrequencies,
    ) -> Mask:
        """Return whether rows (N,) are what the pipeline computes with these rest frequencies."""
        self._pipeline.rest_frequency = rest.values
        wanted = self._pipeline.process(measured, made.left_out)

        allowed = MAX_NOISE_SHARE * self._compute_deviation(made)
        relative_part = MAX_RELATIVE_RESIDUAL_ERROR * wanted.residual
        allowed_residual = MAX_RESIDUAL_ERROR + relative_part
        agrees = agree(made.residual, wanted.residual, allowed_residual)
        agrees &= agree(
            made.components,
            wanted.components,
            allowed,
        ).all(axis=1)
        agrees &= made.observed == wanted.observed
        agrees &= made.left_out == wanted.left_out

        # Rounding decides whether a residual that is close to its limit is above it.
        relative = wanted.residual[:, np.newaxis] / self._limits
        is_at_limit = np.abs(relative - 1).min(axis=1) < LIMIT_MARGIN
        difference = (made.status ^ wanted.status) & ROW_STATUS
        agrees &= (difference == 0) | ((difference == RESIDUAL) & is_at_limit)
        return agrees

    def _compute_deviation(self, made: StressRows) -> Array:
        """Return the standard deviation of each component (N, 15), 0 where it is not observed."""
        # `np.unique` sorts one integer, made of the cube and the mask, much faster than pairs.
        key = made.cube.astype(np.int64) << 32 | made.left_out
        distinct, which = np.unique(key, return_inverse=True)
        rows = [
            self._compute_deviation_of(cube=value >> 32, left_out=value & 0xFFFFFFFF)
            for value in distinct.tolist()
        ]
        # The shape is stated because there may be no rows.
        table = np.array(rows).reshape(-1, len(COMPONENTS))
        return table[which.ravel()]

    def _compute_deviation_of(self, cube: int, left_out: int) -> Array:
        if (cube, left_out) not in self._deviations:
            variance = np.diag(self._pipeline.compute_covariance(cube, left_out))
            self._deviations[cube, left_out] = np.sqrt(np.nan_to_num(variance))
        return self._deviations[cube, left_out]
