# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Linear estimate of the force of one small load from the cube below it and that cube's neighbours.

The values y of these cubes are the sum of three parts: the response H(x) F to the force F of the
load at the unknown position x, the responses (H_other) to other loads farther away, and noise with
the covariance N. The prior standard deviations of the forces are s for the load and t for other
loads. <> is the mean over all positions of the load, or of the other loads. The estimate y W of the
force F has the smallest mean squared error with the matrix::

    W = (s^2 <H H'> + t^2 <H_other H_other'> + N)^-1 s^2 <H>

Source: S. M. Kay, Fundamentals of Statistical Signal Processing: Estimation Theory (1993), 12.3
(linear estimator of minimum mean square error). numpy alone is used, because the reconstruction
node does not load scipy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..config.skin import Elastomer
from ..core.arrays import Array, Index
from ..core.poses import CubePoses
from ..mechanics.layer import Layer
from ..mechanics.load_response import LoadResponse
from .unrolled_skin import unroll

LOAD_WIDTH = 5e-3
"""Diameter, in m, of the Hertz contact that is assumed as the load whose force is estimated. The
estimate is linear, and wider contacts are sums of such contacts."""

FORCE_DEVIATION = 0.1
"""Standard deviation s, in N, of the Gaussian prior of each component of the force of the load, a
typical force of a touch. A smaller value would reduce the error due to noise, and increase the
error due to the unknown position of the load."""

OTHER_FORCE_DEVIATION = 0.03
"""Prior standard deviation t, in N, of each component of the forces of other loads, which are
farther away than the load whose force is estimated. With a larger value, other loads would change
the estimate less, but noise and the unknown position would change the estimate more."""

MAX_PITCHES = 1.0
"""Largest distance, along x and along y, at which the estimate assumes the load from the cube, in
pitches (distances of neighbouring cubes). Half a pitch would be enough for small loads; wide loads
reach farther."""

MIN_OTHER_PITCHES = 2.0
"""Smallest distance at which the estimate assumes other loads, from the cube below the load whose
force is estimated, in pitches (distances of neighbouring cubes). Of the distances along x and y,
the larger one counts."""


class ForceEstimate(NamedTuple):
    """Matrices that estimate the force of a load from the 15 components of k neighbouring cubes.

    Cubes whose neighbours have the same relative poses and noise are of one kind.

    Attributes:
        kind: Number (cubes,) of the kind of each cube.
        weights: Matrix W (kinds, k 15, 3) from the components, in Pa and Pa/m, to the force on the
            skin along x, y and z of the cube in the middle, in N.
        noise_variance: Variances (kinds, 3) of the force due to the noise of the pads, in N^2.
        squared_error: Mean squared error (kinds, 3, 3) of each component of the estimate (last axis
            but one) due to the unknown position, for a force of 1 N along x, y and z (last axis).
    """

    kind: Index
    weights: Array
    noise_variance: Array
    squared_error: Array


def estimate_forces(
    poses: CubePoses,
    elastomer: Elastomer,
    near: Index,
    covariance: Array,
) -> ForceEstimate:
    """Compute the matrices of all cubes.

    This takes half a second, and 5 ms more for each kind of cube (`ForceEstimate`).

    Args:
        poses: Poses of the cubes.
        elastomer: Layer of elastomer around the cubes.
        near: Indices (cubes, k) of each cube and its neighbours, the cube itself first.
        covariance: Covariances (cubes, 15, 15) of the noise of the components, in Pa and Pa/m, NaN
            where a component is not observed.

    Raises:
        ElasticError: The layer does not contain the depth of the cubes.
    """
    layer = Layer(elastomer.thickness, elastomer.poisson)
    response = LoadResponse(layer, elastomer.depth, LOAD_WIDTH)
    n = len(near)
    place, angle = unroll(poses, np.arange(n), near)

    noise = np.nan_to_num(covariance).reshape(n, -1)
    _, noise_kind = np.unique(noise, axis=0, return_inverse=True)
    noise_kind = noise_kind.reshape(n)
    # Poses that differ by less than a micrometre or a tenth of a milliradian count as the same.
    keys = np.hstack([place.reshape(n, -1) / 1e-6, angle / 1e-4, noise_kind[near]]).round()
    _, first, kind = np.unique(
        keys,
        axis=0,
        return_index=True,
        return_inverse=True,
    )

    own = _make_grid(np.linspace(-MAX_PITCHES, MAX_PITCHES, 9))
    other = _make_grid(np.arange(-5.0, 6.0))
    other = other[np.abs(other).max(axis=1) >= MIN_OTHER_PITCHES]
    sources = poses.pitch * np.concatenate([own, other])
    solved = []
    for cube in first.tolist():
        window = near[cube]
        offset = place[cube, :, None] - sources
        angles = np.repeat(angle[cube], len(sources))
        signal = response(offset.reshape(-1, 2), angles)
        signal = signal.reshape(len(window), len(sources), -1, 3).swapaxes(1, 2)
        solved.append(_solve(signal, len(own), covariance[window]))
    return ForceEstimate(kind.reshape(n), *map(np.array, zip(*solved, strict=True)))


def _make_grid(line: Array) -> Array:
    """Return the points (n^2, 2) of a grid with the coordinates `line` (n,) along both x and y."""
    x, y = np.meshgrid(line, line)
    return np.column_stack([x.ravel(), y.ravel()])


def _solve(
    signal: Array,
    n_own: int,
    covariance: Array,
) -> tuple[Array, Array, Array]:
    """Return weights, noise variance and squared error (`ForceEstimate`) for one kind of cube.

    Args:
        signal: Components (k, 15, S, 3) of k cubes for a force of 1 N along x, y and z at each of S
            positions.
        n_own: Number of positions at which the load may be. They come first; the other positions
            are those of other loads.
        covariance: Covariances (k, 15, 15) of the noise, NaN where a component is not observed.
    """
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    observed = np.isfinite(variance)
    noise = np.zeros(observed.shape * 2)
    each = np.arange(len(observed))
    noise[each, :, each] = covariance
    noise = noise[observed][:, observed]

    own, other = np.split(signal[observed], [n_own], axis=1)
    total = FORCE_DEVIATION**2 * _compute_mean_square(own)
    total += OTHER_FORCE_DEVIATION**2 * _compute_mean_square(other)
    total += noise
    expected = FORCE_DEVIATION**2 * own.mean(axis=1)
    solution = np.linalg.solve(total, expected)
    weights = np.zeros((*observed.shape, 3))
    weights[observed] = solution

    estimate = np.einsum("cf,csl->sfl", solution, own)
    squared_error = ((estimate - np.eye(3)) ** 2).mean(axis=0)
    noise_variance = np.einsum("if,ij,jf->f", solution, noise, solution)
    return weights.reshape(-1, 3), noise_variance, squared_error


def _compute_mean_square(signal: Array) -> Array:
    """Return the mean <H H'> (n, n) of products of responses H (n, 3) over S positions of the load.

    Args:
        signal: Responses (n, S, 3): n components for a force of 1 N along x, y and z at each
            position.
    """
    flat = signal.reshape(len(signal), -1)
    n_positions = signal.shape[1]
    return np.asarray(flat @ flat.T / n_positions)
