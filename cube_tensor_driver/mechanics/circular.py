"""Stress and gradient in components that turn with a phase about z.

The field of a disc depends on the distance r, and turns with the direction phi = atan2(y, x) from
the disc. In the circular components c of order m = 0 to 3 about z, and with the force (F_r, F_t,
F_z) along and across that direction, it is::

    c = exp(i m phi) (R(r) F_r + Z(r) F_z + i T(r) F_t),     R, T, Z real

In a frame that is turned by an angle about z, c is exp(-i m angle) times that.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array
from ..core.modes import STRESS
from .layer import FIELD


def _circular() -> tuple[NDArray[np.complex128], NDArray[np.int64]]:
    """(14, 24) circular components of FIELD, and the order (14,) of each."""

    def of(name: str) -> NDArray[np.complex128]:
        return np.eye(len(FIELD))[FIELD.index(name)].astype(complex)

    def plane(suffix: str) -> list[tuple[int, NDArray[np.complex128]]]:
        """Mean of xx and yy, zz; (zx, yz) as a vector; (xx - yy) / 2 and xy."""
        s = {name: of(name + suffix) for name in STRESS}
        return [
            (0, (s["xx"] + s["yy"]) / 2),
            (0, s["zz"]),
            (1, s["zx"] + 1j * s["yz"]),
            (2, (s["xx"] - s["yy"]) / 2 + 1j * s["xy"]),
        ]

    rows = plane("") + plane("_z")
    for (order, along_x), (_, along_y) in zip(plane("_x"), plane("_y"), strict=True):
        rows.append((order + 1, along_x + 1j * along_y))
        if order > 0:
            rows.append((order - 1, along_x - 1j * along_y))
    return np.stack([row for _, row in rows]), np.array([order for order, _ in rows])


CIRCULAR, ORDERS = _circular()
BACK = np.linalg.pinv(np.concatenate([CIRCULAR.real, CIRCULAR.imag])).T
"""(28, 24) FIELD from real and imaginary parts of the circular components."""


def summed(
    circular: NDArray[np.complex64], turn: NDArray[np.complexfloating]
) -> tuple[Array, Array]:
    """Stress (N, 6) and gradient (N, 6, 3), each the sum over L of the circular components
    (N, L, 14) in frames that are turned by the angle of `turn` (N, L), |turn| = 1."""
    powers = np.stack([np.ones_like(turn), turn, turn**2, turn**3], axis=-1)
    total = (circular * powers.astype(np.complex64)[..., ORDERS]).sum(axis=1)
    field = np.concatenate([total.real, total.imag], axis=1).astype(float) @ BACK
    return field[:, :6], field[:, 6:].reshape(-1, 6, 3)
