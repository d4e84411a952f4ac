"""Deviations of real pads from their calibrations: spread of gains, creep with hysteresis, failure.

Foam creeps: under a constant stress its strain keeps growing, and so does the stress that a pad
reports. In linear viscoelasticity the compliance is a Prony series (chain of Kelvin-Voigt
elements), J(t) = J(0) (1 + sum_i c_i (1 - exp(-t / tau_i))), so that a pad under the stress v(t)
reports::

    v + sum_i c_i q_i,     tau_i dq_i/dt = v - q_i

Loading and unloading then differ, which is the hysteresis of this model. The silicone around the
cubes needs no such term: if its Poisson's ratio does not change, the stress in a viscoelastic body
under given tractions is that of the elastic body (correspondence principle). The growth of contacts
as silicone creeps is not modelled.

Source: J. D. Ferry, Viscoelastic Properties of Polymers (1980), 1.E and 3.F; R. M. Christensen,
Theory of Viscoelasticity (1982), 2.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ..config.yaml import read_yaml
from ..core.arrays import Array
from ..core.errors import ConfigError


@dataclass(frozen=True)
class Imperfections:
    """How the pads of simulated cubes differ from their calibrations.

    Attributes:
        gain_spread: Standard deviation of a pad's sensitivity divided by the calibrated one.
        dead: Fraction of the pads whose oscillators do not run, 0 to 1.
        creep: Terms (c, tau) of the series in the module head: relative size, and time in s.
        seed: Seed that determines which pad is how.

    Raises:
        ConfigError: A value is out of range.
    """

    gain_spread: float = 0.0
    dead: float = 0.0
    creep: tuple[tuple[float, float], ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.gain_spread < 1:
            raise ConfigError(f"gain_spread is {self.gain_spread!r}, allowed: 0 to below 1")
        if not 0 <= self.dead <= 1:
            raise ConfigError(f"dead is {self.dead!r}, allowed: a part of the pads from 0 to 1")
        if self.seed < 0:
            raise ConfigError(f"seed is {self.seed!r}, allowed: a whole number from 0 up")
        for size, time in self.creep:
            if not (size >= 0 and time > 0):
                raise ConfigError(
                    f"a term of creep is {(size, time)!r}; give a size from 0 up and a time above "
                    "0 s"
                )


def read_imperfections(path: Path) -> Imperfections:
    """Read a YAML file with some of the fields of `Imperfections`.

    Raises:
        ConfigError: A key is unknown, or a value is wrong.
    """
    data = read_yaml(path)
    keys = [field.name for field in fields(Imperfections)]
    if not isinstance(data, dict) or not set(data) <= set(keys):
        found = [key for key in data if key not in keys] if isinstance(data, dict) else data
        raise ConfigError(
            f"{path}: found {str(found)[:60]!r}, allowed: a table of {', '.join(keys)}"
        )

    for key, value in data.items():
        allowed = _describe_mismatch(key, value)
        if allowed:
            raise ConfigError(f"{path}: {key}: found {str(value)[:60]!r}, allowed: {allowed}")
    if "creep" in data:
        data["creep"] = tuple((size, time) for size, time in data["creep"])
    try:
        return Imperfections(**data)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _describe_mismatch(key: str, value: Any) -> str:
    """Return what is allowed for a key if the type of its value is wrong, else an empty text."""
    if key == "creep":
        is_valid = isinstance(value, list) and all(_is_pair(term) for term in value)
        return "" if is_valid else "[[size, seconds], ...]"
    if key == "seed":
        return "" if isinstance(value, int) and _is_number(value) else "a whole number"
    return "" if _is_number(value) else "a number"


def _is_pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and type(value) is not bool and math.isfinite(value)


class PadBehaviour:
    """Imperfect pads of some cubes, with the creep that they have accumulated."""

    def __init__(
        self,
        imperfections: Imperfections,
        shape: tuple[int, int],
        seed: int,
    ) -> None:
        """Draw the gains and the dead pads.

        Args:
            imperfections: Size of the deviations.
            shape: Number of cubes and of pads per cube.
            seed: Seed that differs between the hubs of a skin.
        """
        random = np.random.default_rng([imperfections.seed, seed])
        self._gain = 1 + imperfections.gain_spread * random.standard_normal(shape)
        self._dead = random.random(shape) < imperfections.dead

        terms = np.array(imperfections.creep, float).reshape(-1, 2)
        self._creep_size = terms[:, 0]
        self._creep_time = terms[:, 1]
        self._crept = np.zeros((len(terms), *shape))  # q_i of the module head
        self._seconds = 0.0

    def reported(self, stress: Array, seconds: float) -> Array:
        """Compute the stress that pads report.

        Args:
            stress: True stress (cubes, pads) in Pa since the previous call.
            seconds: Simulated time in s.

        Returns:
            Reported stress (cubes, pads) in Pa; NaN for a dead pad.
        """
        reported = np.where(self._dead, np.nan, stress * self._gain)
        if len(self._creep_time):
            elapsed = max(seconds - self._seconds, 0.0)
            # Solution of tau dq/dt = v - q for a constant v: 1 - exp(-t / tau)
            approach = -np.expm1(-elapsed / self._creep_time)[:, np.newaxis, np.newaxis]
            self._crept += approach * (np.nan_to_num(reported) - self._crept)
            reported += np.tensordot(self._creep_size, self._crept, axes=1)
            self._seconds = seconds
        return reported
