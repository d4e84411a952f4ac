# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Posterior of the traction on the surface, from windows of neighbouring cubes.

K are prior covariances (prior.py) of the traction t (force per area on the surface) and of the
values y that the cubes measure; N is the covariance of the values' noise. The posterior of the
traction has the mean t and the covariance::

    t = G y,   G = K_ty P,   P = (K_yy + N)^-1,   covariance K_tt - G K_yt

The traction on the patch of surface points around a cube is computed from its window, the cubes
nearest to it. The matrices of a window are computed once, so that every scan (set of values of all
cubes) needs only one product. Windows of the same kind (same relative poses and noise) share their
matrices.

The standard deviation of the prior adapts to the data: all prior variances are those with the
pressure `AMPLITUDE`, multiplied by a scale s^2. The noise and the gain errors of the pads cause the
covariance M of the values (pad_noise.py), which adds diag(G M G') to the variances of the traction.
With n values, the scale is::

    s^2 = (y' P y - tr P M) / n

Source: C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning (2006), 2.2 and
5.4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..core.arrays import Array, Index, Mask, Real, Single
from ..core.poses import CubePoses
from ..mechanics.cache import load_or_compute
from ..mechanics.traction_prior import TractionPrior
from .nearest_cubes import find_nearest_cubes
from .prior import AMPLITUDE, compute_covariance_matrix
from .surface import make_square_points
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

ROWS_PER_POINT = 4
"""Number of results per surface point: the traction along x, y and z, and the pressure below the
point at the depth of the cubes' centres."""

_POSE_TOLERANCE = 1e-5
"""Rounding step of the poses of the cubes in a window (nearest cubes from which the traction around
a cube is computed): in m for positions, without a unit for the sines and cosines of angles.

Windows with equal rounded poses, noise and calibrations share the matrices by which the traction
follows from the values of the cubes.
"""


class ObservationModel(NamedTuple):
    """Components (stresses and gradients) that n cubes observe, and their noise.

    Attributes:
        columns: Indices (C,) in `COMPONENTS` of the components that some cube of the skin observes.
        known: Whether each cube observes each of these components (n, C).
        by_pad: Noise matrices (n, C, P) as from `compute_noise_by_pad`: change of each component,
            in Pa, for one standard deviation of the noise of each pad. Gradients are multiplied by
            half the side of a cube, so that they are in Pa, too.
        variant: Index (n,) of each cube's calibration in the measurement model.
    """

    columns: Index
    known: Mask
    by_pad: Array
    variant: Index

    def select(self, cubes: Index) -> ObservationModel:
        """Return the observation model of some of the cubes.

        Args:
            cubes: Indices (...) of the cubes. Their axes replace the leading axis n of the arrays.
        """
        return ObservationModel(
            self.columns,
            self.known[cubes],
            self.by_pad[cubes],
            self.variant[cubes],
        )


class WindowPosteriors:
    """Matrices of the windows of all cubes, for the formulas at the head of this file.

    The window of a cube is the cube and its nearest neighbours, W cubes in total. Windows of the
    same kind (same relative poses and noise) share their matrices. A cube has C values and, in
    shapes, P pads; in formulas, P is a matrix.

    Attributes:
        near: Indices (cubes, W) of the cubes of each window, sorted by their distance from its
            centre cube, which comes first.
        inner: Number of inner cubes, the first ones of each window, whose values determine the
            scale s of the prior.
        kind: Index (cubes,) of the kind of each window.
        gain: Matrix G (kinds, points x ROWS_PER_POINT, W C) from the values of the window's cubes
            to the results at the points around its centre cube, in single precision.
        precision: Matrix P (kinds, inner C, inner C) in 1/Pa^2, the inverse covariance of the
            values of the inner cubes.
        prior: Posterior variance (kinds, points x 2) in Pa^2 of the pressure on the surface and at
            the cubes' depth, at the scale s = 1 and without pad noise.
        by_pad: Variance (kinds, points x 2, W P) in Pa^2 that the noise of each pad causes in the
            pressure on the surface and in the pressure at the cubes' depth.
        trace: Contribution (kinds, inner P) of the noise of each pad to the trace of P M, where M
            is the covariance of the values that the errors of the pads cause.
        pads: Noise matrices (cubes, C, P) of all cubes in Pa, 0 where nothing is observed.
    """

    def __init__(
        self,
        traction_prior: TractionPrior,
        poses: CubePoses,
        model: ObservationModel,
        spacing: float,
        side: int,
    ) -> None:
        """Compute the matrices, or load them from the cache on disk.

        Args:
            traction_prior: Prior covariances of traction and measured components.
            poses: Poses of the cubes.
            model: Components that the cubes observe, and their noise.
            spacing: Distance of the points on the patch of a cube, in m.
            side: Number of points along a side of the patch.
        """
        self.near = find_nearest_cubes(poses, WINDOW_CUBES, by_position=True)
        self.inner = min(INNER_CUBES, self.near.shape[1])
        self.pads = np.nan_to_num(model.by_pad)
        n = len(self.near)
        place, angle = unroll(poses, np.arange(n), self.near)
        self.kind = self._find_kinds(model, place, angle)

        # The matrices are computed for the first window of each kind, and serve for all of them.
        kinds, first = np.unique(self.kind, return_index=True)
        example = model.select(self.near[first])
        inputs: list[object] = [
            *traction_prior.inputs,
            spacing,
            side,
            place[first],
            angle[first],
        ]
        inputs += [example.columns, example.by_pad, example.variant]
        points = make_square_points(spacing, side)

        def solve_kinds() -> dict[str, Real]:
            """Compute the arrays of `_Window` for all kinds of windows.

            Returns:
                Arrays by their names in `_Window`, each with the kinds as an additional first axis.
            """
            solved: dict[str, Real] = {}
            # The matrices of a kind are copied into the result as soon as they are computed,
            # because a list of all of them would double the memory.
            for number, one in enumerate(first):
                own = model.select(self.near[one])
                window = _solve_window(
                    traction_prior,
                    own,
                    place[one],
                    angle[one],
                    points,
                )
                for name, array in window._asdict().items():
                    if name not in solved:
                        shape = (len(first), *array.shape)
                        solved[name] = np.empty(shape, array.dtype)
                    solved[name][number] = array
            return solved

        solved = load_or_compute("windows", inputs, solve_kinds)
        self.gain = solved["gain"]
        self.precision = solved["precision"]
        self.prior = solved["variance"]
        self.by_pad = solved["by_pad"]
        self.trace = solved["trace"]

        # In `compute_product`, all windows that are the only ones of their kind are multiplied in
        # one batch, the others one kind at a time.
        self._rows = []
        for kind in kinds:
            rows = np.flatnonzero(self.kind == kind)
            self._rows.append((kind, rows))
        self._shared_kinds = [(kind, rows) for kind, rows in self._rows if len(rows) > 1]
        counts = np.bincount(self.kind)
        is_single = counts[self.kind] == 1
        self._single = np.flatnonzero(is_single)
        single_kinds = self.kind[self._single]
        by_point = self.gain.reshape(
            len(self.gain),
            len(points),
            ROWS_PER_POINT,
            -1,
        )
        pressure_gain = np.ascontiguousarray(by_point[:, :, -1])
        self._gains = [(gain, gain[single_kinds]) for gain in (self.gain, pressure_gain)]

    def _find_kinds(
        self,
        model: ObservationModel,
        place: Array,
        angle: Array,
    ) -> Index:
        """Find windows (cubes nearest to one cube) of the same kind, which share their matrices.

        The cubes of such windows have the same relative poses, noise and calibrations.

        Args:
            model: Components that all cubes observe, and their noise.
            place: Positions (cubes, W, 2) of the cubes of each window, in m.
            angle: Rotations (cubes, W) of these cubes, in rad.

        Returns:
            Number (cubes,) of the kind of each window.
        """
        n = len(place)
        # The noise of components that are not observed is NaN, which is not equal to itself. It is
        # replaced by -1 and not by 0, the noise of components without noise.
        noise = np.nan_to_num(model.by_pad, nan=-1.0)
        noise_kind = _number_distinct(noise.reshape(n, -1))
        poses = np.concatenate(
            [
                place.reshape(n, -1),
                np.cos(angle),
                np.sin(angle),
            ],
            axis=1,
        )
        rounded = np.round(poses / _POSE_TOLERANCE)
        features = [
            rounded,
            noise_kind[self.near],
            model.variant[self.near],
        ]
        return _number_distinct(np.concatenate(features, axis=1))

    def compute_product(self, y: Single, only_pressure: bool = False) -> Single:
        """Compute the posterior mean G y (head of this file) of the traction around all cubes.

        Args:
            y: Components (cubes, C) that the cubes measure, in Pa; 0 where unknown.
            only_pressure: Whether only the pressure at the cubes' depth is computed, which takes a
                third of the time.

        Returns:
            Posterior mean (cubes, points x ROWS_PER_POINT) in Pa, at the surface points around each
            cube. Each point has `ROWS_PER_POINT` results: traction along x, y and z, and pressure
            at the cubes' depth. If `only_pressure`, only the latter (cubes, points).
        """
        # The values of all cubes of a window are joined to one row, in the order of the columns of
        # the gain matrix G.
        n = len(self.near)
        gathered = y.take(self.near, axis=0).reshape(n, -1)
        gains, single_gains = self._gains[only_pressure]
        result = np.empty((n, gains.shape[1]), np.float32)
        for kind, rows in self._shared_kinds:
            result[rows] = gathered[rows] @ gains[kind].T
        if len(self._single):
            single = gathered[self._single]
            products = single_gains @ single[:, :, None]
            result[self._single] = products[:, :, 0]
        return result

    def compute_scale(
        self,
        y: Single,
        pad_variance: Single,
        known: Mask,
    ) -> Array:
        """Compute the factor s^2 of the prior variances in each window from its inner cubes.

        Args:
            y: Values (cubes, C) in Pa.
            pad_variance: Variance (cubes, P) of the error of each pad, divided by the variance of
                its noise.
            known: Whether each value is known (cubes, C).

        Returns:
            Factors s^2 (cubes,); 1 in windows without a known value.
        """
        inner = self.near[:, : self.inner]
        n = len(inner)
        gathered = y[inner].reshape(n, -1)
        pads = pad_variance[inner].reshape(n, -1)

        # `excess` is y' P y - tr P M: the squared values, weighted with their inverse covariance P,
        # minus the part that the errors of the pads are expected to cause.
        excess = np.empty(n)
        for kind, rows in self._rows:
            own = gathered[rows]
            weighted = own @ self.precision[kind]
            excess[rows] = (weighted * own).sum(axis=1)
            excess[rows] -= pads[rows] @ self.trace[kind]
        excess = np.maximum(excess, 0)
        count_by_cube = known.sum(axis=1)
        count = count_by_cube[inner].sum(axis=1)
        mean_excess = excess / np.maximum(count, 1)
        return np.where(count > 0, mean_excess, 1.0)

    def compute_noise(self, pad_variance: Single) -> Array:
        """Compute the variances of the pressures that the errors of the pads cause.

        Args:
            pad_variance: Variance (cubes, P) of the error of each pad, divided by the variance of
                its noise.

        Returns:
            Variances (cubes, points x 2) in Pa^2 of the pressure on the surface and of the pressure
            at the cubes' depth.
        """
        n = len(self.near)
        gathered = pad_variance[self.near].reshape(n, -1)
        n_pressures = self.by_pad.shape[1]
        noise = np.empty((n, n_pressures))
        for kind, rows in self._rows:
            by_pad = self.by_pad[kind]
            noise[rows] = gathered[rows] @ by_pad.T
        return noise


class _Window(NamedTuple):
    """Matrices for the traction around a cube from the values of its window (the nearest cubes).

    All windows of one kind (same relative poses and noise) use them. `WindowPosteriors` describes
    them; its attribute `prior` holds each `variance`.
    """

    gain: Single
    precision: Single
    variance: Array
    by_pad: Single
    trace: Single


def _solve_window(
    traction_prior: TractionPrior,
    model: ObservationModel,
    place: Array,
    angle: Array,
    points: Array,
) -> _Window:
    """Compute the matrices of one window, for the traction around its centre cube.

    The traction follows from the values of the W cubes of the window. Positions and rotations are
    in the frame of the centre cube, around which the skin is laid flat.

    Args:
        traction_prior: Prior covariances of traction and measured components.
        model: Components that the W cubes of the window observe, and their noise.
        place: Positions (W, 2) of the cubes in m.
        angle: Rotations (W,) of the cubes in rad.
        points: Positions (points, 2) on the surface around the centre cube, in m.
    """
    columns = model.columns
    n = len(place)
    width = len(columns)
    known = model.known.ravel()
    pads = np.nan_to_num(model.by_pad)

    unit_prior = compute_covariance_matrix(
        traction_prior,
        columns,
        place,
        angle,
        model.variant,
    )
    prior = AMPLITUDE**2 * unit_prior
    total = prior.copy()  # becomes the covariance K_yy + N of the measured values
    for cube, own in enumerate(pads):
        first = cube * width
        part = slice(first, first + width)
        total[part, part] += own @ own.T
    model_variance = MODEL_ERROR**2 * np.diag(prior)
    total[np.diag_indices(n * width)] += model_variance

    # `known_gain` is the gain matrix G = K_ty (K_yy + N)^-1 for the known values, and `variance`
    # the posterior variance diag(K_tt - G K_yt) of the traction.
    cross = _compute_cross_covariance(
        traction_prior,
        model,
        place,
        angle,
        points,
    )
    cross = cross[:, known]
    known_block = np.ix_(known, known)
    # Cholesky takes a quarter of the time of numpy's general solver.
    factor = cho_factor(total[known_block])
    known_gain = cho_solve(factor, cross.T).T
    per_point = np.array([*traction_prior.variance, traction_prior.pressure_variance])
    prior_variance = AMPLITUDE**2 * np.tile(per_point, len(points))
    explained = (known_gain * cross).sum(axis=1)
    variance = prior_variance - explained
    n_results = len(cross)
    gain = np.zeros((n_results, n * width), np.float32)
    gain[:, known] = known_gain

    # With the noise matrix B of the pads, diag(G M G') is a sum of (G B)^2 over the pads.
    by_point = gain.reshape(-1, ROWS_PER_POINT, n, width)
    pressure_gain = by_point[:, 2:].reshape(-1, n, width)
    by_pad = np.einsum("rwc,wcp->rwp", pressure_gain, pads, optimize=True)
    by_pad = by_pad.reshape(len(pressure_gain), -1) ** 2

    inner = min(INNER_CUBES, n)
    size = inner * width
    precision = _invert_known(total[:size, :size], known[:size])
    cubes = np.arange(inner)
    # The noise covariance M has no entries between different cubes, so the trace of P M depends
    # only on the diagonal blocks of P.
    blocks = precision.reshape(inner, width, inner, width)
    diagonal = blocks[cubes, :, cubes]
    inner_pads = pads[:inner]
    trace = np.einsum(
        "wcp,wcd,wdp->wp",
        inner_pads,
        diagonal,
        inner_pads,
        optimize=True,
    )
    pressure_variance = select_pressure(variance)
    return _Window(
        gain=gain,
        precision=precision.astype(np.float32),
        variance=np.maximum(pressure_variance, 0),
        by_pad=by_pad.astype(np.float32),
        trace=trace.ravel().astype(np.float32),
    )


def _compute_cross_covariance(
    traction_prior: TractionPrior,
    model: ObservationModel,
    place: Array,
    angle: Array,
    points: Array,
) -> Array:
    """Compute the prior covariance K_ty of the traction at surface points with the cubes' values.

    At each point, the traction along x, y and z is followed by the pressure below the point at the
    depth of the cubes' centres. Each cube has C values, the observed components. Positions and
    rotations are in the frame of the centre cube, around which the skin is laid flat.

    Args:
        traction_prior: Prior covariances of traction and measured components.
        model: Components that the W cubes of the window observe.
        place: Positions (W, 2) of the cubes in m.
        angle: Rotations (W,) of the cubes in rad.
        points: Positions (points, 2) on the patch of the centre cube, in m.

    Returns:
        Covariance (points x ROWS_PER_POINT, W C) in Pa^2.
    """
    columns = model.columns
    n = len(place)
    n_points = len(points)
    width = len(columns)
    offset = place[:, None] - points
    offset = offset.reshape(-1, 2)
    angles = np.repeat(angle, n_points)
    variants = np.repeat(model.variant, n_points)

    traction = traction_prior.compute_traction_covariance(
        offset,
        angles,
        variants,
    )
    traction = traction[:, columns].reshape(n, n_points, width, 3)
    pressure = traction_prior.compute_pressure_covariance(
        offset,
        angles,
        variants,
    )
    pressure = pressure[:, columns].reshape(n, n_points, width)
    cross = np.empty((n_points, ROWS_PER_POINT, n, width))
    # The axes of `cross` are the points, their results, the cubes and the components.
    cross[:, :3] = traction.transpose(1, 3, 0, 2)
    cross[:, 3] = pressure.transpose(1, 0, 2)
    return AMPLITUDE**2 * cross.reshape(-1, n * width)


def _invert_known(matrix: Array, known: Mask) -> Array:
    """Invert the part of a covariance matrix that belongs to known values.

    Args:
        matrix: Covariance (D, D) of all values.
        known: Whether each value (D,) is known.

    Returns:
        Inverse (D, D), in which the rows and columns of unknown values are 0.
    """
    inverse = np.zeros_like(matrix)
    block = np.ix_(known, known)
    factor = cho_factor(matrix[block])
    identity = np.eye(known.sum())
    inverse[block] = cho_solve(factor, identity)
    return inverse


def select_pressure(rows: Array) -> Array:
    """Select the pressures from results that also contain the shear traction.

    Args:
        rows: Results (..., points x ROWS_PER_POINT). Each point has the traction along x, y and z
            and the pressure at the cubes' depth.

    Returns:
        Results (..., points x 2): for each point the traction along z, whose negative is the
        pressure on the surface, and the pressure at the cubes' depth.
    """
    leading = rows.shape[:-1]
    by_point = rows.reshape(*leading, -1, ROWS_PER_POINT)
    chosen = by_point[..., 2:]
    return chosen.reshape(*leading, -1)


def _number_distinct(rows: Array) -> Index:
    """Number the distinct rows of a matrix.

    Args:
        rows: Matrix (n, k).

    Returns:
        Number (n,) of each row, from 0 on; equal rows have the same number.
    """
    _, number = np.unique(rows, axis=0, return_inverse=True)
    return np.asarray(number).reshape(-1)
