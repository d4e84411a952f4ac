# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The pad's law against the circuit it comes from."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cube_tensor_driver.core.errors import CalibrationError
from cube_tensor_driver.core.oscillator import (
    TemperatureModel,
    compute_pad_frequency,
    compute_pad_stress,
    find_highest_frequency,
)

BETAS = st.floats(0, 2)
STRAINS = st.floats(0.05, 3)


def linear_pad_stress(frequency, rest_frequency, beta, modulus):
    """v = E (1 + beta) (f - f0) / f0: the paper's eq. 7 with R/k for k/R, tension positive."""
    return modulus * (1 + beta) * (frequency - rest_frequency) / rest_frequency


@given(STRAINS, BETAS, st.floats(1e-3, 1e-1))
def test_the_law_is_the_circuit(strain, beta, area):
    """f = k d / (R (eps S + C' d)), the paper's eq. 6, with arbitrary k, R, eps S and d at rest."""
    k, resistance, eps, rest = 0.7, 1e5, 3e-11, 4e-4
    parasitic = beta * eps * area / rest

    def circuit(d: float) -> float:
        return k * d / (resistance * (eps * area + parasitic * d))

    assert compute_pad_stress(circuit(strain * rest), circuit(rest), beta, 3e5) == pytest.approx(
        3e5 * (strain - 1), abs=1e-6
    )


@given(STRAINS, BETAS)
def test_stress_and_frequency_are_inverses(strain, beta):
    v = 3e5 * (strain - 1)
    f = compute_pad_frequency(v, 1e5, beta, 3e5)
    assert 0 < f < find_highest_frequency(1e5, beta)
    assert compute_pad_stress(f, 1e5, beta, 3e5) == pytest.approx(v, abs=1e-5)


def test_the_linear_law_touches_the_exact_one_at_rest():
    f = 1e5 * (1 + np.array([-1e-3, 1e-3, -1e-2, 1e-2]))
    gap = linear_pad_stress(f, 1e5, 0.3, 3e5) - compute_pad_stress(f, 1e5, 0.3, 3e5)
    np.testing.assert_allclose(
        gap, -3e5 * 1.3 * 0.3 * (f / 1e5 - 1) ** 2, rtol=0.01
    )  # -E (1 + beta) beta u^2


def test_the_papers_equation_7_needs_r_over_k():
    """dv = (E/d) (R/k) (eps S + C' d)^2 / (eps S) df; with k/R its value depends on the resistor at
    the same r."""
    k, eps_area, parasitic, d, modulus = 0.7, 3e-14, 2e-11, 4e-4, 3e5
    beta = parasitic * d / eps_area
    for resistance in (1e4, 1e5):
        f0 = k * d / (resistance * (eps_area + parasitic * d))
        shift = 1e-6 * f0
        rest = (eps_area + parasitic * d) ** 2 / eps_area * modulus / d * shift
        assert resistance / k * rest == pytest.approx(
            linear_pad_stress(f0 + shift, f0, beta, modulus), rel=1e-6
        )
        assert k / resistance * rest != pytest.approx(
            linear_pad_stress(f0 + shift, f0, beta, modulus), rel=0.5
        )


def test_beyond_the_range_is_no_number():
    top = float(find_highest_frequency(1e5, 0.3))
    assert top == pytest.approx(1e5 * 1.3 / 0.3) and find_highest_frequency(1e5, 0) == np.inf
    bad = np.array([0, -1e5, np.nan, np.inf, -np.inf, top, 2 * top])
    assert np.isnan(compute_pad_stress(bad, 1e5, 0.3, 3e5)).all()
    assert np.isfinite(compute_pad_stress(np.array([1e-3, 0.99 * top]), 1e5, 0.3, 3e5)).all()
    assert np.isnan(
        compute_pad_frequency(np.array([-3e5, -4e5, np.nan, np.inf]), 1e5, 0.3, 3e5)
    ).all()
    assert np.isnan(compute_pad_stress(np.inf, 1e5, 0.0, 3e5))


def test_tension_is_positive():
    assert compute_pad_stress(1.01e5, 1e5, 0.3, 3e5) > 0 > compute_pad_stress(0.99e5, 1e5, 0.3, 3e5)
    assert compute_pad_stress(np.float32(1e5), 1e5, 0.3, 3e5) == 0


def test_the_temperature_model():
    model = TemperatureModel(25, [[1e-4, 1e-6], [0, 0]])
    np.testing.assert_allclose(model.compute_factor([25, 35]), [[1, 1], [1 + 1e-3 + 1e-4, 1]])
    assert TemperatureModel.from_dict(model.to_dict()).to_dict() == model.to_dict()
    for bad in (
        {"reference": 25},
        {"reference": "warm", "coefficients": [[1]]},
        {"reference": 25, "coefficients": [1]},
        {"reference": 25, "coefficients": [[float("inf")]]},
        3,
    ):
        with pytest.raises(CalibrationError, match="temperature"):
            TemperatureModel.from_dict(bad)
