# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of a skin: its geometry against cases computed by hand, its message as other nodes
read it."""

from __future__ import annotations

import time

import numpy as np
import pytest

from conftest import encoded
from cube_tensor_driver.config import parameters
from cube_tensor_driver.core.latest_stress import DOUBTFUL, FAULTY, FINE, STALE, LatestStress
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.core.status import INVALID, PAD_FAULT, RESIDUAL
from cube_tensor_driver.core.tensor import rotation_from_quaternion, rotation_from_rpy
from cube_tensor_driver.views import scene
from cube_tensor_driver.views.scene import QUANTITIES


def places(n: int = 3, turn: np.ndarray | None = None) -> CubePoses:
    position = np.stack([0.01 * np.arange(n), np.zeros(n), np.zeros(n)], axis=1)
    return CubePoses(
        position, np.tile(np.eye(3) if turn is None else turn, (n, 1, 1)), np.full(n, 0.002)
    )


def rows(values: np.ndarray, status: object = 0, cube: object = None) -> StressRows:
    cubes = np.arange(len(values)) if cube is None else cube
    return StressRows.from_values(cubes, values[:, :6], values[:, 6:], residual=1.0, status=status)


def test_traction_pushes_to_the_face_and_pulls_away_from_it():
    values = np.full((2, 15), np.nan)
    values[0, 2], values[1, 2] = -1e3, 2e3
    (pushed, pulled) = scene.make_traction_arrows(places(2), values, 1e-5)
    np.testing.assert_allclose(pushed, [[0, 0, 0.012], [0, 0, 0.002]])
    np.testing.assert_allclose(pulled, [[0.01, 0, 0.002], [0.01, 0, 0.022]])


def test_arrows_turn_with_their_cube():
    values = np.zeros((1, 15))
    values[0, 2:5] = -1e3, 300, 500
    values[0, 12:14] = 2e5, -1e5
    turn = rotation_from_rpy(0.4, 0.9, -2.0)
    for draw, length in ((scene.make_traction_arrows, 1e-5), (scene.make_gradient_arrows, 1e-8)):
        straight, turned = draw(places(1), values, length), draw(places(1, turn), values, length)
        np.testing.assert_allclose(turned, straight @ turn.T, atol=1e-15)
    # pressure −σzz grows against the gradient of σzz
    tail, tip = scene.make_gradient_arrows(places(1), values, 1e-8)[0]
    np.testing.assert_allclose(tip - tail, [-2e-3, 1e-3, 0], atol=1e-15)


def test_principal_cross_of_pure_shear_lies_at_45_degrees():
    values = np.full((1, 15), np.nan)
    values[0, [0, 2, 4]] = 0, 0, 1e3
    lines, pulls = scene.make_principal_crosses(places(1), values, 1e-5)
    assert pulls[0].tolist() == [True, False, False]
    along = lines[0, 0, 1] - lines[0, 0, 0]
    np.testing.assert_allclose(np.abs(along), np.array([1, 0, 1]) * 0.01 / np.sqrt(2), atol=1e-9)


def test_colours_are_the_table_s_ends_grey_where_unknown_and_monotonous_in_lightness():
    quantity = QUANTITIES["pressure"]
    shown = scene.choose_colours(quantity, np.array([-5.0, 0, 10, 99, np.nan]), 10.0)
    zero, top = np.array([0xFF, 0xFF, 0xCC]) / 255, np.array([0x80, 0x00, 0x26]) / 255
    np.testing.assert_allclose(shown, [zero, zero, top, top, scene.GREY])
    luma = [0.299, 0.587, 0.114]
    lightness = scene.choose_colours(quantity, np.linspace(0, 10, 50), 10.0) @ luma
    assert (np.diff(lightness) < 0).all()
    signed = scene.choose_colours(QUANTITIES["zz"], np.array([-10.0, 0, 10]), 10.0) @ luma
    assert signed[1] > 2 * max(signed[0], signed[2])


def test_the_parameter_quantity_allows_what_can_be_drawn():
    assert tuple(QUANTITIES) == parameters.QUANTITIES


def test_automatic_range_rises_at_once_and_falls_slowly():
    quantity = QUANTITIES["pressure"]
    top = scene.choose_automatic_top(quantity, np.array([np.nan, 9e3, -2e3]))
    assert top == 9e3
    assert scene.choose_automatic_top(quantity, np.array([1.0]), top) == pytest.approx(
        9e3 * scene.RANGE_DECAY
    )
    assert scene.choose_automatic_top(quantity, np.array([np.nan])) == quantity.min_top


def test_health_says_doubtful_no_tensor_and_stale():
    newest = LatestStress(4)
    values = np.zeros((3, 15))
    newest.update(rows(np.zeros((4, 15)), cube=np.array([0, 1, 2, 9])), 10.0)  # cube 9 is not ours
    newest.update(rows(values[:1], PAD_FAULT, cube=np.array([1])), 10.5)
    newest.update(rows(values[:1], INVALID | PAD_FAULT, cube=np.array([2])), 10.5)
    assert newest.compute_health(10.6, 1.0).tolist() == [
        FINE,
        DOUBTFUL,
        FAULTY,
        STALE,
    ]
    assert newest.compute_health(11.2, 1.0).tolist() == [
        STALE,
        DOUBTFUL,
        FAULTY,
        STALE,
    ]
    believed = newest.select_usable_values(newest.compute_health(10.6, 1.0))
    assert np.isnan(believed).all(axis=1).tolist() == [False, False, True, True]
    crosses = scene.make_fault_crosses(places(4), newest.compute_health(10.6, 1.0))
    assert (np.ptp(crosses[0], axis=1) == 0).all() and (
        np.ptp(crosses[1:], axis=2).max(axis=(1, 2)) > 0.004
    ).all()


def test_a_residual_now_and_then_is_noise_and_one_that_stays_is_shown():
    """Of 400 cubes at 50 Hz, one row in a hundred has a residual above its limit. Of cube 7, from
    2 s to 4 s, nearly all rows have. It is shown after one window of such rows, and hidden after
    one without them."""
    n, random = 400, np.random.default_rng(4)
    newest = LatestStress(n)
    for step in range(300):
        now, chance = step / 50, np.full(n, 0.01)
        chance[7] = 0.9 if 2 <= now < 4 else 0.01
        newest.update(
            rows(np.zeros((n, 15)), random.binomial(1, chance) * RESIDUAL, cube=np.arange(n)), now
        )
        health = newest.compute_health(now, 1.0)
        assert (np.delete(health, 7) == FINE).all()
        if not (2 < now < 3 or 4 < now < 5):
            assert health[7] == (DOUBTFUL if 3 <= now <= 4 else FINE), now
    newest.update(
        rows(np.zeros((n, 15)), np.full(n, PAD_FAULT), cube=np.arange(n)), -100.0
    )  # a bag plays again
    newest.update(rows(np.zeros((n, 15)), cube=np.arange(n)), -99.0)
    assert (newest.compute_health(-99.0, 1.0) == FINE).all()


def test_markers_node_draws_what_comes(ros, tmp_path):
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from visualization_msgs.msg import Marker, MarkerArray

    from cube_tensor_driver.config.package_data import find_package_data
    from cube_tensor_driver.config.skin import read_skin
    from cube_tensor_driver.core.pipeline import Pipeline
    from cube_tensor_driver.msg import SkinContacts, SkinInfo, SkinStress
    from cube_tensor_driver.processes.children import Children
    from cube_tensor_driver.processes.skin_processes import Process
    from cube_tensor_driver.ros.messages import make_info_message

    skin = read_skin(find_package_data() / "config" / "skin_demo.yaml")
    n, pressed, silent = len(skin.cubes), 6, 15
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    info = ros.node.create_publisher(SkinInfo, "info", latched)
    info.publish(
        make_info_message(skin, Pipeline([cube.calibration for cube in skin.cubes]), time.time_ns())
    )
    publisher = ros.node.create_publisher(SkinStress, "stress", 10)
    pictures, contacts = ros.listen(MarkerArray, "markers"), ros.listen(SkinContacts, "contacts")
    values = np.full((n, 15), np.nan)
    values[:, [0, 2, 4, 12]] = 0
    values[pressed, [2, 4]] = -20e3, 4e3

    def sent() -> None:
        made = rows(values)
        made.stamp_ns[:] = time.time_ns()
        chosen = made.select(np.arange(n) != silent)
        publisher.publish(encoded(chosen, b"skin_base\0"))

    def drawn() -> bool:
        sent()
        return bool(
            contacts
            and contacts[-1].position
            and pictures
            and "20.0 kPa" in pictures[-1].markers[-1].text
            and any(one.ns == "contact 0" and one.color.a == 1 for one in pictures[-1].markers)
        )

    with Children(tmp_path) as children:
        for name, given in (("markers", {"crosses": True}), ("contacts", {})):
            children.start(Process(name, f"cube_tensor_driver.ros.nodes.{name}", parameters=given))
        ros.wait(drawn)
        children.check()

    markers = {marker.ns: marker for marker in pictures[-1].markers}
    assert len(pictures[-1].markers) <= 24
    assert all(
        marker.header.frame_id == "skin_base" and marker.action == Marker.ADD
        for marker in markers.values()
    )
    cubes = markers["cubes 0"]
    assert cubes.type == Marker.CUBE_LIST and len(cubes.points) == len(cubes.colors) == n
    # RViz 2 shades a box's −z face least among those that one sees from above: the boxes stand on
    # their heads.
    q = cubes.pose.orientation
    turn = rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w]))
    np.testing.assert_allclose(turn, np.diag([-1, 1, -1]), atol=1e-12)
    points = np.array([[p.x, p.y, p.z] for p in cubes.points]) @ turn.T
    upper_faces = np.array([cube.xyz for cube in skin.cubes])
    upper_faces[:, 2] += skin.cubes[0].calibration.half_side
    # A plate covers the upper face: the cube of the robot model is seen below it.
    assert (np.abs(points - upper_faces) <= [1e-12, 1e-12, cubes.scale.z / 2]).all()
    assert cubes.scale.z < 0.2 * cubes.scale.x
    bar = np.array([[p.x, p.y, p.z] for p in markers["legend bar"].points]) * np.diag(turn)
    assert (
        markers["legend bar"].pose.orientation == q
        and (np.diff(bar[:, 0]) > 0).all()
        and not bar[:, 2].any()
    )
    traction = np.array([[p.x, p.y, p.z] for p in markers["traction"].points]).reshape(n, 3, 2, 3)
    shaft = traction[pressed, 0, 1] - traction[pressed, 0, 0]
    assert markers["legend"].text == "pressure -szz: 0 to 20.0 kPa; 15 ok, 1 stale"
    numbers = [float(markers[f"legend number {k}"].text) for k in range(3)]
    assert numbers == [0, 10, 20]
    # Arrows are to the scale of the legend's.
    assert markers["traction scale"].text == "traction 20.0 kPa"
    sample = np.array([[p.x, p.y, p.z] for p in markers["traction arrow"].points])
    assert np.linalg.norm(shaft) / np.linalg.norm(sample[1] - sample[0]) == pytest.approx(
        np.hypot(20, 4) / 20
    )
    # RViz 2 makes blanks over a metre wide where scale.x does not say
    assert 0.4 < markers["legend"].scale.x / markers["legend"].scale.z < 0.8
    # RViz sets a second line 1 cm lower and knows no letter that takes two bytes
    assert "\n" not in markers["legend"].text and markers["legend"].text.isascii()

    contact = contacts[-1]
    assert contact.header.frame_id == "skin_base" and len(contact.position) == 1
    assert contact.normal_force[0] > 0 and contact.force[0].z < 0 < contact.force[0].x
    label, other = markers["contact 0"], markers["contact 1"]
    assert label.text == f"{contact.normal_force[0]:.2f} N, shear {contact.shear_force[0]:.2f} N"
    assert label.color.a == 1 and other.color.a < 0.01
    at = label.pose.position
    assert (at.x, at.y) == pytest.approx((contact.position[0].x, contact.position[0].y))
    rings = np.array([[p.x, p.y, p.z] for p in markers["contacts"].points]).reshape(8, -1, 3)
    radius = np.linalg.norm(rings[0] - rings[0].mean(axis=0), axis=1)
    np.testing.assert_allclose(np.pi * radius**2, contact.area[0], rtol=1e-6)
    assert not np.ptp(rings[1:], axis=1).any()


def picture(quantity="pressure", top=2e3, health=None, contacts=None, n=12) -> list[object]:
    """The markers of a picture of cubes of which one is loaded, as other nodes read them."""
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from rclpy.serialization import deserialize_message
    from visualization_msgs.msg import MarkerArray

    from cube_tensor_driver.ros.markers.canvas import Canvas

    values = np.zeros((n, 15))
    values[n // 2, 2:5] = -2e3, 500, 0
    ranges = scene.Ranges().follow(values, np.zeros(n), top)
    health = np.full(n, FINE) if health is None else health
    canvas = Canvas("skin", places(n), crosses=True)
    chosen = scene.QUANTITIES[quantity]
    data = canvas.draw(chosen, -values[:, 2], values, ranges, health, contacts)
    return deserialize_message(data, MarkerArray).markers


def test_the_text_of_a_contact_is_pale_until_it_is_fitted():
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from geometry_msgs.msg import Point, Vector3

    from cube_tensor_driver.msg import SkinContacts

    one = {"normal_force": [1.0] * 2, "shear_force": [0.5] * 2, "area": [1e-5] * 2}
    one |= {"position": [Point()] * 2, "normal": [Vector3(z=1.0)] * 2}
    opacities = []
    for refined in ([True, False], []):
        drawn = picture(contacts=SkinContacts(refined=refined, **one))
        texts = {marker.ns: marker for marker in drawn}
        opacities.append([texts[f"contact {number}"].color.a for number in range(2)])
    assert opacities == [[1.0, 0.5], [1.0, 1.0]]


def test_the_title_states_quantity_range_and_health_without_padding():
    health = np.full(12, FINE)
    health[7] = FAULTY
    shown = [("pressure", 2e3), ("pressure", 950.0), ("gradient", 3e6), ("residual", 3.0)]
    drawn = [picture(name, top, health) for name, top in shown]
    drawn.append(picture("pressure", 5e5, np.full(12, STALE)))
    assert [markers[-1].ns for markers in drawn] == ["legend"] * 5
    assert [markers[-1].text for markers in drawn] == [
        "pressure -szz: 0 to 2.00 kPa; 11 ok, 1 no tensor",
        "pressure -szz: 0 to 0.95 kPa; 11 ok, 1 no tensor",
        "gradient |dszz/dx, dszz/dy|: 0 to 3.00 kPa/mm; 11 ok, 1 no tensor",
        "residual: 0 to 3.00 sigma; 11 ok, 1 no tensor",
        "pressure -szz: 0 to 500. kPa; 0 ok, 12 stale",
    ]


def test_faults_are_drawn_anew_when_the_health_changes():
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from rclpy.serialization import deserialize_message
    from visualization_msgs.msg import MarkerArray

    from cube_tensor_driver.ros.markers.canvas import Canvas

    canvas = Canvas("skin", places(3), crosses=False)
    values, ranges = np.zeros((3, 15)), scene.Ranges(1.0, 1.0, 1.0)
    counts = []
    for health in ([FINE] * 3, [FINE, FAULTY, STALE], [FINE, FINE, STALE], [FINE, FINE, STALE]):
        data = canvas.draw(
            QUANTITIES["pressure"], np.zeros(3), values, ranges, np.array(health), None
        )
        (faults,) = (
            one for one in deserialize_message(data, MarkerArray).markers if one.ns == "faults"
        )
        crosses = np.array([[p.x, p.y] for p in faults.points]).reshape(3, 4, 2)
        counts.append(np.count_nonzero(np.ptp(crosses, axis=1).any(axis=1)))
        shown = np.array([[c.r, c.g, c.b, c.a] for c in faults.colors])[::4]
        np.testing.assert_allclose(shown[:, :3], scene.MARK[health], atol=1e-6)
        assert (shown[:, 3] == 1).all()
    assert counts == [0, 2, 1, 1]


@pytest.mark.parametrize("name", ["a", "ab", "abc", "abcd", "a name of many letters"])
def test_serialised_shapes_are_the_markers_of_rclpy(name):
    """Lengths of texts decide about the alignment of all that follows."""
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from geometry_msgs.msg import Point
    from rclpy.serialization import deserialize_message, serialize_message
    from std_msgs.msg import ColorRGBA
    from visualization_msgs.msg import Marker, MarkerArray

    from cube_tensor_driver.ros.markers.serialised import Shape, serialise

    random = np.random.default_rng(len(name))
    points, colours = random.random((5, 3)), random.random((5, 3)).astype(np.float32)
    scale, position, colour = random.random((3, 3)).tolist()
    rotation = random.random(4).tolist()
    look = {"scale": scale, "position": position, "rotation": rotation, "colour": colour}
    shapes = [
        Shape(name, Marker.LINE_LIST, points=points, colours=colours, opacity=0.25, **look),
        Shape(f"{name}'s legend", Marker.TEXT_VIEW_FACING, text=name, **look),
        Shape(f"{name}, empty", Marker.CUBE_LIST, scale),
        Shape("last", Marker.CUBE_LIST, points=points[:2], **look),
    ]
    data = serialise(name, shapes)

    markers = []
    for shape in shapes:
        made = Marker(ns=shape.name, type=shape.kind, text=shape.text, frame_locked=True)
        made.header.frame_id = name
        made.lifetime.sec = 2
        given = zip("xyz", shape.position, shape.scale, strict=True)
        for axis, coordinate, extent in given:
            setattr(made.pose.position, axis, coordinate)
            setattr(made.scale, axis, extent)
        for axis, part in zip("xyzw", shape.rotation, strict=True):
            setattr(made.pose.orientation, axis, part)
        made.color.r, made.color.g, made.color.b = shape.colour
        made.color.a = shape.opacity
        made.points = [Point(x=x, y=y, z=z) for x, y, z in shape.points.tolist()]
        made.colors = [ColorRGBA(r=r, g=g, b=b, a=1.0) for r, g, b in shape.colours.tolist()]
        markers.append(made)
    expected = serialize_message(MarkerArray(markers=markers))
    assert len(data) == len(expected)
    assert deserialize_message(data, MarkerArray) == deserialize_message(expected, MarkerArray)


def test_the_head_of_an_arrow_is_at_its_tip_and_flat_to_the_viewer():
    """Also for an arrow that points to the viewer, whose plane is not determined."""
    arrows = np.random.default_rng(3).normal(size=(7, 2, 3))
    normal = np.array([0.6, 0.0, 0.8])
    arrows[0, 1] = arrows[0, 0] + 2 * normal
    lines = scene.make_arrow_lines(arrows, np.broadcast_to(normal, (7, 3)))
    np.testing.assert_array_equal(lines[:, 0], arrows)
    tip, along = arrows[:, 1], arrows[:, 1] - arrows[:, 0]
    np.testing.assert_array_equal(lines[:, 1:, 0], np.stack([tip, tip], axis=1))
    one, other = lines[:, 1, 1] - tip, lines[:, 2, 1] - tip
    np.testing.assert_allclose(one + other, -2 * scene.BARB_LENGTH * along)
    across = one - other
    length = np.linalg.norm(along, axis=1)
    np.testing.assert_allclose(np.linalg.norm(across, axis=1), scene.BARB_LENGTH * length)
    np.testing.assert_allclose(np.einsum("nk,nk->n", across, along), 0, atol=1e-12)
    # The plane is turned by a thousandth, so that it is determined for every arrow.
    assert (np.abs(across[1:] @ normal) < 0.01 * length[1:]).all()


def test_a_click_finds_the_cube_in_front():
    from cube_tensor_driver.views.meshes import find_hit_cube

    around = 2 * np.pi * np.arange(24) / 24
    ring = np.stack([0 * around, np.cos(around), np.sin(around)], axis=1)
    pitch = 2 * np.sin(np.pi / 24)
    for cube in range(24):
        aside = 0.1 * pitch * np.array([1.0, 0, 0])
        assert find_hit_cube(ring, pitch, 5 * ring[cube] + aside, -2 * ring[cube]) == cube
    assert (
        find_hit_cube(ring, pitch, np.array([1.01 * pitch, 5, 0]), np.array([0, -1.0, 0])) is None
    )
    flat = np.stack(
        [*(a.ravel() for a in np.meshgrid(np.arange(6.0), np.arange(5.0))), np.zeros(30)], axis=1
    )
    eye = np.array([2.5, -8, 6.0])  # as the page looks at a skin
    for cube in range(30):
        assert find_hit_cube(flat, 1.0, eye, flat[cube] + [0.2, -0.2, 0] - eye) == cube
