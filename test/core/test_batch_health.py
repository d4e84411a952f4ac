# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Health of recorded batches at once against the same one by one, as the node does it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from conftest import check, stamped
from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.health.health import Health
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.status import STAMP


@pytest.mark.parametrize("kinds", [["planar"], ["planar", "cube"]])
@pytest.mark.parametrize("faults", [False, True])
def test_many_at_once_is_one_by_one_to_the_bit(kinds, faults):
    rng = np.random.default_rng(11)
    n, count = 6, 400
    pipeline = Pipeline(
        [make_illustrative_calibration(kinds[k % len(kinds)]) for k in range(n)], np.float32
    )
    frequency = pipeline.rest_frequency * (1 - 0.02 * rng.random((count, n, pipeline.n_pads)))
    frequency = frequency.astype(np.float32)
    pad_fault = np.zeros((count, n), np.uint32)
    if faults:
        frequency[50:90, 2, 1], frequency[200, 4, 3], frequency[300:, 1, 0] = np.nan, 1e9, 98_000.0
        pad_fault[120, 3] = 4
    stamp_ns = np.repeat(10_000_000 * np.arange(count)[:, None], n, axis=1)
    stamp_ns[70:] += 30_000_000  # rows are missing
    stamp_ns[150:] += np.cumsum(rng.integers(0, 2, count - 150) * 10_000_000)[:, None]
    stamp_ns[250:] -= 2_000_000_000  # played again from further back
    cube = np.arange(n, dtype=np.uint16)
    status = np.zeros((count, n), np.uint16)
    status[30:35, 2], status[199, 4] = STAMP, STAMP
    single, many = Health(pipeline), Health(pipeline)
    expected = [
        check(single, replace(stamped(cube, *one), status=of_scan))
        for *one, of_scan in zip(frequency, pad_fault, stamp_ns, status, strict=True)
    ]
    found = [
        check(
            many,
            replace(
                stamped(
                    np.tile(cube, len(part)),
                    frequency[part].reshape(-1, pipeline.n_pads),
                    pad_fault[part].ravel(),
                    stamp_ns[part].ravel(),
                ),
                status=status[part].ravel(),
            ),
        )
        for part in np.array_split(np.arange(count), 9)
    ]
    for of_many, of_single in zip(
        zip(*found, strict=True), zip(*expected, strict=True), strict=True
    ):
        np.testing.assert_array_equal(np.concatenate(of_many), np.concatenate(of_single))
    assert bool(np.any([mask for mask, _ in expected])) == faults
    assert many.closed == single.closed
    for a, b in zip(many.history, single.history, strict=True):
        for one, other in zip(a, b, strict=True):
            np.testing.assert_array_equal(one, other)
    for name in ("state", "newest_ns"):
        np.testing.assert_array_equal(getattr(many, name), getattr(single, name), err_msg=name)
    np.testing.assert_array_equal(many.diagnosis.still, single.diagnosis.still)
    np.testing.assert_array_equal(many.sums.cubes["mask"], single.sums.cubes["mask"])
    np.testing.assert_array_equal(many.sums.view_pads("last"), single.sums.view_pads("last"))
