"""Presses beside a cube: how they are detected, and what they tell about pads and rotation.

A press on a known side of a cube gives each pad a share of its force. The shares depend on the
distance of the press: e_g (P,) for the distance g. A rotated cube shows another pattern, and pads
with swapped wires show it in another order. For each rotation, an order of the pads has the misfit

    misfit² = sum_k min_g |m_k - a e_g|² / sum_k |m_k|²,   a = max(0, m_k·e_g / e_g·e_g)

    m_k   stresses (P,) that the pads measured in press k
    e_g   stresses expected for that rotation, press and distance, in that order

Pads are swapped two at a time as long as a swap reduces misfit² to less than half. Of all
explanations that fit about as well as the best one, the one with the fewest changes is chosen. A
rotation is one change, and a swap of two pads is one change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..core.arrays import Array, Index, Mask
from ..core.calibration import Calibration
from ..core.defaults import POISSONS_RATIO, SURFACE_DEPTH
from ..core.modes import to_matrix
from ..core.symmetry import find_group
from ..core.tensor import rotate_gradient, rotate_stress
from ..mechanics.contact import disc, field

MIN_PRESS_NOISE_RATIO = 30.0
"""Smallest frequency change of a press, as a multiple of the median noise of the pads.

Smaller changes may be noise.
"""

MIN_PRESS_CHANGE = 2e-4
"""Smallest relative frequency change of a press, whatever the noise is."""

STEADY_SHARE = 0.1
"""Largest difference of two successive averages of a steady press, as a share of the press."""

RELEASED_SHARE = 0.4
"""Ratio of the frequency change to the smallest change of a press, below which a press has ended.

It is below 1, so that a press near the limit is not read twice.
"""

FINGER_RADIUS = 3e-3
"""Radius of the contact of a fingertip, in m."""

SIDES = {
    "+x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
}
"""Places to press: directions from the centre of the cube, in the frame of the skin.

Three of them distinguish all rotations of a cube.
"""

PRESS_DISTANCES = tuple(0.125 * np.arange(2, 17))
"""Distances of a press from the cube's centre that are tried, as multiples of the cube's depth.

People do not press at a measured distance.
"""

MAX_SWAP_RATIO = 0.5
"""Largest ratio of misfit² after and before a swap with which the swap is accepted."""

SIMILAR_RATIO = 1.5
"""Ratio to the lowest misfit up to which an explanation fits as well as the best one."""

SIMILAR_MISFIT = 0.06
"""Misfit up to which an explanation fits as well as the best one, whatever that one's misfit is."""

MAX_MISFIT = 0.5
"""Misfit above which nothing is explained: the presses were elsewhere, or pads do not work."""


class SteadyPress(NamedTuple):
    """A press that can be read.

    Attributes:
        cube: Number of the cube.
        change: Relative frequency changes of its pads (P,).
    """

    cube: int
    change: Array


class PressDetector:
    """Detects presses in successive averages of the frequencies.

    Attributes:
        is_held: Whether the press that was read last continues.
    """

    def __init__(
        self,
        rest: Array,
        noise: Array,
        works: Mask,
    ) -> None:
        """Prepare the detection.

        Args:
            rest: Rest frequencies (C, P), in Hz.
            noise: Relative noise of the pads (C, P).
            works: Which pads are used (C, P).
        """
        self._rest, self._works = rest, works
        self._limit = MIN_PRESS_CHANGE
        if works.any():
            typical = float(np.median(noise[works]))
            self._limit = max(MIN_PRESS_CHANGE, MIN_PRESS_NOISE_RATIO * typical)
        self._before: Array | None = None
        self.is_held = False

    def update(self, mean: Array) -> SteadyPress | None:
        """Examine the newest average (C, P), in Hz.

        Returns:
            A press when it has become steady, once; otherwise None.
        """
        with np.errstate(invalid="ignore"):  # NaN where nothing was measured
            relative = mean / self._rest - 1
        change = np.where(self._works, relative, np.nan)
        before, self._before = self._before, change
        size = np.nan_to_num(np.abs(change))
        strongest = size.max()
        cube = int(size.max(axis=1).argmax())

        if strongest < RELEASED_SHARE * self._limit:
            self.is_held = False
        if self.is_held or before is None or strongest < self._limit:
            return None
        # While the finger still moves, pads keep changing relative to each other.
        movement = np.nanmax(np.abs(change[cube] - before[cube]))
        if movement > STEADY_SHARE * strongest:
            return None
        self.is_held = True
        return SteadyPress(cube, change[cube])


def cube_rotations() -> Index:
    """Return the 24 rotations of a cube (24, 3, 3), the identity first."""
    elements = find_group("full")
    is_rotation = np.linalg.det(elements) > 0
    rotations: Index = elements[is_rotation]
    return rotations


