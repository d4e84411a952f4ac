# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Accuracy of the surface's traction from all cubes: errors and predicted deviations against truth.

Contacts press anywhere in the cell between four cubes of a flat skin. Their stress comes from the
point forces of contact.py, not from what the inverse uses. It goes through the whole chain: pads
whose gains are known to `GAIN_ERROR`, the pad law, a counter's noise, the pipeline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from cube_tensor_driver.config.calibration import (
    find_calibration,
    read_calibration,
)
from cube_tensor_driver.core.arrays import Array, PadMasks
from cube_tensor_driver.core.defaults import (
    CONTACT_PRESSURE,
    FREQUENCY_NOISE,
    POISSONS_RATIO,
)
from cube_tensor_driver.core.modes import to_gradient_tensor
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.core.tensor import rotate_gradient, rotate_stress, rotation_from_rpy
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.mechanics.contact_response import ContactResponse
from cube_tensor_driver.mechanics.influence import Influence
from cube_tensor_driver.mechanics.layer import Layer
from cube_tensor_driver.mechanics.measurement_model import CubeMeasurement
from cube_tensor_driver.touch.inverse import SurfaceInverse
from cube_tensor_driver.touch.pad_measurement import model_pads
from cube_tensor_driver.touch.pad_noise import compute_noise_of_all_pads
from cube_tensor_driver.touch.surface import Contact, Surface
from cube_tensor_driver.touch.tracker.contact_tracker import ContactTracker, TrackedContact

from .field_study import (
    FORCE,
    FRICTION,
    WINDOW,
    FieldExample,
    compute_field_below,
    draw_force,
    make_flat_skin,
)

