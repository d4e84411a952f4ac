"""Test whether one fitted contact is really two contacts beside each other.

Two balls that touch look like one ball with a large residual, or like one long contact. A fit of
one contact does not converge to two. So pairs are tried as starts: a second contact beside the
fitted one in eight directions, and two halves of it in four. The most likely starts are fitted.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from .contact_fit import (
    STEPS_EVALUATE,
    STEPS_NEW,
    USUAL_SIZE,
    ContactFit,
    Observations,
    fit_contacts,
)

FITTED_PAIRS = 3
"""Number of pairs that are fitted: those with the greatest evidence at their start."""

MIN_PAIR_DISTANCE = 0.8
"""Smallest distance of two contacts divided by the sum of their radii: two bodies cannot press on
the same place."""

MAX_PAIR_DISTANCE = 1.5
"""Largest distance of two contacts divided by the sum of their radii: between contacts farther
apart, the pressure has a valley (contact_selection.py)."""

MIN_FORCE_RATIO = 0.1
"""Smallest ratio of the smaller to the larger normal force: the rim of a punch is no contact."""

_ANGLES = 2 * np.pi * np.arange(8) / 8
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def split_contact(
    observations: Observations,
    one: ContactFit,
    j: int,
    start_scale: float,
    max_scale: float,
) -> ContactFit | None:
    """Fit two contacts in place of contact j.

    Args:
        observations: Values of the cubes.
        one: Fit with one contact.
        j: Index of this contact.
        start_scale: Residual scale with which the fits begin, in Pa.
        max_scale: Largest residual scale of an acceptable fit of two, in Pa.

    Returns:
        Fit whose last contact is the new one. None if two contacts are less likely than one, do not
        both press, do not lie beside each other or leave too large a residual.
    """
    size = max(one.sizes[j], USUAL_SIZE * observations.kernels.depth)
    starts = [
        _evaluate_pair(observations, one, j, pair, start_scale)
        for pair in _list_pairs(one.centres[j], size)
    ]
    # A smaller score is more likely.
    likeliest = sorted(starts, key=lambda start: start.score)[:FITTED_PAIRS]
    fits = [
        fit_contacts(observations, start.centres, start.sizes, start_scale, STEPS_NEW)
        for start in likeliest
    ]
    two = min(fits, key=lambda fit: fit.score)

    offsets = two.centres[:-1] - two.centres[-1]
    distances = np.linalg.norm(offsets, axis=1)
    ratios = distances / (two.sizes[:-1] + two.sizes[-1])
    is_beside = ratios.min() > MIN_PAIR_DISTANCE and ratios[j] < MAX_PAIR_DISTANCE
    # Both must press: a fit can explain a residual by a contact that pulls.
    smaller, larger = np.sort(-two.forces[[j, -1], 2])
    both_press = smaller > MIN_FORCE_RATIO * larger
    is_better = two.score < one.score and two.residual_scale < max_scale
    return two if is_better and is_beside and both_press else None


def _list_pairs(centre: Array, size: float) -> list[tuple[Array, Array, float]]:
    """Return centres (2,) of two contacts and their radius: one beside the other, or two halves."""
    # Touching circles of equal size, and two circles with half the radius inside the fitted one.
    beside = [
        (
            centre,
            centre + 2 * size * direction,
            size,
        )
        for direction in _DIRECTIONS
    ]
    shifts = size / 2 * _DIRECTIONS[: len(_DIRECTIONS) // 2]
    halves = [
        (
            centre - shift,
            centre + shift,
            size / 2,
        )
        for shift in shifts
    ]
    return beside + halves


def _evaluate_pair(
    observations: Observations,
    one: ContactFit,
    j: int,
    pair: tuple[Array, Array, float],
    start_scale: float,
) -> ContactFit:
    """Compute the evidence of a pair in place of contact j, without moving it."""
    first, second, size = pair
    centres = np.vstack([one.centres, second])
    sizes = np.append(one.sizes, size)
    centres[j] = first
    sizes[j] = size
    return fit_contacts(observations, centres, sizes, start_scale, STEPS_EVALUATE)
