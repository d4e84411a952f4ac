# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Contact fields against mechanics: balance, compatibility, boundary, total force, Hertz."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.mechanics import contact

FULL = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])  # matrix position -> component

coordinate = st.floats(-3.0, 3.0)
depth = st.floats(0.3, 3.0)
point = st.tuples(coordinate, coordinate, depth.map(lambda h: -h)).map(np.array)
force = (
    st.tuples(coordinate, coordinate, coordinate)
    .map(np.array)
    .filter(lambda f: np.linalg.norm(f) > 0.01)
)
poisson = st.floats(0.0, 0.5)


def one(x, f, nu):
    """Stress (3, 3) and gradient (3, 3, 3) at x for a force f at the origin."""
    stress, gradient = contact.field([x], np.zeros((1, 3)), [f], nu)
    return stress[0][FULL], gradient[0][FULL]


@given(point, force, poisson)
def test_equilibrium(x, f, nu):
    _, gradient = one(x, f, nu)
    assert np.einsum("ijj->i", gradient) == pytest.approx(
        0.0, abs=1e-12 * (1 + abs(gradient).max())
    )


@given(point, force, poisson)
def test_gradient_is_the_derivative_of_the_stress(x, f, nu):
    _, gradient = one(x, f, nu)
    h = 1e-4
    steps = [(one(x + h * e, f, nu)[0] - one(x - h * e, f, nu)[0]) / (2 * h) for e in np.eye(3)]
    scale = np.linalg.norm(f) / np.linalg.norm(x) ** 3
    assert np.abs(np.stack(steps, axis=-1) - gradient).max() <= 1e-6 * scale


@given(point, force, st.floats(0.0, 0.49))
def test_compatibility_beltrami_michell(x, f, nu):
    """Laplace sigma_ij + trace_,ij / (1 + nu) = 0: with balance and a free surface there is one
    answer."""
    h = 1e-4
    second = np.stack(
        [(one(x + h * e, f, nu)[1] - one(x - h * e, f, nu)[1]) / (2 * h) for e in np.eye(3)],
        axis=-1,
    )  # ijkl: d2 sigma_ij / dx_k dx_l
    residual = np.einsum("ijkk->ij", second) + np.einsum("mmij->ij", second) / (1 + nu)
    scale = np.linalg.norm(f) / np.linalg.norm(x) ** 4
    assert np.abs(residual).max() <= 1e-5 * scale


@given(coordinate, coordinate, force, poisson)
def test_surface_is_free_of_traction(x, y, f, nu):
    r = np.hypot(x, y)
    assume(r > 0.1)
    stress, _ = one(np.array([x, y, 0.0]), f, nu)
    assert np.abs(stress[2]).max() <= 1e-12 * np.linalg.norm(f) / r**2


@given(point, force, poisson, st.floats(0.0, 6.3))
def test_turning_the_load_turns_the_field(x, f, nu, angle):
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    stress, gradient = one(x, f, nu)
    turned_stress, turned_gradient = one(turn @ x, turn @ f, nu)
    scale = 1e-11 * np.linalg.norm(f) / np.linalg.norm(x) ** 2
    assert np.abs(turn @ stress @ turn.T - turned_stress).max() <= scale
    expected = np.einsum("ia,jb,kc,abc->ijk", turn, turn, turn, gradient)
    assert np.abs(expected - turned_gradient).max() <= scale / np.linalg.norm(x)


@given(point, force, poisson, st.floats(0.1, 10.0))
def test_scaling_of_length(x, f, nu, factor):
    stress, gradient = one(x, f, nu)
    wide_stress, wide_gradient = one(factor * x, f, nu)
    assert np.allclose(wide_stress * factor**2, stress, rtol=1e-9, atol=1e-12)
    assert np.allclose(wide_gradient * factor**3, gradient, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.48, 0.5])
