# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Contacts on an arm that turns over while its weight cannot be compensated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from point_loads import below_ball

from cube_tensor_driver.config.skin import Elastomer
from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.compensation.models import WeightModel
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.simulation.motion import read_weight
from cube_tensor_driver.touch.contact_finder import ContactSettings, make_contact_finder
from cube_tensor_driver.touch.tracker.contact_tracker import ContactTracker

SIDE = 5
"""Number of cubes along each side of the skin."""
PITCH = 12e-3
"""Distance of neighbouring cubes in m."""
G = 9.81
"""Acceleration of gravity in m/s²."""
ELASTOMER = Elastomer(depth=5.5e-3, thickness=np.inf)


def test_turning_over_is_no_contact_and_hides_none_that_is_stronger():
    """The truth weighs 3 % more than the calibration states. The skin was tared with z upwards."""
    n = SIDE**2
    x, y = PITCH * (np.indices((SIDE, SIDE)).reshape(2, n) - SIDE // 2)
    poses = CubePoses(
        np.stack([x, y, 0 * x], axis=1), np.tile(np.eye(3), (n, 1, 1)), np.full(n, 2e-3)
    )
    response = read_weight("cube_11mm", 24)
    cube = replace(make_illustrative_calibration("cube"), weight=WeightModel(response))
    reconstruct = Reconstructor([cube] * n)
    finders = (
        make_contact_finder(ContactSettings(), poses, [cube] * n, ELASTOMER) for _ in range(3)
    )
    finder, blind, without_errors = finders
    touch = below_ball(poses, ELASTOMER.depth, 5e-3, (1e-3, 2e-3), (0, 0, -0.09))
    n_false = n_found = n_coarse = 0
    for change in ([0, 0, 2 * G], [0, 0, -2 * G], [G, 0, -G], [0, -G, -G]):
        pads = np.tile(1.03 * cube.gain * (response @ change), (n, 1))
        frequency = compute_pad_frequency(pads, cube.rest_frequency, cube.beta, cube.modulus)
        rows = FrequencyRows.from_values(
            np.arange(n, dtype=np.uint16),
            frequency,
            stamp_ns=10**9,
            specific_force=np.full((n, 3), np.nan),
        )
        found = reconstruct(rows)
        values = np.hstack([found.stress, found.gradient]).astype(float)
        errors = reconstruct.errors(np.arange(n), found.left_out)
        blind.update(0.0, values, found.left_out, 0 * found.status)
        n_false += len(blind.contacts)
        finder.update(0.0, values, found.left_out, found.status, errors=errors)
        assert not finder.contacts
        # Together 0.5 to 1.2 kPa at the depth of the cubes.
        both = values + touch, found.left_out, found.status
        without_errors.update(0.0, *both)
        n_found += len(without_errors.contacts)
        finder.update(0.0, *both, errors=errors)
        (contact,) = finder.contacts
        # Measured: 0.0897 to 0.0900 N, at most 0.25 standard deviations off.
        assert abs(contact.normal_force - 0.09) < 3 * contact.force_uncertainty < 5e-3
        finder.update(0.0, values, found.left_out, found.status, errors=errors)
        # Before its fit is ready, the contact is an integral of the pressure. Turning over is two
        # deviations. In the other poses, the integral is negative, and there is no contact yet.
        certain = 2.5 * finder._inverse.error_deviation
        tracker = ContactTracker(finder._inverse, 300.0)
        for coarse in tracker.update(values + touch, certain, max_work=0):
            n_coarse += 1
            assert abs(coarse.normal_force - 0.09) < 2.5 * coarse.force_uncertainty
            assert np.linalg.norm(coarse.position[:2] - [1e-3, 2e-3]) < coarse.position_uncertainty
    # Without the errors, the status bit COMPENSATION raises the threshold to 1.2 kPa.
    assert n_false and n_found == 1 and n_coarse