CUBES = ("24-pad", "planar", "planar, crosswise")
"""Kinds of cubes on a skin. Crosswise means that every second planar cube is turned by a quarter
about z."""
METHODS = ("interpolation", "inverse", "inverse with contacts")
"""Methods that compute the pressure between the cubes: interpolation of the cubes' stresses; the
inverse, which estimates the surface traction that explains all stresses; and the inverse after
contacts were fitted, for the part that these do not explain."""
SHAPES = ("ball", "flat punch")
"""Shapes of the load. `./cube bench contacts` has more."""
GAIN_ERROR = 0.01
"""Standard deviation of the error of a pad's calibrated gain, relative to the gain. The inverse
assumes the value in pad_noise.py."""
CASES = 16
"""Number of random loads for each setting and contact width."""
SKIN_SIDE = 0.072
"""Side of the square skin, in m."""
ORDER = 14
"""Order of the quadrature (number of rings of point forces) of a ball. With it the error of the
stress at 4 mm below a contact of 20 mm is within 1e-3 of the peak."""
SURFACE_ORDER = 100
"""Order of the quadrature (number of rings of point forces) of a ball with which the pressure on
the surface itself is computed."""
MIN_PRESSURE_SHARE = 0.1
"""Share of the peak pressure below which a point does not count for the calibration ratio (rms
error over predicted deviation) of a pressure field."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One skin and its loads; lengths in m.

    The inverse knows the first five values, and takes the elastomer for a layer of
    `known_thickness`. The others are true and not known to it.

    Attributes:
        cubes: One of `CUBES`.
        pitch: Distance between neighbouring cubes.
        depth: Depth of the cubes' centres.
        shape: One of `SHAPES`.
        known_thickness: Thickness of the elastomer as the inverse knows it; infinite for a half
            space.
        depth_error: How much deeper the cubes are than `depth`.
        poisson: True Poisson's ratio of the elastomer.
        thickness: True thickness of the elastomer.
        gain_error: Standard deviation of the pads' gains, relative to the calibrated ones.
        side: Side of the square skin; it is at least five pitches.
    """

    cubes: str = CUBES[0]
    pitch: float = 8e-3
    depth: float = 5e-3
    shape: str = SHAPES[0]
    known_thickness: float = np.inf
    depth_error: float = 0.0
    poisson: float = POISSONS_RATIO
    thickness: float = np.inf
    gain_error: float = GAIN_ERROR
    side: float = SKIN_SIDE


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors for loads of one width on one skin; several contacts of one load count together.

    A calibration ratio is an rms error over the predicted standard deviation.

    Attributes:
        width: Width of the contact, in m.
        field: (3,) rms error of the pressure at the cubes' depth over its rms, by `METHODS`.
        force: (2,) rms error of the normal force over the force: of interpolation, and of the
            inverse with contacts.
        position: (2,) 95th percentile of the position error, in m, of these two methods.
        ratio: (2, 2) calibration ratios of force and position (columns) of these two methods
            (rows).
        field_ratio: (2,) calibration ratios of the pressure with contacts, at the cubes' depth and
            on the surface, where it exceeds `MIN_PRESSURE_SHARE` of its peak.
        found: Share of the loads for which exactly one contact was found.
    """

    width: float
    field: Array
    force: Array
    position: Array
    ratio: Array
    field_ratio: Array
    found: float


class TractionBench:
    """A skin of one setting, its inverse, and loads on it.

    Attributes:
        setting: The setting.
        poses: Poses of the cubes.
        calibration: Calibration of all cubes.
        inverse: Computes the traction on the surface at M points.
        surface: Interpolates the pressure between the cubes.
        window: (M,) whether a point is in the middle of the skin, where errors are computed.
    """

    def __init__(
        self,
        setting: Setting,
        side: int | None = 4,
        influence: Influence | None = None,
    ) -> None:
        """Set up the inverse.

        Args:
            setting: Skin and loads.
            side: Number of points along the side of a cube's patch, the square grid around it.
                None: as many as the inverse chooses.
            influence: Influence functions that the inverse assumes; None: cubes count as points.
        """
        self.setting = setting
        self.poses = _place_cubes(setting)
        layout = "cube" if setting.cubes == CUBES[0] else "planar"
        self.calibration = read_calibration(find_calibration(layout, Path()))
        calibrations = [self.calibration] * len(self.poses.position)
        self._pipeline = Pipeline(calibrations)

        # What the inverse assumes: noise of the pads, their response, and the layer.
        by_pad = compute_noise_of_all_pads(calibrations)
        reading = None if influence is None else model_pads(influence, calibrations)
        known_layer = Layer(setting.known_thickness)
        self.inverse = SurfaceInverse.from_poses(
            self.poses,
            by_pad,
            known_layer,
            setting.depth,
            side,
            reading,
        )
        self.surface = Surface(self.poses, setting.depth, side or 2)
        points = np.abs(self.inverse.points[:, :2])
        from_centre = points.max(axis=1)
        self.window = from_centre < WINDOW / 2

        self._true_layer: ContactResponse | None = None
        if np.isfinite(setting.thickness):
            layer = Layer(setting.thickness, setting.poisson)
            cubes = CubeMeasurement(layer, setting.depth, 1.0)
            self._true_layer = ContactResponse(cubes)

    def compute_truth(
        self,
        points: Array,
        width: float,
        force: Array,
        centre: Array,
    ) -> Array:
        """Return true stress and gradient (N, 6 + 18), in Pa and Pa/m, at the cubes' depth below
        points (N, 2) of the surface, in m."""
        # For a layer, a table holds the fields under unit forces of a ball. The half space has a
        # closed form.
        if self._true_layer is not None:
            unit_fields = self._true_layer.compute_field(points - centre, width / 2)
            return unit_fields @ force
        depth = self.setting.depth + self.setting.depth_error
        load = self.compute_point_forces(width, force, centre)
        return compute_field_below(points, depth, load, self.setting.poisson)

    def compute_surface_truth(
        self,
        width: float,
        force: Array,
        centre: Array,
    ) -> Array:
        """Return the true pressure (M,) on the surface, in Pa, as the mean over the square of each
        point of the inverse."""
        inverse = self.inverse
        sources, forces = self.compute_point_forces(
            width,
            force,
            centre,
            SURFACE_ORDER,
        )
        # Each point force counts for the square in which it lies.
        tree = cKDTree(inverse.points[:, :2])
        nearest = tree.query(sources[:, :2])[1]
        total = np.bincount(nearest, -forces[:, 2], len(inverse.points))
        return total / inverse.area

    def compute_point_forces(
        self,
        width: float,
        force: Array,
        centre: Array,
        order: int = ORDER,
    ) -> tuple[Array, Array]:
        """Return the load as point forces: positions (S, 3) in m and forces (S, 3) in N."""
        distribute = make_flat_punch if self.setting.shape == "flat punch" else contact.hertz
        return distribute(width / 2, force, centre, order)

    def compute_values(
        self,
        width: float,
        force: Array,
        centre: Array,
        random: np.random.Generator,
    ) -> Array:
        """Return stress and gradient (cubes, 15), in Pa and Pa/m, that the pipeline computes under
        a load."""
        return self.measure(self.compute_pads_under(width, force, centre), random)

    def compute_pads_under(
        self,
        width: float,
        force: Array,
        centre: Array,
    ) -> Array:
        """Return the pad stresses (cubes, P), in Pa, under a load."""
        cubes = self.poses.position[:, :2]
        return self.compute_pads_in(self.compute_truth(cubes, width, force, centre))

    def compute_pads_in(self, field: Array) -> Array:
        """Return the pad stresses (cubes, P), in Pa, in a field (cubes, 6 + 18) of stress and
        gradient in the skin's frame."""
        calibration = self.calibration
        # Tensors of the skin's frame become those of each cube's frame.
        to_cube = self.poses.rotation.swapaxes(1, 2)
        stress = rotate_stress(field[:, :6], to_cube)
        gradient = to_gradient_tensor(field[:, 6:].reshape(-1, 6, 3))
        gradient = rotate_gradient(gradient, to_cube)
        amplitudes = calibration.modes.compute_amplitudes(stress, calibration.half_side * gradient)
        return amplitudes @ calibration.response.T

    def measure(
        self,
        pads: Array,
        random: np.random.Generator,
        left_out: PadMasks | None = None,
    ) -> Array:
        """Return stress and gradient (cubes, 15), in Pa and Pa/m, that the pipeline computes.

        Args:
            pads: (cubes, P) true stresses of the pads, in Pa.
            random: Source of the gain errors and of the counter's noise.
            left_out: (cubes,) one bit for each pad that is not used.
        """
        calibration = self.calibration
        gain = 1 + self.setting.gain_error * random.standard_normal(pads.shape)
        pads = pads * gain
        rest = calibration.rest_frequency
        frequency = compute_pad_frequency(
            pads,
            rest,
            calibration.beta,
            calibration.modulus,
        )
        frequency *= 1 + FREQUENCY_NOISE * random.standard_normal(frequency.shape)
        rows = FrequencyRows.from_values(np.arange(len(frequency)), frequency)
        result = self._pipeline.process(rows, left_out)
        return np.concatenate([result.stress, result.gradient], axis=1)

    def draw_load(self, random: np.random.Generator) -> tuple[Array, Array]:
        """Return a random force (3,) in N, and its position (2,) in the cell around the middle
        cube, in m."""
        force = draw_force(random)
        return force, self.setting.pitch * (random.random(2) - 0.5)

    def compute_errors(
        self,
        width: float,
        cases: int = CASES,
        seed: int = 8,
    ) -> Errors:
        """Return the errors for random loads of this width; a seed gives the same loads."""
        random = np.random.default_rng(seed)
        results = [self._compute_case_errors(width, random) for _ in range(cases)]
        field, found, below, surface, is_single = zip(*results, strict=True)
        force, force_deviation, position, position_deviation = np.moveaxis(
            np.array(found),
            2,
            0,
        )
        ratio = [force / force_deviation, position / position_deviation]
        field_ratio = [np.concatenate(squares).mean() for squares in (below, surface)]
        return Errors(
            width=width,
            field=np.sqrt(np.mean(field, axis=0)),
            force=np.sqrt(np.mean(force**2, axis=0)) / FORCE,
            position=np.percentile(position, 95, axis=0),
            ratio=np.sqrt(np.nanmean(np.square(ratio), axis=1)).T,
            field_ratio=np.sqrt(field_ratio),
            found=float(np.mean(is_single)),
        )

    def _compute_case_errors(
        self,
        width: float,
        random: np.random.Generator,
    ) -> tuple[Array, list[ContactErrors], Array, Array, bool]:
        """Return the errors for one random load.

        Returns:
            Mean square error of the pressure over its mean square, by `METHODS`. Errors of the
            contacts of interpolation, and of the inverse. Squares of the errors of the pressure
            with contacts over the predicted variance, at the cubes' depth, and on the surface.
            Whether the inverse found one contact.
        """
        force, centre = self.draw_load(random)
        # Near the edge of the skin there are cubes on one side only, so it does not count.
        points = self.inverse.points[self.window, :2]
        true = -self.compute_truth(points, width, force, centre)[:, 2]
        values = self.compute_values(width, force, centre, random)
        interpolated = self.surface.find_contacts(values, CONTACT_PRESSURE)
        tracker, tracked, pressures = self._solve(values)
        errors = np.array(pressures)[:, self.window] - true
        mean_square = (true**2).mean()
        field = (errors**2).mean(axis=1) / mean_square

        predicted = tracker.deviation(values)
        on_surface = self.compute_surface_truth(width, force, centre)
        below = errors[-1] / predicted.depth_pressure[self.window]
        surface = (tracker.field.pressure - on_surface) / predicted.pressure
        found = [sum_contact_errors(contacts, centre) for contacts in (interpolated, tracked)]
        return (
            field,
            found,
            below[true > MIN_PRESSURE_SHARE * true.max()] ** 2,
            surface[on_surface > MIN_PRESSURE_SHARE * on_surface.max()] ** 2,
            len(tracked) == 1,
        )

    def _solve(self, values: Array) -> tuple[ContactTracker, list[TrackedContact], list[Array]]:
        """Return the contact tracker after one update, the contacts, and the pressure (M,) at the
        cubes' depth by each of `METHODS`, in Pa.

        Args:
            values: Stress and gradient (cubes, 15) of the cubes, in Pa and Pa/m.
        """
        tracker = ContactTracker(self.inverse, CONTACT_PRESSURE)
        tracked = tracker.update(values, max_work=np.inf)
        pressures = [
            self.surface.field(values).pressure,
            self.inverse.field(values).depth_pressure,
            tracker.field.depth_pressure,
        ]
        return tracker, tracked, pressures

    def compute_example(self, width: float, centre: Array) -> FieldExample:
        """Return the pressure at the cubes' depth under one load with friction along x.

        The pressures are the true one, that of each of `METHODS`, and the "standard deviation" that
        the inverse predicts, in Pa.

        Args:
            width: Width of the contact, in m.
            centre: (2,) position of the contact, in m.
        """
        force = FORCE * np.array([FRICTION, 0.0, -1.0])
        values = self.compute_values(
            width,
            force,
            centre,
            np.random.default_rng(1),
        )
        points = self.inverse.points
        tracker, _, pressures = self._solve(values)
        pressure = {
            "truth": -self.compute_truth(points[:, :2], width, force, centre)[:, 2],
            **dict(zip(METHODS, pressures, strict=True)),
            "standard deviation": tracker.deviation(values).depth_pressure,
        }
        return FieldExample(points, pressure, self.poses.position, centre)

    def study(
        self,
        widths: Sequence[float],
        cases: int = CASES,
        seed: int = 8,
    ) -> list[Errors]:
        """Return the errors for random loads of each width (m); a seed gives the same loads."""
        return [self.compute_errors(width, cases, seed) for width in widths]


