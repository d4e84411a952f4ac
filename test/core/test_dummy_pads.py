# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Drift that all pads of a cube have in common, with and without a pad that no load reaches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from dummy_pad import with_dummy

from conftest import stamped
from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.estimator import make_estimator
from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.core.symmetry import find_structure
from cube_tensor_driver.simulation.cubes import PadErrors, SimulatedCubes

DRIFT = 3e-4
PLAIN = replace(make_illustrative_calibration("cube"), drift=DRIFT)
DUMMY = with_dummy("cube", drift=DRIFT)


@pytest.mark.parametrize("layout", ["quad", "planar", "cube"])
@pytest.mark.parametrize("symmetry", ["slab", "mirrors"])
def test_a_dummy_pad_changes_no_coefficient(layout, symmetry):
    plain, dummy = make_illustrative_calibration(layout), with_dummy(layout)
    assert dummy.layout.pads == (*plain.layout.pads, "dummy")
    structures = [find_structure(one.layout, symmetry) for one in (plain, dummy)]
    assert structures[0].names == structures[1].names
    assert structures[1].pad_orbits[:-1] == structures[0].pad_orbits
    np.testing.assert_array_equal(structures[1].basis[:, :-1], structures[0].basis)
    assert not structures[1].basis[:, -1].any()


def test_two_dummy_pads_have_two_names():
    positions, normals = ([[0, 0, 1], [0, 0, 0], [0, 0, 0]] for _ in range(2))
    assert Layout("mine", positions, normals).pads == ("+z", "dummy", "dummy#2")


@pytest.mark.parametrize("layout", ["planar", "cube"])
def test_the_estimate_is_that_of_generalised_least_squares(layout):
    """Against the textbook formula with the covariance N = diag(noise²) + c c' of the pads."""
    random = np.random.default_rng(3)
    calibration = with_dummy(layout)
    a, modes = calibration.response, calibration.modes
    noise, c = random.uniform(2, 5, len(a)), random.uniform(100, 140, len(a))
    covariance = np.diag(noise**2) + np.outer(c, c)
    half = np.linalg.cholesky(np.linalg.inv(covariance))
    best = modes.components @ np.linalg.pinv(half.T @ a, rcond=1e-8) @ half.T
    found = make_estimator(a, noise, modes, drift=c)
    seen = found.observed
    np.testing.assert_allclose(found.matrix[seen], best[seen], atol=1e-6)
    both = found.covariance + np.outer(found.matrix @ c, found.matrix @ c)
    expected = best @ covariance @ best.T
    np.testing.assert_allclose(both[seen][:, seen], expected[seen][:, seen], rtol=1e-6, atol=1e-6)
    # Chi-square is that of the residuals, each with the standard deviation 1 under drift and noise.
    np.testing.assert_allclose(found.null @ covariance @ found.null.T, np.eye(found.dof), atol=1e-8)
    np.testing.assert_allclose(found.null @ a, 0, atol=1e-9)


def errors_of(calibration, pressure, n=400):
    """Mean error (15,) of a simulated cube whose pads have drifted by 300 ppm, and its scatter."""
    cubes = SimulatedCubes([calibration], PadErrors(None, drift=DRIFT), seed=2)
    stress = np.array([[-pressure, -pressure, -pressure, 0, 0, 0]])
    frequency = [cubes.compute_frequency(stress, np.zeros((1, 6, 3)), 1.0)[0] for _ in range(n)]
    rows = FrequencyRows.from_values(
        np.zeros(n), 1e-3 * np.array(frequency), stamp_ns=10_000_000 * np.arange(1, n + 1)
    )
    reconstruct = Reconstructor([calibration], np.float64)
    found = reconstruct(rows)
    error = np.hstack([found.stress - stress, found.gradient])
    return error.mean(axis=0), error.std(axis=0), reconstruct.compute_covariance(0), found


