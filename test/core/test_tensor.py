# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Tensor algebra against its definitions."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.core.forces import Forces
from cube_tensor_driver.core.modes import SPACE, to_matrix, to_voigt
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.core.symmetry import find_group
from cube_tensor_driver.core.tensor import (
    compute_contact_wrench,
    compute_invariants,
    compute_principal_stresses,
    compute_traction,
    compute_von_mises,
    quaternion_from_rpy,
    rotate_gradient,
    rotate_stress,
    rotation_from_quaternion,
    rotation_from_rpy,
)

ANGLES = st.tuples(*[st.floats(-3.1, 3.1)] * 3)
RNG = np.random.default_rng(0)
STRESS = RNG.normal(size=(20, 6))


def test_principal_stresses_are_tractions_along_their_directions():
    values, directions = compute_principal_stresses(STRESS)
    assert np.all(np.diff(values, axis=1) <= 0)
    for k in range(3):
        np.testing.assert_allclose(
            compute_traction(STRESS, directions[:, k]),
            values[:, k, None] * directions[:, k],
            atol=1e-12,
        )
    np.testing.assert_allclose(
        directions @ directions.transpose(0, 2, 1), np.tile(np.eye(3), (20, 1, 1)), atol=1e-12
    )
    values, directions = compute_principal_stresses(
        np.array([[np.nan, 0, 0, 0, 0, 0], [1, 2, 3, 0, 0, 0]])
    )
    assert (
        np.isnan(values[0]).all()
        and np.isnan(directions[0]).all()
        and values[1].tolist() == [3, 2, 1]
    )


def test_invariants_are_those_of_the_principal_stresses():
    a, b, c = compute_principal_stresses(STRESS)[0].T
    np.testing.assert_allclose(
        compute_invariants(STRESS),
        np.stack([a + b + c, a * b + b * c + c * a, a * b * c], 1),
        atol=1e-12,
    )
    np.testing.assert_allclose(
        compute_von_mises(STRESS),
        np.sqrt(((a - b) ** 2 + (b - c) ** 2 + (c - a) ** 2) / 2),
        atol=1e-12,
    )
    assert compute_von_mises(np.array([5.0, 0, 0, 0, 0, 0])) == 5  # uniaxial
    assert compute_von_mises(np.array([0, 0, 0, 0, 2.0, 0])) == pytest.approx(
        2 * np.sqrt(3)
    )  # shear


def test_traction_on_the_faces_is_a_column():
    s = np.array([1.0, 2, 3, 4, 5, 6])  # xx yy zz yz zx xy
    assert compute_traction(s, [0, 0, 7]).tolist() == [5, 4, 3]
    assert compute_traction(s, [-1, 0, 0]).tolist() == [-1, -6, -5]
    with pytest.raises(CubeError, match="length 0"):
        compute_traction(s, [0, 0, 0])


@given(ANGLES)
def test_a_turned_field_is_the_field_at_the_turned_point(rpy):
    """sigma'(R x) = R sigma(x) R', and equilibrium survives."""
    r, x = rotation_from_rpy(*rpy), np.array([0.3, -0.2, 0.7])
    s, g = STRESS, SPACE.gradient[-len(STRESS) :]
    there = to_matrix(s) + g @ x
    turned = to_matrix(rotate_stress(s, r)) + rotate_gradient(g, r) @ (r @ x)
    np.testing.assert_allclose(turned, r @ there @ r.T, atol=1e-12)
    np.testing.assert_allclose(np.einsum("...ijj->...i", rotate_gradient(g, r)), 0, atol=1e-12)


def test_rotations_agree_with_the_groups_action():
    state = RNG.normal(size=21)
    for r in find_group("full")[::5]:
        rotated = SPACE.compute_action(r) @ state
        stress, gradient = (
            rotated @ to_voigt(SPACE.stress),
            np.tensordot(rotated, SPACE.gradient, 1),
        )
        before, slope = state @ to_voigt(SPACE.stress), np.tensordot(state, SPACE.gradient, 1)
        np.testing.assert_allclose(stress, rotate_stress(before, r), atol=1e-12)
        np.testing.assert_allclose(gradient, rotate_gradient(slope, r), atol=1e-12)


