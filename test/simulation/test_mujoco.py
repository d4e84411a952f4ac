# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Skins on the bodies of MuJoCo models: forces in equal forces out, on bodies that stick, slip and
roll; the discs and patches that this is made of, against exact sums."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from conftest import ROOT
from cube_tensor_driver.cli.main import main
from cube_tensor_driver.config.grid import describe_grid
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import Skin, check_skin_data, read_skin
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.mechanics.contact_tables import CONTACT_SIZES, DiscTables, PolygonTables
from cube_tensor_driver.mechanics.layer import Layer
from cube_tensor_driver.simulation.mujoco.patches import Polygon, make_flat_contact
from cube_tensor_driver.simulation.mujoco.scene import MujocoLoad, find_scene_skin
from cube_tensor_driver.simulation.mujoco.source import MujocoSkin
from cube_tensor_driver.simulation.source import simulate
from cube_tensor_driver.touch.inverse import SurfaceInverse

DEPTH, PITCH = 4e-3, 6e-3
SCENES = find_package_data() / "config" / "mujoco"
WEIGHT, FRICTION = 0.5 * 9.81, 0.6
# A skin that is turned, with a flat box on it.
BOX = """
<mujoco>
  <option timestep="0.001" cone="elliptic" impratio="50"/>
  <worldbody>
    <body name="pad" pos="0.1 0.2 0.1" euler="0 0 30">
      <geom type="box" size="0.05 0.05 0.005" pos="0 0 -0.001" friction="0.6"/>
    </body>
    <body name="box" pos="0.1 0.2 0.1079" euler="0 0 30">
      <freejoint/>
      <geom type="box" size="0.012 0.012 0.004" mass="0.5" friction="0.6"/>
    </body>
  </worldbody>
</mujoco>
"""
WEDGE = '<geom type="box" size="0.004 0.004 0.003" pos="0.018 0 0.003"/></body>'
"""A second geom over some of the cubes."""
ALONG = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0])
"""The x axis of the skin in the world."""


def pad(body: str = "pad") -> Skin:
    data = describe_grid(nx=7, ny=7, pitch=PITCH, rate=1000.0, layout="cube") | {
        "parent_frame": body
    }
    skin, mistakes = check_skin_data(data, Path())
    assert not mistakes
    return skin


@pytest.fixture(scope="module")
def mujoco():
    return pytest.importorskip("mujoco", reason="needs MuJoCo: pip install mujoco")


@pytest.fixture(scope="module")
def inverse():
    return SurfaceInverse(pad(), depth=DEPTH)


@pytest.fixture
def box(mujoco):
    """The box at rest on the skin; model, data and skin."""
    model = mujoco.MjModel.from_xml_string(BOX)
    data = mujoco.MjData(model)
    touch = MujocoSkin(model, data, pad())
    for _ in range(300):
        mujoco.mj_step(model, data)
    return model, data, touch


def force_on(touch: MujocoSkin, inverse: SurfaceInverse) -> np.ndarray:
    """(3,) N on the skin, in its frame, as the reconstructed tensors tell: the traction on the
    surface, summed. The sum of the cubes' own traction leaves out what spreads beyond them."""
    rows = touch.read()
    field = inverse.field(np.concatenate([rows.stress, rows.gradient], axis=1))
    force: np.ndarray = field.traction.sum(axis=0) * inverse.area
    return force


def test_discs_are_those_of_point_forces():
    """Stress and gradient under discs of any radius and force anywhere, in a half space."""
    random = np.random.default_rng(1)
    cubes = np.column_stack([random.uniform(-0.02, 0.02, (20, 2)), np.full(20, -DEPTH)])
    middle, forces = random.uniform(-0.02, 0.02, (6, 2)), random.normal(size=(6, 3))
    cubes[0, :2] = middle[0]  # right below: the direction to the disc is lost there
    radius = CONTACT_SIZES[[0, 4, 8, 12, 16, 18]] * DEPTH
    place = cubes[:, None, :2] - middle
    stress, gradient = DiscTables(Layer(poisson=0.3), DEPTH).compute_field(
        place, np.broadcast_to(forces, (20, 6, 3)), radius
    )
    exact = [
        contact.field(cubes, *contact.hertz(a, f, c, order=10), 0.3)
        for a, f, c in zip(radius, forces, middle, strict=True)
    ]
    expected, slope = (sum(parts) for parts in zip(*exact, strict=True))
    assert np.abs(stress - expected).max() < 1e-3 * np.abs(expected).max()
    assert np.abs(gradient - slope).max() < 2e-3 * np.abs(slope).max()


