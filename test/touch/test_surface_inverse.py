# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Traction on the surface from all cubes, against contacts that other methods computed."""

from __future__ import annotations

import numpy as np
import pytest
from curved_skin import cylinder_stress, flat_error
from point_loads import below_ball

from cube_tensor_design.studies.field_study import compute_field_below, make_flat_skin
from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.defaults import POISSONS_RATIO
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.modes import COMPONENTS, STRESS
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.core.tensor import rotation_from_rpy
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.mechanics.layer import Layer
from cube_tensor_driver.mechanics.measurement_model import CubeMeasurement
from cube_tensor_driver.mechanics.traction_prior import AMPLITUDE, TractionPrior
from cube_tensor_driver.touch.inverse import SurfaceInverse
from cube_tensor_driver.touch.pad_noise import GAIN_ERROR
from cube_tensor_driver.touch.posterior import MODEL_ERROR
from cube_tensor_driver.touch.surface import Surface

DEPTH, PITCH, COUNT = 5e-3, 8e-3, 7
FLAT = make_flat_skin(PITCH, (COUNT - 1) * PITCH)
ACROSS = [k for k, name in enumerate(COMPONENTS) if "y" in name]


def pads_noise() -> np.ndarray:
    """(cubes, 15, 15) 3 Pa, a pad for each component."""
    sd = np.where(np.arange(15) < len(STRESS), 3.0, 3.0 / 2e-3)
    return np.tile(np.diag(sd), (COUNT**2, 1, 1))


def ball(poses: CubePoses, width: float, centre, force=(0.6, 0.3, -3.0)) -> np.ndarray:
    return below_ball(poses, DEPTH, width, centre, force)


def true_stress(inverse: SurfaceInverse, width: float, centre) -> np.ndarray:
    """(M,) sigma_zz below the points of the surface."""
    load = contact.hertz(width / 2, (0.6, 0.3, -3.0), centre, 12)
    return compute_field_below(inverse.points, DEPTH, load, POISSONS_RATIO)[:, 2]


def noisy(values: np.ndarray, seed: int = 1) -> np.ndarray:
    """With the noise of the pads, and 1 % of each component."""
    sd = np.where(np.arange(15) < len(STRESS), 3.0, 3.0 / 2e-3)
    error = np.random.default_rng(seed).standard_normal(values.shape)
    return values + error * np.hypot(sd, 0.01 * values)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


@pytest.fixture(scope="module")
def inverse():
    return SurfaceInverse.from_poses(FLAT, pads_noise(), Layer(), DEPTH, side=4)


@pytest.mark.parametrize(("width", "limit"), [(5e-3, 0.06), (10e-3, 0.03)])
def test_the_field_at_the_cubes_depth_is_the_true_one(inverse, width, limit):
    """And far nearer to it than what interpolation between the cubes gives."""
    centre = np.array([0.3, 0.4]) * PITCH
    values = noisy(ball(inverse.poses, width, centre))
    middle = np.abs(inverse.points[:, :2]).max(axis=1) < 0.02
    truth = -true_stress(inverse, width, centre)[middle]
    field = inverse.field(values)
    interpolated = Surface(inverse.poses, DEPTH, 4).field(values).pressure[middle]
    size = np.sqrt((truth**2).mean())
    error, before = (
        np.sqrt(((one - truth) ** 2).mean()) / size
        for one in (field.depth_pressure[middle], interpolated)
    )
    assert error < limit and error < before / 2
    # one contact is one draw: the stated deviation is right within a factor of two and a half
    stated = np.sqrt((inverse.deviation(values).depth_pressure[middle] ** 2).mean()) / size
    assert stated / 2.5 < error < 2.5 * stated


def test_the_traction_carries_the_load(inverse):
    centre, force = np.array([0.002, -0.001]), np.array([0.6, 0.3, -3.0])
    field = inverse.field(noisy(ball(inverse.poses, 10e-3, centre, force)))
    found = field.traction.sum(axis=0) * inverse.area
    np.testing.assert_allclose(found, force, atol=0.05 * np.linalg.norm(force))
    pressing = field.pressure
    middle = pressing @ inverse.points[:, :2] / pressing.sum()
    np.testing.assert_allclose(middle, centre, atol=0.4e-3)
    assert pressing.max() < 1.2 * 1.5 * 3 / (np.pi * 5e-3**2)


