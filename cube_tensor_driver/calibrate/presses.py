# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Presses of a finger beside a cube, from which its rotation and the order of its pads are found.

When a new cube is brought up, it may be mounted in a rotated orientation, and the wires of its pads
may be swapped. A person presses on known sides of the cube. Each press causes stresses on the pads,
whose pattern depends on the rotation of the cube, the order of the pads, and the distance g of the
finger. For each rotation, an order of the pads has the misfit

    misfit² = sum_k min_g |m_k - a e_g|² / sum_k |m_k|²,   a = max(0, m_k·e_g / e_g·e_g)

    m_k   stresses (P,) that the pads measured in press k
    e_g   stresses (P,) expected under 1 N for this rotation, press k and distance g, in this order
          of pads
    a     force of press k in N, not negative because a finger cannot pull

Pads are swapped two at a time as long as a swap reduces misfit² to at most `MAX_SWAP_RATIO` of its
value. Of all explanations (rotation and order) that fit about as well as the best one, the one with
the fewest changes is chosen. A rotation is one change, and a swap of two pads is one change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..core.arrays import Array, Index, Mask
from ..core.calibration import Calibration
from ..core.defaults import POISSONS_RATIO, SURFACE_DEPTH
from ..core.modes import to_gradient_tensor
from ..core.symmetry import find_group
from ..core.tensor import rotate_gradient, rotate_stress
from ..mechanics.contact import disc, field

MIN_PRESS_NOISE_RATIO = 30.0
"""Smallest frequency change of a pad that counts as a press, as a multiple of the median noise
(standard deviation of the frequency) of the pads.

Smaller changes may be noise.
"""

MIN_PRESS_CHANGE = 2e-4
"""Smallest frequency change of a pad that counts as a press, relative to its frequency without
load. A smaller change is no press, even if it is far above the noise of the pads."""

STEADY_SHARE = 0.1
"""A press counts as steady when no pad's frequency differs between two successive averages by more
than this fraction of the largest frequency change that the press caused."""

RELEASED_SHARE = 0.4
"""A press has ended when the largest frequency change of all pads is below this fraction of the
smallest change that counts as a press.

It is below 1, so that a press near the limit is not counted twice.
"""

FINGER_RADIUS = 3e-3
"""Radius of the contact area of a fingertip, in m."""

SIDES = {
    "+x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
}
"""Sides of a cube on which a person presses: directions from the centre of the cube, in the frame
of the skin.

Presses on three sides distinguish all 24 rotations of a cube.
"""

PRESS_DISTANCES = tuple(0.125 * np.arange(2, 17))
"""Distances between a press and the centre of the cube, along the skin, for which stresses are
computed, as multiples of the depth of the centre below the surface.

All of them are tried, because people do not press at a measured distance.
"""

MAX_SWAP_RATIO = 0.5
"""Two pads are taken to be swapped only if correcting the swap multiplies misfit² (unexplained
fraction of the squared stresses on the pads during presses) by at most this number."""

SIMILAR_RATIO = 1.5
"""An explanation of the presses (rotation of the cube, order of its pads) counts as equally good as
the best one if its misfit is at most this multiple of the lowest misfit."""

SIMILAR_MISFIT = 0.06
"""An explanation of the presses (rotation of the cube, order of its pads) with at most this misfit
counts as equally good as the best one, even if the best one has a far lower misfit.

The misfit is the root of the unexplained fraction of the squared stresses on the pads: 0.06 means
that the rms of the unexplained stresses is 6 % of the rms of all stresses.
"""

MAX_MISFIT = 0.5
"""Largest misfit (root of the unexplained fraction of the squared stresses on the pads) with which
a rotation and an order of the pads explain the presses.

If even the best misfit is larger, the presses were elsewhere, or pads do not work.
"""


class SteadyPress(NamedTuple):
    """A press on a cube during which the frequencies have stopped changing.

    Attributes:
        cube: Number of the cube that is pressed: the one with the largest frequency change of a
            pad.
        change: Frequency changes of its pads relative to their frequencies without load (P,); NaN
            for pads that do not work.
    """

    cube: int
    change: Array


