"""The pad law: from the frequency of a pad's oscillator to the normal stress on the pad.

    r = f / f0,   strain d/d0 = r / (1 + beta (1 - r)),   v = E (d/d0 - 1)

which with u = r - 1 is v = E (1 + beta) u / (1 - beta u).

    v          Pa, tension positive
    f, f0      Hz, now and without load
    beta       parasitic over active capacitance at rest
    E          modulus, Pa

Frequencies outside 0 < f < f0 (1 + beta) / beta belong to no thickness and give NaN. All functions
broadcast. Source: the paper's eq. 6, f = k d / (R (eps S + C' d)), solved for d relative to rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .errors import CalibrationError


def pad_stress(frequency, rest_frequency, beta, modulus):
    """Normal stress in Pa, tension positive, from frequencies in Hz; NaN outside the law."""
    f, f0 = np.asarray(frequency), np.asarray(rest_frequency)
    with np.errstate(all="ignore"):
        u = (f - f0) / f0
        rest = 1 - beta * u
        v = modulus * (1 + beta) * u / rest
        return np.where((f > 0) & np.isfinite(f) & (rest > 0), v, np.nan)


def pad_frequency(stress, rest_frequency, beta, modulus):
    """The inverse of pad_stress: Hz from Pa; NaN at or below -E, where no thickness is left."""
    strain = 1 + np.asarray(stress) / modulus
    with np.errstate(all="ignore"):
        f = rest_frequency * strain * (1 + beta) / (1 + beta * strain)
        return np.where((strain > 0) & np.isfinite(strain), f, np.nan)


def stress_slope(frequency, rest_frequency, beta, modulus):
    """dv/df in Pa/Hz; at rest E (1 + beta) / f0. NaN outside the law's range."""
    f, f0 = np.asarray(frequency), np.asarray(rest_frequency)
    with np.errstate(all="ignore"):
        rest = 1 - beta * (f - f0) / f0
        return np.where((f > 0) & (rest > 0), modulus * (1 + beta) / (f0 * rest**2), np.nan)


def highest_frequency(rest_frequency, beta):
    """f0 (1 + beta) / beta in Hz, of an infinitely thick pad; inf without parasitic capacitance."""
    with np.errstate(divide="ignore", over="ignore"):
        return rest_frequency * (1 + beta) / np.asarray(beta, dtype=float)


def linear_pad_stress(frequency, rest_frequency, beta, modulus):
    """v = E (1 + beta) (f - f0) / f0: the paper's eq. 7 with R/k for k/R, tension positive. A
    check."""
    f0 = np.asarray(rest_frequency)
    return modulus * (1 + beta) * (np.asarray(frequency) - f0) / f0


@dataclass(frozen=True, eq=False)
class TemperatureModel:
    """f0(T) = f0 (1 + sum_d c_d (T - reference)^d), d = 1, 2 ...; f0 is the rest frequency at the
    reference.

    reference: degrees Celsius; coefficients: (P, D) per degree^d and pad
    """

    reference: float
    coefficients: np.ndarray

    def __post_init__(self) -> None:
        try:
            reference = float(self.reference)
            coefficients = np.array(self.coefficients, dtype=float)
        except (TypeError, ValueError):
            raise CalibrationError(
                f"temperature: reference {self.reference!r} and coefficients "
                f"{self.coefficients!r} must be numbers"
            ) from None
        if coefficients.ndim != 2 or coefficients.shape[1] == 0:
            raise CalibrationError(
                f"temperature: coefficients have shape {coefficients.shape}; "
                "they must be one list per pad, the linear term first"
            )
        if not (np.isfinite(reference) and np.all(np.isfinite(coefficients))):
            raise CalibrationError("temperature: reference and coefficients must be finite")
        coefficients.flags.writeable = False
        object.__setattr__(self, "reference", reference)
        object.__setattr__(self, "coefficients", coefficients)

    def factor(self, temperature) -> np.ndarray:
        """f0(T) / f0, shape (N, P) for temperatures (N,) in degrees Celsius."""
        dt = np.asarray(temperature, dtype=float)[..., None] - self.reference
        powers = dt[..., None] ** np.arange(1, self.coefficients.shape[1] + 1)
        return 1 + np.sum(self.coefficients * powers, axis=-1)

    def to_dict(self) -> dict[str, Any]:
        return {"reference": self.reference, "coefficients": self.coefficients.tolist()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> TemperatureModel:
        if not isinstance(data, Mapping) or set(data) != {"reference", "coefficients"}:
            raise CalibrationError(
                f"temperature: found {data!r}; it is a table of reference and coefficients"
            )
        return cls(data["reference"], data["coefficients"])
