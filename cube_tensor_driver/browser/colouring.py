"""What the colours of one picture of a skin mean."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..core.arrays import Array
from ..touch.surface import Surface
from ..views import scene
from ..views.scene import QUANTITIES, Quantity
from . import markup
from .moment import DEVIATION, Moment


class Colouring(NamedTuple):
    """The values behind the colours, for N cubes and M points of the surface.

    Attributes:
        quantity: What is shown.
        cubes: (N,) values of the cubes, in SI units.
        field: (M,) values on the surface, in SI units.
        top: Upper end of the colour range, in SI units.
        above: (N, 2) pressure on the surface above each cube and its standard deviation, in Pa;
            None: the node `contacts` gives none.
    """

    quantity: Quantity
    cubes: Array
    field: Array
    top: float
    above: Array | None

    @classmethod
    def of(
        cls, moment: Moment, surface: Surface, quantity: Quantity, fixed_top: float, last_top: float
    ) -> Colouring:
        """Choose the values and the range of a picture.

        Args:
            moment: What is shown.
            surface: The points of its field.
            quantity: The quantity in colours.
            fixed_top: Upper end of the range; 0: it follows the values.
            last_top: Upper end in the picture before, from which an automatic range falls slowly.
        """
        pressure, sigma = moment.field.pressure, moment.field.sigma
        above = None
        if sigma is not None:
            # One point of the surface lies above the centre of each cube.
            above = np.stack([pressure, sigma], axis=1)[surface.middle]
        cubes = quantity.of(moment.values, moment.residual)
        if quantity is DEVIATION and above is not None:
            cubes = above[:, 1]
        field = _field_values(moment, surface, quantity, cubes)
        top = fixed_top or scene.automatic(quantity, np.concatenate([cubes, field]), last_top)
        return cls(quantity, cubes, field, top, above)

    def text(self, cube: int) -> str:
        """Return the value of a cube and the pressure on the surface above it, in words."""
        value = markup.value(self.quantity, self.cubes[cube])
        if self.above is None or self.quantity not in (QUANTITIES["pressure"], DEVIATION):
            return value
        surface = markup.surface_pressure(*self.above[cube])
        return f"pressure {surface}" if self.quantity is DEVIATION else f"{value}, {surface}"


def _field_values(
    moment: Moment,
    surface: Surface,
    quantity: Quantity,
    cubes: Array,
) -> Array:
    """Return the values on the surface (M,); of the nearest cube where the field has none."""
    if quantity is QUANTITIES["pressure"]:
        return moment.field.pressure
    if quantity is QUANTITIES["shear"]:
        return moment.field.shear
    if quantity is DEVIATION and moment.field.sigma is not None:
        return moment.field.sigma
    return cubes[surface.cube]
