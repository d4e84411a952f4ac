# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Temperature of a simulated skin: heat against its series, steady stress and drift."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cube_tensor_driver.config.calibration import find_shipped_calibration
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.yaml import read_yaml
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.oscillator import compute_pad_stress
from cube_tensor_driver.simulation.cubes import PadErrors, SimulatedCubes
from cube_tensor_driver.simulation.imperfections import Imperfections, read_imperfections
from cube_tensor_driver.simulation.temperature import CELLS, WarmLayer, read_thermal_stress

HEIGHT = 11e-3
"""Thickness of the layer of elastomer, in m."""
DIFFUSIVITY = 1.25e-7
"""Thermal diffusivity of the elastomer, in m²/s."""
UNLOADED = np.zeros((2, 6)), np.zeros((2, 6, 3))


def cubes(**imperfections: object) -> SimulatedCubes:
    calibration = find_shipped_calibration(LAYOUTS["cube"])
    assert calibration is not None
    return SimulatedCubes(
        [calibration] * 2, PadErrors(imperfections=Imperfections(**imperfections))
    )  # type: ignore[arg-type]


def read_stress(hertz: np.ndarray) -> np.ndarray:
    calibration = find_shipped_calibration(LAYOUTS["cube"])
    assert calibration is not None
    rest, beta, modulus = calibration.rest_frequency, calibration.beta, calibration.modulus
    return compute_pad_stress(hertz * 1e-3, rest, beta, modulus)


@pytest.mark.parametrize(
    "exchange, height", [(1e9, HEIGHT), (1e-9, 2 * HEIGHT)], ids=["two", "one"]
)
def test_a_step_conducts_as_the_series_of_the_heat_equation(exchange, height):
    """T = 1 - sum 4/((2n+1)pi) sin(kz) exp(-k²Dt), k = (2n+1)pi/height: both faces of a plate have
    the new temperature, or one face of half of it, the other without heat flow."""
    layer = WarmLayer(np.array([HEIGHT]), exchange, 0.0, 0.0)
    layer.advance(1e-9, 1.0, 1.0)
    z = (np.arange(CELLS) + 0.5) / CELLS * HEIGHT
    k = (2 * np.arange(400)[:, None] + 1) * np.pi / height
    time = 0.0
    for seconds in (10.0, 20.0, 70.0, 900.0):
        layer.advance(seconds, 1.0, 1.0)
        time += seconds
        terms = 4 / (k * height) * np.sin(k * z) * np.exp(-k * k * DIFFUSIVITY * time)
        # Finite volumes of 0.25 mm: 1.7e-3 after 10 s, less later.
        np.testing.assert_allclose(layer.temperature[0], 1 - terms.sum(axis=0), atol=2e-3)


def test_one_long_step_is_as_exact_as_many_short_ones():
    ends = []
    for count in (1, 300):
        layer = WarmLayer(np.array([HEIGHT, 0.9 * HEIGHT]), 10.0, 20.0, 20.0)
        for n in range(count):
            layer.advance(60.0 / count, 20.0 + 15.0 * (n + 1) / count, 20.0)
        ends.append(layer.temperature)
    np.testing.assert_allclose(*ends, rtol=1e-10)


def test_still_air_keeps_the_steady_state_of_conduction():
    # Flux k (T_g - T_s) / h = exchange (T_s - T_air), linear in between.
    layer = WarmLayer(np.array([HEIGHT]), 10.0, 20.0, 20.0)
    for _ in range(100):
        layer.advance(100.0, 50.0, 20.0)
    surface = 50 - 30 * (10.0 * HEIGHT / 0.2) / (1 + 10.0 * HEIGHT / 0.2)
    expected = np.interp((np.arange(CELLS) + 0.5) / CELLS, [0, 1], [50, surface])
    np.testing.assert_allclose(layer.temperature[0], expected, rtol=1e-9)


def test_warm_pads_have_the_computed_stress_and_drift():
    """After hours, the whole layer is 10 K warmer: the pattern of a uniform temperature, and 1 per
    mille of the rest frequency; in between, pads lag behind the thermometer."""
    warm = ((0.0, 25.0), (60.0, 35.0))
    stress = np.array(read_yaml(find_package_data() / "config/thermal/cube_11mm.yaml")["pads"])[
        :, 0
    ]
    pattern = cubes(temperature=warm, air=warm, pad_drift=0.0)
    both = cubes(temperature=warm, air=warm)
    assert np.abs(read_stress(pattern.compute_frequency(*UNLOADED, 0.0))).max() < 0.01
    early = read_stress(pattern.compute_frequency(*UNLOADED, 60.0))[0]
    late = read_stress(pattern.compute_frequency(*UNLOADED, 7200.0))[0]
    np.testing.assert_allclose(late, 10 * stress, atol=0.5)
    assert (np.abs(early) < 0.5 * np.abs(late)).all()
    assert pattern.compute_temperature(60.0) == 35.0 and np.isnan(cubes().compute_temperature(60.0))
    # 100 ppm/K are 39 Pa/K (docs/build.md), here of a foam that is strained by 0.5 % at most.
    late_both = read_stress(both.compute_frequency(*UNLOADED, 7200.0))[0]
    np.testing.assert_allclose(late_both - late, 390.0, rtol=0.01)


def test_layers_and_drift_differ_by_the_asked_spread():
    warm = ((0.0, 25.0), (1.0, 35.0))
    wanted = Imperfections(
        temperature=warm, air=warm, pad_drift_spread=0.2, thermal_stress="cube_11mm", seed=3
    )
    calibration = find_shipped_calibration(LAYOUTS["cube"])
    assert calibration is not None
    many = SimulatedCubes([calibration] * 50, PadErrors(imperfections=wanted))
    zero = np.zeros((50, 6)), np.zeros((50, 6, 3))
    drift = (
        read_stress(many.compute_frequency(*zero, 7200.0))
        - 10 * read_thermal_stress("cube_11mm", 24).pads[:, 0]
    )
    assert drift.std() == pytest.approx(0.2 * 390, rel=4 / np.sqrt(2 * 1200))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("temperature: [[0, 25], [0, 30]]", ["temperature", "rising times"]),
        ("temperature: 25", ["temperature", "[[seconds, °C], ...]"]),
        ("heat_exchange: 0", ["heat_exchange", "above 0"]),
        ("{temperature: [[0, 25]], thermal_stress: none}", ["none"]),
    ],
)
def test_a_mistake_is_one_line(tmp_path, text, words):
    path = tmp_path / "worn.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as raised:
        wanted = read_imperfections(path)
        cubes(**vars(wanted))
    for word in words:
        assert word in str(raised.value)


def test_a_file_for_other_pads_is_refused(tmp_path):
    path = tmp_path / "other.yaml"
    path.write_text("{height: 1, depth: 1, side: 1, pads: [[1.0], [2.0]]}")
    with pytest.raises(ConfigError, match=r"shape \(2, 1\), the cubes have 24 pads"):
        read_thermal_stress(str(path), 24)
    Path(path).write_text("{height: 1, depth: 1, pads: [[1.0]]}")
    with pytest.raises(ConfigError, match="'side' does not suit"):
        read_thermal_stress(str(path), 1)
