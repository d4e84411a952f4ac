# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The pad law: from the frequency of a pad's oscillator to the normal stress on the pad.

    r = f / f0,   d/d0 = r / (1 + beta (1 - r)),   v = E (d/d0 - 1)

With u = r - 1 this is v = E (1 + beta) u / (1 - beta u).

    v          normal stress on the pad in Pa, tension positive
    f, f0      frequency in Hz, under load and at rest
    d, d0      thickness of the pad's foam, under load and at rest
    beta       ratio of the parasitic capacitance to the active capacitance at rest
    E          modulus of the foam, in Pa

No thickness belongs to a frequency outside 0 < f < f0 (1 + beta) / beta; there the result is NaN.
All functions broadcast their arguments.

Source: Kiyota & Shinoda, eq. 6, f = k d / (R (eps S + C' d)), solved for d relative to its value at
rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Array, Real
from .compensation.models import EffectModel


def compute_pad_stress(
    frequency: ArrayLike,
    rest_frequency: ArrayLike,
    beta: Real,
    modulus: Real,
) -> Array:
    """Compute the normal stress on pads by the pad law, in Pa, tension positive.

    Args:
        frequency: Frequency of a pad's oscillator, in Hz.
        rest_frequency: Frequency without load, in Hz.
        beta: Ratio of the parasitic capacitance to the active capacitance at rest.
        modulus: Modulus of the pad's foam, in Pa.

    Returns:
        Stresses; NaN for frequencies outside 0 < f < `find_highest_frequency`, which no thickness
        of the foam explains.
    """
    f = np.asarray(frequency)
    f0 = np.asarray(rest_frequency)
    with np.errstate(all="ignore"):
        # The difference of the frequencies is formed first: f / f0 - 1 would lose digits in
        # float32, as f / f0 is near 1.
        u = (f - f0) / f0
        # The denominator is zero at the highest frequency that the pad law allows, at which the
        # foam is infinitely thick.
        denominator = 1 - beta * u
        v = modulus * (1 + beta) * u / denominator
        is_possible = (f > 0) & np.isfinite(f) & (denominator > 0)
        return np.where(is_possible, v, np.nan)


def compute_pad_frequency(
    stress: ArrayLike,
    rest_frequency: Real,
    beta: Real,
    modulus: Real,
) -> Array:
    """Compute the frequencies of pads, in Hz, from their stresses: `compute_pad_stress` inverted.

    Args:
        stress: Normal stress on a pad, in Pa, tension positive.
        rest_frequency: Frequency without load, in Hz.
        beta: Ratio of the parasitic capacitance to the active capacitance at rest.
        modulus: Modulus of the pad's foam, in Pa.

    Returns:
        Frequencies; NaN if the stress is -modulus or less, which would press the foam to a
        thickness of 0.
    """
    thickness = 1 + np.asarray(stress) / modulus
    with np.errstate(all="ignore"):
        f = rest_frequency * thickness * (1 + beta) / (1 + beta * thickness)
        is_possible = (thickness > 0) & np.isfinite(thickness)
        return np.where(is_possible, f, np.nan)


def find_highest_frequency(rest_frequency: ArrayLike, beta: ArrayLike) -> Array:
    """Compute the upper limit f0 (1 + beta) / beta of a pad's frequency, in Hz.

    The frequency approaches this limit when the foam becomes infinitely thick. Without parasitic
    capacitance (beta = 0) the limit is infinite.

    Args:
        rest_frequency: Frequency f0 without load, in Hz.
        beta: Ratio of the parasitic capacitance to the active capacitance at rest.
    """
    f0 = np.asarray(rest_frequency)
    beta = np.asarray(beta, dtype=float)
    with np.errstate(divide="ignore", over="ignore"):
        highest: Array = f0 * (1 + beta) / beta
        return highest


def compute_rest_ratio(coefficients: Array, change: Array) -> Array:
    """Compute the ratio 1 + sum_d c_d t^d of the rest frequencies of pads at two temperatures.

    Horner's scheme needs no powers, whose last bits depend on the processor.

    Args:
        coefficients: Coefficients c_d (..., D, P), in 1/K^d, the linear term first.
        change: Difference t of the temperatures (...), in K.
    """
    *_, n_degrees, n_pads = coefficients.shape
    t = change[..., None]
    total = np.zeros((*change.shape, n_pads))
    for d in reversed(range(n_degrees)):
        total = (total + coefficients[..., d, :]) * t
    return 1 + total


@dataclass(frozen=True, eq=False)
class TemperatureModel(EffectModel):
    """Polynomial of the rest frequency over temperature, relative to the reference temperature.

        f0(T) = f0 (1 + sum_d c_d (T - reference)^d),   d = 1, 2, ...

    Attributes:
        reference: Temperature in °C at which the rest frequencies of the calibration hold.
        coefficients: Coefficients c_d of each pad (P, D), in 1/K^d, the linear term first.
    """

    key = "temperature"
    axes: ClassVar[Mapping[str, str]] = {"reference": "", "coefficients": "PD"}

    reference: Array
    coefficients: Array

    def compute_factor(self, temperature: ArrayLike) -> Array:
        """Compute the ratio (N, P) of the rest frequencies at temperatures T (N,), in °C, to those
        at the reference temperature."""
        change = np.asarray(temperature, dtype=float) - self.reference
        return compute_rest_ratio(self.coefficients.T, change)
