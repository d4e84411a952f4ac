# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Specific force at the cubes of a simulated skin that moves, against the equations of motion."""

from __future__ import annotations

import numpy as np
import pytest

from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.core.tensor import rotation_from_rpy
from cube_tensor_driver.simulation.motion import HeavyPads, MovingFrame, read_weight

G = 9.80665
R = 0.2
"""Distance of the cube from the axis, in m."""
TILT = rotation_from_rpy(0.4, -0.2, 0.9)
POSES = CubePoses(np.array([[R, 0.0, 0.0]]), TILT[None], np.array([0.002]))


def force_at(seconds, *knots):
    return HeavyPads(np.eye(3), POSES, knots).compute_stress(seconds)[0]


def test_a_skin_that_is_held_still_feels_its_weight():
    still = rotation_from_rpy(0.3, 0.5, 0.0)
    found = force_at(7.0, (0.0, 0, 0, 0, 0.3, 0.5, 0.0))
    np.testing.assert_allclose(found, (still @ TILT).T @ [0, 0, G], atol=1e-6)


def test_half_cosines_between_two_positions_are_a_shake():
    """x = A cos(2 pi 5 t), so that the acceleration is that times -(2 pi 5)²."""
    rate, amplitude = 2 * np.pi * 5, 0.02
    knots = [(0.1 * k, amplitude * (-1) ** k, 0, 0, 0, 0, 0) for k in range(11)]
    for seconds in (0.31, 0.55, 0.78):
        acceleration = -amplitude * rate**2 * np.cos(rate * seconds)
        expected = TILT.T @ [acceleration, 0, G]
        np.testing.assert_allclose(force_at(seconds, *knots), expected, atol=2e-3)


def test_a_turn_has_centripetal_and_tangential_acceleration():
    """yaw = (1 - cos(pi t)) / 2."""
    for seconds in (0.25, 0.5):
        rate = 0.5 * np.pi * np.sin(np.pi * seconds)
        change = 0.5 * np.pi**2 * np.cos(np.pi * seconds)
        expected = TILT.T @ [-R * rate**2, R * change, G]
        found = force_at(seconds, (0.0, *[0.0] * 6), (1.0, *[0.0] * 5, 1.0))
        np.testing.assert_allclose(found, expected, atol=1e-4)


def test_a_gyroscope_measures_along_the_axes_of_the_skin():
    """yaw = (1 - cos(pi t)) / 2, about the z axis of the world, of a skin that is tilted."""
    frame = MovingFrame([(0.0, 0, 0, 0, 0.3, 0.5, 0.0), (1.0, 0, 0, 0, 0.3, 0.5, 1.0)])
    rate = 0.5 * np.pi * np.sin(np.pi * 0.25)
    in_skin = rotation_from_rpy(0.3, 0.5, 0.0).T @ [0, 0, rate]
    np.testing.assert_allclose(frame.compute_angular_velocity(0.25), in_skin, atol=1e-5)


def test_a_file_without_weight_or_for_other_pads_is_refused():
    with pytest.raises(ConfigError, match="no weight of cubes with 24 pads; compute it"):
        read_weight("planar_slab", 24)
    with pytest.raises(ConfigError, match="no file 'none'"):
        read_weight("none", 24)
