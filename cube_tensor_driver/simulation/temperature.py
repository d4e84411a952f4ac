# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Temperature of a simulated skin: heat conduction through its layer, thermal stress and drift.

The ground below the elastomer has a given temperature, and the surface exchanges heat with the air.
The layer has the height h, the thermal diffusivity D and the thermal conductivity k; its
temperature at the height z above the ground is T(z, t)::

    dT/dt = D d²T/dz²,   T(0) = T_ground,   -k dT/dz(h) = exchange (T(h) - T_air)

Finite volumes turn this into a linear system, whose eigenvectors are advanced exactly under
temperatures of ground and air that are linear in time. The thermal stress of a pad is linear in
T(z); finite elements (`./cube fem --load temperature`) have computed it for Legendre polynomials.
The oscillators of a cube have the mean temperature of the layer between the lower and the upper
face of the cube. The conduction of heat along the layer, and into the cubes, which conduct better
than the elastomer, is left out.

Source: H. S. Carslaw, J. C. Jaeger, Conduction of Heat in Solids (1959), 3.11.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, TypedDict, cast

import numpy as np
from numpy.polynomial.legendre import legvander

from ..config.package_data import find_shipped
from ..config.yaml import read_yaml
from ..core.arrays import Array
from ..core.errors import ConfigError
from .imperfections import Imperfections

REFERENCE_CELSIUS = 25.0
"""Temperature, in °C, at which the rest frequencies of the calibrations hold and no pad has thermal
stress."""

DIFFUSIVITY = 1.25e-7
"""Thermal diffusivity D of silicone rubber, in m²/s: conductivity / (density × heat capacity)."""

CONDUCTIVITY = 0.2
"""Thermal conductivity k of silicone rubber, in W/(m K)."""

CELLS = 44
"""Number of finite volumes across a layer. 10 s after a step of the temperature of ground or air,
the error of the temperature in the layer is below 2e-3 of the step."""


class ThermalLayer(NamedTuple):
    """Elastomer layer with cubes, as a file of `./cube fem --load temperature` describes it.

    Attributes:
        height: Height of the layer, in m.
        depth: Distance from the centre of a cube to the surface, in m.
        side: Side of a cube, in m.
        pads: Stress on each of P pads under each of K temperature profiles across the layer (P, K),
            in Pa per kelvin. Profile k is the Legendre polynomial of degree k, whose variable grows
            from -1 at the ground to 1 at the surface.
    """

    height: float
    depth: float
    side: float
    pads: Array


class _ThermalContent(TypedDict):
    """Keys of a file of thermal stress that `read_thermal_stress` uses."""

    height: float
    depth: float
    side: float
    pads: list[list[float]]


def read_thermal_stress(name: str, n_pads: int) -> ThermalLayer:
    """Read a file of thermal stress that `./cube fem --load temperature -o` has written.

    Args:
        name: Path of the file, or the name of one in the package.
        n_pads: Number of pads P that the cubes have.

    Raises:
        ConfigError: There is no such file, or it has another number of pads.
    """
    advice = "a file of ./cube fem --load temperature"
    file = find_shipped(
        "thermal/*.yaml",
        name,
        Path(),
        advice,
    )
    # Content of another kind raises an error while the layer is made of it.
    data = cast("_ThermalContent", read_yaml(file))
    try:
        pads = np.array(data["pads"], float)
        layer = ThermalLayer(
            height=float(data["height"]),
            depth=float(data["depth"]),
            side=float(data["side"]),
            pads=pads,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{name}: {error} does not suit; ./cube fem --load temperature -o writes a file"
        ) from None
    if pads.ndim != 2 or len(pads) != n_pads:
        raise ConfigError(
            f"{name}: thermal stress of shape {pads.shape}, the cubes have {n_pads} pads; compute "
            "it with ./cube fem --load temperature for their layout"
        )
    return layer