class PressDetector:
    """Detects presses on the cubes of a skin from successive averages of the frequencies.

    Attributes:
        is_held: Whether the press that was returned last continues.
    """

    def __init__(
        self,
        rest: Array,
        noise: Array,
        works: Mask,
    ) -> None:
        """Prepare the detection.

        Args:
            rest: Frequencies without load (C, P), in Hz, of the P pads of C cubes.
            noise: Standard deviations of these frequencies, divided by the frequencies (C, P).
            works: Whether a pad works and is used (C, P).
        """
        self._rest, self._works = rest, works
        self._limit = MIN_PRESS_CHANGE
        if works.any():
            typical = float(np.median(noise[works]))
            self._limit = max(MIN_PRESS_CHANGE, MIN_PRESS_NOISE_RATIO * typical)
        self._before: Array | None = None
        self.is_held = False

    def update(self, mean: Array) -> SteadyPress | None:
        """Examine the newest average of the frequencies.

        Args:
            mean: Mean frequencies (C, P), in Hz; NaN where nothing was measured.

        Returns:
            A press, once, when it has become steady; otherwise None.
        """
        with np.errstate(invalid="ignore"):  # NaN where nothing was measured
            relative = mean / self._rest - 1
        change = np.where(self._works, relative, np.nan)
        before, self._before = self._before, change
        size = np.nan_to_num(np.abs(change))
        of_cubes = size.max(axis=1)
        cube = int(of_cubes.argmax())
        strongest = of_cubes[cube]

        if strongest < RELEASED_SHARE * self._limit:
            self.is_held = False
        if self.is_held or before is None or strongest < self._limit:
            return None
        # While the finger still moves, the frequencies of the pads change from one average to the
        # next.
        movement = np.abs(change[cube] - before[cube])
        if np.nanmax(movement) > STEADY_SHARE * strongest:
            return None
        self.is_held = True
        return SteadyPress(cube, change[cube])


def list_cube_rotations() -> Index:
    """Return the 24 rotations that map a cube onto itself (24, 3, 3), the identity first."""
    elements = find_group("full")
    is_rotation = np.linalg.det(elements) > 0
    rotations: Index = elements[is_rotation]
    return rotations


def compute_expected_presses(
    calibration: Calibration,
    rotations: Index,
    *,
    depth: float = SURFACE_DEPTH,
    distances: Sequence[float] = PRESS_DISTANCES,
) -> Array:
    """Compute a cube's pad stresses when a fingertip presses straight down beside it with 1 N.

    Source: the elastic half space of `mechanics.contact.field`.

    Args:
        calibration: Calibration of the cube.
        rotations: Rotations (R, 3, 3) from the frame of the cube to that of the skin.
        depth: Depth of the cube's centre below the surface, in m.
        distances: Distances of the finger from the cube's centre along the surface, as multiples of
            the depth.

    Returns:
        Stresses (rotations, sides, distances, pads), in Pa, tension positive. A side is a direction
        from the cube to the finger; the sides are in the order of `SIDES`.
    """
    cube_position = np.array([[0.0, 0.0, -depth]])
    downwards = (0.0, 0.0, -1.0)
    finger, force = disc(FINGER_RADIUS, downwards)
    directions = list(SIDES.values())
    places = np.einsum("g,kj->kgj", distances, directions)
    centres = depth * places
    loaded = finger + centres[:, :, None, :]
    stress, slope = field(cube_position, loaded, force, POISSONS_RATIO)

    # The inverse of each rotation transforms the stress field from the frame of the skin to that of
    # the cube.
    inverse = np.swapaxes(rotations, -1, -2)
    to_cube = inverse[:, None, None, None]
    rotated_stress = rotate_stress(stress, to_cube)
    rotated_gradient = rotate_gradient(to_gradient_tensor(slope), to_cube)
    scaled_gradient = rotated_gradient * calibration.half_side
    amplitudes = calibration.modes.compute_amplitudes(
        rotated_stress.reshape(-1, 6),
        scaled_gradient.reshape(-1, 3, 3, 3),
    )
    on_pads: Array = amplitudes @ calibration.response.T
    shape = (
        len(rotations),
        len(SIDES),
        len(distances),
        -1,
    )
    return on_pads.reshape(shape)


@dataclass(frozen=True)
class Explanation:
    """Rotation of a cube and order of its pads that explain the stresses during presses beside it.

    Attributes:
        rotation: Rotation (3, 3) of the cube from its intended to its real orientation.
        places: Number of the pad in the layout to which each wire of the hub leads (P,).
        misfit: Root of the unexplained fraction of the squared stresses on the pads: 0 is a perfect
            explanation, 1 explains nothing.
        is_certain: Whether no other explanation with as few changes (rotation, swaps of two pads)
            fits as well.
    """

    rotation: Index
    places: Index
    misfit: float
    is_certain: bool = True

    @property
    def is_rotated(self) -> bool:
        """Whether the cube is turned relative to the layout."""
        identity = np.eye(3)
        return not np.array_equal(self.rotation, identity)

    @property
    def swapped(self) -> list[int]:
        """Numbers of the wires of the hub that lead to another pad than the layout of the cube
        states."""
        intended = np.arange(len(self.places))
        swapped = np.flatnonzero(self.places != intended)
        return [int(wire) for wire in swapped]

    @property
    def is_clear(self) -> bool:
        """Whether the presses determine the rotation of the cube and the order of its pads."""
        return self.misfit <= MAX_MISFIT and self.is_certain

    @property
    def changes(self) -> float:
        """Number of changes to the intended cube: 1 for a rotation, and 1 per two swapped pads."""
        n_swaps = len(self.swapped) / 2
        return int(self.is_rotated) + n_swaps