def test_printed_components(nu):
    """The formulas of Johnson 3.2 and 3.6, in his axes (z down, so zx changes sign for us)."""
    x, y, z = 0.7, -0.4, 0.9
    r2, rho = x * x + y * y, np.sqrt(x * x + y * y + z * z)
    k = 1 / (2 * np.pi)
    pressed, _ = one(np.array([x, y, -z]), np.array([0, 0, -1.0]), nu)
    sxx = k * (
        (1 - 2 * nu) / r2 * ((1 - z / rho) * (x * x - y * y) / r2 + z * y * y / rho**3)
        - 3 * z * x * x / rho**5
    )
    sxy = k * (
        (1 - 2 * nu) / r2 * ((1 - z / rho) * 2 * x * y / r2 - x * y * z / rho**3)
        - 3 * x * y * z / rho**5
    )
    assert pressed[0, 0] == pytest.approx(sxx, rel=1e-12)
    assert pressed[2, 2] == pytest.approx(-3 * k * z**3 / rho**5, rel=1e-12)
    assert pressed[0, 2] == pytest.approx(3 * k * x * z * z / rho**5, rel=1e-12)
    assert pressed[0, 1] == pytest.approx(sxy, rel=1e-12)

    slid, _ = one(np.array([x, y, -z]), np.array([1.0, 0, 0]), nu)
    a = rho + z
    sxx = k * (
        -3 * x**3 / rho**5
        + (1 - 2 * nu)
        * (x / rho**3 - 3 * x / (rho * a**2) + x**3 / (rho**3 * a**2) + 2 * x**3 / (rho**2 * a**3))
    )
    syy = k * (
        -3 * x * y * y / rho**5
        + (1 - 2 * nu)
        * (
            x / rho**3
            - x / (rho * a**2)
            + x * y * y / (rho**3 * a**2)
            + 2 * x * y * y / (rho**2 * a**3)
        )
    )
    assert slid[0, 0] == pytest.approx(sxx, rel=1e-12)
    assert slid[1, 1] == pytest.approx(syy, rel=1e-12)
    assert slid[2, 2] == pytest.approx(-3 * k * x * z * z / rho**5, rel=1e-12)
    assert slid[0, 2] == pytest.approx(3 * k * x * x * z / rho**5, rel=1e-12)


def test_force_over_a_plane_below():
    """The traction on z = -1 carries the force: integrated over a disc of radius 2000 depths."""
    f = np.array([0.3, -0.2, -1.0])
    t, weight = np.polynomial.legendre.leggauss(60)
    top = np.arctan(2000.0)
    angle = (t + 1) / 2 * top  # r = tan(angle) opens up the far field
    r, weight = np.tan(angle), weight / 2 * top / np.cos(angle) ** 2
    phi = 2 * np.pi * np.arange(16) / 16
    points = np.stack(
        [np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi)), np.full((60, 16), -1.0)], axis=-1
    ).reshape(-1, 3)
    stress, _ = contact.field(points, np.zeros((1, 3)), [f], 0.4)
    area = np.repeat(weight * r * 2 * np.pi / 16, 16)
    below = (area[:, None] * stress[:, [4, 3, 2]]).sum(
        axis=0
    )  # the lower part has the outward normal +z
    assert below == pytest.approx(f, abs=1e-3)  # what lies beyond the disc: 3 F / (2 * 2000)


@pytest.mark.parametrize("nu", [0.3, 0.48])
def test_hertz_on_the_axis(nu):
    """Johnson 3.4; the stress on the axis under the pressure p0 sqrt(1 - r^2/a^2)."""
    a, load = 1e-3, 2.0
    p0 = 3 * load / (2 * np.pi * a**2)
    h = np.array([0.5, 1.0, 2.0, 5.0])
    points = np.stack([0 * h, 0 * h, -a * h], axis=-1)
    stress, gradient = contact.field(points, *contact.hertz(a, [0, 0, -load], order=20), nu)
    side = -p0 * ((1 + nu) * (1 - h * np.arctan(1 / h)) - 0.5 / (1 + h * h))
    assert stress[:, 0] == pytest.approx(side, rel=1e-5, abs=1e-5 * p0)
    assert stress[:, 1] == pytest.approx(side, rel=1e-5, abs=1e-5 * p0)
    assert stress[:, 2] == pytest.approx(-p0 / (1 + h * h), rel=1e-5)
    assert gradient[:, 2, 2] == pytest.approx(-p0 / a * 2 * h / (1 + h * h) ** 2, rel=1e-4)