class ContactErrors(NamedTuple):
    """Errors of the contacts of one load, which count together.

    Attributes:
        force: Error of the normal force in N.
        force_deviation: Predicted standard deviation of the normal force in N.
        position: Distance of the centre of pressure from the true one in m.
        position_deviation: Predicted standard deviation of this distance in m.
    """

    force: float
    force_deviation: float
    position: float
    position_deviation: float


def sum_contact_errors(
    contacts: Sequence[Contact | TrackedContact],
    centre: Array,
) -> ContactErrors:
    """Return the errors of contacts that are summed as if they were independent of each other.

    Args:
        contacts: The contacts. Without any, the whole force is missing, `WINDOW` away.
        centre: (2,) true centre of pressure in m.
    """
    if not contacts:
        return ContactErrors(-FORCE, np.nan, WINDOW, np.nan)
    forces = np.array([one.normal_force for one in contacts])
    force_deviations = np.array([one.force_uncertainty for one in contacts])
    positions = np.array([one.position[:2] for one in contacts])
    # The deviation is that of each of two coordinates, while the error is a distance.
    coordinates = np.array([one.position_uncertainty for one in contacts])
    position_deviations = np.sqrt(2) * coordinates
    total = float(forces.sum())
    found = forces @ positions / total
    # The uncertain force of a contact moves the centre along the line to the contact.
    lever = np.linalg.norm(positions - found, axis=1)
    moments = np.hypot(forces * position_deviations, lever * force_deviations)
    return ContactErrors(
        force=total - FORCE,
        force_deviation=float(np.linalg.norm(force_deviations)),
        position=float(np.linalg.norm(found - centre)),
        position_deviation=float(np.linalg.norm(moments)) / total,
    )


