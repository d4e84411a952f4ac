"""Contacts of a skin by one of two methods, behind one interface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..config.influence import find_influence
from ..core.arrays import Array, PadMasks
from ..core.calibration import Calibration
from ..core.defaults import CONTACT_METHODS, CONTACT_PRESSURE, POISSONS_RATIO, SURFACE_DEPTH
from ..core.pipeline import Pipeline
from ..core.poses import CubePoses
from ..mechanics.influence_file import read_influence
from ..mechanics.layer import Layer
from .inverse import SurfaceInverse
from .pad_measurement import model_pads
from .pad_noise import noise_by_pad, noise_of_all_pads
from .surface import Contact, Surface
from .tracker.contact_tracker import ContactTracker, TrackedContact

INTERPOLATION, INVERSE = CONTACT_METHODS


@dataclass(frozen=True)
class ContactSettings:
    """Settings of the search for contacts. The names are those of the node's parameters.

    Attributes:
        method: One of `CONTACT_METHODS`.
        depth: Distance from the centres of the cubes to the surface, in m.
        least: Pressure at the depth of the cubes, in Pa, from which on something is a contact.
        thickness: Thickness of the elastomer on rigid ground in m, for the method inverse; 0 for a
            half space.
        poisson: Poisson's ratio of the elastomer. Used by the method inverse.
        influence: Name of the influence functions of the pads (influence_file.py), which then
            determine depth, thickness and Poisson's ratio; empty: cubes are modelled as points.
            Used by the method inverse.
    """

    method: str = INTERPOLATION
    depth: float = SURFACE_DEPTH
    least: float = CONTACT_PRESSURE
    thickness: float = 0.0
    poisson: float = POISSONS_RATIO
    influence: str = ""

    @property
    def layer(self) -> Layer:
        """Layer of these settings.

        Raises:
            ElasticError: Thickness or Poisson's ratio is out of range.
        """
        return Layer(self.thickness or np.inf, self.poisson)

    def check(self) -> None:
        """Check the settings.

        Raises:
            ElasticError: There is no such layer, or it does not contain the depth.
            ConfigError: The influence functions do not exist.
        """
        self.layer.check_depth(self.depth)
        if self.influence:
            find_influence(self.influence)


class ContactFinder(Protocol):
    """Finds the contacts of one skin."""

    def update(self, values: Array, left_out: PadMasks) -> list[Contact] | list[TrackedContact]:
        """Find the contacts in the newest values.

        Args:
            values: Components (cubes, 15), NaN where unknown.
            left_out: Bits (cubes,) of the pads that were left out of the values.

        Returns:
            Contacts, strongest first.
        """

    def cloud(self, values: Array) -> Array | None:
        """Return the surface after `update` with these values.

        Returns:
            Position in the skin's parent frame in m, pressure, shear and standard deviation of the
            pressure in Pa (M, 6); None if the method does not compute the surface.
        """


def contact_finder(
    settings: ContactSettings,
    poses: CubePoses,
    calibrations: Sequence[Calibration],
) -> ContactFinder:
    """Create the finder of these settings; the method inverse takes seconds.

    Args:
        settings: Method and properties of the elastomer.
        poses: Poses of the cubes.
        calibrations: Calibration of each cube.

    Raises:
        ElasticError: The settings and the cubes do not fit together.
        ConfigError: The influence functions cannot be read.
    """
    if settings.method == INTERPOLATION:
        return _InterpolationFinder(settings, poses)
    return _InverseFinder(settings, poses, calibrations)


class _InterpolationFinder:
    """Contacts from the interpolated pressure."""

    def __init__(self, settings: ContactSettings, poses: CubePoses) -> None:
        self._surface = Surface(poses, settings.depth)
        self._threshold = settings.least

    def update(self, values: Array, left_out: PadMasks) -> list[Contact]:
        return self._surface.contacts(values, self._threshold)

    def cloud(self, values: Array) -> None:
        return None


class _InverseFinder:
    """Contacts that are tracked by fits to the values of all cubes."""

    def __init__(
        self,
        settings: ContactSettings,
        poses: CubePoses,
        calibrations: Sequence[Calibration],
    ) -> None:
        layer = settings.layer
        depth = settings.depth
        model = None
        if settings.influence:
            influence = read_influence(find_influence(settings.influence))
            # The influence functions hold for one layer and depth only.
            layer = influence.layer
            depth = influence.depth
            model = model_pads(influence, calibrations)

        by_pad = noise_of_all_pads(calibrations)
        self._pipeline = Pipeline(calibrations)
        self._left_out = np.zeros(len(calibrations), np.uint32)
        self._inverse = SurfaceInverse.from_poses(poses, by_pad, layer, depth, model=model)
        self._tracker = ContactTracker(self._inverse, settings.least)

    def update(self, values: Array, left_out: PadMasks) -> list[TrackedContact]:
        # Noise matrices are computed again only for cubes whose pads in use have changed.
        changed = np.flatnonzero(left_out != self._left_out)
        if len(changed):
            by_pad = noise_by_pad(self._pipeline, changed, left_out[changed])
            self._inverse.leave_out(changed, by_pad)
            self._left_out = left_out.copy()
        return self._tracker.update(values)

    def cloud(self, values: Array) -> Array:
        field = self._tracker.field
        shear = np.hypot(field.traction[:, 0], field.traction[:, 1])
        deviation = self._tracker.deviation(values).pressure
        return np.column_stack(
            [
                self._inverse.points,
                field.pressure,
                shear,
                deviation,
            ]
        )
