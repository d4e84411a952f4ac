# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation subtracts what is no load, and says so; against stresses that tests choose."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from cube_tensor_driver.core.calibration import Calibration, make_illustrative_calibration
from cube_tensor_driver.core.compensation.models import CreepModel, ThermalModel, WeightModel
from cube_tensor_driver.core.errors import CalibrationError
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.core.status import COMPENSATION, PAD_FAULT, WEIGHT

RNG = np.random.default_rng(1)
PLAIN = replace(make_illustrative_calibration("planar"), gain=1 + 0.05 * RNG.normal(size=8))
RESPONSE = 8 * RNG.normal(size=(8, 3))
HEAVY = replace(PLAIN, weight=WeightModel(RESPONSE))
CUBES = 3


def played(loads, forces, calibration: Calibration = HEAVY, **columns) -> FrequencyRows:
    """Rows of three cubes under loads (N, M) of modes and specific forces (N, 3)."""
    forces = np.broadcast_to(forces, (len(loads), 3))
    pads = loads @ calibration.response.T + forces @ (calibration.gain[:, None] * RESPONSE).T
    frequency = compute_pad_frequency(
        pads, calibration.rest_frequency, calibration.beta, calibration.modulus
    )
    scan = np.arange(len(loads)) // CUBES
    cube = np.arange(len(loads), dtype=np.uint16) % CUBES
    columns = {"specific_force": forces, **columns}
    return FrequencyRows.from_values(cube, frequency, stamp_ns=4_000_000 * (scan + 1), **columns)


def loads_of(n: int) -> np.ndarray:
    return 1e3 * np.random.default_rng(2).normal(size=(n, HEAVY.modes.n_modes))


def assert_same(found: StressRows, expected: StressRows) -> None:
    for field in fields(found):
        np.testing.assert_array_equal(
            getattr(found, field.name), getattr(expected, field.name), err_msg=field.name
        )


def test_weight_leaves_the_stress_of_the_load_alone():
    """Exact but for the float32 of the forces; without their column no bit changes."""
    loads, forces = loads_of(60), 20 * RNG.normal(size=(60, 3))
    rows = played(loads, forces)
    expected = Reconstructor([PLAIN] * CUBES, np.float64).process(played(loads, 0 * forces, PLAIN))
    found = Reconstructor([HEAVY] * CUBES, np.float64).process(rows)
    np.testing.assert_allclose(found.stress, expected.stress, atol=1e-3)
    np.testing.assert_allclose(found.gradient, expected.gradient, atol=1)
    assert (found.status == WEIGHT).all()
    off = replace(rows, specific_force=None)
    assert_same(
        Reconstructor([HEAVY] * CUBES).process(off), Reconstructor([PLAIN] * CUBES).process(off)
    )


def test_an_unknown_force_is_not_compensated_and_widens_the_covariance():
    forces = np.tile([0, 0, 9.81], (6, 1))
    forces[3], forces[4, 0] = np.nan, 1e6
    rows = played(loads_of(6), [0, 0, 0], specific_force=forces)
    reconstruct = Reconstructor([HEAVY] * CUBES, np.float64)
    found = reconstruct(rows)
    bits = found.status & (WEIGHT | COMPENSATION)
    assert bits.tolist() == [WEIGHT] * 3 + [COMPENSATION] * 2 + [WEIGHT]
    plain = Reconstructor([PLAIN] * CUBES, np.float64).process(replace(rows, specific_force=None))
    np.testing.assert_array_equal(found.stress[3:5], plain.stress[3:5])
    noise = reconstruct.pipeline.compute_covariance(0)
    np.testing.assert_array_equal(reconstruct.compute_covariance(2), noise)
    # 1 g along each axis, through the matrix of the pads
    response = reconstruct.pipeline.find_matrix(0) @ (HEAVY.gain[:, None] * RESPONSE) * 9.80665
    grown = reconstruct.compute_covariance(0) - noise
    np.testing.assert_allclose(grown, response @ response.T, rtol=1e-6, atol=1e-6)


def test_a_stated_deviation_of_the_response_enters_the_covariance():
    deviation = 0.1 * np.abs(RESPONSE)
    cube = replace(HEAVY, weight=WeightModel(RESPONSE, deviation))
    reconstruct = Reconstructor([cube] * CUBES, np.float64)
    reconstruct(played(loads_of(3), [0, 0, -9.81]))
    expected = reconstruct.pipeline.find_matrix(1) @ (HEAVY.gain * deviation[:, 2] * 9.81)
    grown = reconstruct.compute_covariance(1) - reconstruct.pipeline.compute_covariance(1)
    np.testing.assert_allclose(grown, np.outer(expected, expected), rtol=1e-5, atol=1e-6)


