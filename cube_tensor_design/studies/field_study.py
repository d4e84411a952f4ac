# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What gradients gain: error of the pressure field that is interpolated between the cubes.

Three kinds of skin are compared: values alone; cubes that observe all of stress and gradient;
planar cubes, whose section lies along x, so that they observe ∂σzz/∂x of the gradient and σzx of
the shear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.defaults import POISSONS_RATIO, SURFACE_DEPTH
from cube_tensor_driver.core.modes import COMPONENTS
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.touch.surface import Surface

SKIN_KINDS = ("values alone", "values and gradients", "planar cubes")
"""Kinds of skin that are compared: cubes of which only the stress is used, cubes of which the
gradient is used as well, and planar cubes, which observe a part of both."""
UNOBSERVED_BY_PLANAR = [k for k, name in enumerate(COMPONENTS) if "y" in name]
"""Indices in `COMPONENTS` of the components with an index y, which planar cubes do not observe."""

FORCE = 3.0
"""Normal force, in N, with which the ball of each random contact presses."""
FRICTION = 0.3
"""Ratio of the ball's shear force to its normal force."""
PITCHES = np.array([6, 8, 10, 12, 16, 20, 24]) * 1e-3
"""Distances between neighbouring cubes, in m, for which errors are computed."""
WIDTHS = np.array([2, 5, 10, 15, 20]) * 1e-3
"""Widths of the contact, in m, for which errors are computed."""
CASES = 16
"""Number of random contacts per pitch and width, anywhere in the cell between four cubes."""
SKIN_SIDE = 0.1
"""Side of the square skin on which contacts press, in m."""
WINDOW = 0.04
"""Side of the square in the middle of the skin in which fields are compared, in m."""
POINT_SPACING = 2e-3
"""Distance between the points at which fields are compared, in m."""
SEED = 8
"""Seed of the random contacts, so that every run has the same numbers."""


@dataclass(frozen=True, eq=False)
class FieldStudy:
    """Errors for each contact width (rows), pitch (columns) and kind of skin (last axis).

    The kinds are those of `SKIN_KINDS`.

    Attributes:
        pitches: (columns,) distances between neighbouring cubes, in m.
        widths: (rows,) widths of the contact, in m.
        error: rms of the pressure's error over rms of the pressure, in the window.
    """

    pitches: Array
    widths: Array
    error: Array

    def compute_cubes_saved(self, error: float) -> Array:
        """Return by what factor fewer cubes per area suffice for an error than if only their
        stresses are used.

        Args:
            error: Relative rms error of the pressure.

        Returns:
            (widths, kinds); NaN where no pitch of the study reaches the error.
        """
        saved = np.full((len(self.widths), len(SKIN_KINDS)), np.nan)
        for row, curves in enumerate(self.error):
            pitches = [self._find_pitch_for(error, curve) for curve in curves.T]
            ratio = np.array(pitches) / pitches[0]
            # The number of cubes per area falls with the square of the pitch.
            saved[row] = ratio**2
        return saved

    def _find_pitch_for(self, error: float, curve: Array) -> float:
        """Return the pitch at which a curve of errors (pitches,) reaches an error; NaN if none
        does."""
        # Noise may make a curve fall for a step, and np.interp needs it to rise.
        rising = np.maximum.accumulate(curve)
        if not rising[0] < error < rising[-1]:
            return np.nan
        # Errors are nearly powers of the pitch, so logarithms are interpolated.
        log_error = np.log(rising)
        log_pitches = np.log(self.pitches)
        log_pitch = np.interp(np.log(error), log_error, log_pitches)
        return float(np.exp(log_pitch))


@dataclass(frozen=True, eq=False)
class FieldExample:
    """One contact between the cubes, and the pressure that different methods compute of it.

    Attributes:
        points: (M, 3) positions at which the pressure is given, in m.
        pressure: (M,) pressure in Pa by the name of the method; "truth" is the true one.
        cubes: (cubes, 3) positions of the cubes, in m.
        centre: (2,) position of the contact, in m.
    """

    points: Array
    pressure: dict[str, Array]
    cubes: Array
    centre: Array


