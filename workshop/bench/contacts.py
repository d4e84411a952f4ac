# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""`./cube bench contacts`: errors and CPU time of contacts by the shape of the load (in process).

The stress is that of point forces on a half space. It goes through the whole chain: pads whose
gains are known to 1 %, the pad law, a counter's noise, the pipeline. The estimator uses none of it.
Depth and Poisson's ratio differ from those it is told, as much as its deviations assume.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from cube_tensor_design.studies.field_study import (
    FORCE,
    compute_field_below,
    draw_force,
)
from cube_tensor_design.studies.traction_study import (
    CUBES,
    ContactErrors,
    Setting,
    TractionBench,
    make_flat_punch,
    sum_contact_errors,
)
from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.defaults import CONTACT_PRESSURE
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.mechanics.sensitivity import DEPTH_DEVIATION, POISSON_DEVIATION
from cube_tensor_driver.touch.tracker.contact_tracker import ContactTracker

SCANS = 12
"""Number of scans (samples of all cubes) with which the tracker is called under each load.

Errors are those after the last scan. CPU times are given for the first and for the last scan.
"""

SEED = 11
"""Seed of the random loads."""

SKINS = {
    "24-pad, pitch 8 mm": Setting(),
    "24-pad, pitch 12 mm": Setting(pitch=12e-3, depth=4e-3),
    "planar, pitch 12 mm": Setting(cubes=CUBES[1], pitch=12e-3, depth=4e-3),
}
"""Skins by their names in the result. Cubes 8 mm apart are 5 mm deep, the others 4 mm."""


class LoadShape(NamedTuple):
    """Pressure of a load, with the total force 1 N.

    Attributes:
        forces: Point forces (L, 3): position x, y in m, force in N.
        apart: Distance of two such loads with half of the force each, in pitches (distances of
            neighbouring cubes); 0: there is one.
        outside: Distance of the centre from the outermost cubes, in pitches; None: the centre is in
            the middle cell.
    """

    forces: Array
    apart: float = 0.0
    outside: float | None = None


def make_ellipse(length: float, width: float, order: int = 16) -> Array:
    """Return Hertz's pressure on an ellipse with 1 N, as point forces (see `LoadShape.forces`).

    Args:
        length: Axis of the ellipse along x, in m.
        width: Axis of the ellipse along y, in m.
        order: Number of rings on which the point forces lie.
    """
    sources, forces = contact.hertz(1.0, (0, 0, 1), order=order)
    scaled = sources[:, :2] * np.array([length, width]) / 2
    return np.column_stack([scaled, forces[:, 2]])


def make_punch(width: float) -> Array:
    """Return the pressure under a rigid flat punch with 1 N, as point forces.

    Args:
        width: Diameter of the punch, in m.
    """
    sources, forces = make_flat_punch(
        width / 2,
        np.array([0, 0, 1.0]),
        np.zeros(2),
        14,
    )
    return np.column_stack([sources[:, :2], forces[:, 2]])


def make_bar(length: float, width: float) -> Array:
    """Return a pressure that is uniform along x and semi-elliptic along y, as point forces of 1 N.

    Args:
        length: Length along x, in m.
        width: Width along y, in m.
    """
    nodes, along = np.polynomial.legendre.leggauss(int(length / 0.5e-3))
    angle = np.arange(1, 9) * np.pi / 9
    across = np.sin(angle) ** 2
    across /= across.sum()
    x, y = np.meshgrid(
        nodes * length / 2,
        np.cos(angle) * width / 2,
        indexing="ij",
    )
    force = np.outer(along / 2, across)
    return np.column_stack([x.ravel(), y.ravel(), force.ravel()])


BALL = make_ellipse(5e-3, 5e-3)
"""Pressure of a ball with a contact width of 5 mm."""

SHAPES = {
    "ball 5 mm": LoadShape(BALL),
    "flat punch 8 mm": LoadShape(make_punch(8e-3)),
    "flat punch 16 mm": LoadShape(make_punch(16e-3)),
    "fingertip 16 x 8 mm": LoadShape(make_ellipse(16e-3, 8e-3)),
    "edge 12 x 1 mm": LoadShape(make_bar(12e-3, 1e-3)),
    "edge 24 x 2 mm": LoadShape(make_bar(24e-3, 2e-3)),
    "rod 40 x 3 mm": LoadShape(make_bar(40e-3, 3e-3)),
    "two balls 1.2 pitches apart": LoadShape(BALL, apart=1.2),
    "ball half a pitch outside": LoadShape(BALL, outside=0.5),
    "ball a pitch outside": LoadShape(BALL, outside=1.0),
}
"""Loads by their names in the result."""


