# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Each field of the messages about a skin and its contacts, against values from elsewhere."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from bag_maker import START_NS, make_bag

from cube_tensor_driver.bags.metadata import make_typestore
from cube_tensor_driver.bags.read import Bag, make_message
from cube_tensor_driver.bags.reprocess.job import Overrides, ReprocessJob, reprocess
from cube_tensor_driver.browser.markup import format_newtons
from cube_tensor_driver.config.calibration import find_shipped_calibration
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import Elastomer, Skin, SkinCube, SkinLink, read_skin
from cube_tensor_driver.config.yaml import parse_yaml
from cube_tensor_driver.core.calibration import Calibration
from cube_tensor_driver.core.compensation.motion import Motion
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.messages.compensation import encode_compensation, read_motion
from cube_tensor_driver.messages.contacts import (
    decode_contacts,
    encode_contacts,
    make_traction_message,
)
from cube_tensor_driver.messages.skin_info import read_skin_elastomer
from cube_tensor_driver.messages.types import CONTACTS_TYPE
from cube_tensor_driver.touch.slip import SLIP, STICK, UNKNOWN, Slip
from cube_tensor_driver.touch.surface import Contact
from cube_tensor_driver.touch.tracker.contact_tracker import TrackedContact

PLANAR, CUBE = (find_shipped_calibration(LAYOUTS[name]) for name in ("planar", "cube"))
DRAWS = 40_000
SKIN_FILE = find_package_data() / "config" / "skin_demo.yaml"


def noise_covariance(calibration: Calibration) -> np.ndarray:
    """(15, 15) of the stress and gradients of an unloaded cube: from draws, to 1 % of a variance.

    The noise of a pad is given in Pa; without load its frequency changes by f0 / (E (1 + beta)).
    """
    per_pascal = calibration.rest_frequency / (calibration.modulus * (1 + calibration.beta))
    draws = np.random.default_rng(5).standard_normal((DRAWS, calibration.layout.n_pads))
    hertz = calibration.rest_frequency + draws * calibration.noise * per_pascal
    pipeline = Pipeline([calibration], np.float64)
    rows = pipeline.process(FrequencyRows.from_values(np.zeros(DRAWS, int), hertz))
    return np.cov(np.hstack([rows.stress, rows.gradient]), rowvar=False)


def assert_is_covariance(stated: np.ndarray, calibration: Calibration) -> None:
    """Within 5 standard errors of the draws: 5 sqrt(2 / DRAWS) = 3.5 % of each variance."""
    expected = noise_covariance(calibration)
    seen = np.isfinite(np.diag(expected))
    np.testing.assert_array_equal(np.isfinite(np.diag(stated)), seen)
    scale = np.sqrt(np.diag(expected)[seen])
    off = (stated - expected)[np.ix_(seen, seen)] / np.outer(scale, scale)
    assert np.abs(off).max() < 5 * np.sqrt(2 / DRAWS)


def rotated(quaternion: object, vector: np.ndarray) -> np.ndarray:
    """q v q*, by the vector formula."""
    axis = np.array([quaternion.x, quaternion.y, quaternion.z])
    twice = 2 * np.cross(axis, vector)
    return vector + quaternion.w * twice + np.cross(axis, twice)


