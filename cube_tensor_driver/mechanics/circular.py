"""Circular components: combinations of stress and gradient that only change phase under rotation.

A rotation of the frame about z by an angle multiplies a circular component c of order m (0 to 3) by
exp(-i m angle). The field of a rotationally symmetric contact therefore depends on the direction
phi = atan2(y, x) from the contact to the cube only through a phase. With the force (F_r, F_t, F_z)
along this direction, across it and along z::

    c = exp(i m phi) (R(r) F_r + Z(r) F_z + i T(r) F_t),     R, Z, T real functions of the distance
    r

Example: the in-plane shear (zx, yz) is the component zx + i yz of order 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, Complex
from ..core.modes import STRESS
from .layer import FIELD

Orders = NDArray[np.int64]
"""Array of the orders m of circular components."""


def _define_components() -> tuple[Complex, Orders]:
    """Define the circular components.

    Returns:
        Matrix (14, 24) of the components as combinations of `FIELD`, and their orders (14,).
    """
    # Unit vectors by name, from which the combinations are composed
    unit = dict(zip(FIELD, np.eye(len(FIELD)), strict=True))

    def combine_stresses(suffix: str) -> list[tuple[int, Complex]]:
        """Return order and component for the six stresses, or for their derivative by `suffix`."""
        s = {name: unit[name + suffix].astype(complex) for name in STRESS}
        return [
            (0, (s["xx"] + s["yy"]) / 2),
            (0, s["zz"]),
            (1, s["zx"] + 1j * s["yz"]),
            (2, (s["xx"] - s["yy"]) / 2 + 1j * s["xy"]),
        ]

    components = combine_stresses("") + combine_stresses("_z")

    # The derivative d/dx + i d/dy raises the order by one, d/dx - i d/dy lowers it by one.
    by_x = combine_stresses("_x")
    by_y = combine_stresses("_y")
    for (order, along_x), (_, along_y) in zip(by_x, by_y, strict=True):
        components.append((order + 1, along_x + 1j * along_y))
        if order > 0:  # at order 0 it would be the complex conjugate of the one above
            components.append((order - 1, along_x - 1j * along_y))

    orders = np.array([order for order, _ in components])
    return np.stack([component for _, component in components]), orders


CIRCULAR_FROM_FIELD, ORDERS = _define_components()
"""Matrix (14, 24) from `FIELD` to the circular components, and their orders (14,)."""

FIELD_FROM_CIRCULAR = np.linalg.pinv(
    np.concatenate([CIRCULAR_FROM_FIELD.real, CIRCULAR_FROM_FIELD.imag])
).T
"""Matrix (28, 24) from the real and imaginary parts of the circular components back to `FIELD`.

It is multiplied from the right: ``parts @ FIELD_FROM_CIRCULAR``.
"""


def sum_rotated(
    circular: NDArray[np.complex64], rotation: NDArray[np.complexfloating]
) -> tuple[Array, Array]:
    """Sum fields that are given as circular components in rotated frames.

    Args:
        circular: Circular components (N, L, 14) of L fields at N cubes, each in its own frame.
        rotation: Angle (N, L) of each frame about z as the complex number exp(i angle).

    Returns:
        Stress (N, 6) and gradient (N, 6, 3), each the sum over the L fields in the cube's frame.
    """
    # Multiplying is much faster than the exponential of m times the angle.
    powers = np.stack(
        [
            np.ones_like(rotation),
            rotation,
            rotation**2,
            rotation**3,
        ],
        axis=-1,
    )
    phases = powers.astype(np.complex64)[..., ORDERS]
    total = (circular * phases).sum(axis=1)

    parts = np.concatenate([total.real, total.imag], axis=1)
    field = parts.astype(float) @ FIELD_FROM_CIRCULAR
    stress = field[:, :6]
    gradient = field[:, 6:]
    return stress, gradient.reshape(-1, 6, 3)
