# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Values of the cubes around a region of contact, divided by their noise."""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array, Index
from ..inverse import SurfaceInverse
from ..pad_noise import GAIN_ERROR, pad_stresses


class LocalValues:
    """Values of some cubes around a region, divided by their noise, on the skin laid flat.

    Attributes:
        home: Index of the cube around which the skin is laid flat.
        cubes: Indices (n,) of the cubes.
        place: Positions (n, 2) of the cubes in m, in the frame of the home cube.
        angle: Rotations (n,) of the cubes in rad, in this frame.
        known: Whether each of the C components of the cubes is known (n, C).
        count: Number of known values.
        whitening: Matrices (n, C, C) by which the values of each cube are multiplied, so that their
            noise has variance 1.
    """

    def __init__(self, inverse: SurfaceInverse, home: int, cubes: Index, scaled: Array) -> None:
        """Compute the noise of the cubes.

        Args:
            inverse: Poses, noise and kernels of the skin.
            home: Index of the cube around which the skin is laid flat.
            cubes: Indices (n,) of the cubes.
            scaled: Values (cubes of the skin, C) in Pa, NaN where unknown.
        """
        self._inverse = inverse
        self.home = home
        self.cubes = cubes
        self.place, self.angle = inverse.unroll(home, cubes)
        self._variant = inverse.variant[cubes]
        values = scaled[cubes]
        self.known = np.isfinite(values) & inverse.observed[cubes]
        self.count = int(self.known.sum())

        by_pad = np.where(self.known[:, :, None], inverse.by_pad[cubes], 0.0)
        self._by_pad = by_pad
        stresses = pad_stresses(by_pad, self.known, values)
        gain_variance = (GAIN_ERROR * stresses[:, None]) ** 2
        noise = (by_pad * (1 + gain_variance)) @ by_pad.swapaxes(1, 2)
        # A 1 on the diagonal keeps the matrices of cubes with unknown values invertible, and the
        # tiny increase those of components that are almost dependent.
        identity = np.eye(noise.shape[1])
        noise += identity * ~self.known[:, None] + 1e-9 * identity * noise
        self._noise_root = np.linalg.cholesky(noise)
        self.whitening = np.linalg.inv(self._noise_root) * self.known[:, None]

    def is_valid(self, scaled: Array) -> bool:
        """Return whether the same values are known, and the same pads in use, as at the start.

        Args:
            scaled: Values (cubes of the skin, C) in Pa, NaN where unknown.
        """
        inverse = self._inverse
        by_pad = np.where(self.known[:, :, None], inverse.by_pad[self.cubes], 0.0)
        known = np.isfinite(scaled[self.cubes]) & inverse.observed[self.cubes]
        return np.array_equal(known, self.known) and np.array_equal(by_pad, self._by_pad)

    def whiten(self, scaled: Array) -> Array:
        """Return the values (n C,) of these cubes, transformed so that their noise has variance 1.

        Args:
            scaled: Values (cubes of the skin, C) in Pa. Unknown values give 0.
        """
        values = np.where(self.known, scaled[self.cubes], 0.0)
        return np.asarray((self.whitening @ values[:, :, None]).ravel())

    def unwhiten(self, white: Array) -> Array:
        """Return the values (n, C) in Pa of which `whiten` makes `white` (n C,)."""
        return np.asarray((self._noise_root @ white.reshape(*self.known.shape, 1))[:, :, 0])

    def respond(self, centres: Array, size: float) -> tuple[Array, Array]:
        """Compute the response of the cubes to Hertz contacts with a force of 1 N.

        Args:
            centres: Centres (K, 2) of the contacts in m, in the frame of the home cube.
            size: Radius of the contacts in m.

        Returns:
            Values (n, C, 3 K) in Pa/N, and values (n C, 3 K) divided by their noise: for forces
            along x of all contacts, then along y, then along z.
        """
        count = len(centres)
        offset = (self.place[:, None] - centres).reshape(-1, 2)
        angle = np.repeat(self.angle, count)
        variant = np.repeat(self._variant, count)
        inverse = self._inverse
        response = inverse.kernels.response(offset, angle, variant, size)[:, inverse.columns]
        shape = (len(self.place), count, -1, 3)
        values = response.reshape(shape).transpose(0, 2, 3, 1)
        values = values.reshape(*self.known.shape, -1)
        return values, (self.whitening @ values).reshape(-1, 3 * count)


def unroll_points(inverse: SurfaceInverse, home: int, points: Index) -> Array:
    """Return the positions (n, 2) in m of surface points on the skin laid flat around a cube.

    Args:
        inverse: Poses of the cubes and points of the surface.
        home: Index of the cube in whose frame the positions are.
        points: Indices (n,) of the points.
    """
    cubes = inverse.cube[points]
    place, angle = inverse.unroll(home, cubes)
    from_cube = inverse.points[points] - inverse.poses.position[cubes]
    local = np.einsum("nji,nj->ni", inverse.poses.rotation[cubes], from_cube)[:, :2]
    cosine = np.cos(angle)
    sine = np.sin(angle)
    rotated_x = cosine * local[:, 0] - sine * local[:, 1]
    rotated_y = sine * local[:, 0] + cosine * local[:, 1]
    return np.asarray(place + np.stack([rotated_x, rotated_y], axis=1))
