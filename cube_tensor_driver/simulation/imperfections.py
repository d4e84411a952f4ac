"""What real pads do that their calibrations do not say: spread, creep with hysteresis, failure.

Foam creeps: under a constant stress its strain goes on growing, and so does what a pad reports of
it. In linear viscoelasticity the compliance is a Prony series (chain of Kelvin and Voigt elements),
J(t) = J(0) (1 + sum_i c_i (1 - exp(-t / tau_i))), so that a pad under the stress v(t) reports::

    v + sum_i c_i q_i,     tau_i dq_i/dt = v - q_i

Loading and unloading then differ: that is the hysteresis of this model. The silicone around the
cubes needs no such term: as long as its Poisson's ratio does not change, the stress in a
viscoelastic body under given tractions is that of the elastic body (correspondence principle). That
contacts widen as silicone creeps is left out.

Source: J. D. Ferry, Viscoelastic Properties of Polymers (1980), 1.E and 3.F; R. M. Christensen,
Theory of Viscoelasticity (1982), 2.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..config.yaml import read_yaml
from ..core.arrays import Array
from ..core.errors import ConfigError


@dataclass(frozen=True)
class Imperfections:
    """How the pads of simulated cubes differ from their calibrations.

    gain_spread: standard deviation of a pad's sensitivity over the calibrated one, relative
    dead: part of the pads whose oscillators do not run, 0 to 1
    creep: terms (c, tau) of the series in the module head: relative size, and time in s
    seed: of which pads are how

    ConfigError: a value is out of range.
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
    """A file with some of the fields of `Imperfections`, as YAML. ConfigError: it has another key
    or a value that is none."""
    data = read_yaml(path)
    keys = tuple(Imperfections.__dataclass_fields__)
    if not isinstance(data, dict) or not set(data) <= set(keys):
        found = [key for key in data if key not in keys] if isinstance(data, dict) else data
        raise ConfigError(
            f"{path}: found {str(found)[:60]!r}, allowed: a table of {', '.join(keys)}"
        )
    for key, value in data.items():
        if key == "creep":
            fits = isinstance(value, list) and all(_is_pair(term) for term in value)
        else:
            fits = _is_number(value) and (key != "seed" or isinstance(value, int))
        if not fits:
            allowed = {"creep": "[[size, seconds], ...]", "seed": "a whole number"}
            raise ConfigError(
                f"{path}: {key}: found {str(value)[:60]!r}, allowed: {allowed.get(key, 'a number')}"
            )
    if "creep" in data:
        data["creep"] = tuple((size, time) for size, time in data["creep"])
    try:
        return Imperfections(**data)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _is_pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and type(value) is not bool and math.isfinite(value)


class PadBehaviour:
    """The pads of some cubes, with the creep that they have by now. shape: (cubes, pads)."""

    def __init__(self, imperfections: Imperfections, shape: tuple[int, int], seed: int) -> None:
        random = np.random.default_rng([imperfections.seed, seed])
        self._gain = 1 + imperfections.gain_spread * random.standard_normal(shape)
        self._dead = random.random(shape) < imperfections.dead
        terms = np.array(imperfections.creep, float).reshape(-1, 2)
        self._size, self._time = terms[:, 0], terms[:, 1]
        self._crept = np.zeros((len(terms), *shape))
        self._seconds = 0.0

    def reported(self, stress: Array, seconds: float) -> Array:
        """Stress (cubes, pads) in Pa that pads report under that stress, which has lasted since the
        last call; NaN: the pad is dead."""
        pressed = np.where(self._dead, np.nan, stress * self._gain)
        if len(self._time):
            passed = max(seconds - self._seconds, 0.0)
            part = -np.expm1(-passed / self._time)[:, None, None]
            self._crept += part * (np.nan_to_num(pressed) - self._crept)
            pressed += np.tensordot(self._size, self._crept, axes=1)
            self._seconds = seconds
        return pressed
