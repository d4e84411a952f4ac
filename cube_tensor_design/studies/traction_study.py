"""What the surface's traction from all cubes is worth: errors and stated deviations against truth.

Contacts press anywhere in the cell between four cubes of a flat skin. Their stress comes from the
point forces of contact.py, not from what the inverse uses. It goes through the whole chain: pads
whose gains are known to GAIN_ERROR, the pad law, a counter's noise, the pipeline.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from cube_tensor_driver.config.calibration import find_calibration, read_calibration
from cube_tensor_driver.config.package_data import package_data
from cube_tensor_driver.core.arrays import Array, PadMasks
from cube_tensor_driver.core.calibration import Calibration
from cube_tensor_driver.core.defaults import CONTACT_PRESSURE, FREQUENCY_NOISE, POISSONS_RATIO
from cube_tensor_driver.core.modes import to_matrix
from cube_tensor_driver.core.oscillator import pad_frequency
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.core.tensor import rotation_from_rpy
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.mechanics.influence import Influence
from cube_tensor_driver.mechanics.kernels import Kernels
from cube_tensor_driver.mechanics.layer import Layer
from cube_tensor_driver.touch.inverse import SurfaceInverse
from cube_tensor_driver.touch.pad_measurement import model_pads
from cube_tensor_driver.touch.pad_noise import noise_of_all_pads
from cube_tensor_driver.touch.surface import Surface
from cube_tensor_driver.touch.tracker.contact_tracker import ContactTracker

from .field_study import FORCE, FRICTION, WINDOW, FieldExample, flat_skin

CUBES = ("24-pad", "planar", "planar, crosswise")
METHODS = ("interpolation", "inverse", "inverse with contacts")
SHAPES = ("ball", "flat punch", "rounded punch", "two balls")
"""A rounded punch is the mean of flat ones from 0.6 of its radius on. Two balls touch each other,
and together are as wide as a ball."""
GAIN_ERROR = 0.01
"""Standard deviation of a pad's true gain against its calibration; pad_noise.py has what the
inverse takes it for."""
CASES = 16
_SIDE = 0.072
_ORDER, _SURFACE_ORDER = 14, 100
"""Of the quadrature of a ball: stress at 4 mm below one of 20 mm is within 1e-3 of its peak; the
second one is for the surface itself."""
PRESSED = 0.1


@dataclass(frozen=True)
class Setting:
    """One skin and its loads: lengths in m. What follows `known_thickness` is true and
    not known to the inverse.

    depth: of the cubes; gain_error: of pads; thickness: of the elastomer, inf: a half space
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


@dataclass(frozen=True, eq=False)
class Errors:
    """Of loads of one width (m) on one skin; several contacts of one load count together.

    field: rms error of the pressure at the cubes' depth over its rms, of each of METHODS
    force: rms error of the normal force over the force; place: 95th percentile, m; both of the
        interpolation and of the contacts
    seen: rms of force error and of place error, over what was stated; of interpolation and contacts
    seen_field: rms of the errors of pressure over their stated deviations, with contacts: at the
        cubes' depth and on the surface, where it exceeds PRESSED of its peak
    found: part of the loads with exactly one contact
    """

    width: float
    field: Array
    force: Array
    place: Array
    seen: Array
    seen_field: Array
    found: float


