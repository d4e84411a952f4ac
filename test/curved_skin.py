"""What it costs to lay a curved skin flat, on a cylinder whose stress is known exactly.

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
    """rms error of the stress at cubes of a ring that is laid flat, over its rms.

    radius: of the surface, m; depth: of the cubes, m; pitch: along the ring, m; cubes: on either
    side of the one below the force
    """
    inner = radius - depth
    angle = np.arange(-cubes, cubes + 1) * pitch / inner
    outward = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    place = inner * outward
    true = cylinder_stress(place, radius)
    along = np.stack([outward[:, 1], -outward[:, 0]], axis=1)
    frame = np.stack([along, outward], axis=1)
    true = frame @ true @ frame.swapaxes(1, 2)
    chord = 2 * inner * np.sin(angle / 2)
    flat = _half_plane(np.stack([chord, np.full(len(chord), -depth)], axis=1), np.array([0, -1.0]))
    return float(np.sqrt(((flat - true) ** 2).sum() / (true**2).sum()))


def cylinder_stress(place: Array, radius: float) -> Array:
    """(n, 2, 2) Pa at places (n, 2) m in a cylinder under 1 N/m at (0, radius) and (0, -radius)."""
    top = np.array([0.0, radius])
    both = _half_plane(place - top, -top) + _half_plane(place + top, top)
    return both + np.eye(2) / (np.pi * radius)


def _half_plane(away: Array, inward: Array) -> Array:
    """(n, 2, 2) stress at places `away` (n, 2) from a line force of 1 N/m along `inward`."""
    r = np.linalg.norm(away, axis=1)
    unit = away / r[:, None]
    cosine = unit @ (inward / np.linalg.norm(inward))
    return (-2 * cosine / (np.pi * r))[:, None, None] * unit[:, :, None] * unit[:, None, :]