def _place_cubes(setting: Setting) -> CubePoses:
    skin = make_flat_skin(setting.pitch, max(setting.side, 5 * setting.pitch))
    if setting.cubes != "planar, crosswise":
        return skin
    cell = np.round(skin.position[:, :2] / setting.pitch)
    is_turned = cell.astype(int).sum(axis=1) % 2 == 1
    quarter = rotation_from_rpy(0, 0, np.pi / 2)
    rotation = np.where(is_turned[:, None, None], quarter, np.eye(3))
    return skin._replace(rotation=rotation)


def compute_traction_example() -> FieldExample:
    """Return the pressure under a contact of 6 mm between planar cubes, every second one turned."""
    setting = Setting(cubes=CUBES[2], pitch=10e-3, depth=4e-3)
    centre = setting.pitch * np.array([0.35, 0.25])
    return TractionBench(setting, side=10).compute_example(6e-3, centre)


def make_flat_punch(
    radius: float,
    force: Array,
    centre: Array,
    order: int,
) -> tuple[Array, Array]:
    """Return the load of a rigid flat punch as point forces.

    The traction is F / (2 pi a sqrt(a^2 - r^2)) (Johnson, Contact Mechanics, 3.8).

    Args:
        radius: Radius a of the punch, in m.
        force: Force F (3,) on the skin, in N.
        centre: (2,) position of the centre of the punch, in m.
        order: Number of rings; each has four times as many points.
    """
    sources, forces = contact.hertz(radius, force, centre, order)
    # The rings are Gauss points of s = sqrt(1 - r^2 / a^2), in which Hertz's traction is 3 s^2 and
    # that of the punch is uniform.
    from_centre = sources[:, :2] - centre
    r_square = (from_centre**2).sum(axis=1)
    s_square = 1 - r_square / radius**2
    return sources, forces / (3 * s_square[:, None])


