# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation of temperature against another solution of the filters, and its deviation."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cube_tensor_driver.config.calibration import find_shipped_calibration
from cube_tensor_driver.core.calibration import Calibration
from cube_tensor_driver.core.compensation.models import ThermalModel
from cube_tensor_driver.core.compensation.thermal import LOST_KELVIN, START_KELVIN
from cube_tensor_driver.core.errors import CalibrationError, LayoutError
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.oscillator import TemperatureModel, compute_pad_frequency
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows, concatenate
from cube_tensor_driver.core.status import COMPENSATION, THERMAL

PLANAR = find_shipped_calibration(LAYOUTS["planar"])
LINEAR = np.array([50.0, 60.0, 130.0, 120.0, -200.0, -190.0, -195.0, -205.0])  # Pa/K
KNOTS = np.array([0.0, 100.0, 130.0, 600.0]), np.array([25.0, 25.0, 40.0, 32.0])  # s, °C


def calibration(lag: list[float], quadratic: float = 0.0, **deviations: object) -> Calibration:
    assert PLANAR is not None
    coefficient = np.stack([LINEAR, quadratic * LINEAR], axis=1)
    model = ThermalModel(np.array(25.0), np.array(lag), coefficient, **deviations)  # type: ignore[arg-type]
    return replace(PLANAR, thermal=model)


def reading(seconds: np.ndarray, lag: list[float]) -> np.ndarray:
    """Temperature above 25 °C after filters in a row, by a numerical integration."""

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        return (np.append(np.interp(t, *KNOTS), x[:-1]) - x) / lag

    ends = np.unique(np.concatenate([seconds, KNOTS[0]]))
    found, x = {ends[0]: np.full(len(lag), 25.0)}, np.full(len(lag), 25.0)
    for begin, end in pairwise(ends):
        solution = solve_ivp(slope, (begin, end), x, "LSODA", rtol=1e-10, atol=1e-10)
        found[end] = x = solution.y[:, -1]
    return np.array([found[t][-1] for t in seconds]) - 25


def unloaded(seconds: np.ndarray, lag: list[float], quadratic: float = 0.0) -> FrequencyRows:
    """Rows of a cube without load at times in s, whose pads have the readings of the model."""
    assert PLANAR is not None
    u = reading(seconds, lag)[:, None]
    stress = LINEAR * (u + quadratic * u * u)
    hertz = compute_pad_frequency(stress, PLANAR.rest_frequency, PLANAR.beta, PLANAR.modulus)
    return FrequencyRows.from_values(
        np.zeros(len(seconds), np.uint16),
        hertz,
        stamp_ns=np.round(seconds * 1e9).astype(np.int64) + 10**18,
        sequence=np.arange(len(seconds)),
        temperature=np.interp(seconds, *KNOTS),
    )


# Rows that end at the knots, so that the temperature is linear in between.
UNEVEN = np.array([0.0, 0.01, 0.02, 1.0, 100.0, 101.0, 130.0, 131.7, 250.0, 600.0])


@pytest.mark.parametrize("lag", [[0.0], [200.0], [0.5], [97.0, 21.0], [97.0, 21.0, 5.0]])
def test_no_stress_is_left_whatever_the_intervals(lag):
    quadratic = 0.01
    rows = unloaded(UNEVEN, [max(one, 1e-3) for one in lag], quadratic)
    reconstruct = Reconstructor([calibration(lag, quadratic)], np.float64)
    stress = reconstruct.process(rows).stress
    # Frequencies are counted by float64 here; 3 kPa are compensated.
    np.testing.assert_allclose(stress[:, [0, 2, 4]], 0, atol=2e-3)
    plain = Reconstructor([replace(calibration(lag), thermal=None)], np.float64).process(rows)
    assert np.abs(plain.stress[:, 0]).max() > 1000