def test_values_that_are_missing_are_those_of_a_skin_without_them(inverse):
    """Cubes fall out, and pads of one: as good and as sure as matrices that are set up anew, which
    see what is missing from all cubes of each window, not from those next to it alone."""
    values = noisy(ball(inverse.poses, 10e-3, np.zeros(2)))
    whole, before = inverse.field(values), inverse.deviation(values)
    lost = values.copy()
    lost[[17, 24]], lost[30, ACROSS] = np.nan, np.nan
    field = inverse.field(lost)
    noise = pads_noise()
    noise[[17, 24]] = np.nan
    noise[30, ACROSS] = np.nan
    anew = SurfaceInverse.from_poses(FLAT, noise, Layer(), DEPTH, side=4)
    expected, stated = anew.field(lost), inverse.deviation(lost)
    truth = -true_stress(inverse, 10e-3, np.zeros(2))
    assert rms(field.depth_pressure - truth) < 1.2 * rms(expected.depth_pressure - truth)
    assert rms(stated.depth_pressure) == pytest.approx(
        rms(anew.deviation(lost).depth_pressure), rel=0.2
    )
    there = inverse.cube == 24
    assert (stated.depth_pressure[there] > before.depth_pressure[there]).all()
    again = inverse.field(values)
    np.testing.assert_array_equal(again.traction, whole.traction)
    unknown = np.full_like(values, np.nan)
    assert np.abs(inverse.field(unknown).traction).max() == 0
    assert np.isfinite(inverse.deviation(unknown).pressure).all()


def test_mean_and_deviation_on_a_small_skin_follow_from_the_formulas():
    """Nine cubes are one window of which all cubes are inner ones, so all matrices are small."""
    skin = make_flat_skin(PITCH, 2 * PITCH)
    noise = 90.0  # Pa; in most values about as much as the gain errors
    by_pad = noise / 3 * pads_noise()[:9]
    small = SurfaceInverse.from_poses(skin, by_pad, Layer(), DEPTH, side=2)
    values = noisy(ball(skin, 10e-3, (1e-3, 2e-3)))
    y = small.scale_values(values).ravel()
    prior = TractionPrior(CubeMeasurement(Layer(), DEPTH, skin.half_side[0]))
    place, n_points = skin.position[:, :2], len(small.points)

    first, second = np.divmod(np.arange(81), 9)
    straight, alike = np.zeros(81), np.zeros(81, int)
    pairs = place[first] - place[second], straight, alike, straight, alike
    known = prior.compute_covariance(*pairs).reshape(9, 9, 15, 15).swapaxes(1, 2).reshape(135, 135)
    apart = (place - small.points[:, None, :2]).reshape(-1, 2)
    cross = prior.compute_surface_covariance(apart, np.zeros(len(apart)), np.zeros(len(apart), int))
    cross = AMPLITUDE**2 * cross.swapaxes(1, 2).reshape(n_points, 9, 4, 15).swapaxes(1, 2)
    cross = cross.reshape(n_points, 4, 135)

    # Each component has a pad of its own, with the same noise in Pa.
    model_error = MODEL_ERROR**2 * np.diag(np.diag(known))
    precision = np.linalg.inv(AMPLITUDE**2 * (known + model_error) + noise**2 * np.eye(135))
    gain = cross @ precision
    field = small.field(values)
    found = np.column_stack([field.traction, field.depth_pressure])
    np.testing.assert_allclose(found, gain @ y, atol=1e-4 * np.abs(found).max())

    variance = AMPLITUDE**2 * prior.variance - (gain * cross).sum(axis=2)
    for factor in (1.0, 2.0):
        # The stress on a pad counts in units of its noise. The matrices are those of all pads.
        small.leave_out(np.arange(9), factor * by_pad)
        errors = noise**2 + (GAIN_ERROR * y / factor) ** 2
        scale = (y @ precision @ y - np.diag(precision) @ errors) / 135
        deviation = np.sqrt(scale * variance + gain**2 @ errors)
        stated = small.deviation(values)
        np.testing.assert_allclose(stated.pressure, deviation[:, 2], rtol=1e-3)
        np.testing.assert_allclose(stated.depth_pressure, deviation[:, 3], rtol=1e-3)


