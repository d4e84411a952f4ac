"""Influence functions: response of each pad of a cube in a layer to forces on the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from ..core.arrays import Array
from ..core.layout import Layout
from .layer import Layer


@dataclass(frozen=True, eq=False)
class Influence:
    """Influence functions of the pads of a cube, on a grid of positions on the surface.

    They come from finite elements in space (three components of the force) or in a plane (two).

    Attributes:
        layout: Layout of the P pads.
        side: Side length of the cube, in m.
        layer: Layer on rigid ground that contains the cube.
        depth: Distance from the centre of the cube to the surface, in m.
        place: Positions (n, dim - 1) of the forces in m, from the point of the surface above the
            centre of the cube: a sorted rectangular grid of x and, in space, y.
        pads: Mean normal stress (P, n, dim) of each pad under a unit force along x, (y,) z at each
            position: in Pa per N in space, in Pa per N/m in a plane. Tension is positive.
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
            place: Positions (m, dim - 1) of forces, in m.

        Returns:
            Pad stresses (P, m, dim); 0 outside of the grid.
        """
        # The positions are all combinations of the coordinates, sorted by x, then by y.
        axes = [np.unique(column) for column in self.place.T]
        nodes = np.moveaxis(self.pads, 1, 0)
        grid = nodes.reshape(*map(len, axes), *nodes.shape[1:])
        interpolate = RegularGridInterpolator(
            tuple(axes), grid, "cubic", bounds_error=False, fill_value=0.0
        )
        return np.moveaxis(interpolate(place), 0, 1)

    @property
    def reach(self) -> float:
        """Distance from the centre, in m, up to which the grid covers all directions."""
        smallest = -self.place.min(axis=0).max()
        largest = self.place.max(axis=0).min()
        return float(min(smallest, largest))
