# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Prediction of missing values of a cube from its neighbours.

A window (a cube and its nearest neighbours) has the gain matrix G from values to traction and the
inverse covariance P of the values (posterior.py). Both are computed once, for complete values.
Let D be the missing and R the other values of the window. Predicting the missing values and then
using all values gives the same traction as leaving the missing values out::

    y_D = -P_DD^-1 P_DR y_R,   the covariance of the traction grows by G_D P_DD^-1 G_D'

Source: C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning (2006), 5.4.2
(leave-one-out predictions).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..core.arrays import Array, Index, Mask, Single
from .posterior import WindowPosteriors, select_pressure


class _Prediction(NamedTuple):
    """Matrices for the prediction of the D missing values of one cube.

    In the shapes, C is the number of components of a cube, P the number of its pads, `inner` the
    number of cubes in `near`, and `points` the number of surface points around a cube at which
    pressures are computed.

    Attributes:
        cube: Index of the cube.
        columns: Indices (D,) of the missing values among the C components of the cube.
        near: Indices (inner,) of the cube itself and its nearest neighbours, from whose known
            values the missing ones are predicted.
        weights: Matrix (D, inner C) by which the values of these cubes are multiplied to give the
            predictions; it is 0 for missing values.
        by_pad: Change (D, inner P) of the predictions in Pa for one standard deviation of the noise
            of each pad of these cubes.
        rows: Indices (n,) of the windows (a cube and its nearest neighbours) that contain the cube.
            The index of a window is that of its centre cube.
        gain: Changes (n, D, points x 2) of two pressures at each point of these windows (on the
            surface, and below it at the cubes' depth) per Pa of each missing value.
    """

    cube: int
    columns: Index
    near: Index
    weights: Array
    by_pad: Array
    rows: Index
    gain: Array


class MissingValuePrediction:
    """Predicts all missing values of a skin from the cubes nearest to the cube that lacks them.

    The errors of the predictions for different cubes are treated as independent.

    Attributes:
        variance: Variance (cubes, points x 2) in Pa^2 that the missing values add to two pressures
            at each point around each cube: the pressure on the surface, and the one at the cubes'
            depth. It holds for the scale s = 1 of the prior (posterior.py); for another scale, it
            is multiplied by s^2.
    """

    def __init__(
        self,
        windows: WindowPosteriors,
        observed: Mask,
        known: Mask,
    ) -> None:
        """Prepare the predictions of the values that are observed normally but not known now.

        Args:
            windows: Matrices of all windows (a cube and its nearest neighbours).
            observed: Whether each cube normally observes each component (cubes, C).
            known: Whether each component (cubes, C) is known now.
        """
        missing = observed & ~known
        n_pressures = windows.prior.shape[1]
        self.variance = np.zeros((len(known), n_pressures))
        self._predictions: list[_Prediction] = []
        incomplete = np.flatnonzero(missing.any(axis=1))
        for cube in incomplete.tolist():
            self._add_cube(windows, missing, cube)

    def _add_cube(
        self,
        windows: WindowPosteriors,
        missing: Mask,
        cube: int,
    ) -> None:
        """Prepare the prediction of the missing values of one cube and add to `variance`.

        Args:
            windows: Matrices of all windows (a cube and its nearest neighbours).
            missing: Whether each component (cubes, C) is observed normally but not known now.
            cube: Index of the cube whose missing values are to be predicted.
        """
        width = missing.shape[1]
        near = windows.near[cube, : windows.inner]
        kind = windows.kind[cube]
        precision = windows.precision[kind].astype(float)
        is_missing = missing[near].ravel()
        own = np.flatnonzero(missing[cube])
        n_own = len(own)

        # A window lists its centre cube first, so the first missing values are those of this cube.
        missing_block = precision[np.ix_(is_missing, is_missing)]
        n_missing = is_missing.sum()
        selection = np.eye(n_missing, n_own)
        covariance = np.linalg.solve(missing_block, selection)
        own_covariance = covariance[:n_own]
        weights = -covariance.T @ precision[is_missing]
        weights[:, is_missing] = 0.0

        # `rows` are the windows that contain the cube, and `place` is its position in the list of
        # cubes of each of these windows.
        rows, place = np.nonzero(windows.near == cube)
        columns = place[:, None] * width + own
        kinds = windows.kind[rows]
        all_gain = windows.gain[kinds[:, None], :, columns]
        gain = select_pressure(all_gain.astype(float))
        increase = np.einsum("ncr,cd,ndr->nr", gain, own_covariance, gain)
        self.variance[rows] += np.maximum(increase, 0)

        if is_missing.all():
            return  # nothing is known nearby: the prediction is the mean of the prior, 0
        by_cube = weights.reshape(n_own, len(near), -1)
        pads = windows.pads[near]
        by_pad = np.einsum("fwc,wcp->fwp", by_cube, pads)
        by_pad = by_pad.reshape(n_own, -1)
        prediction = _Prediction(
            cube,
            own,
            near,
            weights,
            by_pad,
            rows,
            gain,
        )
        self._predictions.append(prediction)

    def fill(self, y: Single) -> Single:
        """Replace missing values by predictions from the neighbouring cubes.

        Args:
            y: Values (cubes, C) in Pa, 0 where missing.

        Returns:
            Copy (cubes, C) of the values in which the missing ones are predicted.
        """
        filled: Single = y.copy()
        for one in self._predictions:
            neighbours = y[one.near].ravel()
            filled[one.cube, one.columns] = one.weights @ neighbours
        return filled

    def compute_noise(self, pad_variance: Single) -> Array:
        """Compute the variances that pad noise adds to the pressures through the predicted values.

        Missing values are predicted from other values, which contain the noise of the pads.

        Args:
            pad_variance: Variance (cubes, P) of the error of each pad, divided by the variance of
                its noise.

        Returns:
            Variances (cubes, points x 2) in Pa^2 of the pressures on the surface and at the cubes'
            depth.
        """
        total = np.zeros_like(self.variance)
        for one in self._predictions:
            neighbours = pad_variance[one.near].ravel()
            weighted = one.by_pad * neighbours
            covariance = weighted @ one.by_pad.T
            variance = np.einsum(
                "ncr,cd,ndr->nr",
                one.gain,
                covariance,
                one.gain,
            )
            total[one.rows] += variance
        return total
