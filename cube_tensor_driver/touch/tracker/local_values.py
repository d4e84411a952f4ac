# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Values of the cubes around a region, divided by their noise.

The noise of a cube grows with the stress on its pads, because their gains have the relative error
`GAIN_ERROR`. As the computation takes long, the noise is only computed again for cubes whose stress
has changed.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dtrtri

from ...core.arrays import Array, Index, Mask
from ..inverse import SurfaceInverse
from ..pad_noise import GAIN_ERROR, make_stress_matrices, regularise
from .contact_estimate import Discs
from .hertz_response import respond_to_errors

MIN_FACING = 0.5
"""Smallest cosine of the angle between the outward normals of two cubes at which one of them
responds to a contact above the other. On a bent skin, cubes that face away do not respond."""

MAX_NOISE_CHANGE = 3.0
"""Largest ratio of the variance of a pad's error under the present stress to the variance in use,
or of the latter to the former. Above this ratio, the noise of the pad's cube is computed again. The
same limit applies to the error of the stress that other contacts cause in the cubes of a fit
(`_MIN_DISTURBANCE`)."""

MODEL_ERROR = 1e-4
"""Standard deviation of the error of the stress that the model of the skin predicts on a pad,
divided by the largest stress on any pad of the surrounding cubes."""

_MIN_DISTURBANCE = 1e-3
"""Largest change of the total disturbance, in Pa, after which a fit keeps the weights of its cubes,
however large the relative change is. The total disturbance is the sum of the standard deviations of
the stress that other contacts cause in the cubes of the fit; the larger that of a cube, the smaller
its weight. The limit is far below the noise of a pad and far above rounding errors."""


