# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Deviations of real pads from their calibrations: spread of gains, creep with hysteresis, failure,
and the effects of temperature (`temperature.py`) and of weight (`motion.py`).

The foam of the pads creeps: under a constant stress, its strain keeps growing, and so does the
stress that a pad reports. In linear viscoelasticity, the compliance J (strain per stress) is a
Prony series (chain of Kelvin-Voigt elements), J(t) = J(0) (1 + sum_i c_i (1 - exp(-t / tau_i))).
So a pad under the stress v(t) reports the following stress, in which q_i is v after a first-order
low-pass filter with the time constant tau_i::

    v + sum_i c_i q_i,     tau_i dq_i/dt = v - q_i

Loading and unloading then differ, which is the hysteresis of this model. Measured elastomers follow
a power law over many decades of time instead, J(t) = J(0) (1 + a t^alpha) (fractional element). The
power law is an integral over Kelvin-Voigt elements of all time constants tau::

    t^alpha = alpha / Gamma(1 - alpha) * integral of (1 - exp(-t / tau)) tau^(alpha - 1) dtau

The simulation replaces the integral by a sum over many time constants, with a negligible error. The
silicone around the cubes needs no creep terms: if its Poisson's ratio does not change, the stress
in a viscoelastic body under given tractions is that of the elastic body (correspondence principle).
The growth of contacts as silicone creeps is not modelled.

Source: J. D. Ferry, Viscoelastic Properties of Polymers (1980), 1.E and 3.F; R. M. Christensen,
Theory of Viscoelasticity (1982), 2.2; F. Mainardi, Fractional Calculus and Waves in Linear
Viscoelasticity (2010), 2.5 and 3.1.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ..config.schema import (
    TEXT,
    JsonSchema,
    Schema,
    make_integer_schema,
    make_mapping_schema,
    make_number_schema,
)
from ..config.yaml import read_yaml
from ..core.arrays import Array
from ..core.errors import ConfigError

MAX_SEED = (1 << 63) - 1
"""Largest seed of the random deviations of the pads: the largest signed 64-bit integer."""

GROWTH_S = 600.0
"""Time, in s, after the start of a steady load. `Imperfections.creep_growth` states how much the
stress that pads report has grown by creep until this time."""

MAX_DEVIATIONS = 6
"""Largest deviation of the creep of a pad from the mean, in standard deviations. Random deviations
that are larger, which occur about twice in 10^9 pads, are limited to this value."""

POWER_LAW_TIMES = np.geomspace(1e-4, 1e10, 51)
"""Time constants (51,), in s, of the exponential terms whose sum replaces a power law of creep.

With their ratio of 1.9, the sum differs from the power law by less than 1e-5 of the load. Loads
that last 0.01 s to some hours lie far within their range.
"""


def _make_table_schema(columns: str, *schemas: JsonSchema) -> JsonSchema:
    """Return the schema of a list of rows of numbers.

    Args:
        columns: Names of the columns, for error messages.
        schemas: Schema of the number in each column.
    """
    row = {
        "type": "array",
        "items": list(schemas),
        "minItems": len(schemas),
        "maxItems": len(schemas),
        "description": f"[{columns}]",
    }
    return {
        "type": "array",
        "items": row,
        "description": f"[[{columns}], ...]",
    }


_NUMBER = make_number_schema("a number")
"""Schema of a number of any size."""
_KNOTS = _make_table_schema("seconds, °C", _NUMBER, _NUMBER)
"""Schema of a temperature that is linear in time between the given points."""

_SCHEMA = Schema(
    make_mapping_schema(
        (),
        {
            "gain_spread": make_number_schema(
                "a number from 0 to below 1",
                minimum=0,
                exclusiveMaximum=1,
            ),
            "dead": make_number_schema("a fraction of the pads from 0 to 1", minimum=0, maximum=1),
            "creep": _make_table_schema(
                "size, seconds",
                make_number_schema("a size from 0 up", minimum=0),
                make_number_schema("a time above 0 s", exclusiveMinimum=0),
            ),
            "creep_growth": make_number_schema(
                "a growth from 0 to below 1",
                minimum=0,
                exclusiveMaximum=1,
            ),
            "creep_exponent": make_number_schema(
                "an exponent between 0 and 1",
                exclusiveMinimum=0,
                exclusiveMaximum=1,
            ),
            "creep_spread": make_number_schema(
                "a number from 0 to below 1",
                minimum=0,
                exclusiveMaximum=1,
            ),
            "temperature": _KNOTS,
            "air": _KNOTS,
            "heat_exchange": make_number_schema("a number above 0 in W/(m² K)", exclusiveMinimum=0),
            "thermal_stress": TEXT,
            "pad_drift": make_number_schema("a relative change per K"),
            "pad_drift_spread": make_number_schema("a number from 0 up", minimum=0),
            "layer_spread": make_number_schema("a number from 0 to 0.3", minimum=0, maximum=0.3),
            "poses": _make_table_schema("seconds, x, y, z, roll, pitch, yaw", *[_NUMBER] * 7),
            "weight": TEXT,
            "seed": make_integer_schema(0, MAX_SEED, "a whole number from 0 up"),
        },
    )
)
"""Schema of the file of imperfections."""

