# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Values of cubes under Hertz contacts: the functions in C against those in numpy."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from point_loads import below_ball

from cube_tensor_design.studies.field_study import make_flat_skin
from cube_tensor_driver.config.calibration import find_shipped_calibration
from cube_tensor_driver.config.influence import find_influence
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.modes import STRESS
from cube_tensor_driver.mechanics.contact_response import ContactResponse
from cube_tensor_driver.mechanics.influence import read_influence
from cube_tensor_driver.mechanics.layer import Layer
from cube_tensor_driver.mechanics.measurement_model import CubeMeasurement
from cube_tensor_driver.touch.inverse import SurfaceInverse
from cube_tensor_driver.touch.pad_measurement import model_pads
from cube_tensor_driver.touch.tracker import hertz_response
from cube_tensor_driver.touch.tracker.contact_estimate import Discs
from cube_tensor_driver.touch.tracker.contact_tracker import ContactTracker

pytestmark = pytest.mark.skipif(hertz_response.native is None, reason="_scan is not built")

DEPTH = 5e-3
"""Depth of the cubes' centres below the surface, in m."""
HALF_SIDE = 2e-3
"""Half the side of a cube, in m."""
ROUNDING = 1e-6
"""Largest difference of C and numpy in values and their derivatives by forces and errors of the
elastomer, divided by the largest one."""
SLOPE_ROUNDING = 2e-4
"""Largest difference of C and numpy in derivatives by centre, radius, flatness and moment, divided
by the largest one. These derivatives are small differences of large numbers, so that their rounding
errors are larger."""


def make_points() -> SimpleNamespace:
    """Cubes as points in a half space, of which only some components are measured."""
    response = ContactResponse(CubeMeasurement(Layer(), DEPTH, HALF_SIDE))
    columns = np.array([0, 2, 3, 5, 8, 9, 14])
    return SimpleNamespace(
        contact_response=response, columns=columns, select=lambda values: values[..., columns]
    )


def make_pads() -> SimpleNamespace:
    """Two variants of cubes with pads, in a layer of finite thickness."""
    influence = read_influence(find_influence("cube_11mm"))
    calibrations = [find_shipped_calibration(LAYOUTS[name]) for name in ("cube", "planar")]
    model = model_pads(influence, calibrations)
    cubes = CubeMeasurement(influence.layer, influence.depth, HALF_SIDE, model)
    return SimpleNamespace(
        contact_response=ContactResponse(cubes),
        columns=np.arange(15),
        select=lambda values: values,
    )


@pytest.fixture(scope="module", params=["points", "pads"])
def inverse(request):
    return make_points() if request.param == "points" else make_pads()


