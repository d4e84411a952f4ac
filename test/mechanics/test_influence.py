# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Influence functions of pads against direct solutions, a known field and their own convergence."""

from dataclasses import replace

import numpy as np
import pytest

from cube_tensor_design.fem import body as bodies
from cube_tensor_design.fem import fem
from cube_tensor_design.fem.body import Body, make_mesh
from cube_tensor_design.fem.reciprocity import compute_influence
from cube_tensor_design.studies.surface_study import study_surface
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.layout import LAYOUTS, Layout

LAYER = Body(width=40e-3, ground=True, cube_young=float("inf"), z=1e-3)
PLANAR = LAYOUTS["planar"]


@pytest.fixture(scope="module")
def influence():
    return compute_influence(LAYER, PLANAR, 0)


def test_reciprocity_gives_what_a_force_on_the_surface_does(influence):
    """A direct solution under the force, on a body that is solved without mirrors."""
    body = replace(LAYER, x=1e-9)
    solid = fem.make_solid(body, PLANAR, make_mesh(body, PLANAR, 0))
    x, c = solid.positions, solid.component
    for place, component in ((0, 0), (0, 1), (1, 1), (-3, 0), (-3, 1)):
        top = np.flatnonzero((np.abs(x[1] - x[1].max()) < 1e-12) & (c == component))
        dof = top[np.argmin(np.abs(x[0, top] - place))]
        forces = np.zeros((len(c), 1))
        forces[dof] = 1.0
        direct = fem.compute_pad_stresses(solid, PLANAR, lambda _, f=forces: [f])[:, 0] / (
            body.side / 2
        )
        node = np.argmin(np.abs(influence.place[:, 0] - x[0, dof] * body.side / 2))
        given = influence.pads[:, node, component]
        assert np.abs(direct - given).max() < 1e-4 * np.abs(influence.pads).max()


def test_reciprocity_in_space(monkeypatch):
    """In space, too, a pad's influence function is its stress under a unit force at each place.

    The cube has one pad on each face. The forces act on the line y = 0 of the surface, and the body
    is moved along x so that the solver uses no mirror symmetry along x.
    """
    monkeypatch.setattr(bodies, "BRICK_SIZES", (bodies.BrickSizes(1.0, 0.3, 6.0),))
    layer = Body(width=9e-3, depth=9e-3, height=7e-3, ground=True, cube_young=float("inf"))
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    layout = Layout("faces", faces, faces, 0.6)
    influence = compute_influence(layer, layout, 0)
    body = replace(layer, x=1e-9)
    solid = fem.make_solid(body, layout, make_mesh(body, layout, 0))
    x, c = solid.positions, solid.component
    on_line = (np.abs(x[2] - x[2].max()) < 1e-12) & (np.abs(x[1]) < 1e-9)
    dofs = [
        dof[np.argmin(np.abs(x[0, dof] - place))]
        for place in (0, -2)
        for dof in (np.flatnonzero(on_line & (c == 0)), np.flatnonzero(on_line & (c == 2)))
    ]
    forces = np.zeros((len(c), len(dofs)))
    forces[dofs, range(len(dofs))] = 0.5  # half of the body carries half of a force on its mirror
    direct = fem.compute_pad_stresses(solid, layout, lambda p: [forces * (p[1] > 0)])
    for column, dof in zip(direct.T / (body.side / 2) ** 2, dofs, strict=True):
        away = influence.place - x[:2, dof] * body.side / 2
        given = influence.pads[:, np.argmin(np.hypot(*away.T)), c[dof]]
        assert np.abs(column - given).max() < 1e-5 * np.abs(influence.pads).max()


def test_pressure_everywhere_is_the_calibration_s_response_to_it():
    """What the layer has without the cube, by the response of a cube in a free box."""
    rigid = Body(width=80e-3, height=24e-3, ground=True, cube_young=float("inf"))
    soft = replace(rigid, cube_young=rigid.young, cube_poisson=rigid.poisson)
    of_cube, of_layer = (compute_influence(body, PLANAR, 0) for body in (rigid, soft))
    seen, field = (
        np.trapezoid(i.pads[:, :, 1], i.place[:, 0], axis=1) for i in (of_cube, of_layer)
    )
    response, applied = (
        fem.compute_response(replace(body, ground=False), PLANAR, "slab", meshes=1).matrix
        for body in (rigid, soft)
    )
    expected = response @ np.linalg.lstsq(applied, field)[0]
    assert np.abs(seen - expected).max() < 0.05 * np.abs(seen).max()


def test_influence_converges_with_the_mesh(influence):
    x = np.linspace(-10e-3, 10e-3, 41)
    coarse = influence.interpolate(x[:, None])
    fine = compute_influence(LAYER, PLANAR, 1).interpolate(x[:, None])
    assert np.abs(coarse - fine).max() < 0.02 * np.abs(fine).max()


def test_without_a_cube_the_layer_carries_the_pressure():
    soft = replace(LAYER, cube_young=LAYER.young, cube_poisson=LAYER.poisson)
    influence = compute_influence(soft, PLANAR, 0)
    x = np.linspace(-20e-3, 20e-3, 2001)
    upper = influence.interpolate(x[:, None])[:2, :, 1]
    assert np.trapezoid(upper, x, axis=1) == pytest.approx(1.0, rel=0.03)


def test_a_body_without_ground_is_refused():
    with pytest.raises(ElasticError, match="ground=True"):
        compute_influence(Body(), PLANAR)


def test_a_small_cube_says_what_is_there():
    """Finite elements against the layer's closed form; the pads of a cube of 0.5 mm see the field
    of the layer.

    Of twice the side the error of the pressure is about four times as large, as that of a cylinder
    near a surface is. In a body of 60 mm its ends would cost 5 % of the shear.
    """
    errors = []
    for side in (1e-3, 0.5e-3):
        study = study_surface(Body(width=120e-3, side=side), PLANAR, meshes=2)
        largest = [max(map(abs, row.true.values())) for row in study.rows]
        errors.append(
            [
                {name: abs(row.measured[name] - row.true[name]) / most for name in row.measured}
                for row, most in zip(study.rows, largest, strict=True)
            ]
        )
    coarse, fine = errors
    assert all(error < 0.02 for row in fine for error in row.values())
    (pressed,) = (k for k, row in enumerate(study.rows) if row[:3] == ("press", 5e-3, 0.0))
    assert 3 < coarse[pressed]["zz"] / fine[pressed]["zz"] < 6
    for load, largest_one, other in (("press", "zz", "zx"), ("rub", "zx", "zz")):
        (row,) = (row for row in study.rows if row[:3] == (load, 20e-3, 0.0))
        sign = -1 if load == "press" else 1
        assert sign * row.measured[largest_one] > 10 > 1e4 * abs(row.measured[other])
