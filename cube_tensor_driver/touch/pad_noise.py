# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Noise of the components (stresses and their gradients) that a cube measures.

It has two causes: the noise of the cube's pads (sensing elements) and the errors of their gains. B
is the matrix from the pads' noise, in units of its standard deviation, to the components. A gain
error causes an error in proportion to the stress u on the pad, which is given in the same units.
The covariance N of the components is then::

    N = B diag(1 + GAIN_ERROR^2 u^2) B',     u = B' (B B')^-1 y

The pads' stresses u are those with the smallest norm that explain the components y.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..core.arrays import Array, Index, Mask, PadMasks
from ..core.calibration import Calibration
from ..core.modes import COMPONENTS
from ..core.pipeline import Pipeline

GAIN_ERROR = 0.01
"""Standard deviation of the relative error of a pad's calibrated gain (sensitivity): 1 %."""


def compute_noise_by_pad(
    pipeline: Pipeline,
    cubes: Index,
    left_out: PadMasks,
) -> Array:
    """Return the noise matrices B (from the noise of P pads to 15 components) of n cubes.

    Args:
        pipeline: Pipeline that computes the components of all cubes of the skin.
        cubes: Indices (n,) of the cubes.
        left_out: Bit masks (n,), in which bit k is set if pad k of the cube is not used.

    Returns:
        Change (n, 15, P) of each component, in Pa or Pa/m, for one standard deviation of the noise
        of each pad. It is NaN where a component is not observed, and 0 for a pad that is left out
        or that the cube does not have.
    """
    shape = len(cubes), len(COMPONENTS), pipeline.n_pads
    by_pad = np.zeros(shape)
    # Cubes may have different numbers of pads; the columns of pads that a cube lacks stay 0.
    cube_masks = zip(cubes.tolist(), left_out.tolist(), strict=True)
    for row, (cube, mask) in enumerate(cube_masks):
        calibration = pipeline.calibrations[cube]
        own = pipeline.find_matrix(cube, mask) * calibration.noise
        by_pad[row, :, : own.shape[1]] = own
    return by_pad


def compute_noise_of_all_pads(calibrations: Sequence[Calibration]) -> Array:
    """Return the noise matrices of all cubes of a skin if every cube uses all of its P pads.

    Args:
        calibrations: Calibration of each cube.

    Returns:
        Change (cubes, 15, P) of each component, in Pa or Pa/m, for one standard deviation of the
        noise of each pad, as from `compute_noise_by_pad`.
    """
    n = len(calibrations)
    no_pads = np.zeros(n, np.uint32)
    return compute_noise_by_pad(Pipeline(calibrations), np.arange(n), no_pads)


def make_stress_matrices(by_pad: Array, known: Mask) -> Array:
    """Return the matrices (n, P, C) with which C components of n cubes give the stresses of P pads.

    The stresses are the smallest ones that explain the components, each divided by the standard
    deviation of the noise of its pad.

    Args:
        by_pad: Noise matrices B (n, C, P): change of each component for one standard deviation of
            the noise of each pad.
        known: Whether each component (n, C) is known; the others are ignored.
    """
    by_pad = np.where(known[:, :, None], by_pad, 0.0)
    transposed = by_pad.swapaxes(1, 2)
    covariance = by_pad @ transposed
    covariance = regularise(covariance, known)
    matrices = np.linalg.solve(covariance, by_pad)
    return np.asarray(matrices.swapaxes(1, 2))


def regularise(covariance: Array, known: Mask) -> Array:
    """Increase the diagonals of covariances in place, so that they can be inverted.

    Rows of unknown components are 0, so their diagonal becomes 1. Components may be almost linearly
    dependent, so that the diagonals are also increased by a relative 1e-9.

    Args:
        covariance: Covariances (n, C, C) of C components of n cubes, which are changed.
        known: Whether each component (n, C) is known.

    Returns:
        The array `covariance`.
    """
    diagonal = np.einsum("ncc->nc", covariance)
    diagonal *= 1 + 1e-9
    diagonal += ~known
    return covariance