def test_errors_of_cubes_with_other_pads_and_models_are_those_of_each_alone():
    """With times, causes, powers and pads that other cubes do not have, and a pad left out."""
    large = make_illustrative_calibration("cube")
    few, many = np.arange(1.0, 9.0)[:, None], np.arange(1.0, 25.0)[:, None]
    creep = CreepModel(
        np.array([0.1, 2.0]), 0.01 * np.hstack([few, few]), RNG.normal(size=(1, 8, 2))
    )
    other = CreepModel(
        np.array([2.0, 9.0]), 0.005 * np.hstack([many, many]), RNG.normal(size=(2, 24, 2))
    )
    thermal = ThermalModel(np.array(20.0), np.array([5.0]), few, 0.1 * few, np.hstack([few, -few]))
    bent = ThermalModel(np.array(20.0), np.array([3.0]), np.hstack([many, many]), np.ones((24, 2)))
    cubes = [
        replace(HEAVY, creep=creep, thermal=thermal),
        replace(large, creep=other, thermal=bent),
        PLAIN,
    ]
    together = Reconstructor(cubes, np.float64)
    alone = [Reconstructor([one], np.float64) for one in cubes]
    for k in range(30):
        forces, warm = np.full((3, 3), [1.0, -2.0, 9.0]), 20.0 + 0.1 * k
        frequency = np.full((3, 24), np.nan)
        for c, one in enumerate(cubes):
            frequency[c, : one.gain.size] = one.rest_frequency * (1 + 1e-4 * k)
        known = {"stamp_ns": 10**9 + 50_000_000 * k, "temperature": warm}
        number = np.arange(3, dtype=np.uint16)
        together(FrequencyRows.from_values(number, frequency, specific_force=forces, **known))
        for c, one in enumerate(alone):
            own = frequency[c : c + 1, : cubes[c].gain.size]
            one(FrequencyRows.from_values(number[:1], own, specific_force=forces[:1], **known))
    errors = together.errors(np.arange(3), np.array([1, 2, 0]))
    assert not errors[2][np.isfinite(errors[2])].any()
    for c, mask in enumerate([1, 2]):
        grown = alone[c].compute_covariance(0, mask) - alone[c].pipeline.compute_covariance(0, mask)
        assert np.nanmax(grown) > 100
        np.testing.assert_allclose(errors[c] @ errors[c].T, grown, rtol=1e-4, atol=1e-2)


def test_scans_at_once_are_the_scans_one_by_one_to_the_bit():
    """With pads that fail, forces that are missing, and cubes of other calibrations."""
    forces = 20 * RNG.normal(size=(60, 3))
    forces[17:29] = np.nan
    rows = played(loads_of(60), np.nan_to_num(forces), specific_force=forces)
    rows.frequency[8, 3] = np.nan
    at_once = Reconstructor([HEAVY, PLAIN, HEAVY])
    singly = Reconstructor([HEAVY, PLAIN, HEAVY])
    found = at_once.process(rows)
    for first in range(0, 60, CUBES):
        part = slice(first, first + CUBES)
        assert_same(singly.process(rows.select(part)), found.select(part))
    assert found.status[8] & PAD_FAULT
    assert (found.status[1::3] & (WEIGHT | COMPENSATION) == COMPENSATION).all()


@pytest.mark.parametrize("turned", [1, -1])
def test_a_tare_in_one_pose_holds_in_another(turned):
    """The rest frequencies are those without weight, whatever weighs while they are measured."""
    up = np.tile([0.0, 3.0, 9.0], (900, 1))
    reconstruct = Reconstructor([HEAVY] * CUBES)
    shifted = replace(HEAVY, rest_frequency=HEAVY.rest_frequency * (1 + 1e-3))
    nothing = np.zeros((900, HEAVY.modes.n_modes))
    rows = played(nothing, up, shifted)
    reconstruct(rows)
    reconstruct.tare()
    np.testing.assert_allclose(
        reconstruct.rest_frequency, np.tile(shifted.rest_frequency, (CUBES, 1)), rtol=1e-7
    )
    found = reconstruct(played(nothing[:3], turned * up[:3], shifted))
    assert np.nanmax(np.abs(found.stress)) < 0.5  # Pa; float32 frequencies


MODELS = {
    "weight": WeightModel(RESPONSE, np.abs(RESPONSE)),
    "creep": CreepModel(np.array([1.0, 10.0]), 0.1 * np.ones((8, 2))),
    "thermal": ThermalModel(np.array(25.0), np.array([40.0]), np.ones((8, 2))),
}


@pytest.mark.parametrize("key", list(MODELS))
def test_blocks_of_a_calibration_are_part_of_its_id_and_are_checked(key):
    whole = replace(PLAIN, **{key: MODELS[key]})
    assert Calibration.from_dict(whole.to_dict()).id == whole.id != PLAIN.id
    for wrong in (3, {}, {**MODELS[key].to_dict(), "other": 1}):
        with pytest.raises(CalibrationError, match=f"{key}: found"):
            Calibration.from_dict({**PLAIN.to_dict(), "id": whole.id, key: wrong})
    table = MODELS[key].to_dict()
    name = next(name for name, axes in MODELS[key].axes.items() if len(axes) == 2)
    for values, message in (
        (table[name][:4], "4 pads|must be"),
        ("much", "give numbers|must be finite"),
        ([[np.nan] * 3] * 8, "must be finite"),
    ):
        data = {**table, name: values}
        data.pop("deviation", None)
        with pytest.raises(CalibrationError, match=message):
            Calibration.from_dict({**PLAIN.to_dict(), "id": whole.id, key: data})
