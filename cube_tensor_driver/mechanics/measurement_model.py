# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Measurement model of cubes: the values that they measure, from the stress around them.

The stress around a cube is described by circular components, combinations of stress and gradient
that only change phase under a rotation about z (circular.py). They depend on the load and on the
offset of load and cube. What the cube measures depends linearly on them, with a matrix that also
contains its calibration and which of its pads are in use.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..core.arrays import Array, Index
from ..core.modes import COMPONENTS, STRESS
from .circular import FIELD_FROM_CIRCULAR, compute_rotation_phases
from .layer import MEASURED, Layer
from .spectra import Spectra, compute_layer_spectra

_IS_GRADIENT = np.arange(len(COMPONENTS)) >= len(STRESS)
"""Whether each of the 15 `COMPONENTS` is a gradient in Pa/m; the others are stresses in Pa."""


class MeasurementModel(NamedTuple):
    """Linear model of the values that the cubes of a skin measure under traction on the surface.

    The values follow from n circular components (circular.py), which are the same for all cubes. A
    variant is a set of cubes with the same calibration and the same pads in use: their values
    follow from the circular components by the same matrix.

    Attributes:
        spectra: Spectra of the circular components over the wavenumber.
        components: Matrix (variants, 2 n, 15) from the real and imaginary parts of the circular
            components to the measured `COMPONENTS` in the frame of the cube, in Pa and Pa/m.
        variant: Index (cubes,) of the variant of each cube.
        pads: Matrix (variants, 2 n, P) from the real and imaginary parts of the circular components
            to the stress of each pad, divided by the standard deviation of the pad's noise.
    """

    spectra: Spectra
    components: Array
    variant: Index
    pads: Array


class CubeMeasurement:
    """Conversion of circular components to the values that cubes at one depth in a layer measure.

    Measured components are `COMPONENTS` (six stresses, nine gradients) with the gradients
    multiplied by `scale`, so that all are in Pa.

    Attributes:
        layer: Elastic layer.
        depth: Distance from the centres of the cubes to the surface, in m.
        spectra: Spectra of the n circular components from which the measured values follow.
        point_spectra: Spectra of the circular components of the stress at the centre of a cube; the
            same object as `spectra` if cubes are modelled as points.
        point_matrix: Matrix (28, 15) from the real and imaginary parts of the components of
            `point_spectra` to stresses and gradients in Pa.
        matrices: Matrices (variants, 2 n, 15) from the real and imaginary parts of the circular
            components to the measured components in Pa. A variant is a set of cubes with the same
            calibration and the same pads in use.
        layer_inputs: Numbers and arrays on which the circular components depend, as keys for the
            cache.
    """

    def __init__(
        self,
        layer: Layer,
        depth: float,
        scale: float,
        model: MeasurementModel | None = None,
    ) -> None:
        """Compute the matrices from circular components to the measured components in Pa.

        Args:
            layer: Elastic layer that contains the cubes.
            depth: Distance from the centres of the cubes to the surface, in m.
            scale: Length in m by which gradients are multiplied, so that they are in Pa, too.
            model: Measurement model of the cubes; None: they measure stress and gradient at points.

        Raises:
            ElasticError: The layer does not contain this depth.
        """
        self.layer = layer
        self.depth = depth
        self._unit_factors = np.where(_IS_GRADIENT, scale, 1.0)
        self.point_spectra = compute_layer_spectra(layer, depth)
        self.point_matrix: Array = FIELD_FROM_CIRCULAR[:, MEASURED] * self._unit_factors
        self.spectra = self.point_spectra
        self.matrices = self.point_matrix[None]
        if model is not None:
            self.spectra = model.spectra
            self.matrices = model.components * self._unit_factors
        self.layer_inputs = [
            layer.thickness,
            layer.poisson,
            depth,
            *vars(self.spectra).values(),
        ]

    def add_variant(self, components: Array) -> int:
        """Add a variant of the measurement model, unless an equal one exists already.

        A variant is a set of cubes with the same calibration and the same pads in use.

        Args:
            components: Matrix (2 n, 15) from the real and imaginary parts of the n circular
                components (which describe the stress around a cube, see circular.py) to the
                stresses, in Pa, and gradients, in Pa/m, that these cubes measure.

        Returns:
            Index of the variant in `matrices`.
        """
        # Cubes in which the same pads are left out share a variant, so there are few to compare.
        matrix = components * self._unit_factors
        is_equal = np.isclose(self.matrices, matrix)
        equal = np.flatnonzero(is_equal.all(axis=(1, 2)))
        if len(equal):
            return int(equal[0])
        self.matrices = np.concatenate([self.matrices, matrix[None]])
        return len(self.matrices) - 1

    def measure(self, circular: Array, variant: Index) -> Array:
        """Convert the n circular components at N cubes to the components that the cubes measure.

        Args:
            circular: Real parts and then imaginary parts (N, L, 2 n), for L loads on each cube.
            variant: Index (N,) of each cube's variant in the measurement model.

        Returns:
            Measured components (N, L, 15), for the same loads.
        """
        matrices = self.matrices.astype(circular.dtype)
        if len(matrices) > 1:
            return np.asarray(circular @ matrices[variant])
        # With only one variant, a single matrix product for all cubes is faster than one per cube.
        n, loads, width = circular.shape
        flat = circular.reshape(-1, width)
        measured = flat @ matrices[0]
        return np.asarray(measured.reshape(n, loads, -1))

    def compute_matrices(
        self,
        angle: Array,
        variant: Index,
    ) -> tuple[Array, Array]:
        """Return the matrices from circular components to measured components of N cubes.

        The measured components are in the frame of the cube. The circular components are in a frame
        whose x axis points along the line between the cube and another cube or a point.

        Args:
            angle: Direction (N,) of this line in the frame of the cube, in rad.
            variant: Index (N,) of each cube's variant in the measurement model.

        Returns:
            Two matrices (N, 15, n): for the real parts of the circular components, and for their
            imaginary parts.
        """
        phases = compute_rotation_phases(np.exp(1j * angle), self.spectra.order)
        transposed = self.matrices.swapaxes(1, 2)
        real, imaginary = np.split(transposed, 2, axis=2)
        # A rotation of the frame multiplies each circular component by a phase. Multiplying its
        # column of the matrices by this phase has the same effect on the measured components.
        unrotated = real - 1j * imaginary
        matrices = unrotated[variant] * phases[:, None]
        return matrices.real, -matrices.imag