_TABLES = {"creep", "temperature", "air", "poses"}
"""Names of the fields of `Imperfections` that hold rows of numbers. Each row is a list in the YAML
file and a tuple in an instance, so these fields are converted from one to the other."""


@dataclass(frozen=True, kw_only=True)
class Imperfections:
    """How the pads of simulated cubes differ from their calibrations.

    Attributes:
        gain_spread: Standard deviation of a pad's sensitivity divided by the calibrated one.
        dead: Fraction of the pads whose oscillators do not run, 0 to 1.
        creep: Terms (c, tau) of the creep: in addition to the stress, a pad reports c times the
            stress after a low-pass filter with the time constant tau, in s.
        creep_growth: Mean relative growth of the reported stress under a steady load, from 1 s to
            `GROWTH_S` (600 s) after its start, by creep with a power law. At 1 s the reported
            stress is the true one, because pads are calibrated at about 1 s.
        creep_exponent: Exponent alpha of the power law, 0 to 1.
        creep_spread: Standard deviation of a pad's `creep_growth` divided by the mean.
        temperature: Times in s and temperatures in °C of the ground below the skin, which the
            thermometers of the hubs measure; between these times it changes linearly. Empty: the
            temperature is unknown and has no effect.
        air: Times in s and temperatures in °C of the air above the skin, which also changes
            linearly between them. Empty: the air keeps the first temperature of the ground.
        heat_exchange: Heat exchange of the surface with the air, in W/(m² K).
        thermal_stress: File, written by `./cube fem --load temperature -o`, with the layer and the
            stress of the pads in it, or the name of such a file in the package.
        pad_drift: Mean relative change of the rest frequency (frequency without load) of a pad per
            K, because of its electronics.
        pad_drift_spread: Standard deviation of a pad's `pad_drift` divided by the mean.
        layer_spread: Standard deviation of the layer's height at a cube divided by the mean.
        poses: Times in s, positions in m, and roll, pitch, yaw in rad of the parent frame of the
            skin in the world, whose z axis points up. Between two poses each number follows half a
            period of a cosine. Empty: cubes and elastomer weigh nothing.
        weight: File, written by `./cube fem --load weight -o`, with the stress of the pads per
            specific force, or the name of such a file in the package.
        seed: Seed of the random numbers that determine the deviation of each pad.

    Raises:
        ConfigError: A value is out of range.
    """

    gain_spread: float = 0.0
    dead: float = 0.0
    creep: tuple[tuple[float, float], ...] = ()
    creep_growth: float = 0.0
    creep_exponent: float = 0.2
    creep_spread: float = 0.0
    temperature: tuple[tuple[float, float], ...] = ()
    air: tuple[tuple[float, float], ...] = ()
    heat_exchange: float = 10.0
    thermal_stress: str = "cube_11mm"
    pad_drift: float = 1e-4
    pad_drift_spread: float = 0.0
    layer_spread: float = 0.0
    poses: tuple[tuple[float, ...], ...] = ()
    weight: str = "cube_11mm"
    seed: int = 0

    def __post_init__(self) -> None:
        # The rows are tuples here, but lists in a file, which the schema describes.
        values = asdict(self)
        for name in _TABLES:
            values[name] = [list(row) for row in getattr(self, name)]
        for _, mistake in _SCHEMA.find_mistakes(values):
            raise ConfigError(mistake)
        for name in ("temperature", "air", "poses"):
            times = [time for time, *_ in getattr(self, name)]
            if times != sorted(set(times)):
                raise ConfigError(f"{name}: found the times {times} s, allowed: rising times")
        # The reported stress is the true one 1 s after the start of a load, and smaller before.
        # With a growth above the limit, it would be negative at the start.
        max_growth = GROWTH_S**self.creep_exponent - 1
        max_spread = 1 + MAX_DEVIATIONS * self.creep_spread
        limit = max_growth / max_spread
        if self.creep_growth >= limit:
            raise ConfigError(
                f"creep_growth: found {self.creep_growth:g}, allowed: below {limit:.3g} with this "
                "creep_exponent and creep_spread"
            )


