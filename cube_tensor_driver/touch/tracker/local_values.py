# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Values of the cubes around a region, divided by their noise.

The noise of a cube depends on the stress of its pads, whose gains are only known to `GAIN_ERROR`.
It is computed again when this stress changes, cube by cube, because that takes long.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array, Index, Mask
from ..inverse import SurfaceInverse
from ..pad_noise import GAIN_ERROR

MIN_FACING = 0.5
"""Smallest cosine of the angle between the outward normals of two cubes at which one of them
responds to a contact above the other. On a bent skin, cubes that face away do not respond."""

MAX_NOISE_CHANGE = 1.6
"""Factor by which the variance of a pad's error grows or falls before the noise of its cube is
computed again."""


MODEL_ERROR = 1e-4
"""Standard deviation of the error of each pad's predicted stress, divided by the largest stress of
a pad in the surrounding cubes."""


_MIN_DISTURBANCE = 1e-3
"""Sum of the standard deviations of the response to other contacts, in Pa, that counts as none. It
is far below the noise of a pad and far above rounding errors."""


class CubeNoise:
    """Noise of all cubes of a skin, which grows with the stress of their pads.

    C is the number of components of stress and gradient that some cube determines.

    Attributes:
        whitening: Matrices (cubes, C, C) that transform the values of a cube so that their noise
            has variance 1 and no correlation; 0 for unknown values.
        known: Whether each component is known (cubes, C).
        version: Number (cubes,) that increases when the noise of a cube is computed again.
    """

    def __init__(self, inverse: SurfaceInverse) -> None:
        self._inverse = inverse
        n, width, pads = inverse.by_pad.shape
        self.whitening = np.zeros((n, width, width))
        self.known = np.zeros((n, width), bool)
        self.version = np.zeros(n, np.intp)
        self._by_pad = np.zeros((n, width, pads))
        self._to_pads = np.zeros((n, pads, width))
        self._variance = np.zeros((n, pads))
        self._peak = np.zeros(n)
        self._revision = -1

    def update(self, scaled: Array, cubes: Index) -> None:
        """Compute the noise of cubes again whose pads in use, known values or stresses changed.

        Args:
            scaled: Components of stress and gradient (times d0, half the side of a cube), in Pa
                (cubes of the skin, C); NaN where unknown.
            cubes: Indices (n,) of the cubes that are needed.
        """
        inverse = self._inverse
        if self._revision != inverse.revision:
            # Other pads are in use: every cube is computed again when it is needed.
            self._revision = inverse.revision
            self._variance[:] = 0.0
        known = np.isfinite(scaled[cubes]) & inverse.observed[cubes]
        is_other = (known != self.known[cubes]).any(axis=1) | (self._variance[cubes, 0] == 0)
        if is_other.any():
            other = cubes[is_other]
            self.known[other] = known[is_other]
            self._by_pad[other] = np.where(known[is_other, :, None], inverse.by_pad[other], 0.0)
            self._to_pads[other] = np.linalg.pinv(self._by_pad[other])
            self._variance[other] = 0.0
        values = np.where(known, scaled[cubes], 0.0)
        stresses = (self._to_pads[cubes] @ values[:, :, None])[:, :, 0]
        # Contacts that are not found yet and errors of the tables disturb all cubes around.
        self._peak[cubes] = np.abs(stresses).max(axis=1)
        floor = MODEL_ERROR * self._peak[inverse.near[cubes]].max(axis=1)
        variance = 1 + (GAIN_ERROR * stresses) ** 2 + floor[:, None] ** 2
        before = self._variance[cubes]
        growth = np.maximum(variance, before) > MAX_NOISE_CHANGE * np.minimum(variance, before)
        is_changed = growth.any(axis=1)
        if is_changed.any():
            self._whiten(cubes[is_changed], variance[is_changed])

    def _whiten(self, cubes: Index, variance: Array) -> None:
        """Compute the whitening matrices of n cubes, which make their noise uncorrelated.

        Args:
            cubes: Indices (n,) of the cubes.
            variance: Variances (n, P) of the errors of the stresses on their P pads, divided by the
                variance of the pad's noise without load.
        """
        by_pad = self._by_pad[cubes]
        noise = (by_pad * variance[:, None]) @ by_pad.swapaxes(1, 2)
        # A 1 on the diagonal keeps the matrices of cubes with unknown values invertible, and the
        # tiny increase those of components that are almost dependent.
        identity = np.eye(noise.shape[1])
        noise += identity * ~self.known[cubes][:, None] + 1e-9 * identity * noise
        root = np.linalg.inv(np.linalg.cholesky(noise))
        self.whitening[cubes] = root * self.known[cubes][:, None]
        self._variance[cubes] = variance
        self.version[cubes] += 1