class Bench:
    """A skin of one setting, its inverse, and loads on it."""

    def __init__(self, setting: Setting, side: int = 4, influence: Influence | None = None) -> None:
        """side: points along the side of a cube's patch; influence: what the inverse takes the pads
        for, None: cubes count as points"""
        self.setting = setting
        skin = flat_skin(setting.pitch, max(_SIDE, 5 * setting.pitch))
        n = len(skin.position)
        self.poses = skin
        if setting.cubes == CUBES[2]:
            across = np.round(skin.position[:, :2] / setting.pitch).sum(axis=1).astype(int) % 2 == 1
            turned = np.where(across[:, None, None], rotation_from_rpy(0, 0, np.pi / 2), np.eye(3))
            self.poses = skin._replace(rotation=turned)
        name = "cube.yaml" if setting.cubes == CUBES[0] else "planar.yaml"
        folder = package_data() / "config" / "calibration"
        self.calibration: Calibration = read_calibration(find_calibration(name, folder))
        self._pipeline = Pipeline([self.calibration] * n)
        by_pad = noise_of_all_pads([self.calibration] * n)
        layer, reading = Layer(setting.known_thickness), None
        if influence is not None:
            reading = model_pads(influence, [self.calibration] * n)
        self.inverse = SurfaceInverse.from_poses(
            self.poses, by_pad, layer, setting.depth, side, reading
        )
        self.surface = Surface(self.poses, setting.depth, side)
        self.window = np.abs(self.inverse.points[:, :2]).max(axis=1) < WINDOW / 2
        self._layer: Kernels | None = None
        if np.isfinite(setting.thickness):
            layer = Layer(setting.thickness, setting.poisson)
            self._layer = Kernels(layer, setting.depth, 1.0)

    def truth(self, points: Array, width: float, force: Array, centre: Array) -> Array:
        """(N, 24) stress and its gradient, Pa and Pa/m, below points (N, 2)."""
        depth = self.setting.depth + self.setting.depth_error
        sources, forces = self._load(width, force, centre)
        if self._layer is not None:
            return self._layer.field(points - centre, width / 2) @ force
        below = np.column_stack([points, np.full(len(points), -depth)])
        stress, gradient = contact.field(below, sources, forces, self.setting.poisson)
        return np.concatenate([stress, gradient.reshape(len(points), 18)], axis=1)

    def surface_truth(self, width: float, force: Array, centre: Array) -> Array:
        """(M,) pressure on the surface, Pa, as the mean over the square of each point."""
        inverse = self.inverse
        sources, forces = self._load(width, force, centre, _SURFACE_ORDER)
        nearest = cKDTree(inverse.points[:, :2]).query(sources[:, :2])[1]
        total = np.bincount(nearest, -forces[:, 2], len(inverse.points))
        return np.asarray(total / inverse.area)

    def _load(
        self, width: float, force: Array, centre: Array, order: int = _ORDER
    ) -> tuple[Array, Array]:
        shape, radius = self.setting.shape, width / 2
        if shape == SHAPES[0]:
            return contact.hertz(radius, force, centre, order)
        if shape == SHAPES[1]:
            return flat_punch(radius, force, centre, order)
        if shape == SHAPES[2]:
            radii = np.linspace(0.6, 1.0, 8) * radius
            parts = [flat_punch(one, force / 8, centre, order) for one in radii]
        else:
            apart = radius / 2 * np.array([0.8, 0.6])
            places = (centre - apart, centre + apart)
            parts = [contact.hertz(radius / 2, force / 2, place, order) for place in places]
        sources, forces = zip(*parts, strict=True)
        return np.concatenate(sources), np.concatenate(forces)

    def values(
        self, width: float, force: Array, centre: Array, random: np.random.Generator
    ) -> Array:
        """(cubes, 15) what the pipeline makes of a load."""
        return self.measured(self.pads_under(width, force, centre), random)

    def pads_under(self, width: float, force: Array, centre: Array) -> Array:
        """(cubes, P) pad stresses, Pa, under a load."""
        return self.pads_in(self.truth(self.poses.position[:, :2], width, force, centre))

    def pads_in(self, field: Array) -> Array:
        """(cubes, P) pad stresses, Pa, in a field (cubes, 24) in the skin's frame."""
        calibration, turn = self.calibration, self.poses.rotation
        stress = np.einsum("nai,nbj,nab->nij", turn, turn, to_matrix(field[:, :6]))
        gradient = to_matrix(field[:, 6:].reshape(-1, 6, 3).swapaxes(1, 2))  # (n, axis, 3, 3)
        gradient = np.einsum("nai,nbj,nck,ncab->nijk", turn, turn, turn, gradient)
        state = calibration.modes.state(stress, calibration.half_side * gradient)
        return np.asarray(state @ calibration.response.T)

    def measured(
        self, pads: Array, random: np.random.Generator, left_out: PadMasks | None = None
    ) -> Array:
        """(cubes, 15) what the pipeline makes of pad stresses (cubes, P), Pa. left_out: (cubes,)
        bits of pads."""
        calibration = self.calibration
        pads = pads * (1 + self.setting.gain_error * random.standard_normal(pads.shape))
        rest = calibration.rest_frequency
        hertz = pad_frequency(pads, rest, calibration.beta, calibration.modulus)
        hertz *= 1 + FREQUENCY_NOISE * random.standard_normal(hertz.shape)
        rows = self._pipeline.process(FrequencyRows.of(np.arange(len(hertz)), hertz), left_out)
        return np.concatenate([rows.stress, rows.gradient], axis=1)

    def load(self, random: np.random.Generator) -> tuple[Array, Array]:
        """A force (3,) and where it acts (2,), in the cell in the middle."""
        angle = 2 * np.pi * random.random()
        force = FORCE * np.array([FRICTION * np.cos(angle), FRICTION * np.sin(angle), -1.0])
        return force, self.setting.pitch * (random.random(2) - 0.5)

    def errors(self, width: float, cases: int = CASES, seed: int = 8) -> Errors:
        """Of random loads of this width, with the same numbers for the same seed."""
        random = np.random.default_rng(seed)
        field, force = np.zeros((cases, 3)), np.full((cases, 2), -1.0)
        place, seen = np.full((cases, 2), WINDOW), np.full((cases, 2, 2), np.nan)
        seen_field: list[list[Array]] = []
        one = 0
        for case in range(cases):
            load, centre = self.load(random)
            points = self.inverse.points[self.window, :2]
            true = -self.truth(points, width, load, centre)[:, 2]
            values = self.values(width, load, centre, random)
            tracker = ContactTracker(self.inverse, CONTACT_PRESSURE)
            found: list[Any] = [
                self.surface.contacts(values, CONTACT_PRESSURE),
                tracker.update(values),
            ]
            one += len(found[1]) == 1
            fields = [
                self.surface.field(values).pressure,
                self.inverse.field(values).depth_pressure,
                tracker.field.depth_pressure,
            ]
            stated = tracker.deviation(values)
            surface = self.surface_truth(width, load, centre)
            pressed = true > PRESSED * true.max(), surface > PRESSED * surface.max()
            errors = fields[2][self.window] - true, tracker.field.pressure - surface
            over = errors[0] / stated.depth_pressure[self.window], errors[1] / stated.pressure
            seen_field.append([z[where] ** 2 for z, where in zip(over, pressed, strict=True)])
            for k, computed in enumerate(fields):
                field[case, k] = ((computed[self.window] - true) ** 2).mean() / (true**2).mean()
            for k, contacts in enumerate(found):
                if contacts:
                    whole = _together(contacts)
                    force[case, k] = whole.force / FORCE - 1
                    place[case, k] = np.linalg.norm(whole.place - centre)
                    error = whole.force - FORCE
                    sigma = whole.place_deviation * np.sqrt(2)
                    seen[case, k] = error / whole.force_deviation, place[case, k] / sigma
        return Errors(
            width=width,
            field=np.sqrt(field.mean(axis=0)),
            force=np.sqrt((force**2).mean(axis=0)),
            place=np.percentile(place, 95, axis=0),
            seen=np.sqrt(np.nanmean(seen**2, axis=0)),
            seen_field=np.array(
                [np.sqrt(np.concatenate(z).mean()) for z in zip(*seen_field, strict=True)]
            ),
            found=one / cases,
        )


