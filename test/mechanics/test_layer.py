# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The layer in wavenumber space against point forces; test_influence.py has finite elements."""

from __future__ import annotations

import numpy as np
import pytest
from point_loads import in_cubes

from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.tensor import rotation_from_rpy
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.mechanics.contact_response import ContactResponse
from cube_tensor_driver.mechanics.layer import FIELD, Layer
from cube_tensor_driver.mechanics.measurement_model import CubeMeasurement
from cube_tensor_driver.mechanics.traction_prior import PRIOR_LENGTHS, SHEAR_RATIO, TractionPrior

DEPTH, SCALE = 4e-3, 2e-3
POINTS = np.zeros(48, np.intp)
"""Which reading cubes have that count as points: there is one."""


@pytest.fixture(scope="module")
def half_space():
    return CubeMeasurement(Layer(poisson=0.3), DEPTH, SCALE)


def in_cube_frames(stress, gradient, angle):
    """(N, 15) components, gradients times SCALE, of fields (N, 6) and (N, 6, 3) in turned cubes."""
    rotation = np.array([rotation_from_rpy(0, 0, one) for one in angle])
    field = np.concatenate([stress, gradient.reshape(-1, 18)], axis=1)
    return in_cubes(field, rotation) * np.where(np.arange(15) < 6, 1.0, SCALE)


@pytest.mark.parametrize(("size", "tolerance"), [(0.8e-3, 1e-4), (5e-3, 1e-3)])
def test_hertz_contact_on_a_half_space_is_that_of_point_forces(half_space, size, tolerance):
    """Stress and gradient in cubes at any place, turned by any angle."""
    random = np.random.default_rng(1)
    place, angle = random.uniform(-0.02, 0.02, (30, 2)), random.uniform(-3, 3, 30)
    below = np.column_stack([place, np.full(30, -DEPTH)])
    seen = ContactResponse(half_space).compute_response(place, angle, POINTS[:30], size)
    for axis in range(3):
        stress, gradient = contact.field(
            below, *contact.hertz(size, np.eye(3)[axis], order=20), 0.3
        )
        expected = in_cube_frames(stress, gradient, angle)
        error = np.abs(seen[:, :, axis] - expected)
        assert error.max() < tolerance * np.abs(expected).max()


def test_a_layer_presses_on_its_ground_with_the_whole_force():
    """The mean of sigma_zz over a plane is that of the traction, at every depth (equilibrium)."""
    layer = Layer(11e-3, 0.48)
    for depth in (1e-3, 5e-3, 10.9e-3):
        transfer = layer.compute_transfer(np.array([1e-3, 0.0]), np.zeros(2), depth)
        assert transfer[:, FIELD.index("zz"), 2] == pytest.approx([1, 1], abs=1e-8)
        assert transfer[:, FIELD.index("zx"), 0] == pytest.approx([1, 1], abs=1e-8)
    side = transfer[:, FIELD.index("xx"), 2]  # confined: nu / (1 - nu)
    assert side == pytest.approx([0.48 / 0.52] * 2, rel=1e-6)


def test_a_layer_is_in_equilibrium_and_sticks_to_its_ground():
    """div sigma = 0 at all wavenumbers; at the ground the strain along it vanishes."""
    random = np.random.default_rng(2)
    kx, ky = random.normal(size=(2, 50)) * 400
    layer = Layer(8e-3, 0.45)
    field = layer.compute_transfer(kx, ky, 3e-3)
    for row in ("x", "y", "z"):
        pairs = [("".join(sorted(row + other)), other) for other in "xyz"]
        names = [{"xz": "zx"}.get(pair, pair) + f"_{axis}" for pair, axis in pairs]
        total = sum(field[:, FIELD.index(name)] for name in names)
        assert np.abs(total).max() < 1e-10 * np.abs(field).max()
    xx, yy, zz = (layer.compute_transfer(kx, ky, 8e-3 - 1e-12)[:, k] for k in range(3))
    strain = xx - 0.45 * (yy + zz)
    assert np.abs(strain).max() < 1e-8 * np.abs(xx).max()


def test_covariances_of_the_prior_are_sums_over_its_waves(half_space):
    """int T S T* exp(i k.p) on a square grid of k, without Bessel functions and turning."""
    place, angle = np.array([[2e-3, 1e-3], [-3e-3, 4e-3]]), np.array([0.4, -1.0])
    line = (np.arange(-80, 80) + 0.5) * 12 / 80 / DEPTH
    kx, ky = (part.ravel() for part in np.meshgrid(line, line))
    square = (kx**2 + ky**2) * DEPTH**2
    lengths = np.array(PRIOR_LENGTHS)
    prior = np.mean([2 * np.pi * l**2 * np.exp(-square * l**2 / 2) for l in lengths], axis=0)
    prior *= DEPTH**2 * (line[1] - line[0]) ** 2 / (2 * np.pi) ** 2
    transfer = half_space.layer.compute_transfer(kx, ky, DEPTH)
    shift = np.exp(1j * (np.stack([kx, ky], axis=1) @ (place[0] - place[1])))
    weighted = transfer * (prior * shift)[:, None, None] * [SHEAR_RATIO**2, SHEAR_RATIO**2, 1.0]
    matrix = np.einsum("nai,nbi->ab", weighted, transfer.conj(), optimize=True).real
    views = []
    for one in angle:  # (15, 24): what a turned cube reports of each unit field
        unit = np.eye(24)
        views.append(in_cube_frames(unit[:, :6], unit[:, 6:].reshape(-1, 6, 3), np.full(24, one)).T)
    expected = views[0] @ matrix @ views[1].T
    found = TractionPrior(half_space).compute_covariance(
        place[:1] - place[1:], angle[:1], POINTS[:1], angle[1:], POINTS[:1]
    )[0]
    assert np.abs(found - expected).max() < 2e-3 * np.abs(expected).max()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Layer(0.0), "thickness is 0.0"),
        (lambda: Layer(1e-2, 0.6), "0.6"),
        (lambda: Layer(3e-3).compute_transfer(np.ones(1), np.ones(1), 4e-3), "between 0 and"),
    ],
)
def test_what_no_layer_is(make, words):
    with pytest.raises(ElasticError, match=words):
        make()