def make_flat_skin(pitch: float, side: float = SKIN_SIDE) -> CubePoses:
    """Return a square grid of cubes about the origin, with an odd number along each side.

    Args:
        pitch: Distance between neighbouring cubes, in m.
        side: Side of the skin, in m.
    """
    count = 2 * round(side / pitch / 2) + 1
    line = (np.arange(count) - count // 2) * pitch
    x, y = np.meshgrid(line, line)
    position = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    n_cubes = len(position)
    rotation = np.tile(np.eye(3), (n_cubes, 1, 1))
    half_side = np.full(n_cubes, SURFACE_DEPTH / 2)
    return CubePoses(position, rotation, half_side)


def draw_force(random: np.random.Generator) -> Array:
    """Return the force (3,) of the ball in N, with its shear in a random direction."""
    angle = 2 * np.pi * random.random()
    shear_x = FRICTION * np.cos(angle)
    shear_y = FRICTION * np.sin(angle)
    return FORCE * np.array([shear_x, shear_y, -1.0])


def compute_true_components(
    points: Array,
    width: float,
    force: Array,
    centre: Array,
) -> Array:
    """Return the true stress and gradient at points of the cubes' plane below a ball.

    Args:
        points: (N, 3) positions in m.
        width: Width of the contact, in m.
        force: (3,) force on the skin, in N.
        centre: (2,) position of the contact, in m.

    Returns:
        `COMPONENTS` (N, 15), stresses in Pa and gradients in Pa/m.
    """
    order = contact.choose_hertz_order(width / 2, SURFACE_DEPTH)
    load = contact.hertz(width / 2, force, centre, order)
    field = compute_field_below(points, SURFACE_DEPTH, load, POISSONS_RATIO)
    # Of the gradients, those of the normal stresses come first.
    return field[:, : len(COMPONENTS)]


def compute_field_below(
    points: Array,
    depth: float,
    load: tuple[Array, Array],
    poisson: float,
) -> Array:
    """Return stress and gradient (N, 6 + 18), in Pa and Pa/m, in a half space.

    Args:
        points: (N, 2 or more) positions along x and y, in m.
        depth: Depth of the points below the surface, in m.
        load: Positions (S, 3) in m and forces (S, 3) in N of point forces on the surface.
        poisson: Poisson's ratio.
    """
    # The contact model has its origin on the surface.
    height = np.full(len(points), -depth)
    below = np.column_stack([points[:, :2], height])
    stress, gradient = contact.field(below, *load, poisson)
    slopes = gradient.reshape(len(points), 18)
    return np.concatenate([stress, slopes], axis=1)


def compute_field_example() -> FieldExample:
    """Return the pressure under a contact between four cubes: the true one, and what interpolation
    computes with and without gradients."""
    pitch, width = 0.010, 0.012
    skin = make_flat_skin(pitch, 0.05)
    centre = pitch * np.array([0.35, 0.25])
    force = FORCE * np.array([FRICTION, 0.0, -1.0])
    values = compute_true_components(skin.position, width, force, centre)
    pressure = {}
    for kind in SKIN_KINDS[:2]:
        surface = Surface(
            skin,
            SURFACE_DEPTH,
            20,
            gradients=kind != "values alone",
        )
        true = compute_true_components(surface.points, width, force, centre)
        pressure["truth"] = -true[:, COMPONENTS.index("zz")]
        pressure[kind] = surface.field(values).pressure
    return FieldExample(surface.points, pressure, skin.position, centre)


def study_fields(
    pitches: Array = PITCHES,
    widths: Array = WIDTHS,
    cases: int = CASES,
) -> FieldStudy:
    """Compute the errors for all pitches and widths, in about two minutes; the same numbers every
    time."""
    error = np.zeros((len(widths), len(pitches), len(SKIN_KINDS)))
    for column, pitch in enumerate(pitches):
        trial = _Trial(pitch)
        for row, width in enumerate(widths):
            # The same contacts for every pitch and width make the errors comparable.
            random = np.random.default_rng(SEED)
            squares = [trial.compute_square_errors(width, random) for _ in range(cases)]
            error[row, column] = np.sqrt(np.mean(squares, axis=0))
    return FieldStudy(pitches, widths, error)


class _Trial:
    """Skins of one pitch, and the errors of their interpolated fields under one contact."""

    def __init__(self, pitch: float) -> None:
        self._pitch = pitch
        self._skin = make_flat_skin(pitch)
        side = round(pitch / POINT_SPACING)
        self._surfaces = {}
        for kind in SKIN_KINDS:
            has_gradients = kind != "values alone"
            self._surfaces[kind] = Surface(
                self._skin,
                SURFACE_DEPTH,
                side,
                gradients=has_gradients,
            )
        points = self._surfaces["values alone"].points
        from_centre = np.abs(points[:, :2]).max(axis=1)
        self._window = from_centre < WINDOW / 2
        self._points = points[self._window]

    def compute_square_errors(
        self,
        width: float,
        random: np.random.Generator,
    ) -> list[float]:
        """Return, by kind of skin, the mean square error of the pressure over its mean square
        under a random contact of this width."""
        centre = self._pitch * (random.random(2) - 0.5)
        force = draw_force(random)
        true = compute_true_components(self._points, width, force, centre)
        pressure = -true[:, COMPONENTS.index("zz")]
        measured = compute_true_components(
            self._skin.position,
            width,
            force,
            centre,
        )
        square_errors = []
        for kind, surface in self._surfaces.items():
            values = measured.copy()
            if kind == "planar cubes":
                values[:, UNOBSERVED_BY_PLANAR] = np.nan
            computed = surface.field(values).pressure[self._window]
            error_square = ((computed - pressure) ** 2).mean()
            square_errors.append(error_square / (pressure**2).mean())
        return square_errors
