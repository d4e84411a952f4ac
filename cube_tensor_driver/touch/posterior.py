# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Posterior of the traction on the surface, from windows of neighbouring cubes.

The traction t (force per area on the surface) and the values y that the cubes measure have the
prior covariances K (traction_prior.py); N is the covariance of the errors of the values. The
posterior of the traction has the mean t and the covariance::

    t = G y,   G = K_ty P,   P = (K_yy + N)^-1,   covariance K_tt - G K_yt

The traction on the patch of surface points around a cube is computed from its window, the cubes
nearest to it. The matrices of a window are computed once, so that every scan (set of values of all
cubes) needs only one product. Windows of the same kind (same relative poses and noise) share their
matrices.

The standard deviation of the prior adapts to the data: the prior variances for the standard
deviation `AMPLITUDE` of the pressure are multiplied by a factor s^2. The noise matrix B
(pad_noise.py) turns the errors of all pads into errors of the values. If each pad's error has the
variance v, in units of the variance of its noise, the variances of the traction increase by
(G B)^2 v, with the squares of all entries of G B. With n values, the factor is::

    s^2 = (y' P y - diag(B' P B) v) / n

Source: C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning (2006), 2.2 and
5.4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_solve, cholesky

from ..core.arrays import Array, Index, Mask, Single
from ..core.poses import CubePoses
from ..mechanics.cache import load_or_compute
from ..mechanics.traction_prior import AMPLITUDE, TractionPrior
from .nearest_cubes import find_nearest_cubes
from .unrolled_skin import unroll

WINDOW_CUBES = 25
"""Number of cubes in a window (nearest cubes from which the traction around a cube is computed):
5 x 5 on a square grid."""

INNER_CUBES = 13
"""Number of inner cubes: those nearest to the centre of a window (`WINDOW_CUBES`). The scale of the
prior and missing values of the centre cube are computed from their values. With all 25 cubes of a
window, the precision matrices P (inverse covariances of the values) would take most of the memory.
"""

MODEL_ERROR = 0.01
"""Standard deviation of the error that inexact calibrations and an inexact depth of the cubes cause
in a measured component (stress or gradient), divided by this component's prior standard
deviation."""

_POSE_TOLERANCE = 1e-5
"""Rounding step of the poses of the cubes in a window (nearest cubes from which the traction around
a cube is computed): in m for positions, without a unit for the sines and cosines of angles.

Windows with equal rounded poses, noise and calibrations share the matrices by which the traction
follows from the values of the cubes.
"""


class _WindowMatrices(NamedTuple):
    """Matrices of all kinds of windows (cubes nearest to one cube).

    The head of this file defines the matrices G, P and B (noise), and the scale s^2 of the prior
    variances. A window has W cubes with C values and P pads each. The traction is computed at q
    points around its centre cube. The first cubes of the window are its inner cubes
    (`INNER_CUBES`).

    Attributes:
        gain: Matrices G (kinds, q, 4, W C) from the values of the window's cubes to the results at
            each point: the traction along x, y and z, and the pressure at the cubes' depth.
        variance: Posterior variances (kinds, q, 2) in Pa^2 of the pressure on the surface and of
            that at the cubes' depth, at the scale s = 1 and without errors of the pads.
        by_pad: Variances (kinds, q, 2, W P) in Pa^2 of these pressures due to the noise of each
            pad: the squares of G B.
        precision: Matrices P (kinds, inner C, inner C) of the values of the inner cubes, in 1/Pa^2.
        trace: Diagonals of B' P B (kinds, 1, inner P), by which the noise of each pad of the inner
            cubes reduces s^2.
    """

    gain: Single
    variance: Single
    by_pad: Single
    precision: Single
    trace: Single


