# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Circular components: combinations of stress and gradient that only change phase under rotation.

A rotation of the frame about z by an angle multiplies a circular component c of order m (0 to 3) by
exp(-i m angle). Example: the shear stresses zx and yz form the component zx + i yz of order 1.

The stress under a rotationally symmetric contact therefore depends on the direction phi = atan2(y,
x) from the contact to the cube only through a phase. Let F_r, F_t and F_z be the force along this
direction, across it and along z, and R, Z and T real functions of the distance r. Then::

    c = exp(i m phi) (R(r) F_r + Z(r) F_z + i T(r) F_t)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, Complex
from ..core.modes import STRESS
from .layer import FIELD

Orders = NDArray[np.int64]
"""Array of the orders m of circular components. A circular component of order m is a combination of
stresses and gradients that a rotation of the frame about z by an angle multiplies by exp(-i m
angle)."""


def _define_components() -> tuple[Complex, Orders]:
    """Define the 14 circular components as combinations of the stresses and their gradients.

    A rotation of the frame by an angle multiplies a circular component of order m by exp(-i m
    angle).

    Returns:
        Matrix (14, 24) of the components as combinations of `FIELD`, and their orders (14,).
    """
    # `unit` maps the name of each of the 24 quantities `FIELD` to its unit vector (24,).
    rows = np.eye(len(FIELD))
    unit = dict(zip(FIELD, rows, strict=True))

    def combine_stresses(suffix: str) -> list[tuple[int, Complex]]:
        """Return four circular components of the six stresses, or of their derivatives by one axis.

        Args:
            suffix: "" for the stresses, "_x", "_y" or "_z" for the derivatives.

        Returns:
            For each of the four components, its order m and its coefficients (24,) of `FIELD`.
        """
        vectors = [unit[name + suffix].astype(complex) for name in STRESS]
        xx, yy, zz, yz, zx, xy = vectors
        mean = (xx + yy) / 2
        half_difference = (xx - yy) / 2
        return [
            (0, mean),
            (0, zz),
            (1, zx + 1j * yz),
            (2, half_difference + 1j * xy),
        ]

    components = combine_stresses("") + combine_stresses("_z")

    # The derivative d/dx + i d/dy of a component of order m is a component of order m + 1, and
    # d/dx - i d/dy one of order m - 1.
    by_x = combine_stresses("_x")
    by_y = combine_stresses("_y")
    pairs = zip(by_x, by_y, strict=True)
    for (order, along_x), (_, along_y) in pairs:
        raised = along_x + 1j * along_y
        components.append((order + 1, raised))
        # A component of order 0 is real. Its derivatives `raised` and `lowered` would be complex
        # conjugates of each other, so one of them is enough.
        if order > 0:
            lowered = along_x - 1j * along_y
            components.append((order - 1, lowered))

    orders, coefficients = zip(*components, strict=True)
    return np.stack(coefficients), np.array(orders)


_COMPONENTS = _define_components()
"""Pair of arrays that define the circular components: `CIRCULAR_FROM_FIELD` and `ORDERS`."""

CIRCULAR_FROM_FIELD = _COMPONENTS[0]
"""Matrix (14, 24) from the stresses and gradients `FIELD` to the circular components. A circular
component is a combination of stresses and gradients that a rotation of the frame about z by an
angle multiplies by exp(-i m angle), where m is its order."""

ORDERS = _COMPONENTS[1]
"""Order m (14,) of each circular component: a rotation of the frame about z by an angle multiplies
the component by exp(-i m angle)."""

_PARTS_FROM_FIELD = np.concatenate([CIRCULAR_FROM_FIELD.real, CIRCULAR_FROM_FIELD.imag])
"""Matrix (28, 24) from the stresses and gradients `FIELD` to the real and then the imaginary parts
of the circular components, combinations whose phase alone changes if the frame is rotated about z.
"""

FIELD_FROM_CIRCULAR = np.linalg.pinv(_PARTS_FROM_FIELD).T
"""Matrix (28, 24) from the real and then the imaginary parts of the circular components back to the
stresses and gradients `FIELD`.

A circular component is a complex combination of stresses and gradients whose phase alone changes
if the frame is rotated about z, for example zx + i yz. The parts are a row vector on the left of
the matrix: ``field = parts @ FIELD_FROM_CIRCULAR``.
"""


def compute_rotation_phases(rotation: Complex, order: Orders) -> Complex:
    """Return the phases exp(i m angle) by which rotations multiply circular components of order m.

    They are computed as powers of exp(i angle), because exponential functions take three times as
    long.

    Args:
        rotation: Angles (...) of the rotations as the complex numbers exp(i angle).
        order: Orders m (n,) of the circular components.

    Returns:
        Phases (..., n).
    """
    powers = [np.ones_like(rotation)]
    highest_order = int(order.max())
    for _ in range(highest_order):
        powers.append(powers[-1] * rotation)
    phases = np.stack(powers, axis=-1)
    return phases[..., order]


def rotate_loads(
    parts: Array,
    direction: Array,
    angle: Array,
    order: Orders,
) -> Array:
    """Compute circular components at N cubes, each in its own frame, under unit loads.

    Args:
        parts: Radial functions R, Z and T (N, 3, n) at the distances of N cubes from their load:
            factors of the radial, normal and tangential force (head of this file).
        direction: Directions (N,) from the load to the cube, as angles from the x axis, in rad.
        angle: The same directions (N,), as angles from the x axis of the cube's frame, in rad.
        order: Orders m (n,) of the circular components.

    Returns:
        Real parts and then imaginary parts (N, 3, 2 n) of the n components, for loads along x, y
        and z.
    """
    radial = parts[:, 0]
    normal = parts[:, 1]
    across = 1j * parts[:, 2]

    # A unit force along x has the radial component F_r = cos(phi) and the tangential component
    # F_t = -sin(phi), where phi is the direction from the load to the cube.
    cosine = np.cos(direction)[:, None]
    sine = np.sin(direction)[:, None]
    along_x = cosine * radial - sine * across
    along_y = sine * radial + cosine * across
    loads = np.stack([along_x, along_y, normal], axis=1)

    phases = compute_rotation_phases(np.exp(1j * angle), order)
    rotated = phases[:, None] * loads
    return np.concatenate([rotated.real, rotated.imag], axis=2)


def sum_rotated(
    circular: NDArray[np.complex64],
    rotation: NDArray[np.complexfloating],
) -> tuple[Array, Array]:
    """Sum the stresses and gradients of several loads, given as circular components.

    Args:
        circular: Circular components (N, L, 14) of L fields at N cubes, each in its own frame.
        rotation: Angle (N, L) about z of the frame of each field in the frame of its cube, as the
            complex number exp(i angle).

    Returns:
        Stress (N, 6) and gradient (N, 6, 3) in the frame of each cube, summed over the L fields.
    """
    phases = compute_rotation_phases(rotation.astype(np.complex64), ORDERS)
    total = (circular * phases).sum(axis=1)

    parts = np.concatenate([total.real, total.imag], axis=1)
    field = parts.astype(float) @ FIELD_FROM_CIRCULAR
    stress = field[:, :6]
    gradient = field[:, 6:]
    return stress, gradient.reshape(-1, 6, 3)
