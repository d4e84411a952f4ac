# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Load scripts: what they do in time, and the stress that they cause at the cubes, against
closed forms."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy import interpolate

from cube_tensor_driver.config.load_script import Script, interpolate_knots, read_script
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import Skin, SkinCube, read_skin
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.core.tensor import rotation_from_rpy
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.simulation.load import Load, read_default_script
from cube_tensor_driver.simulation.spline import CubicSpline

ONE = read_skin(find_package_data() / "config" / "cube.yaml").cubes[0]
H = 0.004


def skin_of(places: np.ndarray, rpy: np.ndarray | None = None) -> Skin:
    turns = np.zeros_like(places) if rpy is None else rpy
    cubes = [
        SkinCube(f"c{i}", "hub", i, None, tuple(xyz), tuple(turn), ONE.calibration)
        for i, (xyz, turn) in enumerate(zip(places.tolist(), turns.tolist(), strict=True))
    ]
    return Skin("skin", "base", None, (), tuple(cubes))


def script_of(tmp_path: Path, *does: dict, **more: object) -> Script:
    indenter = {"name": "it", "shape": "disc", "radius": 0.003, "friction": 0.5, "does": list(does)}
    indenter |= {key: more.pop(key) for key in ("shape", "radius", "friction") if key in more}
    path = tmp_path / "load.yaml"
    path.write_text(yaml.safe_dump({"depth": H, **more, "indenters": [indenter]}))
    return read_script(path)


PRESS = {
    "press": {
        "from": 0.0,
        "to": 3.0,
        "at": [0.001, 0.002, 0.0],
        "force": 2.0,
        "shear": [0.6, -0.3, 0.0],
    }
}


def test_cubes_below_carry_the_load(tmp_path):
    """The traction that a plane of cubes sees sums to the force; of shear what lies beyond is
    missing."""
    pitch, reach = 0.002, 0.06
    line = np.arange(-reach, reach + pitch / 2, pitch)
    x, y = (a.ravel() for a in np.meshgrid(line, line))
    inside = np.hypot(x, y) <= reach
    places = np.stack([x[inside], y[inside], 0 * x[inside]], axis=1)
    load = Load(skin_of(places), script_of(tmp_path, PRESS, radius=0.001, poisson=0.5))
    stress, gradient = load.compute_stress_field(1.5)
    force, centre, normal = load.compute_resultant(1.5)
    np.testing.assert_allclose(force, [0.6, -0.3, -2.0], rtol=1e-12)
    np.testing.assert_allclose(centre, PRESS["press"]["at"])
    np.testing.assert_array_equal(normal, [0, 0, 1])
    # below a point load traction is 3 F·d h d / (2π R⁵): beyond R of the axis h³/R³ of the normal
    # part is left, and 3h/2R − h³/2R³ of the tangential; the sum of smooth values converges faster
    # than the rim's cells, 1 % of those
    beyond = H / np.hypot(H, reach)
    total = stress[:, [4, 3, 2]].sum(axis=0) * pitch**2
    assert total[2] == pytest.approx(-2.0 * (1 - beyond**3), rel=2e-3)
    left = 1 - 1.5 * beyond + 0.5 * beyond**3
    np.testing.assert_allclose(total[:2], [0.6 * left, -0.3 * left], rtol=5e-3)
    # equilibrium at every cube: ∂xx/∂x + ∂xy/∂y + ∂zx/∂z = 0 and so on
    for row in ((0, 5, 4), (5, 1, 3), (4, 3, 2)):
        balance = sum(gradient[:, part, axis] for axis, part in enumerate(row))
        assert np.abs(balance).max() < 1e-9 * np.abs(gradient).max()


@pytest.mark.parametrize(("shape", "radius"), [("disc", 0.006), ("disc", 0.02), ("sphere", 0.01)])
def test_on_the_axis_of_a_disc_and_of_a_sphere(tmp_path, shape, radius):
    """Johnson 3.4.2: −p (1 − h³/(a² + h²)^1.5) under uniform pressure, 3.4.3: −p0 / (1 + h²/a²)
    under Hertz's."""
    script = script_of(
        tmp_path,
        {"press": {"from": 0, "to": 3, "at": [0, 0, 0], "force": 3.0}},
        shape=shape,
        radius=radius,
        young=0.4e6,
        poisson=0.45,
    )
    stress, _ = Load(skin_of(np.zeros((1, 3))), script).compute_stress_field(1.5)
    if shape == "disc":
        expected = -3.0 / (np.pi * radius**2) * (1 - H**3 / np.hypot(radius, H) ** 3)
    else:
        a = np.cbrt(3 * 3.0 * radius * (1 - 0.45**2) / (4 * 0.4e6))
        expected = -1.5 * 3.0 / (np.pi * a**2) / (1 + (H / a) ** 2)
    # quadrature; see simulation.load
    assert stress[0, 2] == pytest.approx(expected, rel=1e-3)


