"""What the pads of a cube measure when a fingertip presses the skin beside it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.calibration import Calibration
from ..core.defaults import POISSONS_RATIO, SURFACE_DEPTH
from ..core.modes import to_matrix
from ..core.tensor import rotate_gradient, rotate_stress
from ..mechanics.contact import disc, field

FINGER = 3e-3
"""Radius of the contact of a fingertip, m."""
SIDES = {"+x": (1.0, 0.0, 0.0), "-x": (-1.0, 0.0, 0.0), "+y": (0.0, 1.0, 0.0)}
"""Where to press: the directions from the cube's middle, in the skin's frame. Three tell all turns
of a cube apart."""
AWAY = tuple(0.125 * np.arange(2, 17))
"""Distances that a press may have, in depths: people do not press at a measured place."""


def side_presses(
    calibration: Calibration,
    turns: NDArray[np.int64],
    *,
    depth: float = SURFACE_DEPTH,
    away: Sequence[float] = AWAY,
) -> NDArray[np.float64]:
    """(turns, SIDES, away, pads) pad stresses in Pa under 1 N straight down, tension positive.

    turns: (R, 3, 3), from the cube's frame to the skin's. depth: of the cube's centre, m. away:
    from the cube's middle to that of the finger, in depths. Source: the half space of
    `contact.field`.
    """
    below = np.array([[0.0, 0.0, -depth]])
    finger, down = disc(FINGER, (0.0, 0.0, -1.0))
    places = depth * np.einsum("g,kj->kgj", away, list(SIDES.values()))  # (K, G, 3)
    stress, slope = field(below, finger + places[:, :, None, :], down, POISSONS_RATIO)
    gradient = np.moveaxis(to_matrix(np.moveaxis(slope, -1, -2)), -3, -1)  # (K, G, 1, i, j, k)
    back = np.swapaxes(turns, -1, -2)[:, None, None, None]
    n = len(turns) * stress[..., 0].size
    state = calibration.modes.state(
        rotate_stress(stress, back).reshape(n, 6),
        rotate_gradient(gradient, back).reshape(n, 3, 3, 3) * calibration.half_side,
    )
    return (state @ calibration.response.T).reshape(len(turns), *places.shape[:2], -1)
