"""One instant of a skin: all that the page shows of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.defaults import CONTACT_PRESSURE
from ..core.scene import Newest
from ..elastic.surface import Contact, Field, Surface

Array = NDArray[np.float64]


class Moment(NamedTuple):
    """The rows of N cubes at one instant, and what follows from them.

    values: (N, 15) as in core/scene.py, NaN where a cube has no tensor. residual: (N,). health:
    (N,) as in core/scene.py. status: (N,) bits. field: on the points of the surface. contacts:
    strongest first.
    """

    values: Array
    residual: Array
    health: NDArray[np.integer]
    status: NDArray[np.integer]
    field: Field
    contacts: list[Contact]

    @classmethod
    def of(cls, newest: Newest, health: NDArray[np.integer], surface: Surface) -> Moment:
        """A copy: rows that come later do not change it."""
        values = newest.believed(health)
        return cls(
            values=values,
            residual=newest.residual.copy(),
            health=health,
            status=newest.status.copy(),
            field=surface.field(values),
            contacts=surface.contacts(values, CONTACT_PRESSURE),
        )

    @property
    def contact(self) -> Contact | None:
        """The strongest one; None without a load."""
        return self.contacts[0] if self.contacts else None