class WindowPosteriors:
    """Windows (the cubes nearest to one cube) of all cubes, and products of matrices and values.

    Attributes:
        near: Indices (cubes, W) of the cubes of each window, sorted by their distance from its
            centre cube, which comes first.
        inner: Indices (cubes, inner) of the first `INNER_CUBES` cubes of each window.
        kind: Number (cubes,) of the kind of each window. Windows of one kind have equal poses,
            noise and calibrations, and therefore equal matrices.
        matrices: Matrices of the kinds of windows.
        pads: Noise matrices (cubes, C, P) of all cubes in Pa, 0 where nothing is observed.
    """

    def __init__(
        self,
        prior: TractionPrior,
        poses: CubePoses,
        columns: Index,
        by_pad: Array,
        variant: Index,
        points: Array,
    ) -> None:
        """Compute the matrices, or load them from the cache on disk.

        Args:
            prior: Prior covariances of traction and measured components.
            poses: Poses of the cubes.
            columns: Indices (C,) in `COMPONENTS` of the components that the cubes measure.
            by_pad: Noise matrices (cubes, C, P) as from `compute_noise_by_pad`, with gradients in
                Pa: they are multiplied by half the side of a cube.
            variant: Index (cubes,) of each cube's calibration in the measurement model.
            points: Positions (q, 2) of the points on the patch of a cube in its x-y plane, in m.
        """
        self.near = find_nearest_cubes(poses, WINDOW_CUBES, by_position=True)
        self.inner = self.near[:, :INNER_CUBES]
        self.pads = np.nan_to_num(by_pad)
        place, angle = unroll(poses, np.arange(len(self.near)), self.near)
        first = self._find_kinds(by_pad, variant, place, angle)

        # Windows (each a cube and those nearest to it) of one kind have equal poses, noise and
        # calibrations. Their matrices are computed only once, for the first window of the kind.
        cubes = self.near[first]
        windows = (place[first], angle[first], by_pad[cubes], variant[cubes])

        def solve_kinds() -> dict[str, Single]:
            solved: dict[str, Single] = {}
            # The matrices of a kind are copied into the result as soon as they are computed,
            # because a list of the matrices of all kinds would double the memory.
            for number, window in enumerate(zip(*windows, strict=True)):
                for name, array in _solve_window(prior, columns, points, *window).items():
                    if not number:
                        solved[name] = np.empty((len(first), *array.shape), np.float32)
                    solved[name][number] = array
            return solved

        inputs = [*prior.inputs, columns, points, *windows]
        self.matrices = _WindowMatrices(**load_or_compute("windows", inputs, solve_kinds))

    def _find_kinds(
        self,
        by_pad: Array,
        variant: Index,
        place: Array,
        angle: Array,
    ) -> Index:
        """Set the kind of each window, equal for windows with equal poses, noise and calibrations.

        Args:
            by_pad: Noise matrices (cubes, C, P).
            variant: Index (cubes,) of each cube's calibration in the measurement model.
            place: Positions (cubes, W, 2) of the cubes of each window, in m.
            angle: Rotations (cubes, W) of these cubes, in rad.

        Returns:
            Index (kinds,) of the first window of each kind.
        """
        n = len(place)
        # The noise of components that are not observed is NaN, which is not equal to itself. It is
        # replaced by -1 and not by 0, the noise of components without noise.
        noise = np.nan_to_num(by_pad, nan=-1.0).reshape(n, -1)
        _, noise_kind = np.unique(noise, axis=0, return_inverse=True)
        poses = [place.reshape(n, -1), np.cos(angle), np.sin(angle)]
        rounded = [np.round(one / _POSE_TOLERANCE) for one in poses]
        numbers = [noise_kind.reshape(n)[self.near], variant[self.near]]
        _, first, kind, count = np.unique(
            np.concatenate([*rounded, *numbers], axis=1),
            axis=0,
            return_index=True,
            return_inverse=True,
            return_counts=True,
        )

        # Kinds with only one window come first, so that `multiply` can handle all of them in one
        # batch. The other kinds are handled one by one.
        order = np.argsort(count > 1, kind="stable")
        self.kind = np.argsort(order)[kind.reshape(n)]
        first = first[order]
        n_single = np.count_nonzero(count == 1)
        self._single = first[:n_single]
        kinds = range(n_single, len(first))
        self._shared = [(number, np.flatnonzero(self.kind == number)) for number in kinds]
        return first

    def multiply(self, matrices: Single, values: Array) -> Array:
        """Multiply the values of the cubes of every window by the matrix of the window's kind.

        Args:
            matrices: Matrices (kinds, ..., n k) from k values of each of the first n cubes of a
                window to any results.
            values: Values (cubes, k).

        Returns:
            Results (cubes, ...) for all windows, computed in single precision.
        """
        *shape, width = matrices.shape
        matrices = matrices.reshape(len(matrices), -1, width)
        near = self.near[:, : width // values.shape[1]]
        gathered = values.astype(np.float32).take(near, axis=0).reshape(len(near), -1)
        result = np.empty((len(near), matrices.shape[1]))
        for kind, windows in self._shared:
            result[windows] = gathered[windows] @ matrices[kind].T
        single = gathered[self._single, :, None]
        products = matrices[: len(single)] @ single
        result[self._single] = products[:, :, 0]
        return result.reshape(len(near), *shape[1:])

    def compute_scale(self, y: Array, pad_variance: Array, known: Mask) -> Array:
        """Compute the factor s^2 of the prior variances (head of this file) in each window, from
        its inner cubes.

        Args:
            y: Values (cubes, C) in Pa.
            pad_variance: Variances v (cubes, P) of the errors of the pads, divided by the variance
                of their noise.
            known: Whether each value is known (cubes, C).

        Returns:
            Factors s^2 (cubes,); 1 in windows without a known value.
        """
        weighted = self.multiply(self.matrices.precision, y)
        square = (weighted * y[self.inner].reshape(weighted.shape)).sum(axis=1)
        excess = square - self.multiply(self.matrices.trace, pad_variance)[:, 0]
        count = known.sum(axis=1)[self.inner].sum(axis=1)
        return np.where(
            count > 0,
            np.maximum(excess, 0) / np.maximum(count, 1),
            1.0,
        )


def _solve_window(
    prior: TractionPrior,
    columns: Index,
    points: Array,
    place: Array,
    angle: Array,
    by_pad: Array,
    variant: Index,
) -> dict[str, Single]:
    """Compute the matrices of one window, for the traction around its centre cube.

    Positions and rotations are in the frame of the centre cube, around which the skin is laid flat.

    Args:
        prior: Prior covariances of traction and measured components.
        columns: Indices (C,) in `COMPONENTS` of the components that the cubes measure.
        points: Positions (q, 2) on the surface around the centre cube, in m.
        place: Positions (W, 2) of the cubes in m.
        angle: Rotations (W,) of the cubes in rad.
        by_pad: Noise matrices (W, C, P) in Pa; NaN for components that a cube does not observe.
        variant: Index (W,) of each cube's calibration in the measurement model.

    Returns:
        The arrays of `_WindowMatrices` for this window by name.
    """
    n, width, _ = by_pad.shape
    size = n * width
    observed = np.isfinite(by_pad.sum(axis=2)).ravel()
    pads = np.nan_to_num(by_pad)

    # `covariance` becomes K_yy + N. Only its upper triangle is set and used. Components that are
    # not observed get the variance 1 and no covariance with others, so that they have no effect.
    first, second = np.triu_indices(n)
    pairs = prior.compute_covariance(
        place[first] - place[second],
        angle[first],
        variant[first],
        angle[second],
        variant[second],
    )
    by_cubes = np.zeros((n, n, width, width))
    by_cubes[first, second] = pairs[:, columns[:, None], columns]
    covariance = AMPLITUDE**2 * by_cubes.swapaxes(1, 2).reshape(size, size)
    covariance[np.diag_indices(size)] *= 1 + MODEL_ERROR**2
    covariance += block_diag(*(pads @ pads.swapaxes(1, 2)))
    covariance = np.where(
        np.outer(observed, observed),
        covariance,
        np.eye(size),
    )
    factor = cholesky(covariance)

    # `cross` is K_ty. Its axes, at first cubes, points, components and results, become points,
    # results, and the components of all cubes.
    offset = place[:, None] - points
    cross = prior.compute_surface_covariance(
        offset.reshape(-1, 2),
        np.repeat(angle, len(points)),
        np.repeat(variant, len(points)),
    )
    cross = cross[:, columns].reshape(n, len(points), width, -1)
    cross = cross.transpose(1, 3, 0, 2).reshape(len(points), -1, size)
    cross = AMPLITUDE**2 * np.where(observed, cross, 0.0)
    gain = cho_solve((factor, False), cross.reshape(-1, size).T).T.reshape(cross.shape)
    variance = AMPLITUDE**2 * prior.variance - (gain * cross).sum(axis=2)

    by_cube = gain[:, 2:].reshape(len(points), 2, n, 1, width)
    effect = by_cube @ pads  # G B; the noise matrix B has one block for each cube
    inner = pads[:INNER_CUBES]
    size = len(inner) * width
    precision = cho_solve((factor[:size, :size], False), np.eye(size))
    noise = block_diag(*inner)
    trace = np.einsum("dp,dp->p", precision @ noise, noise)
    arrays = {
        "gain": gain,
        "variance": np.maximum(variance[:, 2:], 0),
        "by_pad": effect.reshape(len(points), 2, -1) ** 2,
        "precision": precision,
        "trace": trace[None],
    }
    return {name: array.astype(np.float32) for name, array in arrays.items()}