@given(ANGLES)
def test_rpy_and_quaternions_agree(rpy):
    roll, pitch, yaw = rpy

    def turn(axis: int, angle: float) -> np.ndarray:
        r, c, s = np.eye(3), np.cos(angle), np.sin(angle)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        r[i, i], r[i, j], r[j, i], r[j, j] = c, -s, s, c
        return r

    r = rotation_from_rpy(*rpy)
    np.testing.assert_allclose(r, turn(2, yaw) @ turn(1, pitch) @ turn(0, roll), atol=1e-12)
    q = quaternion_from_rpy(*rpy)
    assert q[3] >= 0 and np.linalg.norm(q) == pytest.approx(1)
    np.testing.assert_allclose(rotation_from_quaternion(3 * q), r, atol=1e-9)


def test_quaternions_are_in_ros_order():
    np.testing.assert_allclose(
        quaternion_from_rpy(0, 0, np.pi / 2), [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-15
    )
    for bad in ([0, 0, 0, 0], [np.nan, 0, 0, 1]):
        with pytest.raises(CubeError, match="quaternion"):
            rotation_from_quaternion(bad)


def test_the_wrench_is_the_integral_over_the_face():
    stress = np.array([[1.0, 2, 3, 4, 5, 6]])
    gradient = np.arange(1.0, 10)[None]
    side, n = 0.004, 400
    at = (np.arange(n) + 0.5) / n * side - side / 2
    x, y = np.meshgrid(at, at, indexing="ij")
    zz = 3 + gradient[0, 6] * x + gradient[0, 7] * y
    area = (side / n) ** 2
    force, torque = compute_contact_wrench(stress, gradient, side)
    np.testing.assert_allclose(force[0], [5 * side**2, 4 * side**2, zz.sum() * area])
    np.testing.assert_allclose(
        torque[0], [(y * zz).sum() * area, -(x * zz).sum() * area, 0], rtol=1e-4
    )
    force, torque = compute_contact_wrench(np.full((1, 6), np.nan), np.full((1, 9), np.nan), side)
    assert not force.any() and not torque.any()


def test_forces_are_the_traction_of_the_parents_stress_on_each_turned_face():
    """One stress in the parent frame, seen by cubes that are turned in all ways."""
    angles = RNG.uniform(-3, 3, (20, 3))
    side = RNG.uniform(0.002, 0.006, 20)
    turned = np.array([rotation_from_rpy(*rpy) for rpy in angles])
    skin = SimpleNamespace(poses=CubePoses(RNG.normal(size=(20, 3)), turned, side / 2))
    parent = STRESS[0]
    seen = np.array([rotate_stress(parent, rotation.T) for rotation in turned])
    expected = side[:, None] ** 2 * compute_traction(parent, turned[:, :, 2])
    order = RNG.permutation(20)
    rows = StressRows.from_values(order, seen[order], np.zeros((20, 9)))
    np.testing.assert_allclose(Forces(skin)(rows), expected[order], atol=1e-15)
    whole = Forces(skin, side=0.01)(rows)
    np.testing.assert_allclose(whole, (0.01 / side[order, None]) ** 2 * expected[order], atol=1e-15)

    # the last row of each cube; a cube without one, and one that observes nothing, have NaN
    blind = np.where(np.arange(20)[:, None] == 4, np.nan, seen[:19][np.arange(20) % 19])
    rows = StressRows.from_values(np.arange(20) % 19, blind, np.zeros((20, 9)))
    force = Forces(skin).compute_in_parent_frame(rows)
    assert np.flatnonzero(np.isnan(force).any(axis=1)).tolist() == [4, 19]
    np.testing.assert_allclose(force[0], expected[0], atol=1e-15)
    flat = SimpleNamespace(poses=CubePoses(np.zeros((1, 3)), np.eye(3)[None], side[:1] / 2))
    planar = StressRows.from_values([0], [[1, np.nan, -3, np.nan, 2, np.nan]], np.zeros((1, 9)))
    np.testing.assert_allclose(Forces(flat)(planar), [np.array([2, 0, -3]) * side[0] ** 2])
