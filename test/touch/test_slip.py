# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Stick, slip and friction of bodies that rub on a skin, by Coulomb, Cattaneo and Mindlin."""

from __future__ import annotations

import numpy as np
import pytest
from rubbed_skin import Body, RubbedSkin

from cube_tensor_design.studies.traction_study import CUBES, Setting, TractionBench
from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.defaults import CONTACT_PRESSURE
from cube_tensor_driver.touch.slip import SLIP, STICK, SlipEstimator
from cube_tensor_driver.touch.tracker.contact_tracker import ContactTracker

PERIOD_S = 1e-3
TRACKED_SCANS = 50
"""The tracker looks 20 times a second, as in the node."""


@pytest.fixture(scope="module")
def benches() -> list[TractionBench]:
    sparse = Setting(pitch=12e-3, depth=4e-3)
    settings = Setting(), sparse, Setting(cubes=CUBES[1])
    return [TractionBench(setting, side=2) for setting in settings]


class Run:
    """What the estimator says of one contact in each scan."""

    def __init__(self, bench: TractionBench, values: Array) -> None:
        tracker = ContactTracker(bench.inverse, CONTACT_PRESSURE)
        self.estimator = SlipEstimator(bench.inverse)
        self.states, self.velocity, self.begun = [], [], []
        for number, scan in enumerate(values):
            if number % TRACKED_SCANS == 0:
                self.estimator.adopt(tracker.update(scan), scan)
            if self.estimator.update(number * PERIOD_S, scan):
                self.begun.append(number)
            (state,) = self.estimator.slip.state
            self.states.append(state)
            self.velocity.append(self.estimator.slip.velocity[0])


def random_body(random: np.random.Generator) -> Body:
    is_ball = bool(random.integers(2))
    size = random.uniform(6e-3, 20e-3) if is_ball else random.uniform(2e-3, 6e-3)
    return Body(random.uniform(0.2, 1.2), size, is_ball)


@pytest.mark.parametrize("seed", range(3))
def test_gross_slip_is_reported_within_10_ms_with_its_friction(benches, seed):
    """Balls and punches of random friction and load, pulled at a random speed in any direction:
    first all of the contact sticks or only its rim slips, then all of it slips."""
    random = np.random.default_rng(seed)
    bench, body = benches[seed % 3], random_body(random)
    normal, speed, angle = random.uniform(1, 10), random.uniform(10e-3, 80e-3), random.uniform(0, 6)
    along, centre = np.array([np.cos(angle), np.sin(angle)]), 8e-3 * (random.random(2) - 0.5)
    skin, pads = RubbedSkin(bench, random), []
    for number in range(170):
        # Gross slip begins with scan 90.
        shift = body.slip_distance(normal) + (number - 89.5) * PERIOD_S * speed
        pull, slipped = body.pull(normal, max(shift, 0.0))
        pads.append(skin.pads(body, normal, pull * along, centre + slipped * along))
    run = Run(bench, skin.measure(np.array(pads)))

    assert len(run.begun) == 1 and 90 <= run.begun[0] <= 100
    assert SLIP not in run.states[:90] and run.states[4:85].count(STICK) == 81
    assert set(run.states[100:]) == {SLIP}
    slip = run.estimator.slip
    # Targets of the friction: 5 %. Its deviation: no more than four of them, and 1 %.
    error = abs(slip.friction[0] - body.friction)
    assert error < min(0.05 * body.friction, 4 * slip.friction_uncertainty[0])
    assert slip.friction_uncertainty[0] < 0.01
    assert slip.friction_use[0] == pytest.approx(1, abs=0.05)
    velocity = np.mean(run.velocity[100:], axis=0)
    np.testing.assert_allclose(velocity[:2], speed * along, atol=0.25 * speed)