def expected_presses(
    calibration: Calibration,
    rotations: Index,
    *,
    depth: float = SURFACE_DEPTH,
    distances: Sequence[float] = PRESS_DISTANCES,
) -> Array:
    """Compute the stresses on the pads when a fingertip presses straight down with 1 N.

    Source: the elastic half space of `mechanics.contact.field`.

    Args:
        calibration: Calibration of the cube.
        rotations: Rotations (R, 3, 3) from the frame of the cube to that of the skin.
        depth: Depth of the cube's centre, in m.
        distances: Distances of the finger from the cube's centre, as multiples of the depth.

    Returns:
        Stresses (rotations, SIDES, distances, pads), in Pa, tension positive.
    """
    cube_position = np.array([[0.0, 0.0, -depth]])
    finger, force = disc(FINGER_RADIUS, (0.0, 0.0, -1.0))
    directions = list(SIDES.values())
    places = depth * np.einsum("g,kj->kgj", distances, directions)
    loaded = finger + places[:, :, None, :]
    stress, slope = field(cube_position, loaded, force, POISSONS_RATIO)
    # The slope is ordered (..., k, component); a gradient is (..., i, j, k).
    by_component = np.moveaxis(slope, -1, -2)
    gradient = np.moveaxis(to_matrix(by_component), -3, -1)

    # The inverse of each rotation takes the field of the skin into the frame of the cube.
    inverse = np.swapaxes(rotations, -1, -2)
    to_cube = inverse[:, None, None, None]
    rotated_stress = rotate_stress(stress, to_cube)
    rotated_gradient = rotate_gradient(gradient, to_cube)
    state = calibration.modes.state(
        rotated_stress.reshape(-1, 6),
        rotated_gradient.reshape(-1, 3, 3, 3) * calibration.half_side,
    )
    on_pads: Array = state @ calibration.response.T
    return on_pads.reshape(len(rotations), len(SIDES), len(distances), -1)


@dataclass(frozen=True)
class Explanation:
    """Rotation and order of the pads that explain the presses beside a cube.

    Attributes:
        rotation: Rotation (3, 3) of the cube from its intended to its real orientation.
        places: Number of the pad in the layout to which each wire of the hub leads (P,).
        misfit: Unexplained share of the measured stresses: 0 is perfect, 1 explains nothing.
        is_certain: Whether no other explanation with as few changes fits as well.
    """

    rotation: Index
    places: Index
    misfit: float
    is_certain: bool = True

    @property
    def is_rotated(self) -> bool:
        return not np.array_equal(self.rotation, np.eye(3))

    @property
    def swapped(self) -> list[int]:
        """Numbers of the pads that are not where the layout has them."""
        is_swapped = self.places != np.arange(len(self.places))
        return [int(pad) for pad in np.flatnonzero(is_swapped)]

    @property
    def is_clear(self) -> bool:
        """Whether the presses determine rotation and order."""
        return self.misfit <= MAX_MISFIT and self.is_certain

    @property
    def changes(self) -> float:
        """Number of changes: one for a rotation, and one for each swap of two pads."""
        return int(self.is_rotated) + len(self.swapped) / 2


def explain_presses(measured: Array, expected: Array) -> Explanation:
    """Find the simplest explanation of presses.

    Args:
        measured: Stresses on the pads in K presses (K, P), in Pa; NaN for a pad that does not work.
        expected: Stresses (24, K, G, P) for each of `cube_rotations` and G distances, in Pa.
    """
    explanations = []
    for rotation, of_rotation in zip(cube_rotations(), expected, strict=True):
        places, misfit = _find_order(measured, of_rotation)
        explanations.append(Explanation(rotation, places, misfit))
    lowest = min(each.misfit for each in explanations)
    limit = max(SIMILAR_MISFIT, SIMILAR_RATIO * lowest)
    similar = [each for each in explanations if each.misfit <= limit]
    fewest = min(each.changes for each in similar)
    simplest = [each for each in similar if each.changes == fewest]
    best = min(simplest, key=lambda each: each.misfit)
    return replace(best, is_certain=len(simplest) == 1)


def _find_order(measured: Array, expected: Array) -> tuple[Index, float]:
    """Find the order of the pads for one rotation by a local search that swaps two pads.

    Returns:
        Places of the pads (P,), and their misfit.
    """
    n_pads = measured.shape[1]
    places = np.arange(n_pads)
    first, second = np.triu_indices(n_pads, 1)
    swaps = np.arange(len(first))
    lowest = float(_misfit(measured, expected, places[None])[0])
    while len(swaps):
        candidates = np.tile(places, (len(swaps), 1))
        candidates[swaps, first] = places[second]
        candidates[swaps, second] = places[first]
        misfits = _misfit(measured, expected, candidates)
        best = int(misfits.argmin())
        # A swap of real wires helps a lot; a smaller gain comes from noise.
        if misfits[best] ** 2 > MAX_SWAP_RATIO * lowest**2:
            break
        places, lowest = candidates[best], float(misfits[best])
    return places, lowest


def _misfit(
    measured: Array,
    expected: Array,
    places: Index,
) -> Array:
    """Compute the misfit (S,) of S orders of the pads (S, P)."""
    works = np.isfinite(measured).all(axis=0)
    m = measured[:, works]
    e = expected[:, :, places][..., works]  # (K, G, S, pads)
    # The force of a press is unknown but pushes, so only a positive scale is fitted.
    projection = np.maximum(0, np.einsum("kp,kgsp->kgs", m, e))
    total = (m**2).sum(axis=1)
    explained = projection**2 / (e * e).sum(axis=3)
    unexplained = total[:, None, None] - explained
    # Rounding can leave a value just below 0.
    at_best_distance = np.maximum(0, unexplained.min(axis=1))
    misfit: Array = np.sqrt(at_best_distance.sum(axis=0) / total.sum())
    return misfit
