# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Imperfect pads: creep against its closed form, and spread and failure as often as asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.simulation.imperfections import (
    NONE,
    Imperfections,
    PadBehaviour,
    read_imperfections,
)
from cube_tensor_driver.simulation.source import simulate

CREEP = ((0.1, 0.5), (0.05, 20.0))


def test_foam_creeps_under_a_step_and_recovers():
    """v (1 + sum c (1 - exp(-t/tau))) while it is pressed for 3 s, and what is left of it after."""
    pads = PadBehaviour(Imperfections(creep=CREEP), (1, 1), 0)
    pads.compute_reported(np.zeros((1, 1)), 0.0)
    pressed, held = 1e4, 3.0
    for time in np.arange(0.01, 6.0, 0.01):
        found = pads.compute_reported(np.full((1, 1), pressed * (time < held + 5e-3)), time)[0, 0]
        loaded, after = min(time, held), max(time - held, 0.0)
        crept = sum(c * -np.expm1(-loaded / tau) * np.exp(-after / tau) for c, tau in CREEP)
        assert found == pytest.approx(pressed * (crept + (after < 5e-3)), rel=1e-9)


@pytest.mark.parametrize("exponent", [0.1, 0.2, 0.4])
def test_a_power_law_of_creep_follows_its_closed_form(exponent):
    """J = 1 + a (t^alpha - 1) up to 2 h of load, and after it (superposition).

    The terms from 1e-4 to 1e10 s leave 7e-6 of the fastest and 2e-5 of the slowest creep out.
    """
    spread = 0.2
    wanted = Imperfections(creep_growth=0.1, creep_exponent=exponent, creep_spread=spread, seed=1)
    pads = PadBehaviour(wanted, (50, 24), 0)
    held = 7200.0
    pads.compute_reported(np.zeros((50, 24)), 1.0)
    crept = {
        t: pads.compute_reported(np.ones((50, 24)), 1.0 + t)
        for t in (0.01, 1.0, 600.0, 3600.0, held)
    }
    growth = crept[600.0] - 1
    # Of 1200 pads; four standard deviations of the estimates.
    assert growth.mean() == pytest.approx(0.1, abs=4 * 0.1 * spread / np.sqrt(1200))
    assert growth.std() == pytest.approx(0.1 * spread, rel=4 / np.sqrt(2400))
    factor = growth / (600**exponent - 1)
    for time, found in crept.items():
        np.testing.assert_allclose(found, 1 + factor * (time**exponent - 1), atol=5e-5)
    after = pads.compute_reported(np.zeros((50, 24)), 1.0 + held + 10.0)
    left = factor * ((held + 10.0) ** exponent - 10.0**exponent)
    np.testing.assert_allclose(after, left, atol=5e-5)


def test_gains_spread_and_pads_fail_as_often_as_asked_for_and_always_alike():
    stress, wanted = np.full((500, 24), -1e4), Imperfections(gain_spread=0.05, dead=0.1, seed=3)
    found = PadBehaviour(wanted, stress.shape, 0).compute_reported(stress, 1.0)
    # Of 12,000 pads; four standard deviations of the estimates.
    assert np.isnan(found).mean() == pytest.approx(0.1, abs=4 * np.sqrt(0.09 / 12e3))
    assert np.nanstd(found / stress) == pytest.approx(0.05, rel=4 / np.sqrt(2 * 10.8e3))
    again = PadBehaviour(wanted, stress.shape, 0).compute_reported(stress, 1.0)
    np.testing.assert_array_equal(again, found)
    assert not np.array_equal(
        PadBehaviour(wanted, stress.shape, 1).compute_reported(stress, 1.0), found
    )


def test_a_simulated_skin_has_them():
    """Dead pads are NaN; creep shows after the load has lasted, and nothing else changes."""
    skin = read_skin(find_package_data() / "config" / "skin_demo.yaml")
    dead = next(iter(simulate(skin, imperfections=Imperfections(dead=0.5))))
    assert 0.2 < np.isnan(dead.frequency).mean() < 0.8
    sound, same, creeping = (
        list(simulate(skin, rate=10.0, duration=3.0, imperfections=one))[-1].frequency
        for one in (NONE, Imperfections(seed=1), Imperfections(creep=CREEP))
    )
    np.testing.assert_array_equal(same, sound)
    assert np.abs(creeping - sound).max() > 10


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"gain_spread": -0.1}, "gain_spread: found -0.1"),
        ({"dead": 2.0}, "dead: found 2.0"),
        ({"dead": float("nan")}, "dead: found nan"),
        ({"creep_growth": 0.5, "creep_exponent": 0.05}, "creep_growth: found 0.5, allowed: below"),
        ({"creep": ((0.1, 0.0),)}, r"creep\[0\]\[1\]: found 0.0, allowed: a time above 0 s"),
    ],
)
def test_values_out_of_range_are_named(asked, said):
    with pytest.raises(ConfigError, match=said):
        Imperfections(**asked)


def test_a_file_has_the_same_fields(tmp_path: Path):
    path = tmp_path / "worn.yaml"
    path.write_text("{gain_spread: 0.03, creep: [[0.1, 0.5], [0.05, 20]], seed: 3}")
    assert read_imperfections(path) == Imperfections(gain_spread=0.03, creep=CREEP, seed=3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[1]", r"top level: found \[1\], allowed: the keys gain_spread, dead, creep, .*seed"),
        ("{gain: 0.1}", "top level: unknown key 'gain', allowed: gain_spread"),
        ("{dead: many}", "dead: found 'many', allowed: a fraction"),
        ("{dead: 2}", "dead: found 2, allowed"),
        ("{seed: -1}", "seed: found -1, allowed"),
        ("{seed: 0.5}", "seed: found 0.5, allowed: a whole number"),
        ("{creep: [0.1, 0.5]}", r"creep\[0\]: found 0.1, allowed: \[size, seconds\]"),
    ],
)
def test_what_a_file_cannot_say_is_named(tmp_path: Path, text: str, said: str):
    path = tmp_path / "worn.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=f"worn.yaml: {said}"):
        read_imperfections(path)
