# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The specific force at the cubes of a skin: the function in C against the one in numpy, and both
against the acceleration of points of a body that turns."""

from __future__ import annotations

import numpy as np
import pytest

from cube_tensor_driver.core.compensation.motion import ForcesAtCubes, Motion
from cube_tensor_driver.core.kernel import run
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.core.tensor import rotation_from_rpy

RNG = np.random.default_rng(3)
CUBES = 7
POSES = CubePoses(
    RNG.normal(size=(CUBES, 3)),
    np.array([rotation_from_rpy(*RNG.normal(size=3)) for _ in range(CUBES)]),
    np.full(CUBES, 0.002),
)


def rows_at(stamp_ns) -> FrequencyRows:
    """One row at each time; every tenth is of a cube that the skin does not have."""
    n = np.arange(len(stamp_ns))
    cube = np.where(n % 10 == 9, CUBES, n % CUBES).astype(np.uint16)
    return FrequencyRows.from_values(cube, np.zeros((len(n), 1), np.float32), stamp_ns=stamp_ns)


@pytest.mark.skipif(run.native is None, reason="the module _scan is not built")
@pytest.mark.parametrize(
    "instants_ms", [[], [10], [0, 4], [0, 4, 4, 8, 300, 304], [-(2**43), 0, 4, 2**43]]
)
def test_c_and_numpy_give_the_same_bits(monkeypatch, instants_ms):
    """With no instant, one, equal ones, and gaps; before, between and after them."""
    known = Motion(
        np.array(instants_ms, np.int64) * 1_000_000,
        RNG.normal(size=(len(instants_ms), 4, 3)),
    )
    stamps = np.repeat(RNG.integers(-60_000_000, 380_000_000, 400), 3)
    rows = rows_at(np.append(stamps, np.array(instants_ms, np.int64) * 1_000_000))
    found = ForcesAtCubes(POSES).add_to(rows, known).specific_force
    monkeypatch.setattr(run, "native", None)
    expected = ForcesAtCubes(POSES).add_to(rows, known).specific_force
    assert expected.dtype == found.dtype == np.float32
    np.testing.assert_array_equal(found, expected)
    assert np.isnan(found[9::10]).all()
    assert np.isfinite(found).any() == bool(instants_ms)


@pytest.mark.parametrize("compiled", [True, False])
def test_the_force_is_that_of_a_point_of_a_turning_body(monkeypatch, compiled):
    """alpha x r + omega x (omega x r) in the axes of the cube, halfway between two instants."""
    if not compiled:
        monkeypatch.setattr(run, "native", None)
    omega, alpha, force = RNG.normal(size=(3, 3))
    turning, turning_faster = (np.cross(vector, np.eye(3)).T for vector in (omega, alpha))
    gradient = turning_faster + turning @ turning
    scale = np.array([0.0, 2.0])
    state = scale[:, None, None] * np.vstack([force, gradient])
    known = Motion(np.array([0, 2_000_000]), state)
    rows = rows_at(np.full(CUBES, 1_000_000))
    found = ForcesAtCubes(POSES).add_to(rows, known).specific_force
    for cube in range(CUBES):
        r = POSES.position[cube]
        expected = force + np.cross(alpha, r) + np.cross(omega, np.cross(omega, r))
        np.testing.assert_allclose(found[cube], POSES.rotation[cube].T @ expected, atol=1e-5)
