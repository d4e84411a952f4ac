# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""`./cube bench contacts`: errors and CPU time of contacts by the shape of the load.

The stress is that of point forces on a half space. It goes through the whole chain: pads whose
gains are known to 1 %, the pad law, a counter's noise, the pipeline. The estimator uses none of it.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from cube_tensor_design.studies.traction_study import (
    CUBES,
    GAIN_ERROR,
    Setting,
    TractionBench,
    flat_punch,
    sum_contacts,
)
from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.defaults import CONTACT_PRESSURE
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.touch.tracker.contact_tracker import ContactTracker

FORCE_N = 3.0
"""Normal force of each load in N; the shear force is 0.3 times as large."""

SCANS = 12
"""Number of scans (samples of all cubes) with which the tracker is called under each load.

Errors are those after the last scan. CPU times are given for the first and for the last scan.
"""

MOVING_SCANS = 120
"""Number of scans while balls move over the skin."""

RATE_HZ = 100.0
"""Sampling rate of the balls that move, in Hz."""

SPEED = 50e-3
"""Speed of the balls that move, in m/s."""

RADIUS_M = 12e-3
"""Radius in m of the circle on which each ball moves."""

DENSE = Setting()
"""Default settings: skin of 24-pad cubes, 8 mm apart and 5 mm deep."""

SPARSE = Setting(pitch=12e-3, depth=4e-3)
"""Skin of 24-pad cubes, 12 mm apart and 4 mm deep."""


class LoadCase(NamedTuple):
    """Loads of one shape on one skin, which give one line of the result.

    Attributes:
        setting: The skin.
        shape: Point forces (L, 3) of a load of 1 N: position x, y in m, force in N.
        outside: Distance of the centre from the outermost cubes in pitches (distances of
            neighbouring cubes); None: the centre is in the middle cell.
    """

    setting: Setting
    shape: Array
    outside: float | None = None


def ellipse(length: float, width: float, order: int = 16) -> Array:
    """Return Hertz's pressure on an ellipse with 1 N, as point forces (see `LoadCase.shape`).

    Args:
        length: Axis of the ellipse along x, in m.
        width: Axis of the ellipse along y, in m.
        order: Number of rings on which the point forces lie.
    """
    sources, forces = contact.hertz(1.0, (0, 0, 1), order=order)
    scaled = sources[:, :2] * np.array([length, width]) / 2
    return np.column_stack([scaled, forces[:, 2]])


def punch(width: float) -> Array:
    """Return the pressure under a rigid flat punch with 1 N, as point forces.

    Args:
        width: Diameter of the punch, in m.
    """
    sources, forces = flat_punch(width / 2, np.array([0, 0, 1.0]), np.zeros(2), 14)
    return np.column_stack([sources[:, :2], forces[:, 2]])


def bar(length: float, width: float) -> Array:
    """Return a pressure that is uniform along x and semi-elliptic along y, as point forces of 1 N.

    Args:
        length: Length along x, in m.
        width: Width along y, in m.
    """
    nodes, along = np.polynomial.legendre.leggauss(int(length / 0.5e-3))
    angle = np.arange(1, 9) * np.pi / 9
    weight = np.sin(angle) ** 2
    across = weight / weight.sum()
    x_nodes, y_nodes = nodes * length / 2, np.cos(angle) * width / 2
    x, y = np.meshgrid(x_nodes, y_nodes, indexing="ij")
    force = np.outer(along / 2, across)
    return np.column_stack([x.ravel(), y.ravel(), force.ravel()])


def pair(width: float, distance: float) -> Array:
    """Return the pressures of two balls with 0.5 N each, as point forces.

    Args:
        width: Diameter of each contact, in m.
        distance: Distance of the centres along x, in m.
    """
    half = ellipse(width, width) * [1, 1, 0.5]
    shift = np.array([distance / 2, 0, 0])
    return np.concatenate([half + shift, half - shift])


CASES = {
    "ball 5 mm": LoadCase(DENSE, ellipse(5e-3, 5e-3)),
    "flat punch 16 mm": LoadCase(DENSE, punch(16e-3)),
    "fingertip 8 x 16 mm": LoadCase(DENSE, ellipse(16e-3, 8e-3)),
    "edge 12 x 1 mm": LoadCase(DENSE, bar(12e-3, 1e-3)),
    "edge 24 x 2 mm": LoadCase(DENSE, bar(24e-3, 2e-3)),
    "rod 40 x 3 mm": LoadCase(DENSE, bar(40e-3, 3e-3)),
    "two balls 1.2 pitches apart": LoadCase(DENSE, pair(5e-3, 9.6e-3)),
    "ball half a pitch outside": LoadCase(DENSE, ellipse(5e-3, 5e-3), 0.5),
    "ball a pitch outside": LoadCase(DENSE, ellipse(5e-3, 5e-3), 1.0),
    "ball 5 mm, pitch 12": LoadCase(SPARSE, ellipse(5e-3, 5e-3)),
    "flat punch 8 mm, pitch 12": LoadCase(SPARSE, punch(8e-3)),
    "rod 40 x 3 mm, pitch 12": LoadCase(SPARSE, bar(40e-3, 3e-3)),
    "edge 24 x 2 mm, planar, pitch 12": LoadCase(replace(SPARSE, cubes=CUBES[1]), bar(24e-3, 2e-3)),
}
"""Name in the result -> loads of one shape on one skin."""


def values_under(
    bench: TractionBench,
    shape: Array,
    centre: Array,
    force: Array,
    random: np.random.Generator,
) -> Array:
    """Return the components (cubes, 15) that the pipeline computes under a load.

    Args:
        bench: The skin.
        shape: Point forces as in `LoadCase.shape`.
        centre: Centre (2,) of the load in m.
        force: Force (3,) in N.
        random: Source of gain errors and noise.
    """
    return bench.measured(bench.pads_in(_field_under(bench, shape, centre, force)), random)


