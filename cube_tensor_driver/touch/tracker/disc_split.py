"""One contact that is none of the shapes of disc_fit.py: is it two beside each other?

Two balls that touch look like one ball and something that is left, or like one long contact. A fit
of one does not find its way to two. So two are tried: one beside the other in eight directions,
and both halves in four. What is likeliest at first sight is fitted.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from .disc_fit import COLD, LOOK, USUAL_SIZE, Fitted, Scan, fit

FITTED = 3
"""Pairs that are fitted, those likeliest at first sight."""
OVERLAP, BESIDE = 0.8, 1.5
"""Sums of their radii by which two contacts are at least and at most apart: bodies do not press on
the same place, and between those farther apart there is a valley (disc_choice.py)."""
FAINTEST = 0.1
"""Part of the greater force that the smaller one has at least: the rim of a punch is no contact."""
_ANGLES = 2 * np.pi * np.arange(8) / 8
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def split(scan: Scan, one: Fitted, j: int, alpha: float, enough: float) -> Fitted | None:
    """Two contacts in the place of contact j, the second of them last; None: it is one.

    They must be likelier, press, lie beside each other and leave less than `enough`. Fits begin at
    `alpha`. Both in Pa.
    """
    size = max(one.sizes[j], USUAL_SIZE * scan.kernels.depth)
    pairs = [_begin(scan, one, j, *pair, alpha) for pair in _pairs(one.middles[j], size)]
    likeliest = sorted(pairs, key=lambda pair: pair.score)[:FITTED]
    fitted = [fit(scan, pair.middles, pair.sizes, alpha, COLD) for pair in likeliest]
    two = min(fitted, key=lambda pair: pair.score)
    radii = two.sizes[:-1] + two.sizes[-1]
    apart = np.linalg.norm(two.middles[:-1] - two.middles[-1], axis=1) / radii
    beside = apart.min() > OVERLAP and apart[j] < BESIDE
    pressing = np.sort(-two.forces[[j, -1], 2])
    both = pressing[0] > FAINTEST * pressing[1]
    return two if two.score < one.score and two.alpha < enough and beside and both else None


def _pairs(middle: Array, size: float) -> list[tuple[Array, Array, float]]:
    """Middles of two contacts, and their radius: one beside the one that is there; its halves."""
    beside = [(middle, middle + 2 * size * along, size) for along in _DIRECTIONS]
    shifts = size / 2 * _DIRECTIONS[: len(_DIRECTIONS) // 2]
    return beside + [(middle - shift, middle + shift, size / 2) for shift in shifts]


def _begin(
    scan: Scan, one: Fitted, j: int, here: Array, there: Array, size: float, alpha: float
) -> Fitted:
    middles, sizes = np.vstack([one.middles, there]), np.append(one.sizes, size)
    middles[j], sizes[j] = here, size
    return fit(scan, middles, sizes, alpha, LOOK)
