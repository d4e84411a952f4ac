"""What gradients buy: error of the field between the cubes against the contact model.

Three kinds of skin are compared: values alone; cubes that see all of stress and gradient; planar
cubes, whose section lies along x, so that they see ∂σzz/∂x of the gradient and σzx of the shear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.defaults import CONTACT_PRESSURE, POISSONS_RATIO, SURFACE_DEPTH
from cube_tensor_driver.core.modes import COMPONENTS
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.touch.surface import Surface

SKIN_KINDS = ("values alone", "values and gradients", "planar cubes")
_UNSEEN_BY_PLANAR = [k for k, name in enumerate(COMPONENTS) if "y" in name]

FORCE = 3.0
"""Of the ball, N."""
FRICTION = 0.3
"""Shear over normal force of the ball."""
PITCHES = np.array([6, 8, 10, 12, 16, 20, 24]) * 1e-3
WIDTHS = np.array([2, 5, 10, 15, 20]) * 1e-3
CASES = 16
"""Contacts per pitch and width, anywhere in the cell between four cubes."""
SKIN_SIDE = 0.1
"""Of the skin, m."""
WINDOW = 0.04
"""Side of the middle of the skin in which fields are compared, m."""
_POINT_SPACING = 2e-3


@dataclass(frozen=True, eq=False)
class FieldStudy:
    """Errors for each width (rows), pitch (columns) and one of SKIN_KINDS (last axis).

    pitches, widths: m
    error: rms of the pressure's error over rms of the pressure, in the window
    position: 95th percentile of the contact's position error, m
    force: rms error of the contact's normal force over the force
    A contact that was not found counts as a position error of WINDOW and an error of all the force.
    """

    pitches: Array
    widths: Array
    error: Array
    position: Array
    force: Array

    def cubes_saved(self, error: float) -> Array:
        """(widths, kinds) how many times fewer cubes per area give this error than values alone do.

        NaN where no pitch of the study gives it.
        """
        saved = np.full((len(self.widths), len(SKIN_KINDS)), np.nan)
        for row, curves in enumerate(self.error):
            pitch = np.array([self._pitch_for(error, curve) for curve in curves.T])
            saved[row] = (pitch / pitch[0]) ** 2
        return saved

    def _pitch_for(self, error: float, curve: Array) -> float:
        """The pitch at which the errors (pitches,) reach this one; NaN: at none."""
        rising = np.maximum.accumulate(curve)
        if not rising[0] < error < rising[-1]:
            return np.nan
        return float(np.exp(np.interp(np.log(error), np.log(rising), np.log(self.pitches))))


@dataclass(frozen=True, eq=False)
class FieldExample:
    """One contact between the cubes, and the field that different skins make of it.

    points: (M, 3) m; pressure: {"truth" or one of SKIN_KINDS: (M,) Pa}
    cubes: (cubes, 3) m; centre: (2,) m of the contact
    """

    points: Array
    pressure: dict[str, Array]
    cubes: Array
    centre: Array


def flat_skin(pitch: float, side: float = SKIN_SIDE) -> CubePoses:
    """A square grid of cubes about the origin, an odd number along each side; lengths in m."""
    count = 2 * round(side / pitch / 2) + 1
    line = (np.arange(count) - count // 2) * pitch
    x, y = np.meshgrid(line, line)
    position = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    rotation = np.tile(np.eye(3), (len(position), 1, 1))
    return CubePoses(position, rotation, np.full(len(position), SURFACE_DEPTH / 2))


def true_components(points: Array, width: float, force: Array, centre: Array) -> Array:
    """COMPONENTS (N, 15) at points (N, 3) of the cubes' plane, below a ball that presses.

    width: of the contact, m; force: (3,) N; centre: (2,) m. The gradient is in Pa/m.
    """
    below = np.column_stack([points[:, :2], np.full(len(points), -SURFACE_DEPTH)])
    order = contact.hertz_order(width / 2, SURFACE_DEPTH)
    sources, forces = contact.hertz(width / 2, force, centre, order)
    stress, gradient = contact.field(below, sources, forces, POISSONS_RATIO)
    return np.concatenate([stress, gradient[:, :3].reshape(len(points), 9)], axis=1)


def field_example(pitch: float = 0.010, width: float = 0.012) -> FieldExample:
    """A contact beside the middle of a cell: its true pressure, and the field of two skins."""
    skin, centre = flat_skin(pitch, 0.05), pitch * np.array([0.35, 0.25])
    load = FORCE * np.array([FRICTION, 0.0, -1.0])
    surfaces = {
        name: Surface(skin, SURFACE_DEPTH, 20, gradients=name != "values alone")
        for name in ("values alone", "values and gradients")
    }
    points = surfaces["values alone"].points
    pressure = {"truth": -true_components(points, width, load, centre)[:, 2]}
    values = true_components(skin.position, width, load, centre)
    pressure |= {name: surface.field(values).pressure for name, surface in surfaces.items()}
    return FieldExample(points, pressure, skin.position, centre)


def field_study(pitches: Array = PITCHES, widths: Array = WIDTHS, cases: int = CASES) -> FieldStudy:
    """Run the study, with the same numbers every time. About two minutes with the defaults."""
    shape = len(widths), len(pitches), len(SKIN_KINDS)
    error, position, force = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for column, pitch in enumerate(pitches):
        trial = _Trial(pitch)
        for row, width in enumerate(widths):
            random = np.random.default_rng(8)
            errors = np.array([trial.errors(width, random) for _ in range(cases)])
            squares, distances, forces = np.moveaxis(errors, 1, 0)  # each (cases, kinds)
            error[row, column] = np.sqrt(squares.mean(axis=0))
            position[row, column] = np.percentile(distances, 95, axis=0)
            force[row, column] = np.sqrt((forces**2).mean(axis=0))
    return FieldStudy(pitches, widths, error, position, force)


class _Trial:
    """Skins of one pitch, and the errors that they make of one contact."""

    def __init__(self, pitch: float) -> None:
        self.pitch = pitch
        self.skin = flat_skin(pitch)
        side = round(pitch / _POINT_SPACING)
        self.surfaces = {
            kind: Surface(self.skin, SURFACE_DEPTH, side, gradients=kind != "values alone")
            for kind in SKIN_KINDS
        }
        points = self.surfaces["values alone"].points
        self.window = np.abs(points[:, :2]).max(axis=1) < WINDOW / 2
        self.points = points[self.window]

    def errors(self, width: float, random: np.random.Generator) -> Array:
        """(3, kinds) of a random contact of this width.

        The rows: square error of the pressure over its square, distance of the contact's position
        in m, relative error of its force.
        """
        centre = self.pitch * (random.random(2) - 0.5)
        angle = 2 * np.pi * random.random()
        load = FORCE * np.array([FRICTION * np.cos(angle), FRICTION * np.sin(angle), -1.0])
        pressure = -true_components(self.points, width, load, centre)[:, 2]
        seen = true_components(self.skin.position, width, load, centre)
        errors = np.zeros((3, len(SKIN_KINDS)))
        for k, (kind, surface) in enumerate(self.surfaces.items()):
            values = seen.copy()
            if kind == "planar cubes":
                values[:, _UNSEEN_BY_PLANAR] = np.nan
            computed = surface.field(values).pressure[self.window]
            errors[0, k] = ((computed - pressure) ** 2).mean() / (pressure**2).mean()
            contacts = surface.contacts(values, CONTACT_PRESSURE)
            if contacts:
                errors[1, k] = np.linalg.norm(contacts[0].position[:2] - centre)
                errors[2, k] = contacts[0].normal_force / FORCE - 1
            else:
                errors[1, k], errors[2, k] = WINDOW, -1.0
        return errors
