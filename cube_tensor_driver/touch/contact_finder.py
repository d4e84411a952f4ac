# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Common interface of the two methods that find the contacts of a skin: interpolation, inverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..config.influence import find_influence
from ..config.skin import Elastomer
from ..core.arrays import Array, Index, PadMasks, StatusBits
from ..core.calibration import Calibration
from ..core.defaults import CONTACT_METHODS, CONTACT_PRESSURE, SURFACE_DEPTH
from ..core.pipeline import Pipeline
from ..core.poses import CubePoses
from ..core.status import COMPENSATION
from ..mechanics.influence import read_influence
from ..mechanics.layer import Layer
from .inverse import SurfaceInverse
from .pad_measurement import model_pads
from .pad_noise import compute_noise_by_pad, compute_noise_of_all_pads
from .slip import NO_CONTACTS, Slip, SlipEstimator
from .surface import Contact, Surface
from .touch_detection import NO_TOUCHES, Touches
from .touch_links import TouchLinks
from .tracker.contact_tracker import ContactTracker, TrackedContact

AUTO = CONTACT_METHODS[0]
"""Method that stands for `INVERSE` if the elastomer is known from the skin file or from influence
functions, and otherwise for `INTERPOLATION`."""

INTERPOLATION = CONTACT_METHODS[1]
"""Method that interpolates the pressure between the cubes."""

INVERSE = CONTACT_METHODS[2]
"""Method that fits the traction in each contact to the values of the cubes around it."""


UNCERTAIN_PRESSURE = 1200.0
"""Smallest pressure, in Pa at the depth of the cubes' centres, of a new contact above a cube with
the status bit COMPENSATION. The bit says that the compensation of weight, creep or temperature is
uncertain; the limit applies if `ContactFinder.update` is not told how large its errors are.

The compensated values of nine unloaded cubes 24 mm apart gave a pressure of up to 402 Pa when the
ground warmed by 15 K within a minute. If the skin had been tared before, it was up to 860 Pa. A
tare removes the error that the fitted calibration has at rest, and without a tare this error
cancels a part of the error that the warming causes. With smaller distances, the pressures were
lower.
"""

CERTAIN_DEVIATIONS = 2.5
"""Smallest pressure of a new contact, divided by the standard deviation of the pressure that errors
of the compensation cause.

For nine unloaded cubes whose ground warmed by 15 K within a minute, the ratio was at most 2.0,
whether the skin had been tared before or not.
"""


@dataclass(frozen=True)
class ContactSettings:
    """Settings of the search for contacts. The names are those of the node's parameters.

    Attributes:
        method: One of `CONTACT_METHODS`.
        least: Smallest pressure in Pa, at the depth of the cubes, at which a contact is found.
        influence: Name of the file with the influence functions of the pads (influence.py), whose
            depth, thickness and Poisson's ratio replace those of the skin file. Empty: cubes are
            modelled as points. Only the method inverse uses it.
    """

    method: str = AUTO
    least: float = CONTACT_PRESSURE
    influence: str = ""


class ContactFinder(Protocol):
    """Finds the contacts of one skin, by interpolation or by fits (`ContactSettings.method`)."""

    @property
    def contacts(self) -> Sequence[Contact] | Sequence[TrackedContact]:
        """Contacts that the last call of `update` found, the largest normal force first."""

    @property
    def slip(self) -> Slip:
        """Newest slip state and friction of `contacts`; empty if the method is interpolation."""

    @property
    def touch_id(self) -> Index:
        """Number (n,) of the touch (`Touches.id`) to which each of the n `contacts` is linked,
        `NO_TOUCH` without a touch; empty if the method is interpolation."""

    def update(
        self,
        time_s: float,
        values: Array,
        left_out: PadMasks,
        status: StatusBits,
        touches: Touches = NO_TOUCHES,
        errors: Array | None = None,
    ) -> None:
        """Find the contacts in the newest values.

        Args:
            time_s: Time of the newest values in s.
            values: Components (cubes, 15) in Pa and Pa/m, NaN where unknown.
            left_out: Bit masks (cubes,), in which bit k is set if pad k (sensing element) of a cube
                was not used for `values`.
            status: Status bits (cubes,) of `values`.
            touches: Touches in the newest scan.
            errors: Errors (cubes, 15, K) of the values other than noise, as from
                `Reconstructor.errors`. The method inverse includes them in its stated deviations,
                and only finds a new contact if its pressure exceeds `CERTAIN_DEVIATIONS` times the
                deviation that they cause. None: the errors are not known, and a new contact where
                COMPENSATION is set needs `UNCERTAIN_PRESSURE`.
        """

    def follow(self, time_s: float, values: Array) -> bool:
        """Update `slip` from the newest values, without finding the contacts again.

        Args:
            time_s: Time of the values in s.
            values: Components (cubes, 15) in Pa and Pa/m, NaN where unknown.

        Returns:
            Whether a contact has begun to slip.
        """

    def make_cloud(self, values: Array) -> Array | None:
        """Return the traction on the surface as a point cloud; call `update` with `values` before.

        Args:
            values: Components (cubes, 15) of the last `update`.

        Returns:
            One row (M, 6) for each point of the surface: position x, y, z in the skin's parent
            frame in m; pressure, shear and standard deviation of the pressure in Pa. None if the
            method does not compute the traction (interpolation).
        """