class _Whole(NamedTuple):
    """Normal force of all contacts, N, and where it acts (2,), m, with standard deviations."""

    force: float
    force_deviation: float
    place: Array
    place_deviation: float


def _together(contacts: list[Any]) -> _Whole:
    """As if the contacts were independent of each other."""
    forces = np.array([one.normal_force for one in contacts])
    deviations = np.array([one.force_uncertainty for one in contacts])
    places = np.array([one.position[:2] for one in contacts])
    own = np.array([one.position_uncertainty for one in contacts])
    whole = float(forces.sum())
    place = forces @ places / whole
    lever = np.linalg.norm(places - place, axis=1) / np.sqrt(2)
    variance = ((forces * own) ** 2 + (lever * deviations) ** 2).sum()
    deviation = float(np.sqrt(variance)) / whole
    return _Whole(whole, float(np.linalg.norm(deviations)), place, deviation)


def traction_example() -> FieldExample:
    """A narrow contact between planar cubes, crosswise: pressure at the cubes' depth as it is, as
    two methods compute it, and the standard deviation that the inverse states, Pa."""
    bench = Bench(Setting(cubes=CUBES[2], pitch=10e-3, depth=4e-3), side=10)
    centre, width = bench.setting.pitch * np.array([0.35, 0.25]), 6e-3
    load = FORCE * np.array([FRICTION, 0.0, -1.0])
    values = bench.values(width, load, centre, np.random.default_rng(1))
    points = bench.inverse.points
    tracker = ContactTracker(bench.inverse, CONTACT_PRESSURE)
    tracker.update(values)
    pressure = {
        "truth": -bench.truth(points[:, :2], width, load, centre)[:, 2],
        METHODS[0]: bench.surface.field(values).pressure,
        METHODS[1]: bench.inverse.field(values).depth_pressure,
        METHODS[2]: tracker.field.depth_pressure,
        "standard deviation": tracker.deviation(values).depth_pressure,
    }
    return FieldExample(points, pressure, bench.poses.position, centre)