def explain_presses(measured: Array, expected: Array) -> Explanation:
    """Find the rotation of a cube and the order of its pads that explain presses most simply.

    Args:
        measured: Stresses on the pads in K presses (K, P), in Pa; NaN for a pad that does not work.
        expected: Stresses that `compute_expected_presses` computes for the 24 rotations of
            `list_cube_rotations`, the K presses and G distances (24, K, G, P), in Pa.
    """
    explanations = []
    rotations = list_cube_rotations()
    for rotation, of_rotation in zip(rotations, expected, strict=True):
        places, misfit = _find_order(measured, of_rotation)
        explanations.append(Explanation(rotation, places, misfit))
    misfits = [each.misfit for each in explanations]
    limit = max(SIMILAR_MISFIT, SIMILAR_RATIO * min(misfits))
    similar = [each for each in explanations if each.misfit <= limit]
    fewest = min(each.changes for each in similar)
    simplest = [each for each in similar if each.changes == fewest]
    best = min(simplest, key=lambda each: each.misfit)
    return replace(best, is_certain=len(simplest) == 1)


def _find_order(
    measured: Array,
    expected: Array,
) -> tuple[Index, float]:
    """Find the order of the pads, for one rotation of the cube.

    The search swaps two pads at a time, as long as the best swap reduces the misfit (root of the
    unexplained fraction of the squared stresses on the pads) enough.

    Args:
        measured: Stresses on the pads in K presses (K, P), in Pa.
        expected: Stresses expected for this rotation (K, G, P), in Pa, at G distances.

    Returns:
        Number of the pad to which each wire leads (P,), and the misfit of this order.
    """
    n_pads = measured.shape[1]
    places = np.arange(n_pads)
    first, second = np.triu_indices(n_pads, 1)
    swaps = np.arange(len(first))
    (lowest,) = _compute_misfit(measured, expected, places[None])
    while len(swaps):
        copies = (len(swaps), 1)
        candidates = np.tile(places, copies)
        candidates[swaps, first] = places[second]
        candidates[swaps, second] = places[first]
        misfits = _compute_misfit(measured, expected, candidates)
        best = int(misfits.argmin())
        # If two wires really are swapped, correcting them reduces the misfit a lot. A smaller
        # reduction comes from noise.
        if misfits[best] ** 2 > MAX_SWAP_RATIO * lowest**2:
            break
        places = candidates[best]
        lowest = misfits[best]
    return places, float(lowest)


def _compute_misfit(
    measured: Array,
    expected: Array,
    places: Index,
) -> Array:
    """Compute the misfit of several orders of the pads, each of which assigns the wires to pads.

    The misfit is the root of the fraction of the squared measured stresses that the expected ones
    do not explain, with the best distance and force for each press.

    Args:
        measured: Stresses on the pads in K presses (K, P), in Pa.
        expected: Stresses expected for one rotation (K, G, P), in Pa, at G distances.
        places: S orders: the number of the pad to which each wire leads (S, P).

    Returns:
        Misfit of each order (S,).
    """
    is_measured = np.isfinite(measured)
    works = is_measured.all(axis=0)
    m = measured[:, works]
    in_order = expected[:, :, places]  # (K, G, S, P)
    e = in_order[..., works]
    # The force of a press is unknown. So the expected stresses, which are those for 1 N, are scaled
    # by a fitted factor. It is not negative, because a finger cannot pull.
    products = np.einsum("kp,kgsp->kgs", m, e)
    projection = np.maximum(0, products)
    total = (m**2).sum(axis=1)
    squares = (e * e).sum(axis=3)
    explained = projection**2 / squares
    unexplained = total[:, None, None] - explained
    # Rounding can leave a value just below 0.
    lowest = unexplained.min(axis=1)
    at_best_distance = np.maximum(0, lowest)
    share = at_best_distance.sum(axis=0) / total.sum()
    misfit: Array = np.sqrt(share)
    return misfit
