# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""An arm that is shaken with 2 g at 5 Hz and swings, as positions and rotations over time; what an
accelerometer and a gyroscope fixed to it measure follows by differences of these alone."""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.core.tensor import rotation_from_rpy

G = 9.80665
STEP_S = 1e-4
"""Step of the differences: it truncates by 2e-5 m/s² and rounds by 1e-8 m/s²."""


class MovingSkin:
    """The parent frame of a skin in the world, whose z axis points up."""

    def __init__(self, shake=2 * G, swing=0.03, hertz=5.0, turn_s=20.0) -> None:
        self.rate = 2 * np.pi * hertz
        self.amplitude = shake / self.rate**2
        self.swing, self.turn_s = swing, turn_s

    def rotation(self, t: float) -> np.ndarray:
        """(3, 3) from the parent frame to the world: a slow turn through all poses, and a swing."""
        roll = 2 * np.pi * t / self.turn_s
        swing = self.swing * np.sin(self.rate * t + 1)
        return rotation_from_rpy(roll, 0.7 * roll + swing, 0.2)

    def position(self, t: float, point) -> np.ndarray:
        """(3,) in the world, of a point that is fixed in the parent frame."""
        shaken = self.amplitude * np.sin(self.rate * t) * np.array([0.6, 0.0, 0.8])
        return shaken + self.rotation(t) @ point

    def compute_specific_force(self, t: float, point, axes) -> np.ndarray:
        """(3,) at a point of the parent frame, along axes (3, 3) that are the columns."""
        before, here, after = (self.position(t + s, point) for s in (-STEP_S, 0, STEP_S))
        acceleration = (after - 2 * here + before) / STEP_S**2
        upwards = np.array([0, 0, G])
        return axes.T @ self.rotation(t).T @ (acceleration + upwards)

    def compute_angular_velocity(self, t: float, axes) -> np.ndarray:
        rate = (self.rotation(t + STEP_S) - self.rotation(t - STEP_S)) / (2 * STEP_S)
        turning = self.rotation(t).T @ rate
        return axes.T @ [turning[2, 1], turning[0, 2], turning[1, 0]]