def flat_punch(radius: float, force: Array, centre: Array, order: int) -> tuple[Array, Array]:
    """Traction F / (2 pi a sqrt(a^2 - r^2)) as point forces: a rigid flat punch (Johnson 3.8)."""
    nodes, weight = np.polynomial.legendre.leggauss(order)
    r, count = radius * np.sqrt(1 - ((nodes + 1) / 2) ** 2), 4 * order
    angle = 2 * np.pi * np.arange(count) / count
    x, y = np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()
    sources = np.stack([centre[0] + x, centre[1] + y, 0 * x], axis=1)
    return sources, np.repeat(weight / 2 / count, count)[:, None] * np.asarray(force)


def study(
    settings: Sequence[Setting],
    widths: Sequence[float],
    cases: int = CASES,
    progress: Callable[[Setting, Errors], None] | None = None,
    seed: int = 8,
) -> dict[Setting, list[Errors]]:
    """Errors of each setting at each width (m)."""
    results: dict[Setting, list[Errors]] = {}
    for setting in settings:
        bench = Bench(setting)
        results[setting] = []
        for width in widths:
            results[setting].append(bench.errors(width, cases, seed))
            if progress is not None:
                progress(setting, results[setting][-1])
    return results


MAIN = tuple(Setting(cubes=cubes) for cubes in CUBES)
"""Pitch 8 mm, depth 5 mm, a half space that is one."""
PITCHES = tuple(
    Setting(cubes=cubes, pitch=pitch, depth=4e-3) for pitch in (12e-3, 24e-3) for cubes in CUBES[:2]
)
_PLAIN = Setting()
SHAPED = tuple(
    replace(setting, shape=shape) for shape in SHAPES[1:] for setting in (*MAIN[:2], *PITCHES)
)
"""Loads that are no balls."""
WRONG = {
    "everything as known": _PLAIN,
    "5 % gain spread": replace(_PLAIN, gain_error=0.05),
    "cubes 0.5 mm deeper": replace(_PLAIN, depth_error=0.5e-3),
    "Poisson's ratio 0.46": replace(_PLAIN, poisson=0.46),
    "layer of 11 mm taken for a half space": replace(_PLAIN, thickness=11e-3),
    "layer of 11 mm, known": replace(_PLAIN, thickness=11e-3, known_thickness=11e-3),
    "flat punch instead of a ball": replace(_PLAIN, shape=SHAPES[1]),
}
"""What the inverse does not know, and what it costs."""