class WarmLayer:
    """Computes the temperature across the elastomer layer at some cubes as time advances.

    The layer contains the cubes. It lies on the ground, the body that carries the skin, and its
    surface is in the air. The temperatures of ground and air determine that of the layer.
    """

    def __init__(
        self,
        height: Array,
        exchange: float,
        ground: float,
        air: float,
    ) -> None:
        """Begin with the steady state under constant temperatures of ground and air.

        Args:
            height: Height of the layer at each cube (cubes,), in m.
            exchange: Heat exchange of the surface with the air, in W/(m² K).
            ground: Temperature of the ground, in °C.
            air: Temperature of the air, in °C.
        """
        size = height[:, None] / CELLS
        air_resistance = CONDUCTIVITY / (exchange * size[:, 0])
        to_air = 1 / (air_resistance + 0.5)
        # Each finite volume exchanges heat with the next one. The first one exchanges twice as much
        # with the ground, which is at half the distance.
        next_one = np.eye(CELLS, k=1)
        coupling = next_one + next_one.T
        exchanged = coupling.sum(axis=0)
        loss = np.tile(exchanged, (len(height), 1))
        loss[:, 0] += 2
        loss[:, -1] += to_air
        diagonal = loss[:, None] * np.eye(CELLS)
        rate, self._vectors = np.linalg.eigh(coupling - diagonal)
        self._rate = -rate * DIFFUSIVITY / size**2
        # Amplitude of each eigenvector in the steady state, per °C of the ground and of the air.
        at_ground = self._vectors[:, 0]
        at_surface = self._vectors[:, -1]
        self._from_ground = 2 * at_ground / -rate
        self._from_air = to_air[:, None] * at_surface / -rate
        self._steady = self._find_steady(ground, air)
        self._amplitude = self._steady

    def _find_steady(self, ground: float, air: float) -> Array:
        """Return the amplitude of each eigenvector (cubes, `CELLS`) in the steady state, in °C.

        Args:
            ground: Constant temperature of the ground, in °C.
            air: Constant temperature of the air, in °C.
        """
        return np.asarray(ground * self._from_ground + air * self._from_air)

    @property
    def temperature(self) -> Array:
        """Temperature of each finite volume (cubes, `CELLS`), in °C, from the ground up."""
        return np.asarray(np.einsum("cij,cj->ci", self._vectors, self._amplitude))

    def advance(
        self,
        seconds: float,
        ground: float,
        air: float,
    ) -> None:
        """Compute the temperatures of the layer after a further span of time.

        Args:
            seconds: Length of the span, in s, in which ground and air change linearly.
            ground: Temperature of the ground at its end, in °C.
            air: Temperature of the air at its end, in °C.
        """
        if seconds <= 0:
            return
        steady = self._find_steady(ground, air)
        steps = self._rate * seconds
        decay = np.exp(-steps)
        # The steady state changes linearly with ground and air. The amplitudes lag behind it by
        # `lag`, and their initial departure from it decays exponentially.
        lag = (steady - self._steady) * -np.expm1(-steps) / steps
        departure = self._amplitude - self._steady
        self._amplitude = steady + departure * decay - lag
        self._steady = steady


class ThermalPads:
    """Computes the effect of temperature on the pads of some cubes: thermal stress and drift."""

    def __init__(
        self,
        imperfections: Imperfections,
        shape: tuple[int, int],
        seed: int,
    ) -> None:
        """Prepare the layer.

        Args:
            imperfections: Temperatures of ground and air, and the spread of their effects.
            shape: Number of cubes and of pads per cube.
            seed: Seed that differs between the hubs of a skin.

        Raises:
            ConfigError: The file of thermal stress cannot be used for these cubes.
        """
        n_cubes, n_pads = shape
        layer = read_thermal_stress(imperfections.thermal_stress, n_pads)
        random = np.random.default_rng([imperfections.seed, seed, 1])
        deviation = random.standard_normal(n_cubes).clip(-3, 3)
        height = layer.height * (1 + imperfections.layer_spread * deviation)
        spread = 1 + imperfections.pad_drift_spread * random.standard_normal(shape)
        # Relative change of the rest frequency of each pad per K.
        self._drift = imperfections.pad_drift * spread

        ground = np.array(imperfections.temperature).T
        air = np.array(imperfections.air).T if imperfections.air else ground[:, :1]
        # The two rows of each array are times in s and temperatures in °C.
        self._knots = [ground, air]
        self._seconds = 0.0
        outside = self._find_outside_temperatures(0.0)
        self._layer = WarmLayer(height, imperfections.heat_exchange, *outside)

        # Centres of the finite volumes, from -1 at the ground to 1 at the surface.
        s = (2 * np.arange(CELLS) + 1) / CELLS - 1
        # The temperatures are fitted by least squares, because Legendre polynomials are not
        # orthogonal on a grid.
        degree = layer.pads.shape[1] - 1
        to_profiles = np.linalg.pinv(legvander(s, degree))
        self._to_stress = layer.pads @ to_profiles

        height_above_ground = (s + 1) * layer.height / 2
        centre = layer.height - layer.depth
        to_centre = height_above_ground - centre
        self._in_cube = np.abs(to_centre) < layer.side / 2

    def _find_outside_temperatures(self, seconds: float) -> tuple[float, float]:
        """Return the temperatures of ground and air at a time in s, in °C."""
        ground, air = (float(np.interp(seconds, *knots)) for knots in self._knots)
        return ground, air

    def measure(self, seconds: float) -> float:
        """Return the temperature, in °C, that the hub measures: the one below the elastomer."""
        return round(self._find_outside_temperatures(seconds)[0], 2)

    def compute_effect(self, seconds: float) -> tuple[Array, Array]:
        """Return the effect of temperature on the pads.

        Args:
            seconds: Simulated time in s; it should not decrease from call to call.

        Returns:
            Thermal stress of the pads (cubes, P), in Pa, and the factors (cubes, P) by which
            temperature multiplies their rest frequencies.
        """
        knots = np.concatenate([times for times, _ in self._knots])
        passed = knots[(knots > self._seconds) & (knots < seconds)]
        for time in [*sorted(passed.tolist()), seconds]:
            outside = self._find_outside_temperatures(time)
            self._layer.advance(time - self._seconds, *outside)
            self._seconds = time

        rise = self._layer.temperature - REFERENCE_CELSIUS
        in_cube = rise[:, self._in_cube].mean(axis=1)
        stress = rise @ self._to_stress.T
        factor = 1 + self._drift * in_cube[:, None]
        return stress, factor
