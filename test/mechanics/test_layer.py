# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The layer in wavenumber space against point forces, and against finite elements."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("skfem", reason="needs skfem: pip install scikit-fem")

from pressed_layer import press_layer

from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.modes import COMPONENTS, STRESS, to_matrix
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
    turned = []
    for s, g, a in zip(stress, gradient, angle, strict=True):
        c, d = np.cos(a), np.sin(a)
        turn = np.array([[c, d, 0], [-d, c, 0], [0, 0, 1]])
        matrix = turn @ to_matrix(s) @ turn.T
        slopes = np.einsum("ia,jb,kc,cab->ijk", turn, turn, turn, to_matrix(g.T))
        uniform = [matrix["xyz".index(n[0]), "xyz".index(n[1])] for n in STRESS]
        turned.append([*uniform, *(SCALE * slopes[i, i, k] for i in range(3) for k in range(3))])
    return np.array(turned)


@pytest.mark.parametrize(("size", "tolerance"), [(0.8e-3, 1e-4), (5e-3, 1e-3)])
def test_hertz_contact_on_a_half_space_is_that_of_point_forces(half_space, size, tolerance):
    """Stress and gradient in cubes at any place, turned by any angle."""
    random = np.random.default_rng(1)
    place, angle = random.uniform(-0.02, 0.02, (30, 2)), random.uniform(-3, 3, 30)
    below = np.column_stack([place, np.full(30, -DEPTH)])
    seen = ContactResponse(half_space).response(place, angle, POINTS[:30], size)
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
        transfer = layer.transfer(np.array([1e-3, 0.0]), np.zeros(2), depth)
        assert transfer[:, FIELD.index("zz"), 2] == pytest.approx([1, 1], abs=1e-8)
        assert transfer[:, FIELD.index("zx"), 0] == pytest.approx([1, 1], abs=1e-8)
    side = transfer[:, FIELD.index("xx"), 2]  # confined: nu / (1 - nu)
    assert side == pytest.approx([0.48 / 0.52] * 2, rel=1e-6)


def test_a_layer_is_in_equilibrium_and_sticks_to_its_ground():
    """div sigma = 0 at all wavenumbers; at the ground the strain along it vanishes."""
    random = np.random.default_rng(2)
    kx, ky = random.normal(size=(2, 50)) * 400
    layer = Layer(8e-3, 0.45)
    field = layer.transfer(kx, ky, 3e-3)
    for row in ("x", "y", "z"):
        pairs = [("".join(sorted(row + other)), other) for other in "xyz"]
        names = [{"xz": "zx"}.get(pair, pair) + f"_{axis}" for pair, axis in pairs]
        total = sum(field[:, FIELD.index(name)] for name in names)
        assert np.abs(total).max() < 1e-10 * np.abs(field).max()
    xx, yy, zz = (layer.transfer(kx, ky, 8e-3 - 1e-12)[:, k] for k in range(3))
    strain = xx - 0.45 * (yy + zz)
    assert np.abs(strain).max() < 1e-8 * np.abs(xx).max()


def test_stress_in_a_layer_is_that_of_finite_elements():
    """A rigid flat punch without friction on a bonded layer: its contact pressure, from the
    elements, makes at depth the stress that the elements have there."""
    punch = press_layer(thickness=8e-3, radius=3e-3, poisson=0.45, width=40e-3)
    responses = ContactResponse(CubeMeasurement(Layer(8e-3, 0.45), 4e-3, SCALE))
    at = np.array([0.5e-3, 2e-3, 5e-3, 9e-3])
    seen = np.zeros((len(at), 15))
    for radius, force in zip(punch.radius, punch.force, strict=True):  # rings of small discs
        angle = 2 * np.pi * np.arange(48) / 48
        ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        for place, row in zip(at, seen, strict=True):
            response = responses.response(
                np.array([place, 0.0]) - ring, 0 * angle, POINTS[:48], 0.5e-3
            )
            row += response.mean(axis=0) @ [0, 0, -force]
    found = punch.stress(at, 4e-3)
    scale = np.abs(found[:, 2]).max()
    for name, column in (("xx", 0), ("yy", 1), ("zz", 2), ("zx", 3)):
        error = np.abs(seen[:, COMPONENTS.index(name)] - found[:, column])
        assert error.max() < 0.01 * scale, name


def test_covariances_of_the_prior_are_sums_over_its_waves(half_space):
    """int T S T* exp(i k.p) on a square grid of k, without Bessel functions and turning."""
    place, angle = np.array([[2e-3, 1e-3], [-3e-3, 4e-3]]), np.array([0.4, -1.0])
    line = (np.arange(-80, 80) + 0.5) * 12 / 80 / DEPTH
    kx, ky = (part.ravel() for part in np.meshgrid(line, line))
    square = (kx**2 + ky**2) * DEPTH**2
    lengths = np.array(PRIOR_LENGTHS)
    prior = np.mean([2 * np.pi * l**2 * np.exp(-square * l**2 / 2) for l in lengths], axis=0)
    prior *= DEPTH**2 * (line[1] - line[0]) ** 2 / (2 * np.pi) ** 2
    transfer = half_space.layer.transfer(kx, ky, DEPTH)
    shift = np.exp(1j * (np.stack([kx, ky], axis=1) @ (place[0] - place[1])))
    weighted = transfer * (prior * shift)[:, None, None] * [SHEAR_RATIO**2, SHEAR_RATIO**2, 1.0]
    matrix = np.einsum("nai,nbi->ab", weighted, transfer.conj(), optimize=True).real
    views = []
    for one in angle:  # (15, 24): what a turned cube reports of each unit field
        unit = np.eye(24)
        views.append(in_cube_frames(unit[:, :6], unit[:, 6:].reshape(-1, 6, 3), np.full(24, one)).T)
    expected = views[0] @ matrix @ views[1].T
    found = TractionPrior(half_space).covariance(
        place[:1] - place[1:], angle[:1], POINTS[:1], angle[1:], POINTS[:1]
    )[0]
    assert np.abs(found - expected).max() < 2e-3 * np.abs(expected).max()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Layer(0.0), "thickness is 0.0"),
        (lambda: Layer(1e-2, 0.6), "0.6"),
        (lambda: Layer(3e-3).transfer(np.ones(1), np.ones(1), 4e-3), "between 0 and"),
    ],
)
def test_what_no_layer_is(make, words):
    with pytest.raises(ElasticError, match=words):
        make()
