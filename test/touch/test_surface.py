# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The field between the cubes against the contact model, and what the gradients buy."""

from __future__ import annotations

import numpy as np
import pytest
from point_loads import below_ball

from cube_tensor_design.studies.field_study import study_fields
from cube_tensor_design.studies.pads_example import sweep
from cube_tensor_driver.core.defaults import (
    CONTACT_PRESSURE,
    HALF_SIDE,
    SURFACE_DEPTH,
)
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.core.tensor import rotation_from_rpy
from cube_tensor_driver.touch.surface import Surface

DEPTH = SURFACE_DEPTH


def flat(nx: int, ny: int, pitch: float) -> CubePoses:
    x, y = np.meshgrid(
        (np.arange(nx) - (nx - 1) / 2) * pitch, (np.arange(ny) - (ny - 1) / 2) * pitch
    )
    position = np.stack([x.ravel(), y.ravel(), np.zeros(nx * ny)], axis=1)
    return CubePoses(position, np.tile(np.eye(3), (nx * ny, 1, 1)), np.full(nx * ny, HALF_SIDE))


def measured(places: CubePoses, width: float, force: tuple, centre: np.ndarray) -> np.ndarray:
    """What cubes that see everything give: (N, 15)."""
    return below_ball(places, DEPTH, width, centre, force)


def test_a_study_ranks_the_kinds_of_cubes_and_counts_those_that_are_saved():
    """One gradient is better than none and worse than two."""
    study = study_fields(np.array([0.006, 0.012]), np.array([0.02]), cases=3)
    alone, whole, planar = np.moveaxis(study.error[0], 1, 0)
    assert (whole < planar).all() and (planar < alone).all()
    assert (whole < 0.2).all() and (alone > 2 * whole).all()
    ((one, saved, some),) = study.compute_cubes_saved(0.14)
    assert one == 1 and 1 < some < saved
    assert np.isnan(study.compute_cubes_saved(0.9)).all()


def test_value_and_gradient_are_met_at_the_cubes():
    skin = flat(5, 5, 0.008)
    values = measured(skin, 0.01, (0, 0, -2), np.array([0.001, -0.002]))
    # An odd number: the middle point of a patch is where the cube is.
    fine = Surface(skin, DEPTH, 81)
    field = fine.field(values).pressure.reshape(25, 81, 81)
    peak = field.max()
    # the ridge of 1e-6 lets it miss by its root, a thousandth
    np.testing.assert_allclose(field[:, 40, 40], -values[:, 2], atol=1e-3 * peak)
    slope = (field[:, 40, 41] - field[:, 40, 39]) / (2 * fine.spacing)
    np.testing.assert_allclose(slope, -values[:, 12], atol=2e-3 * np.abs(values[:, 12]).max())


def test_cubes_without_a_tensor_are_filled_in_by_the_others():
    skin = flat(5, 5, 0.006)
    surface = Surface(skin, DEPTH)
    values = measured(skin, 0.02, (0, 0, -3), np.zeros(2))
    full = surface.field(values).pressure
    values[12] = np.nan
    hole = surface.field(values).pressure
    assert np.isfinite(hole).all()
    assert np.abs(hole - full).max() < 0.25 * full.max()
    values[:] = np.nan
    assert np.isnan(surface.field(values).pressure).all()
    assert surface.find_contacts(values, CONTACT_PRESSURE) == []


def test_weights_solved_anew_for_some_cubes_are_those_of_a_new_surface():
    skin = flat(7, 7, 0.006)
    surface, values = Surface(skin, DEPTH), measured(skin, 0.02, (1, 0, -3), np.zeros(2))
    surface.find_contacts(values, CONTACT_PRESSURE)
    values[10], values[30, 12:] = np.nan, np.nan
    anew = Surface(skin, DEPTH)
    (known,), (new,) = (
        surface.find_contacts(values, CONTACT_PRESSURE),
        anew.find_contacts(values, CONTACT_PRESSURE),
    )
    np.testing.assert_array_equal(surface.field(values).pressure, anew.field(values).pressure)
    np.testing.assert_array_equal(
        surface.compute_uncertainty(values), anew.compute_uncertainty(values)
    )
    np.testing.assert_array_equal(known.position, new.position)


def test_a_contact_beside_cubes_of_which_nothing_is_known_is_finite():
    skin = flat(20, 5, 0.006)
    values = measured(skin, 0.012, (0.3, 0, -2), np.array([-0.03, 0.0]))
    values[skin.position[:, 0] > 0.01] = np.nan
    surface = Surface(skin, DEPTH)
    assert np.isnan(surface.field(values).pressure).any()
    (found,) = surface.find_contacts(values, CONTACT_PRESSURE)
    assert found.normal_force == pytest.approx(2, rel=0.1) and np.isfinite(found.position).all()


