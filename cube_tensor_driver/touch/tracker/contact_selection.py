"""Number of contacts: detection of new ones, merging of pairs, pruning of vanished ones.

All pressures here are those at the depth of the cubes.
"""

from __future__ import annotations

import itertools

import numpy as np

from ...core.arrays import Array
from .contact_model import ContactModel, HertzContact

DETECTION_FRACTION = 0.2
"""Fraction of the largest pressure that the residual must exceed for a new contact."""

PRUNING_FRACTION = 0.1
"""Fraction of the peak pressure of the strongest contact below which a contact ends. It is smaller
than `DETECTION_FRACTION`, so that a contact near the limit does not flicker."""

MIN_DISTANCE_PITCHES = 1.0
"""Smallest distance, in cube pitches, of a new contact from all others."""

MERGE_DISTANCE_PITCHES = 0.7
"""Distance, in cube pitches, below which two contacts become one. It is smaller than
`MIN_DISTANCE_PITCHES`, so that a contact near the limit does not flicker."""

DETECTION_VALLEY = 0.8
"""Lowest pressure between a new contact and another one, divided by the smaller of their pressures,
below which they are two."""

MERGE_VALLEY = 0.92
"""Lowest pressure between two existing contacts, divided by the smaller of their pressures, above
which they become one."""

SPLIT_OVERLAP = 0.6
"""Distance of two contacts that a split of one contact made (contact_split.py), divided by the sum
of their radii, below which they become one again."""

_VALLEY_SAMPLES = 9
"""Number of positions along the line on which a valley is searched."""

_MIN_PRESSURE = 1e-9
"""Smallest pressure in Pa that is divided by."""


def detect_contact(
    model: ContactModel,
    contacts: list[HertzContact],
    residual: Array,
    pressure: Array,
    tried: list[Array],
    min_pressure: float,
) -> int | None:
    """Find the point at which the next contact begins.

    Args:
        model: Model of the skin.
        contacts: Contacts so far.
        residual: Pressure (M,) that the contacts do not explain, in Pa.
        pressure: Total pressure (M,) in Pa.
        tried: Positions (3,) at which a contact was tried already, in m.
        min_pressure: Pressure from which on something is a contact, in Pa.

    Returns:
        The index of the point with the highest residual that is separated from all contacts by
        distance and by a valley of the pressure; None if there is none.
    """
    threshold = max(
        min_pressure,
        DETECTION_FRACTION * float(pressure.max(initial=0.0)),
    )
    is_candidate = residual > threshold
    points = model.inverse.points
    centres = [model.centre(contact) for contact in contacts]
    for centre in [*tried, *centres]:
        distance = np.linalg.norm(points - centre, axis=1)
        is_candidate &= distance > MIN_DISTANCE_PITCHES * model.inverse.pitch

    # The highest residual may be the flank of a known contact: then the next one is tried.
    highest_first = np.argsort(-np.where(is_candidate, residual, -np.inf))
    for candidate in highest_first[: is_candidate.sum()].tolist():
        position = points[candidate]
        valleys = [valley_ratio(model, centre, position, pressure) for centre in centres]
        if all(valley < DETECTION_VALLEY for valley in valleys):
            return int(candidate)
    return None


def find_pair_to_merge(
    model: ContactModel,
    contacts: list[HertzContact],
    pressure: Array,
) -> tuple[HertzContact, HertzContact] | None:
    """Return two contacts without a valley of the pressure (M,) between them, the older one first.

    Two contacts from a split need no valley, but must not overlap much.
    """
    for older, younger in itertools.combinations(contacts, 2):
        first = model.centre(older)
        second = model.centre(younger)
        if older.was_split and younger.was_split:
            distance = float(np.linalg.norm(first - second))
            is_one = distance < SPLIT_OVERLAP * (older.size + younger.size)
        else:
            is_one = valley_ratio(model, first, second, pressure) > MERGE_VALLEY
        if is_one:
            return older, younger
    return None


def prune_contacts(
    model: ContactModel,
    contacts: list[HertzContact],
    min_pressure: float,
) -> list[HertzContact]:
    """Remove contacts that pull, are weak or lie close to an older one.

    Args:
        model: Model of the skin.
        contacts: Contacts to check.
        min_pressure: Pressure from which on something is a contact, in Pa.
    """
    origin = np.zeros((1, 2))
    kernels = model.inverse.kernels
    peaks = {
        contact.id: float(kernels.disc_pressure(origin, contact.size, contact.force)[0])
        for contact in contacts
    }
    strongest = max(peaks.values(), default=0.0)
    # Half of the pressure at which a contact begins, so that it does not flicker.
    threshold = max(min_pressure / 2, PRUNING_FRACTION * strongest)

    # In the order of their ids: an older contact is kept, a younger one beside it ends.
    kept: list[HertzContact] = []
    for contact in sorted(contacts, key=lambda one: one.id):
        centre = model.centre(contact)
        # Contacts from a split may be close to each other; `find_pair_to_merge` checks these.
        others = [one for one in kept if not (contact.was_split and one.was_split)]
        offsets = [centre - model.centre(one) for one in others]
        distances = [float(np.linalg.norm(offset)) for offset in offsets]
        is_alone = min(distances, default=np.inf) >= MERGE_DISTANCE_PITCHES * model.inverse.pitch
        if peaks[contact.id] > threshold and is_alone:
            kept.append(contact)
    return kept


def valley_ratio(
    model: ContactModel,
    first: Array,
    second: Array,
    pressure: Array,
) -> float:
    """Measure how deep the pressure falls between two positions.

    Args:
        model: Model of the skin.
        first: Position (3,) in m.
        second: Position (3,) in m.
        pressure: Pressure (M,) on all points.

    Returns:
        Lowest pressure along the line between them, divided by the lower one of the pressures at
        its ends; 1 if the pressure does not fall at all.
    """
    fractions = np.linspace(0, 1, _VALLEY_SAMPLES)[:, None]
    path = first + fractions * (second - first)
    along = pressure[model.nearest_points(path)]
    ends = max(min(along[0], along[-1]), _MIN_PRESSURE)
    return float(along.min() / ends)