def test_info_says_what_the_skin_is():
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from cube_tensor_driver.ros.messages import make_info_message

    cubes = (
        SkinCube("c0", "left", 3, None, (0.1, 0.2, 0.3), (0.0, 0.0, 0.0), PLANAR),
        SkinCube("c1", None, None, 0xC1, (-0.1, 0.0, 0.05), (0.0, 0.0, np.pi / 2), CUBE),
        SkinCube("c2", "left", 4, 0xC2, (0.0, 0.0, 0.0), (np.pi / 2, 0.0, 0.0), PLANAR),
    )
    links = (SkinLink("left", "/dev/ttyACM0", 0, None),)
    skin = Skin("hand", "wrist", None, links, cubes, elastomer=Elastomer(4e-3, 9e-3, 0.46))
    pipeline = Pipeline(skin.calibrations)
    rest = pipeline.rest_frequency
    rest[2] *= 1.01
    pipeline.rest_frequency = rest
    info = make_info_message(skin, pipeline, START_NS + 7, {0: 0xA0, 1: 0xA1}, "driver")

    assert info.version == info.VERSION == 4 and info.header.frame_id == "wrist"
    assert info.header.stamp.sec * 10**9 + info.header.stamp.nanosec == START_NS + 7
    assert (info.sender, info.name) == ("driver", "hand")
    elastomer = (info.elastomer_depth, info.elastomer_thickness, info.elastomer_poisson)
    assert elastomer == (4e-3, 9e-3, 0.46)
    assert read_skin_elastomer(info) == skin.elastomer
    assert info.calibration_ids == [PLANAR.id, CUBE.id]
    for text, calibration in zip(info.calibrations, (PLANAR, CUBE), strict=True):
        read = Calibration.from_dict(parse_yaml(text, "info"))
        assert read.id == calibration.id
        np.testing.assert_array_equal(read.response, calibration.response)
    covariances = np.reshape(info.covariance, (2, 15, 15))
    assert_is_covariance(covariances[0], PLANAR)
    assert_is_covariance(covariances[1], CUBE)

    said = [
        (one.name, one.frame_id, one.link, one.index, one.uid, one.layout, one.calibration_id)
        for one in info.cubes
    ]
    assert said == [
        ("c0", "hand_c0", "left", 3, 0xA0, "planar", PLANAR.id),
        ("c1", "hand_c1", "", 0, 0xC1, "cube", CUBE.id),
        ("c2", "hand_c2", "left", 4, 0xC2, "planar", PLANAR.id),
    ]
    axes = {
        0: np.eye(3),
        1: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
        2: [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    }
    for number, (one, cube) in enumerate(zip(info.cubes, cubes, strict=True)):
        position = one.pose.position
        assert (position.x, position.y, position.z) == cube.xyz
        turned = [rotated(one.pose.orientation, axis) for axis in np.eye(3)]
        np.testing.assert_allclose(turned, axes[number], atol=1e-12)
        assert tuple(one.pads) == cube.calibration.layout.pads
        assert one.half_side == cube.calibration.half_side
        factor = 1.01 if number == 2 else 1.0
        np.testing.assert_array_equal(one.rest_frequency, factor * cube.calibration.rest_frequency)


def test_reprocessed_info_says_what_was_used(tmp_path):
    bag = make_bag(tmp_path / "bag", SKIN_FILE, 20)
    skin = read_skin(SKIN_FILE)
    used = skin.calibrations[0]
    reprocess(ReprocessJob(bag, tmp_path / "out", "bag", Overrides(skin=skin)))
    with Bag(bag) as recorded, Bag(tmp_path / "out") as made:
        (before,), (after,) = recorded.read_infos("/info"), made.read_infos("/info")
    assert (after.sender, after.name, after.version) == ("reconstruction", skin.name, 4)
    assert after.header == before.header and after.cubes[3].pose == before.cubes[3].pose
    assert list(after.calibration_ids) == [used.id]
    assert Calibration.from_dict(parse_yaml(after.calibrations[0], "info")).id == used.id
    assert_is_covariance(after.covariance.reshape(15, 15), used)
    for one, cube in zip(after.cubes, skin.cubes, strict=True):
        assert (one.name, one.calibration_id, one.half_side) == (cube.name, used.id, used.half_side)
        np.testing.assert_array_equal(one.rest_frequency, used.rest_frequency)


def test_each_number_of_a_tensor_and_a_wrench_is_in_its_field():
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from std_msgs.msg import Header

    from cube_tensor_driver.ros.messages import make_tensor_message, make_wrench_message

    stress, gradient = np.arange(12.0).reshape(2, 6), 100 + np.arange(18.0).reshape(2, 9)
    rows = StressRows.from_values(
        np.arange(2),
        stress,
        gradient,
        residual=np.array([0.25, 0.75]),
        status=np.array([1, 2050]),
        observed=np.array([7, 0x7FFF]),
    )
    covariance = np.arange(225.0).reshape(15, 15)
    message = make_tensor_message(Header(frame_id="hand_c1"), rows, 1, covariance)
    tensor = message.tensor
    assert message.header.frame_id == "hand_c1"
    # In the order xx yy zz yz zx xy of SkinStress.
    assert (tensor.normal.x, tensor.normal.y, tensor.normal.z) == (6, 7, 8)
    assert (tensor.shear.x, tensor.shear.y, tensor.shear.z) == (9, 10, 11)
    np.testing.assert_array_equal(tensor.normal_gradient, gradient[1])
    np.testing.assert_array_equal(tensor.covariance, covariance.ravel())
    assert (tensor.residual, tensor.status, tensor.observed) == (0.75, 2050, 0x7FFF)

    message = make_wrench_message(Header(frame_id="hand_c1"), np.arange(3.0), 10 + np.arange(3.0))
    force, torque = message.wrench.force, message.wrench.torque
    assert message.header.frame_id == "hand_c1"
    assert (force.x, force.y, force.z, torque.x, torque.y, torque.z) == (0, 1, 2, 10, 11, 12)


def test_a_compensation_says_whether_and_when_the_weight_is_known():
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from rclpy.serialization import deserialize_message

    from cube_tensor_driver.msg import SkinCompensation

    def sent(*values):
        return deserialize_message(encode_compensation("wrist", *values), SkinCompensation)

    motion = Motion(START_NS + np.array([-7, 9]), np.arange(24.0).reshape(2, 4, 3))
    message = sent(START_NS + 5, motion, {"thermal": np.arange(3.0)})
    assert message.header.frame_id == "wrist" and message.weight
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == START_NS + 5
    assert message.time_offset.tolist() == [-12, 4]
    assert message.specific_force.tolist() == [0, 1, 2, 12, 13, 14]
    assert message.gradient.tolist() == [*range(3, 12), *range(15, 24)]
    found = read_motion(message, START_NS + 5)
    np.testing.assert_array_equal(found.time_ns, motion.time_ns)
    np.testing.assert_array_equal(found.state, motion.state)
    assert (list(message.creep), message.thermal.tolist()) == ([], [0, 1, 2])
    without = sent(START_NS, None, {})
    assert not without.weight and read_motion(without, START_NS) is None


NUMBERS = ("normal_force", "shear_force", "area", "position_uncertainty", "force_uncertainty")
TRACKED = ("moment", "shear_uncertainty", "area_uncertainty", "moment_uncertainty")


def distinct(kind: Callable, number: int) -> Contact | TrackedContact:
    """A contact whose every number is another one."""
    values = iter(np.arange(1, 30) / 7 + number)
    fields = {
        name: np.array([next(values) for _ in range(3)])
        if name in ("position", "normal", "force")
        else 10 + number
        if name == "id"
        else number == 1
        if name == "refined"
        else next(values)
        for name in kind._fields
    }
    return kind(**fields)


@pytest.mark.parametrize("kind", [Contact, TrackedContact])
def test_each_number_of_a_contact_is_in_its_field(kind):
    contacts = [distinct(kind, number) for number in range(3)]
    numbers = np.arange(1.0, 10).reshape(3, 3) / 7
    slip = Slip(np.array([UNKNOWN, STICK, SLIP]), *numbers, numbers + 5, numbers[0] + 9)
    touches = np.array([START_NS, -1, START_NS + 1])

    def sent(*values):
        return make_typestore().deserialize_cdr(encode_contacts(*values), CONTACTS_TYPE)

    message = sent(START_NS + 5, "wrist", contacts, slip, touches)
    assert message.header.frame_id == "wrist"
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == START_NS + 5
    for name in ("position", "normal", "force"):
        got = [[one.x, one.y, one.z] for one in getattr(message, name)]
        np.testing.assert_array_equal(got, [getattr(one, name) for one in contacts])
    for name in (*NUMBERS, *TRACKED, "id", "refined"):
        has_it = name in kind._fields
        expected = [getattr(one, name) for one in contacts] if has_it else []
        np.testing.assert_array_equal(getattr(message, name), expected)
    for name, expected in zip(
        ("friction", "friction_uncertainty", "friction_use"), numbers, strict=True
    ):
        np.testing.assert_array_equal(getattr(message, name), expected)
    np.testing.assert_array_equal(message.partial_slip, slip.partial)
    np.testing.assert_array_equal(message.touch_id, touches)
    got = [[one.x, one.y, one.z] for one in message.slip_velocity]
    np.testing.assert_array_equal(got, slip.velocity)
    assert message.slip.tolist() == [message.UNKNOWN, message.STICK, message.SLIP] == [0, 1, 2]
    read = decode_contacts(message)
    assert [one.slips for one in read] == [False, False, True]
    is_tracked = kind is TrackedContact
    assert [format_newtons(one)[0] == "~" for one in read] == [is_tracked, False, is_tracked]
    without = sent(START_NS, "wrist", contacts)
    assert not any(one.slips for one in decode_contacts(without))


def test_each_number_of_a_point_is_in_its_field():
    cloud = np.arange(30.0).reshape(5, 6) / 7
    message = make_traction_message(make_message, START_NS + 5, "wrist", cloud)
    assert message.header.frame_id == "wrist" and message.header.stamp.nanosec == 5
    assert (message.height, message.width, message.is_dense, message.is_bigendian) == (
        1,
        5,
        True,
        False,
    )
    assert (message.point_step, message.row_step) == (24, 120)
    names = ["x", "y", "z", "pressure", "shear", "sigma"]
    assert [field.name for field in message.fields] == names
    for number, field in enumerate(message.fields):
        assert (field.datatype, field.count) == (7, 1)  # sensor_msgs/PointField: FLOAT32
        points = np.frombuffer(bytes(message.data), np.uint8).reshape(5, message.point_step)
        column = points[:, field.offset : field.offset + 4].copy().view("<f4")[:, 0]
        np.testing.assert_array_equal(column, cloud[:, number].astype(np.float32))