@pytest.mark.parametrize("depths", [19.9, 20.1, 40])
def test_discs_far_away_act_within_the_noise_of_a_pad(depths):
    """The tables end at 20 depths, where 3 N that rub cause 73 Pa. The noise of a pad is 3 Pa."""
    force, place = np.array([0.9, 0.0, -3.0]), depths * DEPTH * np.array([1.0, 0.0])
    tables = DiscTables(Layer(poisson=0.48), DEPTH)
    stress, _ = tables.compute_field(place[None, None], force[None, None], np.array([3e-3]))
    load = contact.hertz(3e-3, force, (0, 0), order=8)
    expected, _ = contact.field(np.array([[*place, -DEPTH]]), *load, 0.48)
    np.testing.assert_allclose(stress, expected, atol=2.0)


def under(polygon: Polygon, cubes: np.ndarray, layer: Layer) -> tuple[np.ndarray, np.ndarray]:
    """Stress and gradient at cubes (N, 2) below a polygon on the plane z = 0."""
    start = polygon.corners[:, :2] - cubes[:, None]
    twist = np.full(start.shape[:2], polygon.twist)
    foot = np.column_stack([cubes, np.zeros(len(cubes))]) - polygon.centre
    traction = polygon.traction + polygon.twist * np.cross([0.0, 0.0, 1.0], foot)
    traction = np.repeat(traction[:, None], start.shape[1], axis=1)
    return PolygonTables(layer, DEPTH).compute_field(
        start, np.roll(start, -1, axis=1), traction, twist
    )


