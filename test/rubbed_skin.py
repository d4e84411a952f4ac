# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A rigid ball or flat punch that rubs on a skin: truth for stick, partial slip and gross slip.

A ball that is pressed by P and pulled by Q <= mu P sticks in the middle and slips at the rim. Its
shear traction is that of a sliding ball, minus the same of a smaller one (Cattaneo, Mindlin)::

    q = mu p(r; P, a) - mu p(r; P (c/a)^3, c),   (c / a)^3 = 1 - Q / (mu P)

and the ball moves by 3 mu P (2 - nu) / (16 G a) (1 - (1 - Q / (mu P))^(2/3)) until all of it slips.
Shear under a flat punch is distributed like its pressure, so that all of it slips at the same time,
after it has moved by Q (2 - nu) / (8 G a). Source: K. L. Johnson, Contact Mechanics (1985), 7.2 and
3.7. The stress in the half space is that of point forces (mechanics/contact.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cube_tensor_design.studies.field_study import compute_field_below
from cube_tensor_design.studies.traction_study import TractionBench, make_flat_punch
from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.defaults import FREQUENCY_NOISE, YOUNGS_MODULUS
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.mechanics import contact

ORDER = 6
"""Rings of point forces: 1e-3 of the peak at the depth of the cubes, for radii up to the depth."""


@dataclass(frozen=True)
class Body:
    """A rigid body on the skin; SI units.

    Attributes:
        friction: Friction coefficient mu.
        size: Radius of the ball, or of the face of the punch.
        is_ball: Whether it is a ball.
        poisson: Poisson's ratio of the skin.
    """

    friction: float
    size: float
    is_ball: bool
    poisson: float = 0.48

    def radius(self, normal: float) -> float:
        """Radius of the contact under a normal force."""
        if not self.is_ball:
            return self.size
        modulus = YOUNGS_MODULUS / (1 - self.poisson**2)
        return float(np.cbrt(0.75 * normal * self.size / modulus))

    def slip_distance(self, normal: float) -> float:
        """How far the body moves from rest until all of the contact slips, in m."""
        shear_modulus = YOUNGS_MODULUS / 2 / (1 + self.poisson)
        stiffness = 8 * shear_modulus * self.radius(normal) / (2 - self.poisson)
        return (1.5 if self.is_ball else 1.0) * self.friction * normal / stiffness

    def pull(self, normal: float, shift: float) -> tuple[float, float]:
        """Shear force in N of a body that is moved by `shift` from rest, and how far it slips."""
        until = self.slip_distance(normal)
        left = max(0.0, 1 - shift / until)
        share = 1 - left**1.5 if self.is_ball else 1 - left
        return self.friction * normal * share, max(0.0, shift - until)

    def point_forces(self, normal: float, shear: Array, centre: Array) -> tuple[Array, Array]:
        """Positions (L, 3) in m and forces (L, 3) in N on the skin."""
        radius = self.radius(normal)
        if not self.is_ball:
            return make_flat_punch(radius, np.array([*shear, -normal]), centre, ORDER)
        pull = np.linalg.norm(shear)
        limit = self.friction * normal
        share = max(0.0, 1 - pull / limit)
        sliding = limit * shear / max(pull, 1e-12)
        whole = contact.hertz(radius, np.array([*sliding, -normal]), centre, ORDER)
        if share < 1e-9:
            return whole
        sticking = -np.array([*sliding, 0.0]) * share
        inner = contact.hertz(radius * np.cbrt(share), sticking, centre, ORDER)
        return np.concatenate([whole[0], inner[0]]), np.concatenate([whole[1], inner[1]])


class RubbedSkin:
    """A skin whose pads have gain errors and whose counters have noise.

    Attributes:
        bench: The skin and its inverse.
    """

    def __init__(self, bench: TractionBench, random: np.random.Generator) -> None:
        self.bench = bench
        self._random = random
        count, pads = len(bench.poses.position), len(bench.calibration.response)
        self._gain = 1 + bench.setting.gain_error * random.standard_normal((count, pads))
        self._pipeline = Pipeline([bench.calibration] * count)

    def pads(self, body: Body, normal: float, shear: Array, centre: Array) -> Array:
        """Stress (cubes, P) in Pa of each pad under a body."""
        return self.compute_pads_under(body.point_forces(normal, shear, centre))

    def compute_pads_under(self, load: tuple[Array, Array]) -> Array:
        """Stress (cubes, P) in Pa of each pad under point forces."""
        cubes, setting = self.bench.poses.position[:, :2], self.bench.setting
        return self.bench.compute_pads_in(
            compute_field_below(cubes, setting.depth, load, setting.poisson)
        )

    def measure(self, pads: Array) -> Array:
        """Components (scans, cubes, 15) that the pipeline computes from pads (scans, cubes, P)."""
        calibration = self.bench.calibration
        rest = calibration.rest_frequency
        hertz = compute_pad_frequency(
            pads * self._gain, rest, calibration.beta, calibration.modulus
        )
        hertz *= 1 + FREQUENCY_NOISE * self._random.standard_normal(hertz.shape)
        scans, count, n_pads = hertz.shape
        rows = FrequencyRows.from_values(
            np.tile(np.arange(count), scans), hertz.reshape(-1, n_pads)
        )
        found = self._pipeline.process(rows)
        return np.concatenate([found.stress, found.gradient], axis=1).reshape(scans, count, 15)
