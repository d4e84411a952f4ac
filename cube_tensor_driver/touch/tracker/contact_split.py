"""Test whether one fitted contact is really two contacts beside each other.

Two balls side by side have almost the same response as one ball with a large residual, or as one
elongated contact. A fit with one contact cannot turn into two. So pairs of contacts are tried as
starts: a second contact beside the fitted one in eight directions, and two halves of the fitted one
in four directions. The most likely starts are fitted.
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
"""Number of pairs of contacts, out of all starts that are tried, for which a fit is computed: those
with the greatest evidence before the fit."""

MIN_PAIR_DISTANCE = 0.8
"""Smallest distance of the centres of two contacts, divided by the sum of their radii, at which a
contact is split into them. A pair that is closer overlaps too much to be two bodies, because two
bodies cannot press on the same part of the surface."""

MAX_PAIR_DISTANCE = 1.5
"""Largest distance of the centres of two contacts, divided by the sum of their radii, at which a
contact is split into them. Between contacts farther apart, the pressure has a valley, and
contact_selection.py finds the second one."""

MIN_FORCE_RATIO = 0.1
"""Smallest ratio of the smaller to the larger normal force of two contacts into which a contact is
split. A second contact with less force usually does not describe a second body, but the high
pressure at the rim of a flat punch."""

_ANGLES = 2 * np.pi * np.arange(8) / 8
"""Angles (8,) in rad of the directions from a fitted contact to a second one that is tried."""

_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
"""Unit vectors (8, 2) in the plane of the surface, from a fitted contact to a second one."""


def split_contact(
    observations: Observations,
    one: ContactFit,
    j: int,
    start_scale: float,
    max_scale: float,
) -> ContactFit | None:
    """Fit two contacts in place of contact j, and decide whether they replace it.

    The residual scale is the standard deviation of the pressure that the contacts do not explain.

    Args:
        observations: Known values of the cubes, their noise and prior covariance.
        one: Fit of one or several contacts in which contact j is a single contact.
        j: Index of this contact in `one`.
        start_scale: Residual scale with which the fits begin, in Pa.
        max_scale: Largest residual scale of an acceptable fit with two contacts, in Pa.

    Returns:
        Fit with one more contact, which is the last one. None if the two contacts are less likely
        than one, do not both press on the skin, do not lie side by side, or leave a residual scale
        above `max_scale`.
    """
    size = max(one.sizes[j], USUAL_SIZE * observations.kernels.depth)
    starts = [
        _evaluate_pair(observations, one, j, pair, start_scale)
        for pair in _list_pairs(one.centres[j], size)
    ]
    # The score is -2 ln of the evidence: the start with the smallest score is the most likely.
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
    # Both contacts must press on the skin, because a fit can also explain a residual by a contact
    # that pulls at it.
    smaller, larger = np.sort(-two.forces[[j, -1], 2])
    both_press = smaller > MIN_FORCE_RATIO * larger
    is_better = two.score < one.score and two.residual_scale < max_scale
    return two if is_better and is_beside and both_press else None


def _list_pairs(centre: Array, size: float) -> list[tuple[Array, Array, float]]:
    """List the pairs of contacts that are tried in place of one contact.

    Args:
        centre: Centre (2,) of the fitted contact on the flattened skin, in m.
        size: Radius of the fitted contact in m.

    Returns:
        Centres (2,) of the two contacts and their common radius, in m. First the fitted contact
        with an equal one that touches it, then two circles with half the radius inside it.
    """
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
    """Compute the evidence of a pair of contacts in place of contact j, without moving them.

    Args:
        observations: Known values of the cubes, their noise and prior covariance.
        one: Fit of one or several contacts in which contact j is a single contact.
        j: Index of this contact in `one`.
        pair: Centres (2,) of the two contacts on the flattened skin and their common radius, in m.
        start_scale: Standard deviation of the pressure that the contacts do not explain, in Pa.
    """
    first, second, size = pair
    centres = np.vstack([one.centres, second])
    sizes = np.append(one.sizes, size)
    centres[j] = first
    sizes[j] = size
    return fit_contacts(observations, centres, sizes, start_scale, STEPS_EVALUATE)
