# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Fit: known coefficients and gains come back, within what is stated, from loads with noise and
outliers."""

import dataclasses

import numpy as np
import pytest

from cube_tensor_driver.calibrate.fit import (
    compute_measured_stress,
    describe_mode,
    fit,
    loads_from_forces,
)
from cube_tensor_driver.core.calibration import Calibration, make_illustrative_calibration
from cube_tensor_driver.core.errors import FitError
from cube_tensor_driver.core.modes import SPACE
from cube_tensor_driver.core.oscillator import TemperatureModel, compute_pad_frequency
from cube_tensor_driver.core.response import choose_illustrative_coefficients, compute_response
from cube_tensor_driver.core.symmetry import find_structure


class Bench:
    """20 loads on a cube with 5 % spread of gains and 0.1 % noise."""

    def __init__(
        self, layout: str, symmetry: str, seed: int, loads: int = 20, noise: float = 1e-3
    ) -> None:
        rng = np.random.default_rng(seed)
        self.base = make_illustrative_calibration(layout)
        self.structure = find_structure(self.base.layout, symmetry)
        self.coefficients = choose_illustrative_coefficients(self.structure)
        self.gain = 1 + 0.05 * rng.normal(size=self.base.layout.n_pads)
        for orbit in self.structure.pad_orbits:
            self.gain[orbit] /= self.gain[orbit].mean()
        self.loads = 1e4 * rng.normal(size=(loads, self.structure.modes.n_modes))
        clean = (
            self.loads
            @ (self.gain[:, None] * compute_response(self.structure, self.coefficients)).T
        )
        self.noise = noise * np.sqrt(np.mean(clean**2))
        self.readings = clean + self.noise * rng.normal(size=clean.shape)

    def fit(self, **kwargs):
        return fit(self.structure, self.loads, self.readings, self.noise, **kwargs)

    def errors(self, result) -> np.ndarray:
        """Errors of the coefficients in units of their stated deviations."""
        return np.array(
            [
                (result.coefficients[n] - c) / result.deviations[n]
                for n, c in self.coefficients.items()
            ]
        )


@pytest.mark.parametrize(
    "layout, symmetry", [("planar", "full"), ("planar", "mirrors"), ("quad", "mirrors")]
)
def test_errors_are_within_their_stated_deviations(layout, symmetry):
    errors, gains, scatter = [], [], []
    for seed in range(12):
        bench = Bench(layout, symmetry, seed)
        result = bench.fit()
        errors.append(bench.errors(result))
        gains.append(np.abs(result.gain - bench.gain).max())
        assert not result.undetermined and not result.advice
        assert result.held_out == pytest.approx(1e-3, rel=0.5)
        scatter.append((result.scale, result.chi2 / result.dof))
        for orbit in bench.structure.pad_orbits:
            assert result.gain[orbit].mean() == pytest.approx(1, abs=1e-12)
    assert np.std(errors) == pytest.approx(1, abs=0.15)
    assert np.max(gains) < 0.005
    np.testing.assert_allclose(np.mean(scatter, axis=0), 1, atol=0.1)


def test_the_cube_too():
    bench = Bench("cube", "full", 0)
    result = bench.fit()
    assert np.abs(bench.errors(result)).max() < 4 and np.abs(result.gain - bench.gain).max() < 0.005


def test_without_noise_it_is_exact():
    bench = Bench("planar", "full", 1, noise=0)
    result = fit(bench.structure, bench.loads, bench.readings, 1.0)
    np.testing.assert_allclose(
        [result.coefficients[n] for n in bench.coefficients],
        list(bench.coefficients.values()),
        atol=1e-9,
    )
    np.testing.assert_allclose(result.gain, bench.gain, atol=1e-9)
    np.testing.assert_allclose(result.fitted, bench.readings, atol=1e-4)


def test_outliers_are_forgotten():
    bench = Bench("planar", "full", 2)
    bench.readings[3, 2] *= 3
    bench.readings[7, 0] += 1e5
    bench.readings[11, 5] = 0
    result = bench.fit()
    assert {(3, 2), (7, 0), (11, 5)} <= {tuple(i) for i in np.argwhere(result.outliers)}
    assert np.abs(bench.errors(result)).max() < 4 and np.abs(result.gain - bench.gain).max() < 0.005


def test_noise_of_another_size_is_found():
    bench = Bench("planar", "full", 3)
    result = fit(bench.structure, bench.loads, bench.readings, bench.noise / 10)
    assert result.scale == pytest.approx(10, rel=0.3) and result.chi2 / result.dof == pytest.approx(
        100, rel=0.4
    )
    assert np.abs(bench.errors(result)).max() < 4  # deviations follow the scatter found


def test_what_the_loads_leave_open_is_said_and_following_the_advice_settles_it():
    bench = Bench("planar", "full", 4)
    bench.loads[:, 3:] = 0
    a = bench.gain[:, None] * compute_response(bench.structure, bench.coefficients)
    rng = np.random.default_rng(0)
    bench.readings = bench.loads @ a.T + bench.noise * rng.normal(size=(20, 8))
    result = bench.fit()
    assert result.undetermined == ("e", "f", "g", "h")
    assert np.isnan(
        [result.coefficients[n] for n in "efgh"] + [result.deviations[n] for n in "efgh"]
    ).all()
    assert np.abs(bench.errors(result)[:3]).max() < 4
    assert (
        len(result.advice) == 2
        and "add a load of zz_x alone, sigma_zz growing along x" in result.advice[0]
    )
    with pytest.raises(FitError, match=r"do not determine e, f.*fixed"):
        result.make_calibration(bench.base)
    advised = [text.split("a load of ")[1].split()[0] for text in result.advice]
    extra = 1e4 * np.eye(7)[bench.structure.modes.find_indices(advised)]
    bench.loads = np.vstack([bench.loads, extra])
    bench.readings = bench.loads @ a.T + bench.noise * rng.normal(size=(22, 8))
    assert not bench.fit().undetermined
    bench.loads, bench.readings = bench.loads[:20], bench.readings[:20]
    known = {n: bench.coefficients[n] for n in "efgh"}
    settled = bench.fit(fixed=known)
    assert not settled.undetermined and settled.coefficients["g"] == known["g"]
    assert settled.make_calibration(bench.base).coefficients["g"] == known["g"]


def test_loads_in_proportion_are_not_told_apart():
    bench = Bench("quad", "mirrors", 5)
    bench.loads[:, bench.structure.modes.names.index("xx")] = 0.5 * bench.loads[:, 0]
    a = bench.gain[:, None] * compute_response(bench.structure, bench.coefficients)
    result = fit(bench.structure, bench.loads, bench.loads @ a.T + bench.noise, bench.noise)
    assert result.undetermined == ("a", "b") and len(result.advice) == 1


def test_a_fit_becomes_a_calibration():
    bench = Bench("planar", "mirrors", 6)
    result = bench.fit()
    c = result.make_calibration(bench.base, created="2024-05-01T12:00:00Z", source="loads.csv")
    assert (
        c.symmetry == "mirrors"
        and c.source == "loads.csv"
        and Calibration.from_dict(c.to_dict()).id == c.id
    )
    np.testing.assert_allclose(bench.loads @ c.response.T, result.fitted, rtol=1e-9, atol=1e-6)
    assert np.all(c.noise >= bench.base.noise)


def test_readings_from_frequencies():
    c = dataclasses.replace(
        make_illustrative_calibration("planar"),
        temperature=TemperatureModel(25, np.full((8, 1), 1e-4)),
    )
    v = np.random.default_rng(0).normal(size=(5, 8)) * 1e3
    f = compute_pad_frequency(v, c.rest_frequency * 1.001, c.beta, c.modulus)
    np.testing.assert_allclose(compute_measured_stress(c, f, np.full(5, 35.0)), v, atol=1e-6)
    f[2, 3] = 1e9
    with pytest.raises(FitError, match=r"load 3, pad -z\+x: 1e\+09 Hz"):
        compute_measured_stress(c, f)
    with pytest.raises(FitError, match=r"\(5, 4\).*8"):
        compute_measured_stress(c, f[:, :4])


def test_loads_from_a_reference_force_sensor():
    amplitudes = loads_from_forces(SPACE, np.array([[1.0, 2, -3]]), 1e-4)
    assert dict(zip(SPACE.names, amplitudes[0], strict=True)) | {
        "zz": -3e4,
        "zx": 1e4,
        "yz": 2e4,
    } == dict(zip(SPACE.names, amplitudes[0], strict=True))
    assert np.count_nonzero(amplitudes) == 3
    with pytest.raises(FitError, match="area"):
        loads_from_forces(SPACE, np.ones((1, 3)), 0)


def test_without_gains_fewer_loads_are_enough():
    c = make_illustrative_calibration("planar")
    loads = 1e4 * np.eye(7)[[0, 3, 4, 1]]
    readings = loads @ c.response.T
    assert fit(c.structure, loads, readings, gains=False).undetermined == ()
    assert fit(c.structure, loads, readings).gain.shape == (8,)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"loads": np.zeros((20, 7))}, "all loads are zero"),
        ({"loads": np.ones((20, 8))}, "shape"),
        ({"readings": np.ones((19, 8))}, "shape"),
        ({"readings": np.full((20, 8), np.nan)}, r"reading 1, \+z-x: nan"),
        ({"loads": np.full((20, 7), np.inf)}, "load 1, zz: inf"),
        ({"noise": 0}, "noise is 0"),
        ({"noise": np.ones(3)}, "noise"),
        ({"fixed": {"k": 1.0}}, "'k'.*a, b, c_plus_d"),
        ({"loads": "heavy"}, "numbers"),
        ({"loads": np.zeros((0, 7)), "readings": np.zeros((0, 8))}, "at least one"),
    ],
)
def test_what_cannot_be_fitted_is_an_error_with_its_reason(change, words):
    bench = Bench("planar", "full", 7)
    case = {
        "loads": bench.loads,
        "readings": bench.readings,
        "noise": bench.noise,
        "fixed": None,
    } | change
    with pytest.raises(FitError, match=words):
        fit(bench.structure, case["loads"], case["readings"], case["noise"], case["fixed"])


def test_one_load_alone_settles_no_coefficient():
    c = make_illustrative_calibration("cube")
    loads = loads_from_forces(c.modes, np.array([[0, 0, -1.0]]), 1e-4)
    with pytest.raises(FitError, match=r"determine no coefficient.*add a load of"):
        fit(c.structure, loads, loads @ c.response.T)


def test_modes_in_words():
    assert describe_mode("zz") == "sigma_zz, uniform"
    assert describe_mode("xy_y-zx_z") == "sigma_xy growing along y against sigma_zx growing along z"