def test_few_points_from_afar_are_as_good(tmp_path):
    """Against 24 rings for every cube: within 1e-3 of the largest value, wherever the number of
    points changes."""
    places = np.stack([np.linspace(0, 0.3, 181), np.full(181, 0.0007), np.zeros(181)], axis=1)
    for shape, radius in (("disc", 0.006), ("disc", 0.025), ("sphere", 0.02)):
        load = Load(
            skin_of(places), script_of(tmp_path, PRESS, shape=shape, radius=radius, poisson=0.5)
        )
        found = load.compute_stress_field(1.5)
        press = load.find_contact_loads(1.5)[0]
        sources, forces = getattr(contact, "hertz" if shape == "sphere" else shape)(
            press.radius, press.force, order=24
        )
        below = places - [*press.position[:2], H]
        for ours, truth in zip(found, contact.field(below, sources, forces, 0.5), strict=True):
            assert np.abs(ours - truth).max() < 1e-3 * np.abs(truth).max()


def test_mirrored_cubes_see_mirrored_stress(tmp_path):
    places = np.array([[x, y, 0.0] for x in (-0.01, 0.01) for y in (-0.005, 0.005)])
    script = script_of(tmp_path, {"press": {"from": 0, "to": 3, "at": [0, 0, 0], "force": 3.0}})
    stress, gradient = Load(skin_of(places), script).compute_stress_field(1.5)
    odd = np.array([1, 1, 1, 1, -1, -1])  # zx and xy change sign under x → −x
    scale = 1e-12 * np.abs(stress).max()
    np.testing.assert_allclose(stress[2:], stress[:2] * odd, atol=scale)
    np.testing.assert_allclose(gradient[2:, :, 2], gradient[:2, :, 2] * odd, atol=scale / H)
    np.testing.assert_allclose(gradient[2:, :, 0], -gradient[:2, :, 0] * odd, atol=scale / H)


def test_a_slide_is_a_press_moved(tmp_path):
    """In the middle of a straight slide: the force at the middle, friction × force along the
    path."""
    skin = skin_of(np.random.default_rng(0).uniform(-0.02, 0.02, (20, 3)) * [1, 1, 0])
    moved = {"from": 0, "to": 2, "path": [[-0.01, 0, 0], [0.02, 0.04, 0]], "force": [0, 3, 0]}
    slide = Load(skin, script_of(tmp_path, {"slide": moved}))
    in_place = {
        "from": 0,
        "to": 2,
        "at": [0.005, 0.02, 0],
        "force": [0, 3, 0],
        "shear": [0.9, 1.2, 0],
    }
    press = Load(skin, script_of(tmp_path, {"press": in_place}))
    # 1.5 × 50 mm in 2 s in the middle: (FRICTION_SPEED / v)² / 2 is missing of the friction
    for sliding, still in zip(
        slide.compute_stress_field(1.0), press.compute_stress_field(1.0), strict=True
    ):
        np.testing.assert_allclose(sliding, still, atol=1e-3 * np.abs(still).max())
    roll = Load(skin, script_of(tmp_path, {"roll": moved}))
    np.testing.assert_allclose(roll.compute_resultant(1.0)[0], [0, 0, -3], atol=1e-12)
    np.testing.assert_allclose(roll.compute_resultant(1.0)[1], [0.005, 0.02, 0])
    # at rest at both ends
    np.testing.assert_allclose(slide.find_contact_loads(1e-6)[0].position, [-0.01, 0, 0], atol=1e-9)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("points", [2, 3, 4, 9])
def test_the_curve_of_a_path_is_the_cubic_spline_of_scipy(points, closed):
    path = np.random.default_rng(points).normal(size=(points, 3))
    if closed:
        path = np.concatenate([path, path[:1]])
    curve = CubicSpline(path, closed=closed)
    ends = "periodic" if closed else "clamped"
    expected = interpolate.CubicSpline(np.linspace(0, 1, len(path)), path, bc_type=ends)
    for time in np.linspace(0, 1, 41):
        position, velocity = curve.interpolate(time)
        np.testing.assert_allclose(position, expected(time), atol=1e-12)
        np.testing.assert_allclose(velocity, expected(time, 1), atol=1e-10)


