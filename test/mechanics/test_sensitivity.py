# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Sensitivity to the elastomer's data, against differences of other methods."""

from __future__ import annotations

import numpy as np
import pytest

from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.mechanics.contact_response import ContactResponse
from cube_tensor_driver.mechanics.layer import Layer
from cube_tensor_driver.mechanics.load_response import LoadResponse
from cube_tensor_driver.mechanics.measurement_model import CubeMeasurement
from cube_tensor_driver.mechanics.sensitivity import (
    DEPTH_DEVIATION,
    POISSON_DEVIATION,
    THICKNESS_DEVIATION,
)

DEPTH = 4e-3
"""Distance of the centres of the cubes from the surface, in m."""
HALF_SIDE = 2e-3
"""Half the side of a cube, in m."""
RADIUS = 3e-3
"""Radius of the Hertz contact, in m."""
FORCE = np.array([0.4, -0.3, -1.5])
UNITS = np.where(np.arange(15) < 6, 1.0, HALF_SIDE)
"""Factors that convert the components to Pa."""
TOLERANCE = 0.02
"""Error relative to the largest change. Linear interpolation between the tabulated radii leaves
1 %, differences of the truth over one standard deviation leave half as much."""


@pytest.fixture
def place():
    return np.random.default_rng(4).uniform(-2, 2, (20, 2)) * DEPTH


def changes_at(place, layer) -> np.ndarray:
    """(S, 20, 15) in cubes that are turned by 0.5 rad."""
    n = len(place)
    responses = ContactResponse(CubeMeasurement(layer, DEPTH, HALF_SIDE))
    turned, size = np.full(n, 0.5), np.full(n, RADIUS)
    return responses.compute_sensitivity(place, turned, size, np.tile(FORCE, (n, 1))).swapaxes(0, 1)


def below_a_ball(place, depth, poisson) -> np.ndarray:
    """(20, 15) of point forces, in the frame of the cubes."""
    cosine, sine = np.cos(0.5), np.sin(0.5)
    into_cubes = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    points = np.column_stack([place, np.full(len(place), -depth)]) @ into_cubes.T
    load = contact.hertz(RADIUS, into_cubes @ FORCE, order=12)
    stress, gradient = contact.field(points, *load, poisson)
    return np.concatenate([stress, gradient[:, :3].reshape(-1, 9)], axis=1) * UNITS


def test_depth_and_poissons_ratio_change_the_stress_as_point_forces_say(place):
    by_depth, by_poisson = changes_at(place, Layer(poisson=0.47))
    half = DEPTH * DEPTH_DEVIATION / 2
    expected = below_a_ball(place, DEPTH + half, 0.47) - below_a_ball(place, DEPTH - half, 0.47)
    np.testing.assert_allclose(by_depth, expected, atol=TOLERANCE * np.abs(expected).max())
    half = POISSON_DEVIATION / 2
    expected = below_a_ball(place, DEPTH, 0.47 + half) - below_a_ball(place, DEPTH, 0.47 - half)
    np.testing.assert_allclose(by_poisson, expected, atol=TOLERANCE * np.abs(expected).max())


def test_the_thickness_changes_the_stress_as_a_sum_of_waves_says(place):
    thickness = 8e-3
    by_thickness = changes_at(place, Layer(thickness, 0.47))[2]
    thin, thick = (
        LoadResponse(
            Layer(thickness * (1 + sign * THICKNESS_DEVIATION / 2), 0.47), DEPTH, 2 * RADIUS
        )
        for sign in (-1, 1)
    )
    angle = np.full(len(place), 0.5)
    expected = (thick(place, angle) - thin(place, angle)) @ FORCE * UNITS
    np.testing.assert_allclose(by_thickness, expected, atol=TOLERANCE * np.abs(expected).max())
