# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""When the errors of a skin's stress are computed again."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.core.status import COMPENSATION, WEIGHT
from cube_tensor_driver.core.stress_errors import StressErrors

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000


def scan(status: list[int], left_out: int = 0) -> StressRows:
    """A row of each of the first cubes of three."""
    n = len(status)
    cubes, stress, gradient = np.arange(n), np.zeros((n, 6)), np.zeros((n, 9))
    return StressRows.from_values(
        cubes, stress, gradient, status=np.array(status), left_out=left_out
    )


def test_errors_are_due_twice_a_second_and_when_a_cube_becomes_uncertain():
    masks = []

    def compute_errors(cubes, left_out):
        masks.append(left_out.tolist())
        return np.full((len(cubes), 15, 1), 0.1)

    reconstructor = SimpleNamespace(names="abc", has_errors=False, errors=compute_errors)
    errors = StressErrors(reconstructor)
    sure, doubtful = [WEIGHT] * 3, [WEIGHT, COMPENSATION, WEIGHT]

    def is_due(ms: int, *given) -> bool:
        return errors.update(scan(*given), START_NS + ms * MS) is not None

    assert not is_due(0, sure)
    reconstructor.has_errors = True
    assert is_due(0, sure) and not is_due(1, sure)
    # A cube without a row stays uncertain, and one that becomes certain again can wait.
    assert is_due(2, doubtful) and not is_due(3, doubtful) and not is_due(4, [WEIGHT])
    assert not is_due(501, sure, 4) and is_due(502, sure, 2)
    assert is_due(503, doubtful)
    # The stamps go back, as of a bag that is played again.
    assert not is_due(100, sure) and is_due(2, sure)
    assert masks == [[0] * 3, [0] * 3, [2] * 3, [0] * 3, [0] * 3]
    found = errors.update(scan(sure), START_NS + 1000 * MS)
    assert found.dtype == np.float32 and found.shape == (3, 15, 1)
