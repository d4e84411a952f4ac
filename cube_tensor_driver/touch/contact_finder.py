"""Contacts of a skin by one of two methods, for those who do not care which one it is."""

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
from .pad_noise import noise_by_pad, noise_of_all_pads
from .pad_reading import read_pads
from .surface import Contact, Surface
from .tracker.touches import Touches, TrackedContact

INTERPOLATION, INVERSE = CONTACT_METHODS


@dataclass(frozen=True)
class ContactSettings:
    """How contacts are found.

    method: of CONTACT_METHODS; depth: from the cubes' centres to the surface, m; least: pressure
    at the cubes that counts as contact, Pa
    thickness: of the elastomer over rigid ground, m, 0: a half space; poisson: of the elastomer;
    both for the method inverse
    influence: for the method inverse, which influence functions the pads have (influence_file.py);
    then depth, thickness and poisson are theirs. Empty: cubes count as points
    """

    method: str = INTERPOLATION
    depth: float = SURFACE_DEPTH
    least: float = CONTACT_PRESSURE
    thickness: float = 0.0
    poisson: float = POISSONS_RATIO
    influence: str = ""

    @property
    def layer(self) -> Layer:
        """ElasticError: no layer is like that."""
        return Layer(self.thickness or np.inf, self.poisson)

    def check(self) -> None:
        """ElasticError: there is no such layer, or it does not have this depth. ConfigError: there
        are no such influence functions."""
        self.layer.check_depth(self.depth)
        if self.influence:
            find_influence(self.influence)


class ContactFinder(Protocol):
    """Finds the contacts of one skin."""

    def update(self, values: Array, left_out: PadMasks) -> list[Contact] | list[TrackedContact]:
        """Contacts of the newest values (cubes, 15), NaN where unknown; strongest first. left_out:
        (cubes,) bits of pads that the values are without."""

    def cloud(self, values: Array) -> Array | None:
        """(M, 6) the surface after `update` of these values: place in the skin's parent frame, m,
        pressure, shear and the standard deviation of the pressure, Pa. None: not known."""


def contact_finder(
    settings: ContactSettings, poses: CubePoses, calibrations: Sequence[Calibration]
) -> ContactFinder:
    """The finder of these settings for cubes with these poses and calibrations.

    ElasticError, ConfigError: nothing to compute with. The method inverse takes seconds to set up.
    """
    if settings.method == INTERPOLATION:
        return _Interpolated(settings, poses)
    return _Followed(settings, poses, calibrations)


class _Interpolated:
    def __init__(self, settings: ContactSettings, poses: CubePoses) -> None:
        self._surface, self._least = Surface(poses, settings.depth), settings.least

    def update(self, values: Array, left_out: PadMasks) -> list[Contact]:
        return self._surface.contacts(values, self._least)

    def cloud(self, values: Array) -> None:
        return None


class _Followed:
    def __init__(
        self,
        settings: ContactSettings,
        poses: CubePoses,
        calibrations: Sequence[Calibration],
    ) -> None:
        layer, depth, reading = settings.layer, settings.depth, None
        if settings.influence:
            influence = read_influence(find_influence(settings.influence))
            layer, depth = influence.layer, influence.depth
            reading = read_pads(influence, calibrations)
        by_pad = noise_of_all_pads(calibrations)
        self._pipeline = Pipeline(calibrations)
        self._left_out = np.zeros(len(calibrations), np.uint32)
        self._inverse = SurfaceInverse.of_cubes(poses, by_pad, layer, depth, reading=reading)
        self._touches = Touches(self._inverse, settings.least)

    def update(self, values: Array, left_out: PadMasks) -> list[TrackedContact]:
        changed = np.flatnonzero(left_out != self._left_out)
        if len(changed):
            by_pad = noise_by_pad(self._pipeline, changed, left_out[changed])
            self._inverse.leave_out(changed, by_pad)
            self._left_out = left_out.copy()
        return self._touches.update(values)

    def cloud(self, values: Array) -> Array:
        field = self._touches.field
        shear = np.hypot(field.traction[:, 0], field.traction[:, 1])
        sigma = self._touches.deviation(values).pressure
        return np.column_stack([self._inverse.points, field.pressure, shear, sigma])