def test_predictions_on_a_small_skin_lose_nothing():
    """Missing values are predicted from all others, and give the field of a skin without them."""
    skin = make_flat_skin(PITCH, 2 * PITCH)
    values, noise = ball(skin, 10e-3, (1e-3, 2e-3)), pads_noise()[:9]
    lost = noise.copy()
    for one in (values, lost):
        one[[1, 4]], one[7, ACROSS] = np.nan, np.nan
    field, expected = (
        SurfaceInverse.from_poses(skin, one, Layer(), DEPTH, side=2).field(values)
        for one in (noise, lost)
    )
    limit = 1e-4 * np.abs(expected.traction).max()
    np.testing.assert_allclose(field.traction, expected.traction, atol=limit)
    np.testing.assert_allclose(field.depth_pressure, expected.depth_pressure, atol=limit)


def test_cubes_that_are_turned_see_the_same_traction(inverse):
    """Each by an angle of its own about z, and the whole skin somewhere else in space.

    Not exactly the same: turned cubes observe other parts of the shear's gradient.
    """
    random = np.random.default_rng(4)
    angle = random.uniform(-3, 3, COUNT**2)
    turns = np.array([rotation_from_rpy(0, 0, a) for a in angle])
    values = ball(FLAT, 10e-3, (0.001, 0.002))
    turned = ball(FLAT._replace(rotation=turns), 10e-3, (0.001, 0.002))
    away = rotation_from_rpy(0.7, -1.1, 2.0)
    poses = CubePoses(FLAT.position @ away.T + [1, 2, 3], away @ turns, FLAT.half_side)
    straight = inverse.field(values)
    field = SurfaceInverse.from_poses(poses, pads_noise(), Layer(), DEPTH, side=1).field(turned)
    one = SurfaceInverse.from_poses(FLAT, pads_noise(), Layer(), DEPTH, side=1).field(values)
    peak = np.abs(straight.traction).max()
    in_parent = np.einsum("nij,nj->ni", turns, field.traction)
    np.testing.assert_allclose(in_parent, one.traction, atol=0.03 * peak)
    np.testing.assert_allclose(field.depth_pressure, one.depth_pressure, atol=0.01 * peak)


def test_a_skin_that_observes_nothing_and_a_patch_without_points():
    with pytest.raises(ElasticError, match="no cube"):
        SurfaceInverse.from_poses(FLAT, pads_noise() * np.nan, Layer(), DEPTH)
    with pytest.raises(ElasticError, match="at least 1"):
        SurfaceInverse.from_poses(FLAT, pads_noise(), Layer(), DEPTH, side=0)
    with pytest.raises(ElasticError, match="between 0 and"):
        SurfaceInverse.from_poses(FLAT, pads_noise(), Layer(3e-3), DEPTH)


def test_a_curved_skin_laid_flat_is_off_by_half_its_depth_over_its_radius():
    """On a cylinder: its surface is free of traction, and the error goes as 1 / radius."""
    angle = np.linspace(0.1, np.pi - 0.1, 20)
    outward = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    traction = np.einsum("nij,nj->ni", cylinder_stress(0.045 * outward, 0.045), outward)
    assert np.abs(traction).max() < 1e-9 * 2 / np.pi / 0.045
    forearm = flat_error(0.045, DEPTH, 12.6e-3)
    assert forearm == pytest.approx(DEPTH / (2 * 0.045), rel=0.1)
    assert flat_error(0.45, DEPTH, 12.6e-3) == pytest.approx(forearm / 10, rel=0.05)


def test_it_is_made_of_a_skin_as_read_from_its_file():
    from types import SimpleNamespace as Skin

    poses = CubePoses(*(column[:6] for column in FLAT))
    calibrations = [make_illustrative_calibration("planar")] * 6
    inverse = SurfaceInverse(
        Skin(poses=poses, calibrations=calibrations, elastomer=None), depth=DEPTH
    )
    values = np.full((6, 15), np.nan)
    assert np.isfinite(inverse.field(values).traction).all()
    assert len(inverse.columns) == 7
