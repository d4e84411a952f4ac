"""One instant of a skin: all that the page shows of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array
from ..core.defaults import CONTACT_PRESSURE
from ..core.latest_stress import LatestStress
from ..touch.surface import Contact, Surface
from ..views.scene import QUANTITIES, Quantity

DEVIATION = Quantity(
    "standard deviation of pressure",
    "kPa",
    1e3,
    QUANTITIES["pressure"].least,
    False,
    lambda values, residual: np.full(len(values), np.nan),
)
"""Of the field on the surface; a cube has none of its own."""


class SurfaceField(NamedTuple):
    """On the M points of a surface.

    pressure, shear: (M,) Pa, NaN where unknown. sigma: (M,) standard deviation of the pressure, Pa;
    None: interpolated between the cubes, at their depth.
    """

    pressure: Array
    shear: Array
    sigma: Array | None = None


class Found(NamedTuple):
    """What the node `contacts` found; None: it does not run, or not with the method inverse."""

    contacts: list[Contact] | None = None
    field: SurfaceField | None = None


class Moment(NamedTuple):
    """The rows of N cubes at one instant, and what follows from them.

    values: (N, 15) as in views/scene.py, NaN where a cube has no tensor. residual: (N,). health:
    (N,) as in views/scene.py. status: (N,) bits. field: on the points of the surface. contacts:
    strongest first.
    """

    values: Array
    residual: Array
    health: NDArray[np.integer]
    status: NDArray[np.integer]
    field: SurfaceField
    contacts: list[Contact]

    @classmethod
    def of(
        cls, newest: LatestStress, health: NDArray[np.integer], surface: Surface, found: Found
    ) -> Moment:
        """A copy: rows that come later do not change it. What was not found is interpolated."""
        values = newest.usable_values(health)
        field, contacts = found.field, found.contacts
        if field is None:
            between = surface.field(values)
            shear = np.linalg.norm(np.nan_to_num(between.shear), axis=1)
            field = SurfaceField(between.pressure, shear)
        if contacts is None:
            contacts = surface.contacts(values, CONTACT_PRESSURE)
        return cls(
            values=values,
            residual=newest.residual.copy(),
            health=health,
            status=newest.status.copy(),
            field=field,
            contacts=contacts,
        )

    @property
    def contact(self) -> Contact | None:
        """The strongest one; None without a load."""
        return self.contacts[0] if self.contacts else None
