# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Response to Hertz contacts: its derivatives, and the stress far beyond the tables."""

from __future__ import annotations

import numpy as np
import pytest

from cube_tensor_driver.core.modes import STRESS
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.mechanics.contact_response import ContactResponse
from cube_tensor_driver.mechanics.layer import Layer
from cube_tensor_driver.mechanics.measurement_model import CubeMeasurement

DEPTH = 4e-3
"""Depth of the cubes' centres below the surface, in m."""
FORCE = np.array([0.4, -0.3, -1.5])
"""Force of the contact, in N."""


@pytest.fixture(scope="module")
def responses():
    return ContactResponse(CubeMeasurement(Layer(8e-3, 0.45), DEPTH, 2e-3))


def test_slopes_are_differences_of_the_response(responses):
    """The tolerances are ten times what central differences and single precision leave.

    The steps are a thousandth of the depth, and 2 % of the radius.
    """
    random = np.random.default_rng(4)
    place = random.uniform(-2, 2, (20, 2)) * DEPTH
    angle = random.uniform(-3, 3, 20)
    variant = np.zeros(20, np.intp)
    step, size = 1e-3 * DEPTH, 0.7 * DEPTH
    slopes = responses.compute_response_slopes(
        place, angle, variant, np.full(20, size), np.tile(FORCE, (20, 1))
    )

    def under_force(place: np.ndarray, size: float = size) -> np.ndarray:
        return responses.compute_response(place, angle, variant, size) @ FORCE

    def assert_close(found: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
        largest = np.abs(expected).max()
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * largest)

    unit = responses.compute_response(place, angle, variant, size).swapaxes(1, 2)
    assert_close(slopes[:, :3], unit, 1e-6)
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        # The cubes move against the contact.
        difference = under_force(place - shift) - under_force(place + shift)
        assert_close(slopes[:, 3 + axis], difference / (2 * step), 1e-5)
    wider, narrower = (under_force(place, size * np.exp(sign * 0.02)) for sign in (1, -1))
    assert_close(slopes[:, 5], (wider - narrower) / 0.04, 2e-3)
    assert_close(slopes[:, 6], (wider + narrower - 2 * under_force(place)) / 0.02**2, 1e-4)


def test_a_moment_is_a_pair_of_forces(responses):
    """A moment of 1 N m about z is that of four forces of 1 / (4 h), each at the distance h.

    Two act along y at x = h and against y at x = -h, the others along x and against it.
    """
    random = np.random.default_rng(5)
    place = random.uniform(-2, 2, (20, 2)) * DEPTH
    angle, variant = np.zeros(20), np.zeros(20, np.intp)
    size, h = 0.7 * DEPTH, 1e-3 * DEPTH
    slopes = responses.compute_response_slopes(
        place, angle, variant, np.full(20, size), np.tile(FORCE, (20, 1))
    )
    moment = 0.0
    for sign in (1, -1):
        for axis, across, turn in ((0, 1, 1), (1, 0, -1)):
            centre = sign * h * np.eye(2)[axis]
            unit = responses.compute_response(place - centre, angle, variant, size)
            moment = moment + sign * turn * unit[:, :, across] / (4 * h)
    np.testing.assert_allclose(slopes[:, 7], moment, rtol=0, atol=2e-5 * np.abs(moment).max())


def test_distant_contacts_cause_stress_beyond_the_tables():
    """At 19 depths the tables hold the stress, at 21 and 40 it is extrapolated.

    The tolerance of 0.5 Pa is a sixth of the noise of a pad.
    """
    half_space = ContactResponse(CubeMeasurement(Layer(np.inf, 0.48), DEPTH, 2e-3))
    direction = np.array([0.8, 0.6])
    for depths in (19, 21, 40):
        place = depths * DEPTH * direction
        expected, _ = contact.field(
            np.array([[*place, -DEPTH]]), np.zeros((1, 3)), FORCE[None], 0.48
        )
        size, variant = 0.7 * DEPTH, np.zeros(1, np.intp)
        cubic = half_space.compute_response(place[None], np.zeros(1), variant, size) @ FORCE
        linear = half_space.compute_response_to_forces(
            place[None], np.zeros(1), variant, np.array([size]), FORCE[None]
        )
        for found in (cubic, linear):
            np.testing.assert_allclose(found[:, : len(STRESS)], expected, rtol=0, atol=0.5)