@pytest.mark.parametrize(
    "patch",
    [
        lambda n: contact.disc(1.0, [0.3, 0, -1], order=n),
        lambda n: contact.hertz(1.0, [0.3, 0, -1], order=n),
    ],
)
def test_patches_converge_and_carry_their_force(patch):
    points = np.array([[0.2, 0.1, -0.5], [0.9, 0.3, -0.5], [2.0, -1.0, -0.5]])
    exact, _ = contact.field(points, *patch(24), 0.4)
    errors = [np.abs(contact.field(points, *patch(n), 0.4)[0] - exact).max() for n in (2, 4, 8)]
    assert errors[1] < errors[0] / 4 and errors[2] < errors[1] / 16
    assert errors[2] < 1e-3 * np.abs(exact).max()
    assert patch(5)[1].sum(axis=0) == pytest.approx([0.3, 0, -1])


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.5, 4.0])
def test_a_hertz_contact_is_good_at_the_depth_that_its_order_is_for(ratio):
    x = np.linspace(0, 3, 41)
    points = np.stack([x, 0.3 * x, np.full(len(x), -1.0)], axis=1)
    order = contact.choose_hertz_order(ratio, 1.0)
    made = contact.field(points, *contact.hertz(ratio, [0.3, 0, -1], order=order), 0.48)
    exact = contact.field(points, *contact.hertz(ratio, [0.3, 0, -1], order=40), 0.48)
    for a, b in zip(made, exact, strict=True):
        assert np.abs(a - b).max() < 1e-3 * np.abs(b).max()


@pytest.mark.parametrize("radius, depth", [(0.0, 1.0), (1.0, 0.0), (1.0, -1.0)])
def test_no_order_without_a_contact_above_the_point(radius, depth):
    with pytest.raises(ElasticError, match="radius is"):
        contact.choose_hertz_order(radius, depth)


def test_leading_axes_broadcast():
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (4, 3)) - [0, 0, 1.5]
    sources = rng.uniform(-1, 1, (5, 7, 3)) * [1, 1, 0]
    forces = rng.normal(size=(5, 7, 3))
    stress, gradient = contact.field(points, sources, forces, 0.45)
    assert stress.shape == (5, 4, 6) and gradient.shape == (5, 4, 6, 3)
    alone = contact.field(points, sources[3], forces[3], 0.45)
    assert np.allclose(stress[3], alone[0], rtol=1e-12) and np.allclose(
        gradient[3], alone[1], rtol=1e-12
    )


@pytest.mark.parametrize(
    "points, sources, forces, nu, words",
    [
        ([[0, 0, 1.0]], [[0, 0, 0]], [[0, 0, 1]], 0.3, "negative z"),
        ([[0, 0, -1.0]], [[0, 0, 0.1]], [[0, 0, 1]], 0.3, "z = 0"),
        ([[0, 0, -1.0]], [[0, 0, 0]], [[0, 0, 1]], 0.51, r"0\.51"),
        ([[0, 0, 0.0]], [[0, 0, 0]], [[0, 0, 1]], 0.3, "below the surface"),
        ([[0, 0, -1.0]], [[0, 0, 0]], [[0, 0, 1], [0, 0, 1]], 0.3, "1 sources but 2 forces"),
        ([[0, 0, np.nan]], [[0, 0, 0]], [[0, 0, 1]], 0.3, "finite"),
        ([[0, 0]], [[0, 0, 0]], [[0, 0, 1]], 0.3, "shape"),
    ],
)
def test_bad_input(points, sources, forces, nu, words):
    with pytest.raises(ElasticError, match=words):
        contact.field(points, sources, forces, nu)


def test_bad_patches():
    with pytest.raises(ElasticError, match="radius"):
        contact.disc(0.0, [0, 0, 1])
    with pytest.raises(ElasticError, match="order"):
        contact.hertz(1.0, [0, 0, 1], order=0)
