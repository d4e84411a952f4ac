"""How many contacts there are: where one begins, which ends, which two are one.

What is called pressure here is that at the cubes' depth.
"""

from __future__ import annotations

import itertools

import numpy as np

from ...core.arrays import Array
from .disc import Disc, DiscModel

ADDED, DROPPED = 0.2, 0.1
"""A contact begins where what is left of the pressure exceeds this part of its greatest, and ends
where its own falls below that part: two limits, so that nothing flickers."""
APART, MERGED = 1.0, 0.7
"""Pitches between contacts from which on a second one begins, and below which two are one."""
VALLEY, NO_VALLEY = 0.8, 0.92
"""Between two contacts the pressure falls below this part of the fainter one's; two between which
it does not fall below the second number become one."""

INSIDE = 0.6
"""Part of the sum of their radii below which two contacts that were told apart are one again."""


def beginning(
    model: DiscModel, discs: list[Disc], rest: Array, below: Array, tried: list[Array], least: float
) -> int | None:
    """The point where the next contact begins: the highest of what is left, behind a valley from
    all others; None: nowhere.

    rest, below: (M,) Pa, what the discs do not explain and all; tried: (3,) m, places of no use
    """
    limit = max(least, ADDED * float(below.max(initial=0.0)))
    allowed = rest > limit
    points = model.inverse.points
    middles = [model.middle(disc) for disc in discs]
    for middle in [*tried, *middles]:
        allowed &= np.linalg.norm(points - middle, axis=1) > APART * model.inverse.pitch
    for candidate in np.argsort(-np.where(allowed, rest, -np.inf))[: allowed.sum()].tolist():
        place = points[candidate]
        if all(valley(model, middle, place, below) < VALLEY for middle in middles):
            return int(candidate)
    return None


def same(model: DiscModel, discs: list[Disc], below: Array) -> tuple[Disc, Disc] | None:
    """Two contacts without a valley between them, the older first; None: there are none.

    Two that their likelihood told apart need no valley, but may not lie in each other.
    """
    for older, younger in itertools.combinations(discs, 2):
        here, there = model.middle(older), model.middle(younger)
        if older.told_apart and younger.told_apart:
            one = float(np.linalg.norm(here - there)) < INSIDE * (older.size + younger.size)
        else:
            one = valley(model, here, there, below) > NO_VALLEY
        if one:
            return older, younger
    return None


def remaining(model: DiscModel, discs: list[Disc], least: float) -> list[Disc]:
    """Without those that pull, are faint or lie in an older one; least: Pa."""
    strongest = 0.0
    peaks = {}
    for disc in discs:
        peak = model.inverse.kernels.disc_pressure(np.zeros((1, 2)), disc.size, disc.force)
        peaks[disc.id] = float(peak[0])
        strongest = max(strongest, peaks[disc.id])
    limit = max(least / 2, DROPPED * strongest)
    kept: list[Disc] = []
    for disc in sorted(discs, key=lambda one: one.id):
        others = [one for one in kept if not (disc.told_apart and one.told_apart)]
        apart = [np.linalg.norm(model.middle(disc) - model.middle(one)) for one in others]
        alone = min(apart, default=np.inf) >= MERGED * model.inverse.pitch
        if peaks[disc.id] > limit and alone:
            kept.append(disc)
    return kept


def valley(model: DiscModel, here: Array, there: Array, below: Array) -> float:
    """The least pressure between two places (3,), over the fainter one's."""
    places = here + np.linspace(0, 1, 9)[:, None] * (there - here)
    pressure = below[model.nearest_points(places)]
    return float(pressure.min() / max(min(pressure[0], pressure[-1]), 1e-9))