def point_forces(polygon: Polygon, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Places (L, 3) m and forces (L, 3) N of its traction, by Gauss points in its triangles."""
    t, weight = np.polynomial.legendre.leggauss(order)
    u, v = (one.ravel() for one in np.meshgrid((t + 1) / 2, (t + 1) / 2))
    share = np.outer(weight, weight).ravel() / 4 * u
    normal = np.cross(*np.diff(polygon.corners[:3], axis=0))
    normal /= np.linalg.norm(normal)
    places, forces = [], []
    legs = polygon.corners - polygon.centre
    for one, other in zip(legs, np.roll(legs, -1, axis=0), strict=True):
        arm = np.outer(u * (1 - v), one) + np.outer(u * v, other)
        area = share * (np.cross(one, other) @ normal)
        traction = polygon.traction + polygon.twist * np.cross(normal, arm)
        places.append(polygon.centre + arm)
        forces.append(area[:, None] * traction)
    return np.concatenate(places), np.concatenate(forces)


@pytest.mark.parametrize("corners", [3, 4, 6])
def test_polygons_are_those_of_point_forces(corners):
    """Stress and gradient under uniform traction and one that turns, in a half space."""
    random = np.random.default_rng(corners)
    angle = 2 * np.pi * np.arange(corners) / corners + 0.3
    around = np.column_stack([0.02 * np.cos(angle), 0.006 * np.sin(angle), np.zeros(corners)])
    centre = np.array([0.005, 0.002, 0.0])
    polygon = Polygon(centre + around, centre, random.normal(size=3), 90.0)
    cubes = random.uniform(-0.03, 0.03, (30, 2))
    cubes[0] = polygon.corners[0, :2]  # right below a corner two edges have no distance
    places = np.column_stack([cubes, np.full(30, -DEPTH)])
    expected, slope = contact.field(places, *point_forces(polygon, 24), 0.3)
    stress, gradient = under(polygon, cubes, Layer(poisson=0.3))
    assert np.abs(stress - expected).max() < 2e-3 * np.abs(expected).max()
    assert np.abs(gradient - slope).max() < 4e-3 * np.abs(slope).max()


def test_a_square_on_a_layer_is_that_of_its_waves():
    """On a thin layer on rigid ground: the transfer functions times the square's spectrum."""
    layer, half = Layer(2 * DEPTH, 0.4), 2 * DEPTH
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    square = Polygon(corners, np.zeros(3), np.array([1.0, -2.0, -3.0]), 0.0)
    cubes = np.random.default_rng(1).uniform(-2 * half, 2 * half, (30, 2))
    nodes, weight = np.polynomial.legendre.leggauss(160)
    k, angle = (nodes + 1) * 8 / DEPTH, 2 * np.pi * (np.arange(192) + 0.5) / 192
    kx, ky = (np.outer(k, turn(angle)).ravel() for turn in (np.cos, np.sin))
    element = np.repeat(weight * 8 / DEPTH * k, 192) / 192 / (2 * np.pi)
    spectrum = 4 * np.sin(half * kx) * np.sin(half * ky) / (kx * ky) * element
    waves = np.exp(1j * (cubes @ [kx, ky])) * spectrum
    expected = (waves @ (layer.compute_transfer(kx, ky, DEPTH) @ square.traction)).real
    stress, gradient = under(square, cubes, layer)
    for found, wanted in ((stress, expected[:, :6]), (gradient, expected[:, 6:].reshape(-1, 6, 3))):
        assert np.abs(found - wanted).max() < 4e-3 * np.abs(wanted).max()


@pytest.mark.parametrize("count", [2, 3, 4, 8])
def test_a_flat_contact_keeps_force_and_moments_and_nothing_pulls(count):
    random = np.random.default_rng(count)
    normal = random.normal(size=3)
    normal /= np.linalg.norm(normal)
    points = random.uniform(-0.02, 0.02, (count, 3))
    points -= np.outer(points @ normal - 0.05, normal)
    forces = random.normal(size=(count, 3)) - 4 * normal
    polygon = make_flat_contact(points, forces, normal, DEPTH / 4)
    places, parts = point_forces(polygon, 3)
    np.testing.assert_allclose(parts.sum(axis=0), forces.sum(axis=0), rtol=1e-12)
    moment = np.cross(points, forces).sum(axis=0)
    np.testing.assert_allclose(np.cross(places, parts).sum(axis=0), moment, atol=1e-12)
    assert polygon.traction @ normal < 0


def pull_at_the_foot(data, pull: float) -> None:
    """A force in N on the box where it touches the skin, along it."""
    data.body("box").xfrc_applied[:3] = pull * ALONG
    data.body("box").xfrc_applied[3:] = np.cross([0, 0, -0.004], pull * ALONG)


@pytest.mark.parametrize("pull", [0.0, 1.5, -2.5])
def test_the_skin_feels_the_weight_and_the_pull_of_a_box_that_sticks(mujoco, box, inverse, pull):
    """The box is pulled along the skin at its foot, with less than friction holds."""
    model, data, touch = box
    pull_at_the_foot(data, pull)
    for _ in range(200):
        mujoco.mj_step(model, data)
    assert np.abs(data.qvel).max() < 1e-2
    np.testing.assert_allclose(force_on(touch, inverse), [pull, 0, -WEIGHT], atol=0.02 * WEIGHT)


def test_a_box_that_slips_drags_the_skin_along_by_friction_times_weight(mujoco, box, inverse):
    model, data, touch = box
    pressed, there = touch.touches()[0].press.position, data.body("box").xpos.copy()
    # Pulled as hard as friction brakes it, it goes on at the same speed and does not tip.
    data.qvel[:3] = 0.1 * ALONG
    pull_at_the_foot(data, FRICTION * WEIGHT)
    for _ in range(80):
        mujoco.mj_step(model, data)
    force, press = force_on(touch, inverse), touch.touches()[0].press
    np.testing.assert_allclose(force, press.force, atol=0.02 * np.linalg.norm(press.force))
    assert force[0] == pytest.approx(-FRICTION * force[2], rel=0.02)
    # Slip is seen: what presses moves along the skin as far as the box does.
    moved = (data.body("box").xpos - there) @ ALONG
    assert moved > 5e-3
    assert (press.position - pressed)[0] == pytest.approx(moved, abs=1e-3)


def test_the_back_of_a_body_feels_nothing(mujoco):
    """The same box below the skin, in free fall upwards."""
    upwards = BOX.replace("<option", '<option gravity="0 0 9.81"').replace("0.1079", "0.0901")
    model = mujoco.MjModel.from_xml_string(upwards)
    data = mujoco.MjData(model)
    touch = MujocoSkin(model, data, pad())
    for _ in range(100):
        mujoco.mj_step(model, data)
    assert data.ncon > 0
    assert not touch.touches()
    np.testing.assert_allclose(touch.read().stress, 0.0, atol=1.0)


@pytest.mark.parametrize(
    ("scene", "seconds", "force"),
    [
        # A steel ball of 20 mm; a box of 0.3 kg in the air; a leg that is pushed down by 450 N.
        ("ball", 0.6, [0, 0, -9.81 * 7800 * 4 / 3 * np.pi * 0.02**3]),
        ("gripper", 1.6, [0, 0, -0.3 * 9.81]),
        ("foot", 0.8, [0, 0, -450]),
    ],
)
def test_shipped_scenes(mujoco, scene, seconds, force):
    """They play, bear the weight, and are the same whenever they are asked for a time."""
    path = SCENES / f"{scene}.xml"
    skin = read_skin(find_scene_skin(path))
    load = MujocoLoad(path, skin)
    np.testing.assert_allclose(
        load.compute_resultant(seconds)[0], force, atol=0.02 * np.linalg.norm(force)
    )
    once = np.concatenate(load.compute_stress_field(seconds), axis=None)
    load.compute_stress_field(0.5 * seconds)
    again = (
        load.compute_stress_field(load.period + seconds),
        MujocoLoad(path, skin).compute_stress_field(seconds),
    )
    for fields in again:
        np.testing.assert_array_equal(np.concatenate(fields, axis=None), once)
    rows = next(iter(simulate(skin, load, rate=100.0)))
    assert len(rows) == len(skin.cubes)


def test_a_scene_without_keyframes_goes_on_and_is_the_same_when_asked_again(mujoco, tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(BOX.replace('timestep="0.001"', 'timestep="0.005"'))
    load = MujocoLoad(path, pad())
    assert load.repeats is None
    first = load.compute_resultant(0.02)[0]
    np.testing.assert_allclose(load.compute_resultant(2.5)[0], [0, 0, -WEIGHT], atol=0.02 * WEIGHT)
    np.testing.assert_array_equal(load.compute_resultant(0.02)[0], first)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<mujoco", "MuJoCo cannot read it"),
        ("<mujoco/>", "names no skin"),
        (BOX.replace('"pad"', '"plate"'), "has no body pad.*bodies are world, plate, box"),
        (
            BOX.replace("0.05 0.05 0.005", "0.01 0.05 0.005"),
            "no geom of body pad .* above cube c00",
        ),
        (
            BOX.replace("</body>", WEDGE, 1),
            "cube c.* lies .* mm below the surface, the others 4 mm",
        ),
    ],
)
def test_what_does_not_fit_is_named(mujoco, tmp_path, text, said):
    path = tmp_path / "scene.xml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said) as caught:
        if "body" in text:
            MujocoLoad(path, pad())
        else:
            find_scene_skin(path)
    assert "\n" not in str(caught.value)