def study_tractions(
    settings: Sequence[Setting],
    widths: Sequence[float],
    cases: int = CASES,
    seed: int = 8,
) -> dict[Setting, list[Errors]]:
    """Return the errors of each setting for loads of each width (m)."""
    return {setting: TractionBench(setting).study(widths, cases, seed) for setting in settings}


MAIN = tuple(Setting(cubes=cubes) for cubes in CUBES)
"""Skins with a pitch of 8 mm and a depth of 5 mm. The elastomer is a half space, as the inverse
assumes."""
PITCHES = tuple(
    Setting(
        cubes=cubes,
        pitch=pitch,
        depth=4e-3,
    )
    for pitch in (12e-3, 24e-3)
    for cubes in CUBES[:2]
)
"""Skins with pitches (distances between neighbouring cubes) of 12 and 24 mm and a depth of 4 mm."""
WRONG = {
    "everything as known": Setting(),
    "5 % gain spread": Setting(gain_error=0.05),
    "cubes 0.5 mm deeper": Setting(depth_error=0.5e-3),
    "Poisson's ratio 0.46": Setting(poisson=0.46),
    "layer of 11 mm taken for a half space": Setting(thickness=11e-3),
    "layer of 11 mm, known": Setting(thickness=11e-3, known_thickness=11e-3),
    "flat punch instead of a ball": Setting(shape="flat punch"),
}
"""Skins about which the inverse assumes something wrong, by what is wrong. The first one has no
wrong assumption, for comparison."""
