"""Stress in a layer under forces on lines along y: plane strain.

The transfer functions T(k) of layer.py, for waves along x, of both ways::

    modes(x) = int T(k) exp(-i k x) dk / (2 pi)
"""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.modes import PLANE
from cube_tensor_driver.mechanics.layer import FIELD, Layer

_WAVES = 4000
_GREATEST = 30.0
"""Points in k, and wavenumber times depth at the last one: the field has decayed by exp(-30)."""


def line_load(layer: Layer, x: Array, depth: float, scale: float) -> Array:
    """(7, m, 2) amplitudes of the modes PLANE at z = -depth, x = 0 under forces along x and z.

    x: (m,) m, where the forces act. 1/m: Pa under 1 N/m; gradients are times scale (m).
    """
    k = (np.arange(_WAVES) + 0.5) * _GREATEST / depth / _WAVES
    transfer = layer.transfer(k, 0 * k, depth)[:, :, [0, 2]]
    rows = transfer[:, [FIELD.index(name) for name in PLANE.names]]
    rows[:, [name not in ("zz", "zx", "xx") for name in PLANE.names]] *= scale
    wave = np.exp(-1j * np.outer(x, k)) * ((k[1] - k[0]) / np.pi)
    return np.moveaxis(np.tensordot(wave, rows, axes=1).real, 0, 1)