def _field_under(bench: TractionBench, shape: Array, centre: Array, force: Array) -> Array:
    """Return stress and gradient (cubes, 24) in Pa and Pa/m; arguments as in `values_under`."""
    sources = np.column_stack([shape[:, :2] + centre, np.zeros(len(shape))])
    below = bench.poses.position - [0, 0, bench.setting.depth]
    fields = contact.field(below, sources, shape[:, 2:] * force, bench.setting.poisson)
    return np.concatenate([part.reshape(len(below), -1) for part in fields], axis=1)


def bench_contacts(loads: int) -> dict[str, Any]:
    """Measure the contacts of loads of each shape.

    A calibration ratio is an rms error divided by the predicted standard deviation.

    Args:
        loads: Number of loads of each shape.
    """
    result: dict[str, Any] = {name: _bench_case(case, loads) for name, case in CASES.items()}
    for cubes in CUBES[:2]:
        result[f"four balls that move, 289 {cubes} cubes"] = bench_moving_balls(cubes)
    return result


def bench_moving_balls(cubes: str) -> dict[str, float]:
    """Measure the CPU time of a scan while four balls begin, move at 50 mm/s and end.

    Args:
        cubes: Kind of the cubes, one of `CUBES`.
    """
    bench = TractionBench(replace(DENSE, cubes=cubes, side=0.128, gain_error=0.0), side=2)
    random = np.random.default_rng(3)
    count = (len(bench.poses.position), len(bench.calibration.noise))
    gain = 1 + GAIN_ERROR * random.standard_normal(count)
    shape = ellipse(6e-3, 6e-3, order=6)
    tracker = ContactTracker(bench.inverse, CONTACT_PRESSURE)
    corners = 28e-3 * np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])
    times_ms, errors = [], []
    for scan in range(MOVING_SCANS):
        pads, pressing = np.zeros(count), 0.0
        for number, corner in enumerate(corners):
            # Each ball touches 15 scans after the one before, and reaches its full force in 10.
            since = scan - 15 * number - 5
            until = MOVING_SCANS - 10 * number - scan
            share = float(np.clip(min(since, until) / 10, 0, 1))
            angle = since / RATE_HZ * SPEED / RADIUS_M
            direction = np.array([np.cos(angle), np.sin(angle)])
            centre = corner + RADIUS_M * direction
            force = share * FORCE_N * np.array([0.3, 0.0, -1.0])
            field = _field_under(bench, shape, centre, force)
            pads = pads + bench.pads_in(field)
            pressing += share * FORCE_N
        values = bench.measured(pads * gain, random)
        start_s = time.process_time()
        found = tracker.update(values)
        times_ms.append(1e3 * (time.process_time() - start_s))
        if pressing > 3.9 * FORCE_N:
            errors.append(sum(one.normal_force for one in found) / pressing - 1)
    return {
        "scan_cpu_mean_ms": float(np.mean(times_ms)),
        "scan_cpu_p99_ms": float(np.percentile(times_ms, 99)),
        "force_error_percent": float(100 * np.sqrt(np.mean(np.square(errors)))),
    }


def _bench_case(case: LoadCase, loads: int) -> dict[str, float]:
    bench = TractionBench(case.setting, side=2)
    random = np.random.default_rng(11)
    results = np.array([_bench_load(bench, case, random) for _ in range(loads)])
    mean_squares = (results[:, :4] ** 2).mean(axis=0)
    force, force_ratio, position, position_ratio = np.sqrt(mean_squares)
    count, first_ms, scan_ms = results[:, 4:].mean(axis=0)
    return {
        "force_error_percent": 100 * force / FORCE_N,
        "force_ratio": force_ratio,
        "position_error_mm": 1e3 * position,
        "position_ratio": position_ratio,
        "contacts": count,
        "first_scan_cpu_ms": first_ms,
        "scan_cpu_ms": scan_ms,
    }


def _bench_load(
    bench: TractionBench,
    case: LoadCase,
    random: np.random.Generator,
) -> list[float]:
    """Measure the contacts that the tracker finds under one load at a random position.

    Returns:
        Error of the force, in N, and this error / its predicted standard deviation; error of the
        position, in m, and this error / its predicted standard deviation; number of contacts; CPU
        times of the first and of the last scan, in ms.
    """
    direction, angle = random.uniform(0, 2 * np.pi, 2)
    shear = 0.3 * FORCE_N * np.array([np.cos(direction), np.sin(direction)])
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rotated = case.shape[:, :2] @ rotation.T
    shape = np.column_stack([rotated, case.shape[:, 2]])
    centre = case.setting.pitch * (random.random(2) - 0.5)
    if case.outside is not None:
        outermost = float(bench.poses.position[:, 0].max())
        centre[0] = outermost + case.outside * case.setting.pitch
    force = np.array([*shear, -FORCE_N])
    values = values_under(bench, shape, centre, force, random)

    tracker = ContactTracker(bench.inverse, CONTACT_PRESSURE)
    times_ms = []
    for _ in range(SCANS):
        start_s = time.process_time()
        found = tracker.update(values)
        times_ms.append(1e3 * (time.process_time() - start_s))
    total = sum_contacts(found)
    force_error = total.force - FORCE_N
    distance = float(np.linalg.norm(total.position - centre))
    # `position_deviation` is that of one coordinate. The distance results from the errors of two
    # coordinates, so its predicted rms is larger by √2.
    predicted_distance = total.position_deviation * np.sqrt(2)
    return [
        force_error,
        force_error / total.force_deviation,
        distance,
        distance / predicted_distance,
        len(found),
        times_ms[0],
        times_ms[-1],
    ]