def draw_load(inverse, n_contacts: int, smallest: float = 0.4) -> tuple:
    """Cubes at all distances, one of them below the first contact, and contacts of all sizes.

    Args:
        inverse: From `make_points` or `make_pads`.
        n_contacts: Number of contacts.
        smallest: Smallest radius, divided by the depth. Derivatives by smaller ones are almost 0.
    """
    random = np.random.default_rng(3)
    n_cubes, n_variants = 60, len(inverse.contact_response.collect_tables(inverse.columns)[3])
    direction = random.uniform(-3, 3, n_cubes)
    distance = DEPTH * np.geomspace(0.01, 30, n_cubes)
    place = distance[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    discs = Discs(
        random.normal(size=(n_contacts, 3)),
        np.concatenate([place[:1], DEPTH * random.normal(size=(n_contacts - 1, 2))]),
        np.log(DEPTH * np.geomspace(smallest, 6, n_contacts)),
    )
    angle, variant = random.uniform(-3, 3, n_cubes), random.integers(n_variants, size=n_cubes)
    return inverse, place, angle, variant, discs


def compute_differences(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """(...) Largest differences of arrays (cubes, C, ...), divided by the largest values."""
    return np.abs(found - expected).max(axis=(0, 1)) / np.abs(expected).max(axis=(0, 1))


@pytest.mark.parametrize("n_contacts", [1, 4])
def test_values_are_those_of_numpy(inverse, monkeypatch, n_contacts):
    load = draw_load(inverse, n_contacts, 0.05)
    found = hertz_response.respond(*load)
    monkeypatch.setattr(hertz_response, "native", None)
    assert compute_differences(found, hertz_response.respond(*load)) < ROUNDING


@pytest.mark.parametrize("n_contacts", [1, 4])
def test_effects_of_errors_are_those_of_numpy(inverse, monkeypatch, n_contacts):
    inverse, place, angle, _, discs = draw_load(inverse, n_contacts, 0.05)
    found = hertz_response.respond_to_errors(inverse, place, angle, discs).swapaxes(1, 2)
    monkeypatch.setattr(hertz_response, "native", None)
    expected = hertz_response.respond_to_errors(inverse, place, angle, discs).swapaxes(1, 2)
    assert (compute_differences(found, expected) < ROUNDING).all()


@pytest.mark.parametrize("n_contacts", [1, 4])
def test_derivatives_are_those_of_numpy(inverse, monkeypatch, n_contacts):
    load = draw_load(inverse, n_contacts)
    n = len(inverse.columns)
    whitening = np.tril(np.random.default_rng(4).normal(size=(len(load[1]), n, n)))
    found = hertz_response.differentiate(*load, 0.1, whitening)
    monkeypatch.setattr(hertz_response, "native", None)
    expected = hertz_response.differentiate(*load, 0.1, whitening)
    limit = np.full(expected[0].shape[2], ROUNDING)
    limit[: 8 * n_contacts].reshape(-1, 8)[:, 3:] = SLOPE_ROUNDING
    for one, other in zip(found, expected, strict=True):
        assert (compute_differences(one, other) < limit).all()


def test_contacts_are_those_of_numpy(monkeypatch):
    """The limit for the force is ten times the difference on a recording of four balls."""
    poses = make_flat_skin(12e-3, 72e-3)
    by_pad = np.tile(np.diag(np.where(np.arange(15) < len(STRESS), 3.0, 1500.0)), (49, 1, 1))
    inverse = SurfaceInverse.from_poses(poses, by_pad, Layer(), DEPTH)

    def follow() -> list:
        tracker = ContactTracker(inverse, 300.0)
        scans = []
        for x in np.linspace(0, 0.01, 6):
            values = below_ball(poses, DEPTH, 5e-3, (x, 0.02), (0.6, -0.3, -3.0))
            values += below_ball(poses, DEPTH, 5e-3, (-x, -0.02), (0.0, 0.3, -2.0))
            scans.append(tracker.update(values, max_work=np.inf))
        return scans

    found = follow()
    monkeypatch.setattr(hertz_response, "native", None)
    expected = follow()
    for scan, other_scan in zip(found, expected, strict=True):
        assert len(scan) == 2
        for one, other in zip(scan, other_scan, strict=True):
            assert (one.id, one.refined) == (other.id, other.refined)
            assert one.normal_force == pytest.approx(other.normal_force, rel=2e-6)


def test_arrays_that_do_not_fit_are_refused(inverse):
    inverse, *load = draw_load(inverse, 2)
    native, tables = hertz_response.native, inverse.contact_response.collect_tables(inverse.columns)
    arrays = hertz_response._convert(*load)
    result = np.empty((len(load[0]), 1, len(inverse.columns)))
    with pytest.raises(ValueError, match="array result does not fit"):
        native.respond(*tables[:4], *arrays, result[1:])
    order = tables[2].copy()
    order[-1] = 9
    with pytest.raises(ValueError, match="do not fit together"):
        native.respond(*tables[:2], order, tables[3], *arrays, result)
    columns = np.empty((len(result), result.shape[2], 16))
    whitening = np.zeros((*columns.shape[:2], result.shape[2]))
    with pytest.raises(ValueError, match="do not fit together"):
        native.linearise(1.0, *tables[:4], *arrays, None, *tables[4:], whitening, columns, columns)
