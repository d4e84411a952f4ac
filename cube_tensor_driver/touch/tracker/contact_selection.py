"""Number of contacts: detection of new ones, merging of pairs, removal of those that have ended.

All pressures in this file are pressures in the plane of the cubes' centres, not on the surface.
"""

from __future__ import annotations

import itertools

import numpy as np

from ...core.arrays import Array
from .contact_model import ContactModel, HertzContact

DETECTION_FRACTION = 0.2
"""A new contact is detected only where the pressure that the present contacts do not explain is
above this fraction of the largest total pressure on the skin. It must be above an absolute
threshold, too."""

PRUNING_FRACTION = 0.1
"""A contact is removed if its peak pressure is below this fraction of the peak pressure of the
strongest contact. The fraction is smaller than `DETECTION_FRACTION`, so that a contact near the
threshold is not removed and detected again in turn."""

MIN_DISTANCE_PITCHES = 1.0
"""Smallest distance of a new contact from every other one, divided by the pitch (distance of
neighbouring cubes)."""

MERGE_DISTANCE_PITCHES = 0.7
"""Distance of two contacts, divided by the pitch (distance of neighbouring cubes), below which the
younger one is removed. It is smaller than `MIN_DISTANCE_PITCHES`, so that a contact near the
threshold is not removed and detected again in turn."""

DETECTION_VALLEY = 0.8
"""Threshold of the valley ratio (lowest pressure on the line between two positions, divided by the
lower pressure at its ends) for a new contact. A new contact is accepted only if its valley ratio to
every other contact is smaller."""

MERGE_VALLEY = 0.92
"""Threshold of the valley ratio (lowest pressure on the line between two positions, divided by the
lower pressure at its ends) above which two contacts are merged into one."""

SPLIT_OVERLAP = 0.6
"""Distance of the centres of two contacts, divided by the sum of their radii, below which the two
are merged if both were made by splitting one contact in two (contact_split.py)."""

_VALLEY_SAMPLES = 9
"""Number of positions on the line between two contacts at which the pressure is compared, the ends
included."""

_MIN_PRESSURE = 1e-9
"""Smallest pressure, in Pa, by which `valley_ratio` divides; it avoids a division by 0."""


def detect_contact(
    model: ContactModel,
    contacts: list[HertzContact],
    residual: Array,
    pressure: Array,
    tried: list[Array],
    min_pressure: float,
) -> int | None:
    """Find the point of the surface at which a new contact is started.

    All pressures are at the depth of the cubes' centres, below the M points of the surface.

    Args:
        model: Surface points of the skin, and the response of its cubes to contacts.
        contacts: Contacts that are tracked at present.
        residual: Pressure (M,) that these contacts do not explain, in Pa.
        pressure: Total pressure (M,), that of the contacts included, in Pa.
        tried: Positions (3,) in m, in the skin's parent frame, at which a contact was already
            started with the values of this scan. No contact is started near them again.
        min_pressure: Smallest pressure of a new contact in Pa.

    Returns:
        Index of the point with the highest residual among those whose residual is above the
        thresholds and that are separated from all contacts, both by `MIN_DISTANCE_PITCHES` and by a
        valley of the pressure (`DETECTION_VALLEY`). None if there is no such point.
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

    # The highest residual may lie on the flank of a present contact, without a valley in between.
    # Such a point is rejected, and the point with the next lower residual is tested.
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
    """Find two contacts that are really one, because the pressure between them has no valley.

    A valley is a clear minimum of the pressure on the line between two contacts (`MERGE_VALLEY`).
    Two contacts that were made by splitting one contact need no valley. They count as one if they
    overlap too much (`SPLIT_OVERLAP`).

    Args:
        model: Surface points of the skin, and the response of its cubes to contacts.
        contacts: Contacts, the oldest first.
        pressure: Total pressure (M,) in Pa at the cubes' depth, below all points of the surface.

    Returns:
        The first pair to merge, its older contact first; None if no pair is to be merged.
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
    """Remove contacts that pull at the skin, are weak, or lie close to an older one.

    Args:
        model: Surface points of the skin, and the response of its cubes to contacts.
        contacts: Contacts to check.
        min_pressure: Smallest peak pressure of a new contact at the depth of the cubes, in Pa. A
            contact is weak if its peak pressure is below half of this, or below `PRUNING_FRACTION`
            of the peak pressure of the strongest contact.

    Returns:
        The contacts that are kept, the oldest first.
    """
    origin = np.zeros((1, 2))
    kernels = model.inverse.kernels
    peaks = {
        contact.id: float(kernels.disc_pressure(origin, contact.size, contact.force)[0])
        for contact in contacts
    }
    strongest = max(peaks.values(), default=0.0)
    # A contact is removed below half of `min_pressure`, the smallest pressure of a new contact.
    # So a contact whose pressure is near one of both limits is not removed and detected in turn.
    threshold = max(min_pressure / 2, PRUNING_FRACTION * strongest)

    # Ids increase with time, so older contacts come first. They are kept, and younger contacts
    # that lie close to a kept one are removed.
    kept: list[HertzContact] = []
    for contact in sorted(contacts, key=lambda one: one.id):
        centre = model.centre(contact)
        # Contacts that were made by a split may be close to each other; `find_pair_to_merge`
        # decides about them.
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
    """Measure how far the pressure falls on the line between two positions.

    Args:
        model: Surface points of the skin.
        first: Position (3,) of one end of the line, in m in the skin's parent frame.
        second: Position (3,) of the other end, in the same units and frame.
        pressure: Pressure (M,) in Pa at the cubes' depth, below all points of the surface.

    Returns:
        Lowest pressure along the line, divided by the lower one of the pressures at its ends; 1 if
        the pressure does not fall at all.
    """
    fractions = np.linspace(0, 1, _VALLEY_SAMPLES)[:, None]
    path = first + fractions * (second - first)
    along = pressure[model.nearest_points(path)]
    ends = max(min(along[0], along[-1]), _MIN_PRESSURE)
    return float(along.min() / ends)
