# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Error of a curved skin that is laid flat, on a cylinder whose stress is known exactly.

A line force presses on a solid cylinder and another one on its far side holds it. Its stress is
that of two half planes and a uniform tension; laid flat there is one half plane. sigma_rr is in the
direction from the force, the tension in all directions::

    sigma_rr = -2 P cos(theta) / (pi r) for each force,    sigma = P / (pi R)

Source: S. P. Timoshenko, J. N. Goodier, Theory of Elasticity (1951), 33 (half plane) and 37 (disc).
"""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.core.arrays import Array


def flat_error(radius: float, depth: float, pitch: float, cubes: int = 2) -> float:
    """Return the rms error of the stress at cubes of a ring that is laid flat, over its rms.

    Args:
        radius: Radius of the surface, in m.
        depth: Depth of the cubes, in m.
        pitch: Distance between the cubes along the ring, in m.
        cubes: Number of cubes on either side of the one below the force.
    """
    inner = radius - depth
    angle = np.arange(-cubes, cubes + 1) * pitch / inner
    outward = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    true = cylinder_stress(inner * outward, radius)
    # The true stress in the frame of each cube.
    along = np.stack([outward[:, 1], -outward[:, 0]], axis=1)
    frame = np.stack([along, outward], axis=1)
    true = frame @ true @ frame.swapaxes(1, 2)

    # Laid flat, the cubes have the distances of the chords.
    chord = 2 * inner * np.sin(angle / 2)
    place = np.stack([chord, np.full(len(chord), -depth)], axis=1)
    flat = _half_plane_stress(place, np.array([0, -1.0]))
    square_error = ((flat - true) ** 2).sum()
    return float(np.sqrt(square_error / (true**2).sum()))


def cylinder_stress(place: Array, radius: float) -> Array:
    """Return the stress (n, 2, 2) in Pa in a cylinder under 1 N/m at (0, radius) and (0, -radius).

    Args:
        place: (n, 2) in m.
        radius: Radius of the cylinder, in m.
    """
    top = np.array([0.0, radius])
    upper = _half_plane_stress(place - top, -top)
    lower = _half_plane_stress(place + top, top)
    return upper + lower + np.eye(2) / (np.pi * radius)


def _half_plane_stress(from_force: Array, inward: Array) -> Array:
    """Return the stress (n, 2, 2) at (n, 2) from a line force of 1 N/m along `inward`."""
    r = np.linalg.norm(from_force, axis=1)
    unit = from_force / r[:, None]
    cosine = unit @ (inward / np.linalg.norm(inward))
    sigma_rr = -2 * cosine / (np.pi * r)
    return sigma_rr[:, None, None] * unit[:, :, None] * unit[:, None, :]
