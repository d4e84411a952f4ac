"""What the pads of one planar cube show of simple loads, and what two pads alone take for shear.

For docs/stress_tensor.md. The response is that of the shipped planar calibration, the load is a
frictionless ball on a half space.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cube_tensor_driver.config.calibration import read_calibration
from cube_tensor_driver.config.package_data import package_data
from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.calibration import Calibration
from cube_tensor_driver.core.defaults import POISSONS_RATIO, SURFACE_DEPTH
from cube_tensor_driver.core.estimator import make_estimator
from cube_tensor_driver.core.modes import COMPONENTS
from cube_tensor_driver.mechanics import contact

LOAD = -10e3
"""Stress of each simple load, Pa."""
BALL_RADIUS, BALL_FORCE = 0.004, (0.0, 0.0, -2.0)
"""Of the contact, m; on the skin, N."""
REACH = 0.016
"""The ball presses at places from minus to plus this, m."""
BALL_X = 0.005
"""Where the ball presses in the picture of the field, m."""
PAIR = ("+z-x", "+z+x")
"""The two pads of a sensor that has pads on its upper face only."""


def planar_calibration() -> Calibration:
    return read_calibration(package_data() / "config" / "calibration" / "planar.yaml")


def simple_loads(calibration: Calibration) -> dict[str, Array]:
    """State (7,) of each load by its title: pressure, shear, pressure that grows along x."""
    names = calibration.modes.names
    size = f"{abs(LOAD) / 1e3:g}$ kPa"
    states = {
        rf"pressure: $\sigma_{{zz}} = -{size}": {"zz": LOAD},
        rf"shear: $\sigma_{{zx}} = {size}": {"zx": -LOAD},
        rf"growing pressure: $-{abs(LOAD) / 1e3:g}\,(1 + x/d_0)$ kPa": {
            "zz": LOAD,
            "zz_x": LOAD,
        },
    }
    return {
        title: np.array([state.get(name, 0.0) for name in names]) for title, state in states.items()
    }


@dataclass(frozen=True, eq=False)
class Sweep:
    """A frictionless ball, and what sensors under x = 0 make of it.

    place: (M,) along x, m
    profile: (M,) σzz there in the plane of the sensor while the ball presses at BALL_X, Pa
    value, slope: σzz and ∂σzz/∂x at the sensor then, Pa and Pa/m
    truth, cube, pair: (M,) σzx at the sensor while the ball presses at `place`: true, found by all
        eight pads, taken for shear by the two upper pads, Pa
    """

    place: Array
    profile: Array
    value: float
    slope: float
    truth: Array
    cube: Array
    pair: Array


def sweep(points: int = 129) -> Sweep:
    """Stress at the sensor for each place of the ball, and what the pads make of it.

    The response is linear in stress and gradient, as in the driver. The pair is calibrated by
    uniform shear alone.
    """
    calibration = planar_calibration()
    place = np.linspace(-REACH, REACH, points)
    profile = _field(place - BALL_X)[0][:, 2]
    at_sensor, its_gradient = _field([-BALL_X])

    stress, gradient = _field(-place)
    slopes = calibration.half_side * gradient
    state = {"zz": stress[:, 2], "zx": stress[:, 4], "xx": stress[:, 0]}
    state |= {"zz_x": slopes[:, 2, 0], "zz_z": slopes[:, 2, 2]}
    state |= {"xx_x": slopes[:, 0, 0], "xx_z": slopes[:, 0, 2]}
    states = np.stack([state[name] for name in calibration.modes.names], axis=1)
    pads = states @ calibration.response.T

    every_pad = make_estimator(calibration.response, calibration.noise, calibration.modes)
    cube = pads @ every_pad.matrix[COMPONENTS.index("zx")]
    left, right = (calibration.layout.index(name) for name in PAIR)
    of_shear = calibration.response[:, calibration.modes.names.index("zx")]
    shown = float(at_sensor[0, 2]), float(its_gradient[0, 2, 0])
    pair = (pads[:, left] - pads[:, right]) / (of_shear[left] - of_shear[right])
    return Sweep(place, profile, *shown, stress[:, 4], cube, pair)


def _field(x: Array | list[float]) -> tuple[Array, Array]:
    """Stress (N, 6) and gradient (N, 6, 3) at places x from the ball, in the sensor's plane."""
    points = np.stack([x, np.zeros(len(x)), np.full(len(x), -SURFACE_DEPTH)], axis=1)
    ball = contact.hertz(BALL_RADIUS, BALL_FORCE, np.zeros(2))
    return contact.field(points, *ball, POISSONS_RATIO)