def make_contact_finder(
    settings: ContactSettings,
    poses: CubePoses,
    calibrations: Sequence[Calibration],
    elastomer: Elastomer | None = None,
) -> ContactFinder:
    """Create the contact finder for one skin. With the method inverse, this takes seconds.

    Args:
        settings: Method and influence functions.
        poses: Poses of the cubes.
        calibrations: Calibration of each cube.
        elastomer: Elastomer of the skin file. None: the file does not describe it, so it is taken
            as a half space in which the cubes lie `SURFACE_DEPTH` below the surface.

    Raises:
        ElasticError: No cube observes any component, or the influence functions belong to other
            cubes.
        ConfigError: The influence functions cannot be read.
    """
    is_known = elastomer is not None or settings.influence
    automatic = INVERSE if is_known else INTERPOLATION
    method = automatic if settings.method == AUTO else settings.method
    elastomer = elastomer or Elastomer(SURFACE_DEPTH, np.inf)
    if method == INTERPOLATION:
        return _InterpolationFinder(settings, poses, elastomer)
    return _InverseFinder(settings, poses, calibrations, elastomer)


class _InterpolationFinder:
    """Finds contacts in the pressure that is interpolated between the cubes (surface.py)."""

    def __init__(
        self,
        settings: ContactSettings,
        poses: CubePoses,
        elastomer: Elastomer,
    ) -> None:
        self._surface = Surface(poses, elastomer.depth)
        self._threshold = settings.least
        self.contacts: list[Contact] = []
        self.slip = NO_CONTACTS
        self.touch_id = NO_TOUCHES.id

    def update(
        self,
        time_s: float,
        values: Array,
        left_out: PadMasks,
        status: StatusBits,
        touches: Touches = NO_TOUCHES,
        errors: Array | None = None,
    ) -> None:
        self.contacts = self._surface.find_contacts(values, self._threshold)

    def follow(self, time_s: float, values: Array) -> bool:
        return False

    def make_cloud(self, values: Array) -> None:
        return None


class _InverseFinder:
    """Finds contacts by fits to the values of all cubes and follows them from scan to scan."""

    def __init__(
        self,
        settings: ContactSettings,
        poses: CubePoses,
        calibrations: Sequence[Calibration],
        elastomer: Elastomer,
    ) -> None:
        layer = Layer(elastomer.thickness, elastomer.poisson)
        depth = elastomer.depth
        model = None
        if settings.influence:
            influence = read_influence(find_influence(settings.influence))
            # Influence functions hold for one layer and depth, which replace those of the file.
            layer = influence.layer
            depth = influence.depth
            model = model_pads(influence, calibrations)

        by_pad = compute_noise_of_all_pads(calibrations)
        self._pipeline = Pipeline(calibrations)
        self._left_out = np.zeros(len(calibrations), np.uint32)
        self._errors: Array | None = None
        self._inverse = SurfaceInverse.from_poses(
            poses,
            by_pad,
            layer,
            depth,
            model=model,
        )
        self._tracker = ContactTracker(self._inverse, settings.least)
        self._slip = SlipEstimator(self._inverse)
        self._links = TouchLinks(poses)
        self.contacts: list[TrackedContact] = []
        self.touch_id = NO_TOUCHES.id

    @property
    def slip(self) -> Slip:
        return self._slip.slip

    def update(
        self,
        time_s: float,
        values: Array,
        left_out: PadMasks,
        status: StatusBits,
        touches: Touches = NO_TOUCHES,
        errors: Array | None = None,
    ) -> None:
        # The noise of a cube's components depends on the pads in use. So the noise matrices are
        # computed again for cubes whose pads in use have changed since the last scan.
        changed = np.flatnonzero(left_out != self._left_out)
        if len(changed):
            by_pad = compute_noise_by_pad(
                self._pipeline,
                changed,
                left_out[changed],
            )
            self._inverse.leave_out(changed, by_pad)
            self._left_out = left_out.copy()
        if errors is not self._errors:
            self._errors = errors
            self._inverse.state_errors(errors)
        if errors is None:
            is_uncertain = status & COMPENSATION != 0
            certain = np.where(is_uncertain, UNCERTAIN_PRESSURE, 0.0)[self._inverse.cube]
        else:
            certain = CERTAIN_DEVIATIONS * self._inverse.error_deviation
        self.contacts = self._tracker.update(values, certain)
        self._slip.update(
            time_s,
            values,
            self.contacts,
            self._tracker.single_fits,
        )
        self.touch_id = self._links.link(self.contacts, touches)

    def follow(self, time_s: float, values: Array) -> bool:
        return self._slip.update(time_s, values)

    def make_cloud(self, values: Array) -> Array:
        field = self._tracker.field
        along_x, along_y, _ = field.traction.T
        shear = np.hypot(along_x, along_y)
        deviation = self._tracker.deviation(values).pressure
        return np.column_stack([self._inverse.points, field.pressure, shear, deviation])
