# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Sensitivity of the stress in the elastomer to errors of its depth, Poisson's ratio and thickness.

A skin file states these three quantities with a limited accuracy. Each one has a normal
distribution about the stated value, with the standard deviations below. The contact tracker
estimates the errors together with the contacts, so that the deviations it states include them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .layer import Layer
from .spectra import Spectra, compute_layer_spectra

DEPTH_DEVIATION = 0.03
"""Prior standard deviation of the depth of the cubes' centres, divided by the depth: 0.15 mm at a
depth of 5 mm, a tolerance of casting by hand."""

POISSON_DEVIATION = 0.02
"""Prior standard deviation of Poisson's ratio. Values published for silicone rubber and foamed
elastomers of one hardness scatter by this much."""

THICKNESS_DEVIATION = 0.03
"""Prior standard deviation of the thickness of the layer, divided by the thickness."""

_STEP = 1e-3
"""Step of the finite differences: change of Poisson's ratio, and relative change of the depth and
the thickness."""


def compute_sensitivities(layer: Layer, depth: float) -> list[Spectra]:
    """Compute how errors of depth, Poisson's ratio and thickness change the spectra of a layer.

    The spectra are the responses of stress and gradient at a depth to waves of traction on the
    surface, as functions of the wavenumber (`compute_layer_spectra`).

    Args:
        layer: Elastic layer.
        depth: Distance from the cubes' centres to the surface, in m.

    Returns:
        Changes of the spectra for one standard deviation of the depth, of Poisson's ratio and, in a
        layer of finite thickness, of the thickness.
    """
    base = compute_layer_spectra(layer, depth)
    # The finite differences are one-sided, and their steps do not leave the allowed ranges: the
    # depth is reduced, and Poisson's ratio (0 to 0.5) is changed towards 0.25.
    poisson_step = _STEP if layer.poisson < 0.25 else -_STEP
    softer = replace(layer, poisson=layer.poisson + poisson_step)
    of_softer = compute_layer_spectra(softer, depth)
    shallower = compute_layer_spectra(layer, (1 - _STEP) * depth, depth)
    changes = [
        _subtract(shallower, base, -DEPTH_DEVIATION / _STEP),
        _subtract(of_softer, base, POISSON_DEVIATION / poisson_step),
    ]
    if np.isfinite(layer.thickness):
        thicker = replace(layer, thickness=(1 + _STEP) * layer.thickness)
        of_thicker = compute_layer_spectra(thicker, depth)
        changes.append(_subtract(of_thicker, base, THICKNESS_DEVIATION / _STEP))
    return changes


def _subtract(spectra: Spectra, base: Spectra, factor: float) -> Spectra:
    """Return the difference of two spectra at the same wavenumbers, multiplied by a factor."""
    return replace(
        base,
        plus=factor * (spectra.plus - base.plus),
        minus=factor * (spectra.minus - base.minus),
        normal=factor * (spectra.normal - base.normal),
    )