NONE = Imperfections()
"""Pads that agree with their calibrations."""


def read_imperfections(path: Path) -> Imperfections:
    """Read a YAML file with some of the fields of `Imperfections`.

    Raises:
        ConfigError: A key is unknown, or a value is wrong.
    """
    data = read_yaml(path)
    mistakes = _SCHEMA.find_mistakes(data)
    if mistakes or not isinstance(data, dict):
        _, mistake = mistakes[0]
        raise ConfigError(f"{path}: {mistake}")
    # Lists become tuples, because an instance of `Imperfections` is immutable.
    for name in _TABLES & data.keys():
        data[name] = tuple(map(tuple, data[name]))
    return Imperfections(**data)


class PadBehaviour:
    """Computes the stress that imperfect pads of some cubes report.

    Because of creep, the reported stress depends on all stresses since the beginning.
    """

    def __init__(
        self,
        imperfections: Imperfections,
        shape: tuple[int, int],
        seed: int,
    ) -> None:
        """Draw random gains (relative sensitivities) of the pads, and the pads that do not work.

        Args:
            imperfections: Size of the deviations.
            shape: Number of cubes and of pads per cube.
            seed: Seed that differs between the hubs of a skin.
        """
        # The random numbers are drawn in the same order whatever the imperfections are, so that a
        # seed gives the same dead pads (pads that do not work) whatever the other deviations are.
        random = np.random.default_rng([imperfections.seed, seed])
        self._gain = 1 + imperfections.gain_spread * random.standard_normal(shape)
        self._dead = random.random(shape) < imperfections.dead

        # Without terms, the array must have the shape (0, 2).
        terms = np.array(imperfections.creep, float)
        terms = terms.reshape(-1, 2)
        self._creep_time = terms[:, 1]
        self._creep_size = np.ones(shape) * terms[:, 0, None, None]
        # Fraction (cubes, pads) of the stress that a pad reports without delay.
        self._at_once: Array = np.ones(shape)
        if imperfections.creep_growth:
            deviation = random.standard_normal(shape).clip(-MAX_DEVIATIONS, MAX_DEVIATIONS)
            spread = np.maximum(1 + imperfections.creep_spread * deviation, 0)
            growth = imperfections.creep_growth * spread
            self._add_power_law(growth, imperfections.creep_exponent)
        self._crept = np.zeros_like(self._creep_size)  # low-passed stress of each term, in Pa
        self._seconds = 0.0

    def _add_power_law(self, growth: Array, exponent: float) -> None:
        """Add the terms of creep with a power law.

        Args:
            growth: Relative growth (cubes, pads) of the reported stress from 1 s to `GROWTH_S`.
            exponent: Exponent alpha of the power law.
        """
        # The reported stress divided by the true one, at the time t in s after the start of a
        # steady load, is 1 + factor (t^alpha - 1).
        factor = growth / (GROWTH_S**exponent - 1)
        step = math.log(POWER_LAW_TIMES[1] / POWER_LAW_TIMES[0])
        weight = exponent / math.gamma(1 - exponent) * POWER_LAW_TIMES**exponent
        # t^alpha is an integral of the terms 1 - exp(-t / tau) over tau. The part of the integral
        # with shorter time constants than the first of `POWER_LAW_TIMES` is reported without delay.
        fastest = weight[0] / exponent * math.exp(-exponent * step / 2)
        self._at_once = 1 - factor * (1 - fastest)
        self._creep_time = np.append(self._creep_time, POWER_LAW_TIMES)
        sizes = factor * (weight * step)[:, None, None]
        self._creep_size = np.concatenate([self._creep_size, sizes])

    def compute_reported(self, stress: Array, seconds: float) -> Array:
        """Compute the stress that the pads report, and advance their creep.

        Args:
            stress: True stress (cubes, pads) in Pa, taken as constant since the previous call.
            seconds: Simulated time in s; it should not decrease from call to call.

        Returns:
            Reported stress (cubes, pads) in Pa; NaN for a pad that does not work.
        """
        # NaN stands for the missing frequency of an oscillator that does not run.
        stress = np.where(self._dead, np.nan, stress * self._gain)
        reported = stress * self._at_once
        if len(self._creep_time):
            elapsed = max(seconds - self._seconds, 0.0)
            # The low-passed stress q follows tau dq/dt = v - q. If the stress v is constant for the
            # time t, q approaches it by the fraction 1 - exp(-t / tau).
            approach = -np.expm1(-elapsed / self._creep_time)
            target = np.nan_to_num(stress)
            self._crept += approach[:, None, None] * (target - self._crept)
            reported += (self._creep_size * self._crept).sum(axis=0)
            self._seconds = seconds
        return reported
