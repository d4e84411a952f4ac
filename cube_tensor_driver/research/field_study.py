"""What gradients buy: error of the field between the cubes against the contact model, with them and
without.

Three kinds of skin: of values alone, of cubes that see all of stress and gradient, and of planar
cubes, whose section
lies along x: of the gradients in the plane they see ∂σzz/∂x, of the shear σzx.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.modes import COMPONENTS
from ..core.scene import CubePoses
from ..elastic import contact
from ..elastic.surface import Array, Surface

DEPTH, POISSON, FORCE = 4e-3, 0.48, 3.0
PITCHES = np.array([6, 8, 10, 12, 16, 20, 24]) * 1e-3
WIDTHS = np.array([2, 5, 10, 15, 20]) * 1e-3
CASES = 16
"""Contacts per pitch and width, anywhere in the cell between four cubes, with shear of 0.3 of the
normal force."""
SKIN = 0.1
"""Side of the skin, m; all that is compared lies in the middle of it, WINDOW wide."""
WINDOW = 0.04
KINDS = ("values alone", "values and gradients", "planar cubes")
UNSEEN = [k for k, name in enumerate(COMPONENTS) if "y" in name]
"""By planar cubes."""


@dataclass(frozen=True)
class FieldStudy:
    """Rows per width, columns per pitch; the last axis: KINDS.

    error: rms of the pressure's error over rms of the pressure, in the window. position: 95th
    percentile of the contact's position error, m. force: rms error of its normal force over the
    force. Contacts that were not found count as errors of WINDOW and of the whole force.
    """

    pitches: Array
    widths: Array
    error: Array
    position: Array
    force: Array

    def cubes_saved(self, error: float) -> Array:
        """(widths, kinds) how many times fewer cubes per area give this error than with values
        alone; NaN: no pitch."""
        saved = np.full((len(self.widths), len(KINDS)), np.nan)
        for row, curves in enumerate(self.error):
            pitch = []
            for curve in curves.T:
                rising = np.maximum.accumulate(curve)
                inside = rising[0] < error < rising[-1]
                pitch.append(
                    np.exp(np.interp(np.log(error), np.log(rising), np.log(self.pitches)))
                    if inside
                    else np.nan
                )
            saved[row] = (np.array(pitch) / pitch[0]) ** 2
        return saved


def flat_skin(pitch: float, side: float = SKIN) -> CubePoses:
    """A square grid of cubes about the origin, an odd number a side."""
    count = 2 * round(side / pitch / 2) + 1
    x, y = np.meshgrid(*2 * [(np.arange(count) - count // 2) * pitch])
    position = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    return CubePoses(
        position, np.tile(np.eye(3), (len(position), 1, 1)), np.full(len(position), DEPTH / 2)
    )


def truth(points: Array, width: float, force: Array, centre: Array) -> Array:
    """(N, 15) components at points of the cubes' plane, DEPTH below a ball that presses over this
    width."""
    below = np.column_stack([points[:, :2], np.full(len(points), -DEPTH)])
    stress, gradient = contact.field(below, *contact.hertz(width / 2, force, centre), POISSON)
    return np.concatenate([stress, gradient[:, :3].reshape(len(points), 9)], axis=1)


def field_study(pitches: Array = PITCHES, widths: Array = WIDTHS, cases: int = CASES) -> FieldStudy:
    """Run it; the same numbers every time. About two minutes with the defaults."""
    shape = len(widths), len(pitches), len(KINDS)
    error, position, force = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for column, pitch in enumerate(pitches):
        skin = flat_skin(pitch)
        side = round(pitch / 2e-3)
        surfaces = [Surface(skin, DEPTH, side, kind != KINDS[0]) for kind in KINDS]
        window = np.abs(surfaces[0].points[:, :2]).max(axis=1) < WINDOW / 2
        points = surfaces[0].points[window]
        for row, width in enumerate(widths):
            random = np.random.default_rng(8)
            squares, places, forces = np.zeros((3, cases, len(KINDS)))
            for case in range(cases):
                centre, angle = pitch * (random.random(2) - 0.5), 2 * np.pi * random.random()
                load = FORCE * np.array([0.3 * np.cos(angle), 0.3 * np.sin(angle), -1.0])
                pressure, values = (
                    -truth(points, width, load, centre)[:, 2],
                    truth(skin.position, width, load, centre),
                )
                for k, surface in enumerate(surfaces):
                    if KINDS[k] == "planar cubes":
                        values = values.copy()
                        values[:, UNSEEN] = np.nan
                    made = surface.field(values).pressure[window]
                    squares[case, k] = ((made - pressure) ** 2).mean() / (pressure**2).mean()
                    found = surface.contacts(values, 300.0)[:1]
                    places[case, k] = (
                        np.linalg.norm(found[0].position[:2] - centre) if found else WINDOW
                    )
                    forces[case, k] = (found[0].normal_force if found else 0.0) / FORCE - 1
            error[row, column] = np.sqrt(squares.mean(axis=0))
            position[row, column] = np.percentile(places, 95, axis=0)
            force[row, column] = np.sqrt((forces**2).mean(axis=0))
    return FieldStudy(pitches, widths, error, position, force)