def test_taps_presses_and_the_time_between(tmp_path):
    skin = skin_of(np.zeros((1, 3)))
    script = script_of(
        tmp_path,
        {"tap": {"from": 5.0, "to": 6.0, "at": [0, 0, 0], "force": 2.0, "times": 4}},
        {"press": {"from": 0.0, "to": 3.0, "at": [0, 0, 0], "force": 1.0}},
        period=10.0,
    )
    load = Load(skin, script)
    times = np.arange(0, 20, 0.005)
    force = -np.array([load.compute_resultant(time)[0][2] for time in times])
    np.testing.assert_allclose(force[:2000], force[2000:], atol=1e-9)  # it begins anew
    peaks = (
        np.flatnonzero((force[1:-1] > force[:-2]) & (force[1:-1] > force[2:]) & (times[1:-1] < 10))
        + 1
    )
    np.testing.assert_allclose(times[peaks], 5.0 + 0.125 + 0.25 * np.arange(4), atol=0.006)
    np.testing.assert_allclose(force[peaks], 2.0, rtol=1e-3)
    assert (
        not force[(times >= 3) & (times < 5)].any() and not load.compute_stress_field(4.0)[0].any()
    )
    assert force[300] == pytest.approx(1.0)
    # half cosines: as steep as π/2 × peak / (an eighth of a second) at most
    assert np.abs(np.diff(force)).max() <= 0.005 * np.pi / 2 * 2.0 / 0.125 * (1 + 1e-9)


def test_between_meets_its_knots_and_stays_between_them():
    knots = np.array([0.0, 3.0, 1.0, 1.0, 2.0])
    np.testing.assert_allclose(interpolate_knots(knots, np.linspace(0, 1, 5)), knots)
    fine = interpolate_knots(knots, np.linspace(0, 1, 401))
    assert (fine >= 0).all() and (fine <= 3).all() and (np.diff(fine[:100]) > 0).all()


def test_turning_skin_and_load_changes_nothing(tmp_path):
    rpy = (0.3, -0.5, 1.1)
    turn = rotation_from_rpy(*rpy)
    places = np.random.default_rng(1).uniform(-0.02, 0.02, (12, 3)) * [1, 1, 0]
    flat = Load(skin_of(places), script_of(tmp_path, PRESS))
    turned = copy.deepcopy(PRESS)
    for key in ("at", "shear"):
        turned["press"][key] = (turn @ PRESS["press"][key]).tolist()
    other = Load(skin_of(places @ turn.T, np.tile(rpy, (12, 1))), script_of(tmp_path, turned))
    for one, two in zip(
        flat.compute_stress_field(1.0), other.compute_stress_field(1.0), strict=True
    ):
        np.testing.assert_allclose(one, two, atol=1e-9 * np.abs(one).max())


def test_a_cube_that_faces_away_sees_nothing(tmp_path):
    angle = np.deg2rad([0, 45, 89, 91, 135, 180, -135, -91, -89, -45])
    places = 0.04 * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    rpy = np.stack([0 * angle, angle, 0 * angle], axis=1)
    script = script_of(tmp_path, {"press": {"from": 0, "to": 3, "at": [0, 0, 0.044], "force": 3.0}})
    load = Load(skin_of(places, rpy), script)
    top = np.abs(load.compute_stress_field(1.5)[0]).max(axis=1)
    assert (np.diff(top[:3]) < 0).all() and not top[3:8].any()
    np.testing.assert_allclose(top[[8, 9]], top[[2, 1]])
    np.testing.assert_allclose(load.compute_resultant(1.5)[0], [0, 0, -3], atol=1e-6)


def test_the_shipped_script_is_the_same_in_every_process_and_never_lets_go():
    skin = read_skin(find_package_data() / "config" / "skin_demo.yaml")
    one, two = Load(skin, read_default_script()), Load(skin, read_default_script())
    assert one.period == 8.0
    for time in np.arange(0, 8, 0.37):
        np.testing.assert_array_equal(
            one.compute_stress_field(time)[0], two.compute_stress_field(time)[0]
        )
        np.testing.assert_allclose(
            one.compute_stress_field(time)[0],
            two.compute_stress_field(time + 8 * one.period)[0],
            rtol=1e-9,
        )
        assert 0.3 - 1e-9 <= -one.compute_resultant(time)[0][2] <= 3.0 + 1e-9