def test_the_programs_of_the_page_run(mujoco, tmp_path, monkeypatch, capsys):
    """A sensor, and hubs that the real driver reads: both see the ball."""
    page = (ROOT / "docs" / "simulation.md").read_text()
    *_, sensor, hubs = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (tmp_path / "config").symlink_to(ROOT / "config")
    monkeypatch.chdir(tmp_path)
    exec(sensor + hubs, {})
    said = capsys.readouterr().out
    here, through_links = re.fullmatch(r"l\D+(\d+\.\d) kPa\nl\D+(\d+\.\d) kPa\n", said).groups()
    assert float(here) > 1.0
    assert float(through_links) == pytest.approx(float(here), rel=0.3)
    assert not (tmp_path / "ports").exists()


def test_the_gripper_of_the_page_holds_a_cup_with_little_force(mujoco, monkeypatch, capsys):
    """It slips once, learns the friction of the scene, and holds the filled cup."""
    page = (ROOT / "docs" / "examples.md").read_text()
    (program,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(ROOT)
    names: dict = {}
    exec(program, names)
    force, needed, slid = map(float, re.findall(r"\d+\.\d+", capsys.readouterr().out))
    assert needed < force < 1.3 * needed and slid < 6
    assert np.nanmax(names["estimator"].slip.friction) == pytest.approx(0.8, rel=0.05)


def test_without_mujoco_the_install_line_is_given(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ConfigError, match=r"pip install 'cube-tensor-driver\[mujoco\]'"):
        find_scene_skin(SCENES / "ball.xml")


def test_the_demo_says_in_one_line_why_it_does_not_start(mujoco, capfd):
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    assert main(["demo", "--mujoco", "no_such_scene.xml"]) == 1
    assert main(["demo", "--mujoco", str(SCENES / "ball.xml"), "--cubes", "3"]) == 1
    no_file, two = capfd.readouterr().err.splitlines()
    assert "no_such_scene.xml: no such file" in no_file and "--config" in two