class LocalValues:
    """Noise and positions of n cubes around a region of contact, on the skin laid flat.

    The values of a cube are C components of stress and gradient; `whiten` divides them by their
    noise. The skin is laid flat around one cube, the home cube, whose frame is that of the fit.

    Attributes:
        home: Index of the home cube.
        cubes: Indices (n,) of the cubes.
        place: Positions (n, 2) of the cubes in m, in the frame of the home cube.
        angle: Rotations (n,) of the cubes about z in rad, in the frame of the home cube.
        variant: Number (n,) of the matrix of the measurement model that applies to each cube, which
            depends on its calibration and its pads in use.
        whitening: Matrices (n, C, C) as in `CubeNoise`, of the last `refresh`.
        known: Whether each of the C components of the cubes is known (n, C).
        count: Number of known values.
        disturbance: Standard deviation (n, C) in Pa of the response to other contacts.
    """

    whitening: Array
    known: Mask
    count: int

    def __init__(self, inverse: SurfaceInverse, noise: CubeNoise, home: int, cubes: Index) -> None:
        """Collect the noise of the cubes.

        Args:
            inverse: Poses and kernels of the skin.
            noise: Noise of all cubes, up to date for these cubes.
            home: Index of the cube around which the skin is laid flat.
            cubes: Indices (n,) of the cubes.
        """
        self.home = home
        self.cubes = cubes
        self._inverse = inverse
        self._noise = noise
        self.place, self.angle = inverse.unroll(home, self.cubes)
        self.disturbance = np.zeros((len(self.cubes), len(inverse.columns)))
        self.refresh()

    def refresh(self) -> None:
        """Copy the newest noise of the cubes, and reduce the weight of cubes that other contacts
        disturb."""
        self._versions = self._noise.version[self.cubes]
        self.variant = self._inverse.variant[self.cubes]
        whitening = self._noise.whitening[self.cubes]
        self._disturbed = float(self.disturbance.sum())
        # A cube that other contacts disturb counts less.
        relative = (whitening @ self.disturbance[:, :, None])[:, :, 0]
        weight = 1 / np.sqrt(1 + (relative**2).mean(axis=1))
        self.whitening = whitening * weight[:, None, None]
        self.known = self._noise.known[self.cubes]
        self.count = int(self.known.sum())

    @property
    def is_stale(self) -> bool:
        """Whether the noise of the cubes or the disturbance has changed since `refresh`."""
        sums = self._disturbed, float(self.disturbance.sum())
        is_other = max(sums) > MAX_NOISE_CHANGE * min(sums) + _MIN_DISTURBANCE
        return is_other or not np.array_equal(self._versions, self._noise.version[self.cubes])

    @property
    def has_same_values(self) -> bool:
        """Whether the same components are known as at the last `refresh`."""
        return np.array_equal(self.known, self._noise.known[self.cubes])

    def whiten(self, scaled: Array, others: Array | float) -> Array:
        """Return the values (n C,) of these cubes, transformed so that their noise has variance 1.

        Args:
            scaled: Values (cubes of the skin, C) in Pa. Unknown values give 0.
            others: Response (n, C) in Pa to other contacts, which is subtracted.
        """
        values = np.where(self.known, scaled[self.cubes] - others, 0.0)
        return np.asarray((self.whitening @ values[:, :, None]).ravel())

    def respond(self, centres: Array, size: float) -> tuple[Array, Array]:
        """Compute the response of the cubes to Hertz contacts with a force of 1 N.

        Args:
            centres: Centres (K, 2) of the contacts in m, in the frame of the home cube.
            size: Radius of the contacts in m.

        Returns:
            Values (n, C, 3 K) in Pa/N of the C components of n cubes, and the same values divided
            by their noise (n C, 3 K), in 1/N. The last axis holds forces along x of all contacts,
            then along y, then along z.
        """
        count = len(centres)
        offset = (self.place[:, None] - centres).reshape(-1, 2)
        angle = np.repeat(self.angle, count)
        variant = np.repeat(self.variant, count)
        inverse = self._inverse
        response = inverse.kernels.response(offset, angle, variant, size)[:, inverse.columns]
        shape = (len(self.place), count, -1, 3)
        values = response.reshape(shape).transpose(0, 2, 3, 1)
        values = values.reshape(*self.known.shape, -1)
        return values, (self.whitening @ values).reshape(-1, 3 * count)

    def sensitivity(self, centres: Array, size: float, forces: Array) -> Array:
        """Compute how the values change by errors of the elastomer's data (sensitivity.py).

        Args:
            centres: Centres (K, 2) of Hertz contacts in m, in the frame of the home cube.
            size: Radius of the contacts in m.
            forces: Forces (3, K) of the contacts in N.

        Returns:
            Changes (n, C, S) in Pa of the C components of n cubes by one standard deviation of each
            of S quantities.
        """
        n, count = len(self.cubes), len(centres)
        inverse = self._inverse
        changes = inverse.kernels.sensitivity(
            (self.place[:, None] - centres).reshape(-1, 2),
            np.repeat(self.angle, count),
            np.full(n * count, size),
            np.tile(forces.T, (n, 1)),
        )[:, :, inverse.columns]
        by_contact = changes.reshape(n, count, *changes.shape[1:])
        return np.asarray(by_contact.sum(axis=1).swapaxes(1, 2), float)


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
