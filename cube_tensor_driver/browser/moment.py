"""The data that the page shows of a skin at one instant."""

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
"""The standard deviation of the pressure on the surface, as a quantity for colours.

Only the node `contacts` computes it, for points of the surface. From the values of the cubes alone
it is unknown, so that `of` returns NaN.
"""


class SurfaceField(NamedTuple):
    """Pressure and shear at the M points of a surface.

    Attributes:
        pressure: (M,) pressure in Pa; NaN where it is unknown.
        shear: (M,) magnitude of the shear traction in Pa; NaN where it is unknown.
        sigma: (M,) standard deviation of the pressure, in Pa. None if pressure and shear are only
            interpolated between the cubes, in the plane of their centres.
    """

    pressure: Array
    shear: Array
    sigma: Array | None = None


class Found(NamedTuple):
    """The latest results of the node `contacts`.

    Attributes:
        contacts: The contacts, strongest first; None if the node does not run.
        field: Pressure and shear on the surface; None unless the node runs with the method
            `inverse`.
    """

    contacts: list[Contact] | None = None
    field: SurfaceField | None = None


class Moment(NamedTuple):
    """The latest values of the N cubes at one instant, with the field and the contacts.

    Attributes:
        values: (N, 15) 6 stress components in Pa and 9 gradients in Pa/m, in the frames of the
            cubes; NaN where a cube has no usable tensor.
        residual: (N,) misfit between pads and tensor relative to the noise; 1 for noise alone.
        health: (N,) health of the cubes (fine, doubtful, faulty or stale), coded as in
            core/latest_stress.py.
        status: (N,) status bits, as in core/status.py.
        field: Pressure and shear at the points of the surface.
        contacts: The contacts, strongest first.
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
        """Copy the latest values, and interpolate what the node `contacts` did not provide.

        Args:
            newest: The latest row of each cube.
            health: (N,) health of the cubes at this instant.
            surface: Points at which the field is computed.
            found: Results of the node `contacts`; contacts or field that are None are computed
                here by interpolation between the cubes.
        """
        values = newest.usable_values(health)
        field, contacts = found.field, found.contacts
        if field is None:
            between = surface.field(values)
            # A shear component that is unknown (NaN) counts as 0 in the magnitude.
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
        """The contact with the largest force; None if there is no contact."""
        return self.contacts[0] if self.contacts else None