def test_contact_has_the_load_s_place_and_force():
    skin = flat(9, 9, 0.006)
    force, centre = np.array([0.6, -0.4, -3.0]), np.array([0.0023, -0.0031])
    (found,) = Surface(skin, DEPTH).find_contacts(
        measured(skin, 0.012, force, centre), CONTACT_PRESSURE
    )
    # What spreads beyond a skin of 54 mm is lost: 3 (1 - (1 + (27/4)²)^-3/2) N is 0.3 % less.
    assert found.normal_force == pytest.approx(3.0, rel=0.02)
    # Shear falls as 3 depth x² / (2 π r⁵): 1.5 depth / 27 mm of it lies outside.
    shear = found.force[:2] / force[:2]
    np.testing.assert_allclose(shear, 1 - 1.5 * DEPTH / 0.027, rtol=0.1)
    # Without the layer's equilibrium it would be DEPTH × shear / normal = 0.96 mm off.
    np.testing.assert_allclose(found.position, [*centre, DEPTH], atol=3e-4)
    np.testing.assert_allclose(found.normal, [0, 0, 1], atol=1e-12)
    assert found.shear_force == pytest.approx(np.linalg.norm(found.force[:2]))
    assert 0 < found.position_uncertainty < 1e-3 and 0 < found.force_uncertainty < 0.5


def test_two_contacts_are_two_the_stronger_first():
    skin = flat(15, 5, 0.006)
    left, right = np.array([-0.03, 0.0]), np.array([0.03, 0.002])
    values = measured(skin, 0.008, (0, 0, -1), left) + measured(skin, 0.008, (0, 0, -2), right)
    first, second = Surface(skin, DEPTH).find_contacts(values, CONTACT_PRESSURE)
    assert first.normal_force == pytest.approx(2, rel=0.1)
    assert second.normal_force == pytest.approx(1, rel=0.1)
    assert np.linalg.norm(first.position[:2] - right) < 1e-3
    assert np.linalg.norm(second.position[:2] - left) < 1e-3


def test_a_turned_skin_gives_the_turned_field():
    skin = flat(5, 4, 0.008)
    turn = rotation_from_rpy(0.7, -1.1, 2.0)
    moved = CubePoses(
        skin.position @ turn.T + [1.0, 2.0, 3.0], turn @ skin.rotation, skin.half_side
    )
    values = measured(skin, 0.01, (0.3, 0.2, -2), np.array([0.002, 0.001]))
    straight, turned = Surface(skin, DEPTH), Surface(moved, DEPTH)
    peak = np.nanmax(straight.field(values).pressure)
    np.testing.assert_allclose(
        turned.field(values).pressure, straight.field(values).pressure, atol=1e-6 * peak
    )
    (a,), (b,) = (
        straight.find_contacts(values, CONTACT_PRESSURE),
        turned.find_contacts(values, CONTACT_PRESSURE),
    )
    np.testing.assert_allclose(b.position, turn @ a.position + [1, 2, 3], atol=1e-8)
    np.testing.assert_allclose(b.force, turn @ a.force, atol=1e-6)


@pytest.mark.parametrize(("depth", "side"), [(0.0, 4), (float("nan"), 4), (1e-3, 0)])
def test_what_no_surface_is(depth, side):
    with pytest.raises(ElasticError, match="greater than 0"):
        Surface(flat(2, 2, 0.01), depth, side)


def test_the_view_s_squares_have_the_colour_of_their_value():
    from cube_tensor_driver.views import scene
    from cube_tensor_driver.views.meshes import (
        COLOUR_STEPS,
        compute_step_colours,
        find_colour_steps,
    )

    for name in ("pressure", "zz"):
        quantity = scene.QUANTITIES[name]
        shown = np.append(np.linspace(-12e3, 12e3, 301), np.nan)
        colours = compute_step_colours(quantity)[find_colour_steps(quantity, shown, 10e3)]
        expected = 255 * scene.choose_colours(quantity, shown, 10e3)
        # half a step, where the scale is steepest
        scale = 255 * scene.choose_colours(quantity, np.linspace(-10e3, 10e3, 2000), 10e3)
        steepest = np.abs(np.diff(scale, axis=0)).max() * 2000 / COLOUR_STEPS
        assert np.abs(colours - expected).max() <= steepest / 2 + 1


def test_two_pads_take_a_gradient_for_shear_and_eight_do_not():
    """As docs/stress_tensor.md says and draws."""
    found = sweep(129)
    step = found.place[1] - found.place[0]
    assert found.slope == pytest.approx(np.gradient(found.profile, step)[64], rel=1e-3)
    assert found.profile[64] == pytest.approx(found.value)
    # Without friction the load pulls nowhere: its shear is odd about the place of the ball.
    assert np.allclose(found.truth, -found.truth[::-1], atol=1e-6)
    assert np.allclose(found.cube, found.truth, atol=1e-6)
    assert np.abs(found.pair).max() > 3 * np.abs(found.truth).max()
