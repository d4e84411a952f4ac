# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The values that the colours of one picture of a skin stand for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..core.arrays import Array
from ..touch.surface import Surface
from ..views import scene
from ..views.scene import QUANTITIES, Quantity
from .scan import Scan
from .surface_field import DEVIATION


class Colouring(NamedTuple):
    """The values that are drawn as colours, for N cubes and M points of the surface.

    Attributes:
        quantity: The quantity that the colours show.
        cubes: (N,) values at the cubes, in SI units.
        field: (M,) values at the points of the surface, in SI units.
        top: Value, in SI units, at the upper end of the colour scale.
        above: (N, 2) pressure at the surface above each cube and its standard deviation, in Pa;
            None if the node `contacts` does not compute them.
    """

    quantity: Quantity
    cubes: Array
    field: Array
    top: float
    above: Array | None

    @classmethod
    def from_scan(
        cls,
        scan: Scan,
        surface: Surface,
        quantity: Quantity,
        fixed_top: float,
        last_top: float,
    ) -> Colouring:
        """Compute the values and the range of the colour scale for one picture.

        Args:
            scan: Values of the cubes and of the surface at the instant that is drawn.
            surface: Points at which `scan.field` is given.
            quantity: The quantity that the colours show.
            fixed_top: Upper end of the colour scale, in SI units; 0: it follows the values.
            last_top: Upper end in the picture before, in SI units; an automatic range falls slowly
                from it.
        """
        cubes = quantity.compute(scan.values, scan.residual)
        # `surface.middle` contains, for each cube, the index of the point nearest to it.
        middle = scan.field.pressure[surface.middle]
        sigma = scan.field.sigma
        above = None
        if sigma is not None:
            above = np.stack([middle, sigma[surface.middle]], axis=1)
        if quantity is DEVIATION and above is not None:
            cubes = above[:, 1]
        # Only these three quantities have values between the cubes. For all others, each point of
        # the surface has the value of its cube.
        field = {
            QUANTITIES["pressure"].label: scan.field.pressure,
            QUANTITIES["shear"].label: scan.field.shear,
            DEVIATION.label: sigma,
        }.get(quantity.label)
        if field is None:
            field = cubes[surface.cube]
        top = fixed_top or scene.choose_automatic_top(
            quantity,
            np.concatenate([cubes, field]),
            last_top,
        )
        return cls(quantity, cubes, field, top, above)
