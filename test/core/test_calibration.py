# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Calibrations: plain types and back, and every way to be refused."""

import dataclasses
import json

import numpy as np
import pytest

from cube_tensor_driver.core.calibration import Calibration, make_illustrative_calibration
from cube_tensor_driver.core.errors import CalibrationError
from cube_tensor_driver.core.layout import LAYOUTS, Layout
from cube_tensor_driver.core.oscillator import TemperatureModel


def full_of_everything() -> Calibration:
    c = make_illustrative_calibration("planar")
    rng = np.random.default_rng(0)
    return dataclasses.replace(
        c,
        gain=1 + 0.05 * rng.normal(size=8),
        rest_frequency=1e5 + rng.normal(size=8),
        covariance=np.eye(7) * 1e-6,
        temperature=TemperatureModel(25, rng.normal(size=(8, 2)) * 1e-5),
        drift=3e-4,
        neglect=("xx_x",),
        uid=2**64 - 1,
        created="2024-05-01T12:00:00Z",
        source="loads.csv",
    )


@pytest.mark.parametrize(
    "calibration",
    [
        make_illustrative_calibration("quad"),
        make_illustrative_calibration("planar"),
        make_illustrative_calibration("cube"),
        full_of_everything(),
    ],
)
def test_a_calibration_survives_plain_types(calibration):
    text = json.dumps(calibration.to_dict())
    again = Calibration.from_dict(json.loads(text))
    assert again.id == calibration.id and json.dumps(again.to_dict()) == text
    np.testing.assert_array_equal(again.response, calibration.response)
    assert len(calibration.id) == 16


def test_the_id_tells_any_difference_and_no_other():
    c = full_of_everything()
    changes = [
        {"gain": np.ones(8)},
        {"uid": 5},
        {"source": "x"},
        {"neglect": ()},
        {"half_side": 3e-3},
        {"drift": None},
        {"temperature": None},
        {"coefficients": dict(c.coefficients) | {"a": 1.5}},
    ]
    assert len({c.id, *(dataclasses.replace(c, **change).id for change in changes)}) == 1 + len(
        changes
    )
    shuffled = dict(reversed(c.coefficients.items()))
    assert dataclasses.replace(c, coefficients=shuffled).id == c.id
    p = make_illustrative_calibration("planar")
    assert dataclasses.replace(p, beta=np.full(8, 0.3), half_side=np.float64(2e-3)).id == p.id


def test_the_response_has_the_gains_in():
    c = full_of_everything()
    np.testing.assert_allclose(
        c.response, c.gain[:, None] * make_illustrative_calibration("planar").response
    )
    m = dataclasses.replace(c, coefficients=None, matrix=np.arange(56.0).reshape(8, 7))
    np.testing.assert_allclose(
        Calibration.from_dict(m.to_dict()).response, c.gain[:, None] * m.matrix
    )


def test_another_layout_keeps_its_pads():
    mine = Layout("mine", LAYOUTS["quad"].positions * [0.5, 1, 1], LAYOUTS["quad"].normals, 0.3)
    c = dataclasses.replace(make_illustrative_calibration("quad"), layout=mine)
    again = Calibration.from_dict(json.loads(json.dumps(c.to_dict())))
    assert again.layout.has_same_pads(mine) and again.id == c.id


@pytest.mark.parametrize(
    "change, words",
    [
        ({"gain": 1.1}, "edited by hand"),
        ({"id": "0" * 16}, "edited by hand"),
        ({"colour": "red"}, "unknown keys.*colour"),
        ({"schema": 2}, "schema 2.*schema 1"),
        ({"layout": "ring"}, "'ring'"),
        ({"layout": "quad"}, "has 4 pads|lacks this symmetry"),
        ({"symmetry": "round"}, "'round'"),
        ({"symmetry": 3}, "symmetry is 3"),
        ({"symmetry": "none"}, "56 coefficients"),
        ({"noise": 0}, "noise holds 0"),
        ({"beta": -0.1}, "beta holds -0.1"),
        ({"modulus": [1, 2]}, "modulus has shape"),
        ({"rest_frequency": "1e5"}, "2.0e-3"),
        ({"rest_frequency": float("nan")}, "NaN"),
        ({"half_side": -1}, "half_side"),
        ({"drift": 0}, "drift is 0.0; it must be above 0 and at most 0.01"),
        ({"drift": 0.02}, "drift is 0.02; it must be"),
        ({"half_side": [1]}, "half_side has shape"),
        ({"matrix": [[1]]}, "both"),
        ({"coefficients": None}, "neither"),
        ({"coefficients": None, "matrix": [[1]]}, "matrix has shape"),
        ({"coefficients": 3}, "coefficients is 3"),
        ({"covariance": [[1]]}, "covariance has shape"),
        ({"neglect": "xx"}, "list"),
        ({"neglect": ["aa"]}, "'aa'"),
        ({"uid": -1}, "uid is -1"),
        ({"uid": "0x1"}, "whole number"),
        ({"temperature": {"reference": 25, "coefficients": [[0.1]]}}, "1 pads"),
        ({"modulus": True}, "must be numbers"),
        ({"gain": [[1], [2, 3]]}, "must be numbers"),
    ],
)
def test_a_bad_calibration_is_refused_with_the_reason(change, words):
    good = make_illustrative_calibration("planar").to_dict()
    with pytest.raises(CalibrationError, match=words):
        Calibration.from_dict(good | change)


@pytest.mark.parametrize(
    "key", ["layout", "rest_frequency", "noise", "modulus", "half_side", "schema"]
)
def test_a_missing_key_is_named(key):
    data = make_illustrative_calibration("planar").to_dict()
    del data[key]
    with pytest.raises(CalibrationError, match=f"missing keys.*{key}"):
        Calibration.from_dict(data)
    with pytest.raises(CalibrationError, match="table"):
        Calibration.from_dict([])


def test_a_hand_written_start_needs_no_id():
    data = make_illustrative_calibration("planar").to_dict()
    del data["id"]
    assert Calibration.from_dict(data | {"gain": 1.1}).gain.tolist() == [1.1] * 8


def test_the_wrong_layout_or_cube_is_refused():
    c = dataclasses.replace(make_illustrative_calibration("planar"), uid=0xA1)
    c.check(LAYOUTS["planar"], 0xA1)
    c.check()
    make_illustrative_calibration("planar").check(uid=7)  # for any cube
    with pytest.raises(CalibrationError, match=r"'planar' .8 pads.*'quad' .4 pads"):
        c.check(LAYOUTS["quad"])
    with pytest.raises(CalibrationError, match=r"0x00000000000000a1.*0x00000000000000a2"):
        c.check(uid=0xA2)
