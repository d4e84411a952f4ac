# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A simulated skin that moves: accelerations at its points, and the stress of its pads by weight.

The parent frame of the skin has the position p(t) and rotation R(t) in the world, whose z axis
points up. An accelerometer in a cube with the position r and rotation C in the parent frame
measures the specific force, acceleration minus gravity::

    s = (R C)^T (d²(p + R r)/dt² + g z)

with the gravitational acceleration g and the unit vector z of the world. The stress of the pads is
linear in s. Finite elements (`./cube fem --load weight`) have computed it from the densities of
cube and elastomer.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..config.calibration import read_calibration
from ..config.package_data import find_shipped
from ..core.arrays import Array
from ..core.compensation.weight import STANDARD_GRAVITY
from ..core.errors import ConfigError
from ..core.poses import CubePoses
from ..core.tensor import rotation_from_rpy

STEP_S = 1e-3
"""Time step, in s, of the second differences from which accelerations are computed. For a motion of
5 Hz, the error of an acceleration is below 1e-4 of it."""


def read_weight(name: str, n_pads: int) -> Array:
    """Return the stress of the pads per specific force (P, 3), in Pa per m/s².

    Args:
        name: File that `./cube fem --load weight -o` has written, or the name of one in the
            package.
        n_pads: Number of pads P that the cubes have.

    Raises:
        ConfigError: There is no such file, it states no weight, or is for another number of pads.
    """
    path = find_shipped(
        "weight/*.yaml",
        name,
        Path(),
        "a file of ./cube fem --load weight",
    )
    model = read_calibration(path).weight
    if model is None or model.n_pads != n_pads:
        raise ConfigError(
            f"{path}: no weight of cubes with {n_pads} pads; compute it with ./cube fem --load "
            "weight for their layout"
        )
    return model.response


class MovingFrame:
    """Computes what an accelerometer and a gyroscope in the parent frame of a skin measure."""

    def __init__(self, knots: Sequence[Sequence[float]]) -> None:
        """Prepare the motion.

        Args:
            knots: Poses of the parent frame over time, as `Imperfections.poses` defines them.
        """
        self._times, *self._columns = np.array(knots).T
        self._numbers = np.arange(len(knots))

    def _compute_pose(self, seconds: float) -> tuple[Array, Array]:
        """Return position (3,), in m, and rotation (3, 3) of the parent frame at a time in s.

        Between two knots, position and angles follow half a period of a cosine.
        """
        number = np.interp(seconds, self._times, self._numbers)
        begin = np.floor(number)
        phase = np.pi * (number - begin)
        eased = begin + 0.5 * (1 - np.cos(phase))
        values = [np.interp(eased, self._numbers, column) for column in self._columns]
        return np.array(values[:3]), rotation_from_rpy(*values[3:])

    def compute_angular_velocity(self, seconds: float) -> Array:
        """Return the angular velocity (3,) in rad/s, in the parent frame, at a time in s."""
        times = seconds - STEP_S, seconds, seconds + STEP_S
        (_, before), (_, now), (_, after) = map(self._compute_pose, times)
        turning = now.T @ (after - before) / (2 * STEP_S)
        return np.array(
            [
                turning[2, 1],
                turning[0, 2],
                turning[1, 0],
            ]
        )

    def compute_specific_force(
        self,
        seconds: float,
        points: Array,
        axes: Array,
    ) -> Array:
        """Return the specific force at N points of the parent frame (N, 3), in m/s².

        Args:
            seconds: Time in s.
            points: The points (N, 3), in m.
            axes: Rotations (N, 3, 3) from the frames of the results to the parent frame.
        """
        times = seconds - STEP_S, seconds, seconds + STEP_S
        (origin_before, before), (origin, now), (origin_after, after) = map(
            self._compute_pose,
            times,
        )
        moved = origin_after - 2 * origin + origin_before
        turned = after - 2 * now + before
        in_world = (moved + points @ turned.T) / STEP_S**2
        in_world[:, 2] += STANDARD_GRAVITY
        to_world = now @ axes
        force = np.einsum("nji,nj->ni", to_world, in_world)
        return np.asarray(force)


class HeavyPads:
    """Computes the specific force at cubes of a moving skin and the stress of their pads by it."""

    def __init__(
        self,
        response: Array,
        poses: CubePoses,
        knots: Sequence[Sequence[float]],
    ) -> None:
        """Prepare the motion.

        Args:
            response: Stress of the pads per specific force (P, 3), in Pa per m/s².
            poses: Poses of the cubes in the parent frame of the skin.
            knots: Poses of the parent frame over time, as `Imperfections.poses` defines them.
        """
        self._response = response
        self._cubes = poses
        self._frame = MovingFrame(knots)

    def compute_specific_force(self, seconds: float) -> Array:
        """Return the specific force (cubes, 3) in m/s² at each cube, in the frame of the cube."""
        return self._frame.compute_specific_force(
            seconds,
            self._cubes.position,
            self._cubes.rotation,
        )

    def compute_stress(self, seconds: float) -> Array:
        """Return the stress of the pads by weight and inertia (cubes, P), in Pa."""
        force = self.compute_specific_force(seconds)
        return np.asarray(force @ self._response.T)
