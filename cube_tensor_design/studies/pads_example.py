# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pad stresses of one planar cube under simple loads, and the shear that two pads alone would give.

The numbers are for docs/stress_tensor.md. The response is that of the shipped planar calibration,
the load is a frictionless ball on a half space.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cube_tensor_driver.config.calibration import read_calibration
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.calibration import Calibration
from cube_tensor_driver.core.defaults import POISSONS_RATIO, SURFACE_DEPTH
from cube_tensor_driver.core.modes import COMPONENTS
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.simulation.cubes import compute_true_amplitudes

from .field_study import compute_field_below

LOAD = -10e3
"""Stress of each simple load on the cube, in Pa; compression is negative."""
BALL_RADIUS = 0.004
"""Radius of the contact of the ball with the skin, in m."""
BALL_FORCE = (0.0, 0.0, -2.0)
"""Force of the ball on the skin, in N."""
REACH = 0.016
"""Largest distance of the ball from the sensor along x, in m."""
BALL_X = 0.005
"""Position of the ball in the picture of the field, in m."""
PAIR = ("+z-x", "+z+x")
"""Names of the two pads of a sensor that has pads on its upper face only."""


def read_planar_calibration() -> Calibration:
    """Return the calibration of planar cubes in the package."""
    return read_calibration(find_package_data() / "config" / "calibration" / "planar.yaml")


def make_simple_loads(calibration: Calibration) -> dict[str, Array]:
    """Return the amplitudes of the modes (7,) of three loads, by their title: pressure, shear, and
    a pressure that grows along x."""
    size = f"{abs(LOAD) / 1e3:g}"
    states = {
        rf"pressure: $\sigma_{{zz}} = -{size}$ kPa": {"zz": LOAD},
        rf"shear: $\sigma_{{zx}} = {size}$ kPa": {"zx": -LOAD},
        rf"growing pressure: $-{size}\,(1 + x/d_0)$ kPa": {
            "zz": LOAD,
            "zz_x": LOAD,
        },
    }
    loads = {}
    for title, state in states.items():
        names = calibration.modes.names
        loads[title] = np.array([state.get(name, 0.0) for name in names])
    return loads


@dataclass(frozen=True, eq=False)
class Sweep:
    """A frictionless ball at many places, and the shear that sensors at x = 0 measure.

    Attributes:
        place: (M,) positions along x, in m.
        profile: (M,) σzz at `place` in the plane of the sensor while the ball is at `BALL_X`, in
            Pa.
        value: σzz at the sensor while the ball is at `BALL_X`, in Pa.
        slope: ∂σzz/∂x at the sensor while the ball is at `BALL_X`, in Pa/m.
        truth: (M,) true σzx at the sensor while the ball is at `place`, in Pa.
        cube: (M,) σzx from all eight pads, in Pa.
        pair: (M,) σzx from the two upper pads, calibrated by uniform shear alone, in Pa.
    """

    place: Array
    profile: Array
    value: float
    slope: float
    truth: Array
    cube: Array
    pair: Array


def sweep(points: int = 129) -> Sweep:
    """Return stress and measured shear for each place of the ball.

    The response is linear in stress and gradient, as in the driver.
    """
    calibration = read_planar_calibration()
    place = np.linspace(-REACH, REACH, points)
    zz, zx, zz_x = (COMPONENTS.index(name) for name in ("zz", "zx", "zz_x"))
    at_sensor = _compute_field_beside_ball(np.array([-BALL_X]))[0]
    passing = _compute_field_beside_ball(-place)
    gradient = passing[:, 6:].reshape(points, 6, 3)
    pads = compute_true_amplitudes(calibration, passing[:, :6], gradient) @ calibration.response.T

    to_components = Pipeline([calibration]).find_matrix(0)
    left, right = (calibration.layout.pads.index(name) for name in PAIR)
    # The difference of the two pads counts as shear, with the gain of uniform shear.
    to_shear = calibration.response[:, calibration.modes.names.index("zx")]
    pair_gain = to_shear[left] - to_shear[right]
    return Sweep(
        place=place,
        profile=_compute_field_beside_ball(place - BALL_X)[:, zz],
        value=float(at_sensor[zz]),
        slope=float(at_sensor[zz_x]),
        truth=passing[:, zx],
        cube=pads @ to_components[zx],
        pair=(pads[:, left] - pads[:, right]) / pair_gain,
    )


def _compute_field_beside_ball(x: Array) -> Array:
    """Return stress in Pa and gradient in Pa/m (N, 6 + 18) at distances x (N,) from the ball's
    centre, in m, in the plane of the sensor."""
    ball = contact.hertz(BALL_RADIUS, BALL_FORCE)
    points = np.stack([x, 0 * x], axis=1)
    return compute_field_below(points, SURFACE_DEPTH, ball, POISSONS_RATIO)