class CubeNoise:
    """Noise of all cubes of a skin, which grows with the stress on their pads.

    C is the number of components of stress and gradient that at least one cube determines.

    Attributes:
        whitening: Matrices (cubes, C, C) that transform the values of a cube so that their noise
            has variance 1 and no correlation; 0 for unknown values.
        known: Whether each component is known (cubes, C).
        version: Number (cubes,) that increases when the noise of a cube is computed again.
        scaled: Newest values (cubes, C) in Pa, NaN where unknown.
    """

    scaled: Array

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
        """Compute the noise of cubes again if it has changed.

        The noise of a cube has changed if other pads are in use, other components are known (not
        NaN) or other errors are stated (`SurfaceInverse.state_errors`) than at the last update. The
        noise has also changed if the stress of the cube makes the variance of a pad's error differ
        by more than the factor `MAX_NOISE_CHANGE`.

        Args:
            scaled: Components of stress and gradient (times d0, half the side of a cube), in Pa
                (cubes of the skin, C); NaN where unknown.
            cubes: Indices (n,) of the cubes that are needed.
        """
        self.scaled = scaled
        inverse = self._inverse
        if self._revision != inverse.revision:
            # The pads in use or the stated errors have changed, so all stored variances are invalid
            # and are set to 0.
            self._revision = inverse.revision
            self._variance[:] = 0.0
        values = scaled.take(cubes, axis=0)
        known = np.isfinite(values) & inverse.observed.take(cubes, axis=0)
        is_other_value = known != self.known.take(cubes, axis=0)
        is_outdated = self._variance[cubes, 0] == 0
        if is_outdated.any() or is_other_value.any():
            is_outdated |= is_other_value.any(axis=1)
            self._replace_pads(cubes[is_outdated], known[is_outdated])
        columns = np.where(known, values, 0.0)[:, :, None]
        stresses = (self._to_pads.take(cubes, axis=0) @ columns)[:, :, 0]

        # Interpolation errors of the tabulated response, and contacts that are not found yet, cause
        # errors of the predicted stress on a pad. Both grow with the stress in the cubes around.
        # Stresses are in units of the pad's noise without load here, so this noise has variance 1.
        magnitudes = np.abs(stresses)
        self._peak[cubes] = magnitudes.max(axis=1)
        around = inverse.near.take(cubes, axis=0)
        model_deviation = MODEL_ERROR * self._peak.take(around).max(axis=1)
        gain_deviation = GAIN_ERROR * stresses
        variance = gain_deviation**2
        variance += (1 + model_deviation**2)[:, None]

        before = self._variance.take(cubes, axis=0)
        larger = np.maximum(variance, before)
        smaller = np.minimum(variance, before)
        is_pad_changed = larger > MAX_NOISE_CHANGE * smaller
        is_changed = is_pad_changed.any(axis=1)
        if is_changed.any():
            changed = cubes[is_changed]
            self._whiten(changed, variance[is_changed])

    def _replace_pads(self, cubes: Index, known: Mask) -> None:
        """Store the noise matrices of n cubes whose known components or pads in use have changed.

        Args:
            cubes: Indices (n,) of the cubes.
            known: Whether each of the C components is known (n, C).
        """
        by_pad = self._inverse.by_pad[cubes]
        is_known = known[:, :, None]
        known_by_pad = np.where(is_known, by_pad, 0.0)
        self.known[cubes] = known
        self._by_pad[cubes] = known_by_pad
        self._to_pads[cubes] = make_stress_matrices(by_pad, known)
        self._variance[cubes] = 0.0

    def _whiten(self, cubes: Index, variance: Array) -> None:
        """Compute the whitening matrices of n cubes, which make their noise uncorrelated.

        Args:
            cubes: Indices (n,) of the cubes.
            variance: Variances (n, P) of the errors of the stresses on their P pads, divided by the
                variance of the pad's noise without load.
        """
        by_pad = self._by_pad.take(cubes, axis=0)
        weighted = by_pad * variance[:, None]
        covariance = weighted @ by_pad.swapaxes(1, 2)
        is_known = self.known[cubes]
        errors = self._inverse.errors[cubes] * is_known[:, :, None]
        covariance += errors @ errors.swapaxes(1, 2)
        covariance = regularise(covariance, is_known)
        # The inverse of a triangular matrix takes a quarter of the time of a general one.
        factors = np.linalg.cholesky(covariance)
        whitening = np.array([dtrtri(factor, lower=1)[0] for factor in factors])
        self.whitening[cubes] = whitening * is_known[:, None]
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
        whitening: Matrices (n, C, C) as in `CubeNoise`, at the last `refresh`, multiplied by the
            weights of the cubes.
        known: Whether each of the C components of the cubes is known (n, C).
        count: Number of known values.
        disturbance: Standard deviation (n, C), in Pa, of the part of the values that contacts
            outside of the region cause.
    """

    whitening: Array
    known: Mask
    count: int

    def __init__(
        self,
        inverse: SurfaceInverse,
        noise: CubeNoise,
        home: int,
        cubes: Index,
    ) -> None:
        """Collect the noise of the cubes.

        Args:
            inverse: Poses and responses of the skin.
            noise: Noise of all cubes, up to date for these cubes.
            home: Index of the cube around which the skin is laid flat.
            cubes: Indices (n,) of the cubes.
        """
        self.home = home
        self.cubes = cubes
        self._inverse = inverse
        self._noise = noise
        self.place, self.angle = inverse.unroll(home, cubes)
        shape = len(cubes), len(inverse.columns)
        self.disturbance = np.zeros(shape)
        self.refresh()

    def refresh(self) -> None:
        """Copy the newest noise of the cubes.

        Cubes in which other contacts cause stress that is not exactly known (`disturbance`) get a
        smaller weight.
        """
        cubes, noise = self.cubes, self._noise
        self._versions = noise.version.take(cubes)
        self.variant = self._inverse.variant.take(cubes)
        self.known = noise.known.take(cubes, axis=0)
        self.count = int(np.count_nonzero(self.known))
        self._total_disturbance = float(self.disturbance.sum())

        # The noise has variance 1 after whitening. The disturbance adds its own variance to this 1.
        whitening = noise.whitening.take(cubes, axis=0)
        white_disturbance = (whitening @ self.disturbance[:, :, None])[:, :, 0]
        square = np.einsum("nc,nc->n", white_disturbance, white_disturbance)
        disturbance_variance = square / white_disturbance.shape[1]
        weight = 1 / np.sqrt(1 + disturbance_variance)
        self.whitening = whitening * weight[:, None, None]

    def find_nearest_cubes(self, places: Array) -> Index:
        """Return the indices (J,) of the cubes nearest to places (J, 2) on the skin laid flat."""
        offset = places[:, None] - self.place
        squared_distance = np.einsum("jnk,jnk->jn", offset, offset)
        nearest = squared_distance.argmin(axis=1)
        return np.asarray(self.cubes[nearest])

    @property
    def is_stale(self) -> bool:
        """Whether the noise, or the disturbance by other contacts, has changed since `refresh`."""
        total = float(self.disturbance.sum())
        larger = max(self._total_disturbance, total)
        smaller = min(self._total_disturbance, total)
        limit = MAX_NOISE_CHANGE * smaller + _MIN_DISTURBANCE
        if larger > limit:
            return True
        versions = self._noise.version.take(self.cubes)
        return bool((self._versions != versions).any())

    def refresh_if_stale(self) -> None:
        """Refresh if the noise of the cubes or the disturbance has changed."""
        if self.is_stale:
            self.refresh()

    @property
    def has_same_values(self) -> bool:
        """Whether the known components of the cubes are the same as at the last `refresh`."""
        known = self._noise.known.take(self.cubes, axis=0)
        return bool((self.known == known).all())

    def whiten(self, scaled: Array, others: Array | float) -> Array:
        """Return the values (n C,) of these cubes, transformed so that their noise has variance 1.

        Args:
            scaled: Values (cubes of the skin, C) in Pa. Unknown values give 0.
            others: Response (n, C) in Pa to other contacts, which is subtracted.
        """
        unexplained = scaled.take(self.cubes, axis=0) - others
        values = np.where(self.known, unexplained, 0.0)
        white = self.whitening @ values[:, :, None]
        return white.ravel()

    def respond(self, centres: Array, size: float) -> Array:
        """Compute the response of the cubes to Hertz contacts with a force of 1 N.

        Args:
            centres: Centres (K, 2) of the contacts in m, in the frame of the home cube.
            size: Radius of the contacts in m.

        Returns:
            Response (n, C, 3 K), in Pa/N, of the C components of n cubes. The last axis holds
            forces along x of all contacts, then along y, then along z.
        """
        n = len(self.cubes)
        count = len(centres)
        offset = self.place[:, None] - centres
        offset = offset.reshape(-1, 2)
        angle = np.repeat(self.angle, count)
        variant = np.repeat(self.variant, count)
        contact_response = self._inverse.contact_response
        response = contact_response.compute_response(
            offset,
            angle,
            variant,
            size,
        )
        response = response[:, self._inverse.columns]
        by_contact = response.reshape(n, count, -1, 3)
        by_axis = by_contact.transpose(0, 2, 3, 1)
        return np.asarray(by_axis.reshape(*self.known.shape, -1))

    def compute_sensitivity(
        self,
        centres: Array,
        size: float,
        forces: Array,
    ) -> Array:
        """Compute how errors of the elastomer's properties change the response to Hertz contacts.

        The properties are the S quantities of mechanics/sensitivity.py: depth of the cubes,
        Poisson's ratio and, if it is finite, the thickness.

        Args:
            centres: Centres (K, 2) of the contacts in m, in the frame of the home cube (the cube
                around which the skin is laid flat).
            size: Radius of the contacts in m.
            forces: Forces (3, K) of the contacts in N.

        Returns:
            Changes (n, C, S) in Pa of the C components of n cubes, if the error of a property is
            one standard deviation.
        """
        log_sizes = np.full(len(centres), np.log(size))
        discs = Discs(forces.T, centres, log_sizes)
        changes = respond_to_errors(
            self._inverse,
            self.place,
            self.angle,
            discs,
        )
        return np.asarray(changes.swapaxes(1, 2))


def make_rotations_about_normal(angle: Array) -> Array:
    """Return the matrices (..., 3, 3) from one frame to another that is rotated about z.

    Args:
        angle: Angles (...) in rad by which the second frame is rotated in the first one.
    """
    cosine = np.cos(angle)
    sine = np.sin(angle)
    shape = np.shape(angle)
    rotation = np.zeros((*shape, 3, 3))
    rotation[..., 0, 0] = cosine
    rotation[..., 0, 1] = sine
    rotation[..., 1, 0] = -sine
    rotation[..., 1, 1] = cosine
    rotation[..., 2, 2] = 1.0
    return rotation


def unroll_points(inverse: SurfaceInverse, home: int, points: Index) -> Array:
    """Return the positions (n, 2) in m of surface points on the skin laid flat around a cube.

    Args:
        inverse: Poses of the cubes and points of the surface.
        home: Index of the cube in whose frame the positions are.
        points: Indices (n,) of the points.
    """
    cubes = inverse.cube[points]
    place, angle = inverse.unroll(home, cubes)
    rotation = inverse.poses.rotation[cubes]
    from_cube = inverse.points[points] - inverse.poses.position[cubes]
    local = np.einsum("nji,nj->ni", rotation, from_cube)
    x, y, _ = local.T
    cosine = np.cos(angle)
    sine = np.sin(angle)
    rotated_x = cosine * x - sine * y
    rotated_y = sine * x + cosine * y
    rotated = np.stack([rotated_x, rotated_y], axis=1)
    return np.asarray(place + rotated)
