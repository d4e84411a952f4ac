"""Influence functions: what each pad of a cube in a layer sees of forces on the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from ..core.arrays import Array
from ..core.layout import Layout
from .layer import Layer


@dataclass(frozen=True, eq=False)
class Influence:
    """Influence functions of a cube's pads, at places on the surface of a layer on rigid ground.

    layout: of the pads; side: of the cube, m; depth: from its middle to the surface, m
    place: (n, dim - 1) m, from the point above the cube's middle: all combinations of some x and,
    in space, some y, sorted
    pads: (P, n, dim) mean normal stress of each pad under a unit force along x, (y,) z at a place:
    in Pa per N in space, Pa per N/m in a plane; tension is positive
    """

    layout: Layout
    side: float
    layer: Layer
    depth: float
    place: Array
    pads: Array

    def at(self, place: Array) -> Array:
        """(P, m, dim) at places (m, dim - 1) m between the known ones, by cubic splines; 0 beyond
        them."""
        axes = [np.unique(column) for column in self.place.T]
        nodes = np.moveaxis(self.pads, 1, 0)
        grid = nodes.reshape(*map(len, axes), *nodes.shape[1:])
        between = RegularGridInterpolator(
            tuple(axes), grid, "cubic", bounds_error=False, fill_value=0.0
        )
        return np.moveaxis(between(place), 0, 1)

    @property
    def reach(self) -> float:
        """Distance from the middle within which all directions are known, m."""
        return float(min(-self.place.min(axis=0).max(), self.place.max(axis=0).min()))
