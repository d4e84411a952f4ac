# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Influence functions: stress of each pad of a cube under a unit force, by the force's position."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from ..core.arrays import Array
from ..core.layout import Layout
from .layer import Layer


@dataclass(frozen=True, eq=False)
class Influence:
    """Influence functions of the pads (sensing elements) of a cube in an elastic layer.

    They are tabulated on a grid of positions of the force on the surface. Finite elements computed
    them, either in space (dim = 3 components of the force) or in a plane (dim = 2).

    Attributes:
        layout: Positions, normals and size of the P pads on the cube.
        side: Side length of the cube, in m.
        layer: Layer on rigid ground that contains the cube.
        depth: Distance from the centre of the cube to the surface, in m.
        place: Positions (n, dim - 1) of the forces in m, from the point of the surface above the
            centre of the cube: a sorted rectangular grid of x and, in space, y.
        pads: Mean normal stress (P, n, dim) of each pad under a unit force along x, y (only in
            space) and z at each position: in Pa per N in space, in Pa per N/m in a plane. Tension
            is positive.
    """

    layout: Layout
    side: float
    layer: Layer
    depth: float
    place: Array
    pads: Array

    def at(self, place: Array) -> Array:
        """Interpolate the pad stresses between the positions of the grid, with cubic splines.

        Args:
            place: Positions (m, dim - 1) of forces on the surface, in m from the point above the
                cube's centre.

        Returns:
            Stress (P, m, dim) of each pad per unit force, where the last index is the direction of
            the force; 0 for positions outside of the grid.
        """
        return np.moveaxis(self._splines(place), 0, 1)

    @property
    def reach(self) -> float:
        """Radius in m of the largest circle around the cube's centre that lies within the grid."""
        smallest = -self.place.min(axis=0).max()
        largest = self.place.max(axis=0).min()
        return float(min(smallest, largest))

    @cached_property
    def _splines(self) -> RegularGridInterpolator:
        """Cubic splines through the tabulated stresses, whose set-up takes tenths of a second."""
        # The grid contains all combinations of its x and y coordinates, sorted by x, then by y.
        axes = [np.unique(column) for column in self.place.T]
        nodes = np.moveaxis(self.pads, 1, 0)
        grid_shape = [len(axis) for axis in axes]
        grid = nodes.reshape(*grid_shape, *nodes.shape[1:])
        return RegularGridInterpolator(
            tuple(axes), grid, "cubic", bounds_error=False, fill_value=0.0
        )