GOOD = {
    "period": 8.0,
    "indenters": [
        {
            "name": "a",
            "shape": "disc",
            "radius": 0.01,
            "does": [{"press": {"from": 0, "to": 1, "at": [0, 0, 0], "force": 1}}],
        },
        {
            "name": "b",
            "shape": "sphere",
            "radius": 0.01,
            "friction": 0.3,
            "does": [
                {"roll": {"from": 1, "to": 2, "path": [[0, 0, 0], [1, 0, 0]], "force": [0, 2, 0]}},
                {"tap": {"from": 3, "to": 4, "at": [0, 0, 0], "force": 1}},
            ],
        },
    ],
}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.update(speed=1), ["top level: unknown key 'speed'", "allowed: period, depth"]),
        (
            lambda d: d["indenters"][0].update(radius=-0.1),
            ["indenters[0].radius: found -0.1", "greater than 0"],
        ),
        (
            lambda d: d["indenters"][0].update(shape="cone"),
            ["indenters[0].shape: found 'cone'", "disc or sphere"],
        ),
        (
            lambda d: d["indenters"][0].update(does=[{"poke": {}}]),
            ["unknown key 'poke', allowed: press, slide, roll"],
        ),
        (
            lambda d: d["indenters"][1]["does"][0].update(tap=d["indenters"][1]["does"][1]["tap"]),
            ["one of press"],
        ),
        (
            lambda d: d["indenters"][0]["does"].append({}),
            ["indenters[0].does[1]: found {}", "one of press, slide"],
        ),
        (
            lambda d: d["indenters"][0]["does"][0]["press"].pop("at"),
            ["does[0].press: the key 'at' is missing"],
        ),
        (
            lambda d: d["indenters"][0]["does"][0]["press"].update(force=-1),
            ["press.force: found -1", "greater than 0"],
        ),
        (
            lambda d: d["indenters"][0]["does"][0]["press"].update(force=float("nan")),
            ["press.force: found nan"],
        ),
        (
            lambda d: d["indenters"][0]["does"][0]["press"].update(force=[0, 0]),
            ["press from 0 to 1 s has no force"],
        ),
        (
            lambda d: d["indenters"][0]["does"][0]["press"].update(to=0),
            ["press from 0 to 0 s ends before it begins"],
        ),
        (
            lambda d: d["indenters"][1]["does"][0]["roll"].update(to=3.5),
            ["(b)", "tap begins at 3 s", "ends at 3.5 s"],
        ),
        (
            lambda d: d["indenters"][1]["does"][0]["roll"].update(path=[[0, 0, 0]]),
            ["roll.path", "at least two"],
        ),
        (
            lambda d: d["indenters"][1]["does"][0]["roll"].update(shear=[1, 0, 0]),
            ["(b): roll", "0.5 of", "is 0.3"],
        ),
        (
            lambda d: d["indenters"][1].update(name="a"),
            ["indenters[1] (a): the name appears twice"],
        ),
        (lambda d: d.update(period=3.5), ["tap from 3 to 4 s is not over", "period is 3.5 s"]),
        (lambda d: d.update(poisson=0.6), ["poisson: found 0.6", "<= 0.5"]),
        (lambda d: d.update(indenters=[]), ["indenters: found []", "at least one"]),
    ],
)
def test_one_message_per_mistake(tmp_path, change, words):
    data = copy.deepcopy(GOOD)
    path = tmp_path / "load.yaml"
    path.write_text(yaml.safe_dump(data))
    read_script(path)
    change(data)
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError) as caught:
        read_script(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and "\n" not in text
    for word in words:
        assert word in text


def test_a_sphere_that_sinks_in_is_refused(tmp_path):
    script = script_of(tmp_path, PRESS, shape="sphere", radius=0.001)
    with pytest.raises(
        ConfigError, match=r"it: under 2 N the contact's radius is .* take less force"
    ):
        Load(skin_of(np.zeros((1, 3))), script)
    Load(skin_of(np.zeros((1, 3))), script_of(tmp_path, PRESS, shape="sphere", radius=0.02))
    with pytest.raises(
        ConfigError, match=r"radius is 50 mm, the cubes' depth 4 mm; .* at most 12 times"
    ):
        Load(skin_of(np.zeros((1, 3))), script_of(tmp_path, PRESS, radius=0.05))