def test_each_pad_has_its_own_mixture_of_filters():
    lags = [97.0, 21.0, 5.0]
    lagging = np.random.default_rng(4).normal(scale=150.0, size=(8, 3))
    one = calibration(lags, lagging=lagging)
    outputs = np.column_stack([reading(UNEVEN, [lag]) for lag in lags])
    measured = np.interp(UNEVEN, *KNOTS) - 25
    stress = np.outer(outputs.mean(axis=1), LINEAR) + (measured[:, None] - outputs) @ lagging.T
    hertz = compute_pad_frequency(stress, one.rest_frequency, one.beta, one.modulus)
    rows = replace(unloaded(UNEVEN, lags), frequency=hertz)
    found = Reconstructor([one, calibration([50.0])], np.float64).process(rows).stress
    np.testing.assert_allclose(found[:, [0, 2, 4]], 0, atol=2e-3)


def test_parts_and_a_restored_state_give_the_same_bits():
    rows = unloaded(np.sort(np.concatenate([UNEVEN, np.linspace(102, 590, 50)])), [97.0, 21.0])
    whole, parts = (Reconstructor([calibration([97.0, 21.0])]) for _ in range(2))
    expected = whole.process(rows)
    found = []
    for begin in range(0, len(rows), 7):
        states = parts.compensation.collect_states()
        parts = Reconstructor([calibration([97.0, 21.0])])
        parts.compensation.restore(states)
        found.append(parts.process(rows.select(slice(begin, begin + 7))))
    assert concatenate(found).stress.tobytes() == expected.stress.tobytes()
    # Two cubes in one scan, then the same as single scans.
    two = [calibration([97.0, 21.0]), calibration([50.0])]
    both = FrequencyRows.from_values(
        np.tile([0, 1], len(rows)).astype(np.uint16),
        np.repeat(rows.frequency, 2, axis=0),
        stamp_ns=np.repeat(rows.stamp_ns, 2),
        temperature=np.repeat(rows.temperature, 2),
    )
    together = Reconstructor(two).process(both)
    assert together.stress[::2].tobytes() == expected.stress.tobytes()
    with pytest.raises(LayoutError, match="a state of thermal has 3 numbers"):
        parts.compensation.restore({"thermal": np.zeros(3)})


def test_the_deviation_grows_while_the_elastomer_lags_and_a_bit_says_so():
    ramp = np.stack([0.05 * LINEAR, np.full(8, 2.0)], axis=1)
    deviation = np.stack([0.01 * LINEAR, np.zeros(8)], axis=1)
    lag = [97.0]
    reconstruct = Reconstructor([calibration(lag, ramp=ramp, deviation=deviation)], np.float64)
    times = np.concatenate([np.arange(0.0, 600.0), [600.0]])
    rows = unloaded(times, lag)
    matrix, noise = reconstruct.pipeline.find_matrix(0), reconstruct.pipeline.compute_covariance(0)
    u = reading(times, lag)
    flagged = []
    for number in range(len(rows)):
        row = rows.select(slice(number, number + 1))
        flagged.append(bool(reconstruct.process(row).status[0] & COMPENSATION))
        behind = rows.temperature[number] - 25.0 - u[number]
        start = START_KELVIN * np.exp(-times[number] / 97)
        patterns = np.column_stack([start * LINEAR, behind * ramp, u[number] * deviation])
        if number in (0, 99, 130, 400):
            expected = noise + matrix @ patterns @ patterns.T @ matrix.T
            np.testing.assert_allclose(
                reconstruct.compute_covariance(0), expected, rtol=1e-5, atol=1e-3
            )
    # 1 K of an unknown start is 140 Pa; 10 K behind are 70 Pa; both are above 30 Pa.
    assert flagged[0]
    assert all(flagged[115:140]) and not any(flagged[450:])
    # Nothing but a common drift of all pads, 1 Pa per pad, reads as pressure from all sides.
    uniform = matrix @ np.ones(8)
    assert uniform[0] == pytest.approx(uniform[2], rel=0.05) and abs(uniform[4]) < 1e-9


