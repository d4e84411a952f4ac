"""One instant of a skin: all that the page shows of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..core.arrays import AnyArray, Array
from ..core.defaults import CONTACT_PRESSURE
from ..core.latest_stress import LatestStress
from ..touch.surface import Contact, Surface
from ..views.scene import QUANTITIES, Quantity

DEVIATION = Quantity(
    label="standard deviation of pressure",
    unit="kPa",
    size=1e3,
    min_top=QUANTITIES["pressure"].min_top,
    signed=False,
    of=lambda values, residual: np.full(len(values), np.nan),
)
"""The standard deviation of the pressure on the surface. Cubes alone have none, so that it is NaN
unless the node `contacts` gives a field."""


class SurfaceField(NamedTuple):
    """Values on the M points of a surface.

    Attributes:
        pressure: (M,) Pa; NaN where it is unknown.
        shear: (M,) Pa; NaN where it is unknown.
        sigma: (M,) standard deviation of the pressure, in Pa; None: the values are interpolated
            between the cubes, at their depth.
    """

    pressure: Array
    shear: Array
    sigma: Array | None = None


class Found(NamedTuple):
    """What the node `contacts` found.

    Attributes:
        contacts: The contacts; None: the node does not run.
        field: Pressure and shear on the surface; None: the node does not run with the method
            `inverse`.
    """

    contacts: list[Contact] | None = None
    field: SurfaceField | None = None


class Moment(NamedTuple):
    """The newest rows of the N cubes at one instant, and what follows from them.

    Attributes:
        values: (N, 15) as in views/scene.py; NaN where a cube has no tensor.
        residual: (N,) residual relative to the expected noise.
        health: (N,) as in core/latest_stress.py.
        status: (N,) status bits.
        field: On the points of the surface.
        contacts: Strongest first.
    """

    values: Array
    residual: Array
    health: AnyArray
    status: AnyArray
    field: SurfaceField
    contacts: list[Contact]

    @classmethod
    def of(
        cls,
        newest: LatestStress,
        health: AnyArray,
        surface: Surface,
        found: Found,
    ) -> Moment:
        """Copy the newest rows, and compute what the node `contacts` did not give."""
        values = newest.usable_values(health)
        field, contacts = found.field, found.contacts
        if field is None:
            between = surface.field(values)
            # A component that no cube observes counts as 0 here.
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
    def strongest_contact(self) -> Contact | None:
        """The contact with the largest force; None without a load."""
        return self.contacts[0] if self.contacts else None
