# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Stress in a layer under forces on lines along y, which is a state of plane strain.

With the transfer functions T(k) of layer.py for waves along x of both signs, the modes at x are::

    modes(x) = int T(k) exp(-i k x) dk / (2 pi)
"""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.modes import PLANE
from cube_tensor_driver.mechanics.layer import FIELD, Layer

WAVES = 4000
"""Number of wavenumbers k at which the integral over all waves along x is evaluated."""
MAX_WAVENUMBER = 30.0
"""Largest wavenumber of the integral over waves, times the depth of the point. The stress of such a
wave has decayed by exp(-30) at this depth."""


def compute_line_load(
    layer: Layer,
    x: Array,
    depth: float,
    scale: float,
) -> Array:
    """Return the plane modes at one point of a layer under unit line loads along x and z.

    Args:
        layer: The layer.
        x: (m,) positions of the line loads relative to the point, in m.
        depth: Depth of the point, in m.
        scale: Length that gradients are multiplied with, in m.

    Returns:
        (7, m, 2) amplitudes of the modes `PLANE` (linear stress fields), in Pa under 1 N/m.
    """
    # The midpoints of equal intervals leave out k = 0, where the transfer function is a limit.
    midpoints = np.arange(WAVES) + 0.5
    k = midpoints * MAX_WAVENUMBER / depth / WAVES
    transfer = layer.compute_transfer(k, 0 * k, depth)
    transfer = transfer[:, :, [0, 2]]  # The columns of forces along x and z.
    modes_in_field = [FIELD.index(name) for name in PLANE.names]
    rows = transfer[:, modes_in_field]
    is_gradient = ["_" in name for name in PLANE.names]
    rows[:, is_gradient] *= scale

    # The integrand at -k is the complex conjugate of that at k. So the integral over all k is twice
    # the real part of that over k > 0, and the factor of the inverse transform is 2 / (2 pi).
    step = k[1] - k[0]
    phase = np.outer(x, k)
    wave = np.exp(-1j * phase) * (step / np.pi)
    modes = np.tensordot(wave, rows, axes=1)  # (m, 7, 2)
    return np.moveaxis(modes.real, 0, 1)