@pytest.mark.parametrize("is_known", [False, True])
def test_the_drift_of_oscillators_multiplies_a_load_unless_it_is_known(is_known):
    """100 ppm/K for 15 K, which the model of temperature knows without load."""
    assert PLANAR is not None
    unloaded = PLANAR.modulus * (1 + PLANAR.beta) * 1e-4
    model = ThermalModel(np.array(25.0), np.array([0.0]), unloaded[:, None] * (not is_known))
    stated = TemperatureModel(np.array(25.0), np.full((8, 1), 1e-4)) if is_known else None
    one = replace(PLANAR, thermal=model, temperature=stated)
    reconstruct = Reconstructor([one, one], np.float64)
    load = np.array([-800.0, 0.0, -1e3, 0.0, 50.0, 0.0])
    pads = one.modes.compute_amplitudes(np.stack([load, 0 * load])) @ one.response.T
    for second in range(61):
        rest = PLANAR.rest_frequency * (1 + 1e-4 * second / 4)
        row = FrequencyRows.from_values(
            [0, 1],
            compute_pad_frequency(pads, rest, PLANAR.beta, PLANAR.modulus),
            stamp_ns=10**18 + second * 10**9,
            temperature=25.0 + second / 4,
        )
        found = reconstruct.process(row)
    growth = reconstruct.compute_covariance(0) - reconstruct.pipeline.compute_covariance(0)
    error = (found.stress[0] - found.stress[1] - load)[[0, 2]]
    if is_known:
        assert np.abs(error).max() < 1e-3 and growth[2, 2] == 0
    else:
        assert np.abs(error).min() > 1.5
        deviation = np.sqrt(np.diag(growth))[[0, 2]]
        np.testing.assert_allclose(deviation, np.abs(error), rtol=5e-3)


def test_an_unknown_temperature_is_a_stated_deviation():
    rows = unloaded(np.arange(0.0, 500.0, 0.5), [97.0])
    reconstruct = Reconstructor([calibration([97.0])], np.float64)
    never = reconstruct.process(replace(rows, temperature=np.full(len(rows), np.nan)))
    assert (never.status & (COMPENSATION | THERMAL) == COMPENSATION).all()
    growth = reconstruct.compute_covariance(0) - reconstruct.pipeline.compute_covariance(0)
    expected = reconstruct.pipeline.find_matrix(0) @ LINEAR * LOST_KELVIN
    np.testing.assert_allclose(growth, np.outer(expected, expected), rtol=1e-9, atol=1e-6)

    # A thermometer that fails: the last temperature is kept, and 5 K are approached with the lag.
    reconstruct = Reconstructor([calibration([97.0])], np.float64)
    reconstruct.process(rows.select(slice(0, 160)))
    lost = replace(rows, temperature=np.full(len(rows), np.nan)).select(slice(160, 400))
    found = reconstruct.process(lost)
    share = 1 - np.exp(-120 / 97)
    unknown = START_KELVIN * np.exp(-199.5 / 97) + LOST_KELVIN * share
    growth = reconstruct.compute_covariance(0) - reconstruct.pipeline.compute_covariance(0)
    expected = reconstruct.pipeline.find_matrix(0) @ LINEAR * unknown
    assert growth[0, 0] == pytest.approx(expected[0] ** 2, rel=1e-3)
    assert found.status[-1] & COMPENSATION


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lag": [10.0, 10.0]}, "different"),
        ({"lag": [-1.0]}, "at least 0"),
        ({"coefficient": [[1.0]] * 7}, "thermal has values of 7 pads"),
        ({"deviation": [[1.0]] * 8}, "deviation has shape"),
        ({"ramp": [[1.0]] * 7}, "ramp has shape"),
    ],
)
def test_a_wrong_model_is_refused(changes, words):
    model = calibration([97.0]).thermal
    assert model is not None and PLANAR is not None
    with pytest.raises(CalibrationError, match=words):
        replace(PLANAR, thermal=type(model).from_dict(model.to_dict() | changes))