def test_a_dummy_pad_separates_drift_from_pressure():
    deviation = DRIFT * PLAIN.modulus[0] * (1 + PLAIN.beta[0])
    bare, _, stated, _ = errors_of(PLAIN, 0.0)
    # Without a dummy pad, the whole drift is read as pressure, and the covariance says so.
    assert np.abs(bare[:3]).min() > 120
    np.testing.assert_allclose(np.sqrt(np.diag(stated))[:3], np.abs(bare[:3]), rtol=0.02)
    # The dummy pad measures the drift, except for its noise.
    error, scatter, stated, found = errors_of(DUMMY, 0.0)
    noise = DUMMY.noise[0]
    plain = make_estimator(PLAIN.response, PLAIN.noise, PLAIN.modes)
    gain, own = plain.matrix[0].sum(), plain.covariance[0, 0]
    # Generalised least squares leaves the drift with the variance 1 / (1/deviation² + 1/noise²).
    known = 1 / (deviation**-2 + noise**-2)
    expected = own + gain**2 * known
    assert stated[0, 0] == pytest.approx(expected, rel=0.02)
    np.testing.assert_allclose(scatter[:3], np.sqrt(stated[0, 0]), rtol=0.12)
    # The mean error falls by noise² / (noise² + deviation²), below the error of the mean here.
    assert np.abs(error[:3]).max() < 4 * scatter[0] / np.sqrt(400)
    factor = noise**2 / (noise**2 + deviation**2)
    exact = Reconstructor([DUMMY], np.float64).pipeline.find_matrix(0) @ np.full(25, deviation)
    np.testing.assert_allclose(exact[:3], gain * deviation * factor, rtol=1e-6)
    assert found.residual.mean() == pytest.approx(1, abs=0.1)


def test_a_pressure_from_all_sides_is_not_taken_for_drift():
    _, _, _, found = errors_of(DUMMY, 5e3)
    # A drift multiplies the frequency, so it changes a load by 300 ppm (1 + beta) or so.
    np.testing.assert_allclose(found.stress[:, :3].mean(axis=0), -5e3, rtol=1e-3)


def test_without_the_dummy_pad_the_drift_is_pressure_again():
    """A dummy pad that breaks is left out like any other."""
    f = np.tile(DUMMY.rest_frequency * (1 + DRIFT), (2, 1))
    f[1, -1] = np.nan
    reconstruct = Reconstructor([DUMMY] * 2, np.float64)
    found = reconstruct(stamped(np.arange(2), f, 0, 0))
    assert np.abs(found.stress[0, :3]).max() < 0.2 and np.abs(found.stress[1, :3]).min() > 120
    covariances = [
        reconstruct.compute_covariance(0)[2, 2],
        reconstruct.compute_covariance(1, 1 << 24)[2, 2],
    ]
    assert np.sqrt(covariances[0]) < 5 and np.sqrt(covariances[1]) > 120
    assert (
        reconstruct.has_errors
        and not Reconstructor([make_illustrative_calibration("cube")]).has_errors
    )


def test_a_dummy_pad_is_not_called_stuck_or_drifting():
    """Neither while a load moves nor under one that grows slowly; and it may be noisy."""
    random = np.random.default_rng(0)
    response, rest = DUMMY.response, DUMMY.rest_frequency
    state = random.standard_normal(DUMMY.modes.n_modes)
    for size, end in ((lambda t: 10e3 * np.sin(3 * t), 6.0), (lambda t: 30 * t, 20.0)):
        reconstruct = Reconstructor([DUMMY])
        for time in np.arange(0.0, end, 0.01).tolist():
            v = size(time) * response @ state
            f = compute_pad_frequency(v, rest, DUMMY.beta, DUMMY.modulus)
            f[:-1] *= 1 + 8e-6 * random.standard_normal(24)
            reconstruct(stamped(np.zeros(1, np.uint16), f[None], 0, round(1e9 * time)))
        assert not reconstruct.health.state[0, -1]
    for step in range(200):
        f[-1] = rest[-1] * (1 + 1e-3 * random.standard_normal())
        reconstruct(stamped(np.zeros(1, np.uint16), f[None], 0, round(1e9 * end) + 10**7 * step))
    assert reconstruct.health.state[0, -1]
