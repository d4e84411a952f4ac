# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Prediction of missing values of a cube from its neighbours.

A window (a cube and its nearest neighbours) has the gain matrix G from values to traction and the
inverse covariance P of the values (posterior.py). Both are computed once, for complete values.
With the missing values y_D and the other values y_R of the window, predicting the missing values
and then using all values gives the same traction as leaving the missing values out::

    y_D = -P_DD^-1 P_DR y_R,   the covariance of the traction grows by G_D P_DD^-1 G_D'

Source: C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning (2006), 5.4.2
(leave-one-out predictions).
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Mask
from .posterior import WindowPosteriors


class CubePrediction:
    """Predicts the D missing values of one cube from the inner cubes of its window.

    The errors of the predictions for different cubes are treated as independent.
    """

    def __init__(
        self,
        windows: WindowPosteriors,
        missing: Mask,
        cube: int,
    ) -> None:
        """Compute the weights of the other values, and the covariance of the prediction.

        Args:
            windows: Windows of all cubes.
            missing: Whether each component (cubes, C) is observed normally but not known now.
            cube: Index of the cube.
        """
        self._windows = windows
        self._cube = cube
        self._near = windows.inner[cube]
        self._columns = np.flatnonzero(missing[cube])
        # The numbers of the windows (each a cube and those nearest to it) that contain this cube,
        # and its position in the list of cubes of each of these windows.
        self._rows, self._place = np.nonzero(windows.near == cube)
        precision = windows.matrices.precision[windows.kind[cube]].astype(float)
        is_missing = missing[self._near].ravel()
        # A window lists its centre cube first, so the first missing values are those of this cube.
        n = len(self._columns)
        among_missing = precision[np.ix_(is_missing, is_missing)]
        inverse = np.linalg.solve(among_missing, np.eye(len(among_missing), n))
        self._covariance = inverse[:n]
        self._weights = -inverse.T @ precision[is_missing]
        self._weights[:, is_missing] = 0.0

    def fill(self, y: Array) -> None:
        """Replace the missing values in the values y (cubes, C) of all cubes, which are in Pa."""
        y[self._cube, self._columns] = self._weights @ y[self._near].ravel()

    def add_variance(
        self,
        variance: Array,
        scale: Array,
        pad_variance: Array,
    ) -> None:
        """Add the variance of the pressures that errors of the predicted values cause.

        Args:
            variance: Variances (cubes, q, 2) in Pa^2 of the pressure on the surface and at the
                cubes' depth, at q points around each cube; they are increased.
            scale: Factors s^2 (cubes,) of the prior variances in the window around each cube, as
                from `WindowPosteriors.compute_scale`.
            pad_variance: Variances v (cubes, P) of the errors of the pads, divided by the variance
                of their noise.
        """
        # The values from which the missing ones are predicted contain the noise of their pads.
        near = self._near
        pads = self._windows.pads[near]
        n, width = len(self._columns), pads.shape[1]
        by_pad = self._weights.reshape(n, -1, width).swapaxes(0, 1) @ pads
        weighted = by_pad * pad_variance[near, None]
        noise = (weighted @ by_pad.swapaxes(1, 2)).sum(axis=0)

        rows = self._rows
        columns = self._place[:, None] * width + self._columns
        kinds = self._windows.kind[rows]
        gain = self._windows.matrices.gain[kinds[:, None], :, 2:, columns]
        gain = gain.reshape(*columns.shape, -1)
        covariance = scale[rows, None, None] * self._covariance + noise
        increase = (gain * (covariance @ gain)).sum(axis=1)
        variance[rows] += increase.reshape(-1, *variance.shape[1:])
