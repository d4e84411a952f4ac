# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What the Reconstructor puts together, and the statistics below it, against truth."""

from __future__ import annotations

import numpy as np

from conftest import check, stamped
from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.health.health import Health
from cube_tensor_driver.core.health.statistics import clear_sums
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.reconstructor import Reconstructor, RecordedHealth
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.core.status import PAD_FAULT, SHORT, STAMP, STUCK

CALIBRATION = make_illustrative_calibration("planar")


def test_noise_of_a_window_is_the_deviation_of_white_noise():
    """Of 32,000 pads with 100 rows: 3.2 million differences leave 0.1 %."""
    cubes, rows, deviation = 4000, 100, 0.8
    health = Health(Pipeline([CALIBRATION] * cubes, np.float32))
    random = np.random.default_rng(1)
    f = (1e5 + deviation * random.standard_normal((rows + 3, cubes, 8))).astype(np.float32)
    cube = np.arange(cubes, dtype=np.uint16)
    for row in range(rows + 3):
        check(health, stamped(cube, f[row], 0, 4_000_000 * (row + 1)))
        if row == 2:
            clear_sums(health.sums)
    noise = np.sqrt(np.mean(health.read_window().noise ** 2))
    # float32 rounds 1e5 Hz to 1/128 Hz, which adds 0.005 % here
    np.testing.assert_allclose(noise, deviation, rtol=4e-3)


def frequencies() -> np.ndarray:
    f = np.tile(CALIBRATION.rest_frequency, (2, 1)).astype(np.float32)
    f[1, 3] = np.nan
    return f


def test_doubt_of_a_stamp_goes_with_the_row():
    """Nothing else that a peer writes there does."""
    doubt = np.array([STAMP, STAMP | STUCK])
    rows = FrequencyRows.from_values(np.arange(2), frequencies(), status=doubt)
    reconstruct = Reconstructor([CALIBRATION] * 2)
    assert reconstruct(rows).status.tolist() == [STAMP, STAMP | PAD_FAULT | SHORT]
    recorded = RecordedHealth(np.ones(2, bool), np.zeros(2, np.uint32), np.zeros(2, np.uint16))
    assert reconstruct.process_known(rows, recorded).status.tolist()[0] == STAMP


def test_recorded_health_replaces_that_found_now_where_it_is_known():
    rows = stamped(np.arange(2), frequencies(), 0, 0)
    recorded = RecordedHealth(
        np.array([True, False]), np.array([1 << 5, 0], np.uint32), np.array([STUCK, 0], np.uint16)
    )
    stress = Reconstructor([CALIBRATION] * 2).process(rows, recorded)
    assert stress.left_out.tolist() == [1 << 5, 1 << 3]
    assert stress.status.tolist() == [PAD_FAULT | STUCK, PAD_FAULT | SHORT]


def test_what_a_notebook_shows_is_one_short_line():
    rows = stamped(np.arange(2), frequencies(), 0, [0, 5_000_000])
    reconstruct = Reconstructor([CALIBRATION] * 2)
    assert repr(rows) == "FrequencyRows(2 rows of 2 cubes over 0.005 s)"
    assert repr(rows.select(slice(0))) == "FrequencyRows(no rows)"
    assert repr(reconstruct(rows)) == "StressRows(2 rows of 2 cubes over 0.005 s)"
    shown = "<Reconstructor: 2 cubes, float32, 0 changes of rest frequencies>"
    assert repr(reconstruct) == shown
    shown = f"Calibration({CALIBRATION.id}, layout 'planar', any cube, illustrative)"
    assert repr(CALIBRATION) == shown