class TrackingResult(NamedTuple):
    """What the tracker found of one load.

    Attributes:
        errors: Errors of force and place; several contacts count together.
        contacts: Number of contacts.
        first_ms: CPU time of the first scan in ms.
        last_ms: CPU time of the last scan in ms.
    """

    errors: ContactErrors
    contacts: int
    first_ms: float
    last_ms: float


TrackingResults = dict[tuple[str, str], list[TrackingResult]]
"""Results of all loads by the names of skin and shape."""


def compute_values_under(
    bench: TractionBench,
    forces: Array,
    centre: Array,
    force: Array,
    random: np.random.Generator,
    depth_error: float = 0.0,
    poisson_error: float = 0.0,
) -> Array:
    """Return the components (cubes, 15) that the pipeline computes under a load.

    Args:
        bench: The skin.
        forces: Point forces as in `LoadShape.forces`.
        centre: Centre (2,) of the load in m.
        force: Force (3,) in N.
        random: Source of gain errors and noise.
        depth_error: How much deeper the cubes are than the inverse knows, divided by the depth.
        poisson_error: How much larger Poisson's ratio is.
    """
    pads = _compute_pads_under(
        bench,
        forces,
        centre,
        force,
        depth_error,
        poisson_error,
    )
    return bench.measure(pads, random)


def _compute_pads_under(
    bench: TractionBench,
    forces: Array,
    centre: Array,
    force: Array,
    depth_error: float = 0.0,
    poisson_error: float = 0.0,
) -> Array:
    """Return the pad stresses (cubes, P) in Pa; arguments as of `compute_values_under`."""
    place = np.column_stack([forces[:, :2] + centre, np.zeros(len(forces))])
    load = place, forces[:, 2:] * force
    depth = bench.setting.depth * (1 + depth_error)
    poisson = min(bench.setting.poisson + poisson_error, 0.5)
    return bench.compute_pads_in(compute_field_below(bench.poses.position, depth, load, poisson))


def bench_shapes(loads: int) -> TrackingResults:
    """Find the contacts of a number of loads of each shape on each skin."""
    results: TrackingResults = {}
    for skin, setting in SKINS.items():
        bench = TractionBench(setting, side=2)
        for name, shape in SHAPES.items():
            random = np.random.default_rng(SEED)
            results[skin, name] = [_bench_load(bench, shape, random) for _ in range(loads)]
    return results


def _bench_load(
    bench: TractionBench,
    shape: LoadShape,
    random: np.random.Generator,
) -> TrackingResult:
    """Find the contacts of a load in a random direction at a random place."""
    pitch = bench.setting.pitch
    angle = random.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    centre = pitch * (random.random(2) - 0.5)
    if shape.outside is not None:
        centre[0] = bench.poses.position[:, 0].max() + shape.outside * pitch
    forces = shape.forces
    if shape.apart:
        shift = np.array([shape.apart * pitch / 2, 0, 0])
        forces = np.concatenate([forces - shift, forces + shift]) * [1, 1, 0.5]
    turned = np.column_stack([forces[:, :2] @ turn, forces[:, 2]])
    force = draw_force(random)
    errors = random.standard_normal(2) * [DEPTH_DEVIATION, POISSON_DEVIATION]
    values = compute_values_under(
        bench,
        turned,
        centre,
        force,
        random,
        *errors,
    )

    tracker = ContactTracker(bench.inverse, CONTACT_PRESSURE)
    times_ms = []
    for _ in range(SCANS):
        start_s = time.process_time()
        found = tracker.update(values)
        times_ms.append(1e3 * (time.process_time() - start_s))
    return TrackingResult(
        sum_contact_errors(found, centre),
        len(found),
        times_ms[0],
        times_ms[-1],
    )


def summarise(results: TrackingResults) -> dict[str, dict[str, float]]:
    """Return the errors and times of each skin and shape by its name.

    A calibration ratio is an rms error divided by the predicted standard deviation.
    """
    return {f"{name}, {skin}": _summarise(name, loads) for (skin, name), loads in results.items()}


def _summarise(name: str, loads: list[TrackingResult]) -> dict[str, float]:
    errors, contacts, first_ms, last_ms = zip(*loads, strict=True)
    force, force_deviation, place, place_deviation = np.array(errors).T
    expected = 2 if SHAPES[name].apart else 1
    is_right = np.array(contacts) == expected
    return {
        "force_error_percent": 100 * _compute_rms(force) / FORCE,
        "force_ratio": _compute_rms(force / force_deviation),
        "position_error_mm": 1e3 * _compute_rms(place),
        "position_ratio": _compute_rms(place / place_deviation),
        "right_number_percent": 100 * float(is_right.mean()),
        "first_scan_cpu_ms": float(np.mean(first_ms)),
        "scan_cpu_ms": float(np.mean(last_ms)),
    }


def _compute_rms(values: Array) -> float:
    """Return the root mean square of the values that are not NaN."""
    return float(np.sqrt(np.nanmean(values**2)))
