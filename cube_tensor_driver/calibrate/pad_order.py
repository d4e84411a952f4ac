"""Which pad is which, and how a cube is turned, from presses at known places.

A press on a known side of a cube gives each pad a share of its force, which depends on how far away
it was: e_g (P,) for the distance g. A cube that is turned shows another pattern, and pads whose
wires are swapped show it in another order. For each turn the misfit of an order is

    misfit² = sum_k min_g |m_k - a e_g|² / sum_k |m_k|²,   a = max(0, m_k·e_g / e_g·e_g)

    m_k   (P,) what the pads measured in press k
    e_g   (P,) expected of that turn, press and distance, in that order

Pads are swapped two at a time for as long as that lowers misfit² to less than half. Of all
explanations that fit about as well as the best, the one with the fewest changes holds: a turn or a
swap of two pads is one change.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.symmetry import find_group

GAIN = 0.5
"""A swap must lower misfit² to this share."""
CLOSE = 1.5
"""An explanation with a misfit up to so many times the lowest, or up to FLOOR, fits as well."""
FLOOR = 0.06
WORST = 0.5
"""A misfit above this explains nothing: the presses were elsewhere, or pads do not work."""


@dataclass(frozen=True)
class Explanation:
    """turn: (3, 3) cube to where it should be, the identity if it is not turned. places: (P,) the
    pad of the layout that each measured pad is. misfit: 0 is perfect, 1 nothing explained.
    is_certain: nothing else with as few changes fits as well.
    """

    turn: np.ndarray
    places: np.ndarray
    misfit: float
    is_certain: bool = True

    @property
    def is_turned(self) -> bool:
        return not np.array_equal(self.turn, np.eye(3))

    @property
    def swapped(self) -> list[int]:
        """Pads that are not where the layout has them."""
        return np.flatnonzero(self.places != np.arange(len(self.places))).tolist()

    @property
    def is_clear(self) -> bool:
        """Whether the presses say anything."""
        return self.misfit <= WORST and self.is_certain

    @property
    def _changes(self) -> float:
        # A swap concerns two pads.
        return int(self.is_turned) + len(self.swapped) / 2


def cube_turns() -> np.ndarray:
    """(24, 3, 3) the rotations of a cube, the identity first."""
    elements = find_group("full")
    return elements[np.linalg.det(elements) > 0]


def explain_presses(measured: np.ndarray, expected: np.ndarray) -> Explanation:
    """The simplest explanation of presses.

    measured: (K, P) pad stresses of K presses, NaN for a pad that does not work. expected:
    (24, K, G, P) for each of `cube_turns` and G distances.
    """
    found = [_best_order(measured, of_turn) for of_turn in expected]
    explanations = [
        Explanation(turn, places, misfit)
        for turn, (places, misfit) in zip(cube_turns(), found, strict=True)
    ]
    limit = max(FLOOR, CLOSE * min(each.misfit for each in explanations))
    fitting = [each for each in explanations if each.misfit <= limit]
    fewest = min(each._changes for each in fitting)
    simplest = [each for each in fitting if each._changes == fewest]
    best = min(simplest, key=lambda each: each.misfit)
    return Explanation(best.turn, best.places, best.misfit, len(simplest) == 1)


def _best_order(measured: np.ndarray, expected: np.ndarray) -> tuple[np.ndarray, float]:
    """places (P,) and misfit of one turn; a local search that swaps pads."""
    n = measured.shape[1]
    places = np.arange(n)
    first, second = np.triu_indices(n, 1)
    best = float(_misfit(measured, expected, places[None])[0])
    while len(first):
        swapped = np.tile(places, (len(first), 1))
        rows = np.arange(len(first))
        swapped[rows, first], swapped[rows, second] = places[second], places[first]
        misfits = _misfit(measured, expected, swapped)
        number = int(misfits.argmin())
        if misfits[number] ** 2 > GAIN * best**2:
            break
        places, best = swapped[number], float(misfits[number])
    return places, best


def _misfit(measured: np.ndarray, expected: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(S,) of S orders (S, P)."""
    works = np.isfinite(measured).all(axis=0)
    m = measured[:, works]
    e = expected[:, :, places][..., works]  # (K, G, S, pads)
    along = np.maximum(0, np.einsum("kp,kgsp->kgs", m, e))
    square = (m**2).sum(axis=1)[:, None, None]
    rest = square - along**2 / (e * e).sum(axis=3)
    misfit: np.ndarray = np.sqrt(np.maximum(0, rest.min(axis=1)).sum(axis=0) / square.sum())
    return misfit
