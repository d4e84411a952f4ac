"""A load that moves over a skin, and the stress it makes at each cube."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.tensor import rotation_from_rpy
from ..elastic import contact
from ..files.skin import Skin

DEPTH = 4e-3
"""From a cube's centre to the surface above it, m."""
POISSON = 0.48
RADIUS = 6e-3
"""Of the pressing disc, m."""
FORCE = 3.0
"""Greatest normal force, N; the tangential force is at most FRICTION of it."""
FRICTION = 0.4
CIRCUIT_S = 8.0
PRESS_S = 2.0


class MovingLoad:
    """A disc that presses and rubs while it wanders over the skin: the same at the same time in every process.

    Each cube sees the half space whose surface lies DEPTH above it, across its own z axis.
    """

    def __init__(self, skin: Skin) -> None:
        self._position = np.array([cube.xyz for cube in skin.cubes])
        self._to_cube = np.array([rotation_from_rpy(*cube.rpy) for cube in skin.cubes]).transpose(0, 2, 1)
        low, high = self._position.min(axis=0), self._position.max(axis=0)
        self._centre, self._span = (low + high) / 2, (high - low) / 2
        self._disc, self._share = contact.disc(RADIUS, (0.0, 0.0, 1.0), order=3)

    def at(self, seconds: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Stress (cubes, 6) in Pa and gradient (cubes, 6, 3) in Pa/m, order xx yy zz yz zx xy, in the cubes' frames."""
        place, force = self.contact(seconds)
        local = np.einsum("nij,nj->ni", self._to_cube, place - self._position)
        sources = local[:, None, :] * (1.0, 1.0, 0.0) + self._disc
        forces = np.einsum("nij,j->ni", self._to_cube, force)[:, None, :] * self._share[:, 2:]
        stress, gradient = contact.field(np.array([[0.0, 0.0, -DEPTH]]), sources, forces, POISSON)
        return stress[:, 0], gradient[:, 0]

    def contact(self, seconds: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centre of the disc (3,) in m and force on the skin (3,) in N, in the skin's parent frame."""
        turn = 2 * np.pi * seconds / CIRCUIT_S
        path = np.array([np.sin(turn), np.sin(2 * turn + 0.5), 0.0])
        press = 0.55 - 0.45 * np.cos(2 * np.pi * seconds / PRESS_S)
        rub = FRICTION * np.array([np.cos(turn), np.sin(turn)])
        return self._centre + path * self._span, FORCE * press * np.array([rub[0], rub[1], -1.0])
