# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""One instant of the page: rows and the results of `contacts` for them, field, sampling rates."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser", reason="needs viser: pip install viser")
pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from cube_tensor_driver.browser import markup
from cube_tensor_driver.browser.colouring import Colouring
from cube_tensor_driver.browser.history import SampleRate
from cube_tensor_driver.browser.scan import MAX_WAITING_MESSAGES, Scan, ScanSynchronizer
from cube_tensor_driver.browser.surface_field import DEVIATION, FieldModel, SurfaceField
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.errors import BagError
from cube_tensor_driver.core.modes import COMPONENTS
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.messages.contacts import decode_traction, make_traction_message
from cube_tensor_driver.ros.messages import make_message
from cube_tensor_driver.simulation.load import Load, read_default_script
from cube_tensor_driver.touch.inverse import SurfaceInverse
from cube_tensor_driver.touch.surface import Surface, place_patches

DEPTH = 0.004
"""Depth of the cubes' centres below the surface, in m."""
PITCH = 0.01
"""Distance between neighbouring cubes, in m."""
DEMO = read_skin(find_package_data() / "config" / "skin_demo.yaml")


@pytest.fixture
def poses() -> CubePoses:
    x, y = np.meshgrid(PITCH * np.arange(4), PITCH * np.arange(4))
    place = np.stack([x.ravel(), y.ravel(), np.zeros(16)], axis=1)
    return CubePoses(place, np.tile(np.eye(3), (16, 1, 1)), np.full(16, 0.002))


def cloud_of(poses: CubePoses) -> np.ndarray:
    """Return a point cloud of traction as the node publishes it, with 2 x 2 points per cube."""
    points = place_patches(poses, PITCH / 2, 2).reshape(-1, 3) + np.array([0, 0, DEPTH])
    pressure = 1e3 + 1e5 * points[:, 0] - 2e5 * points[:, 1]
    return np.column_stack([points, pressure, 0.3 * pressure, 70.0 + 0.01 * pressure])


def test_a_point_cloud_becomes_the_field_between_its_points(poses):
    surface = Surface(poses, DEPTH)
    field = FieldModel(surface, DEMO.calibrations).compute(np.zeros((16, 15)), cloud_of(poses))
    # The points lie a quarter of the way between those of the cloud. The weights 9 : 1.8 : 1.8 : 1
    # of the inverse squares give 0.206 of the step instead: 0.044 of 500 + 1000 Pa too few.
    x, y, _ = surface.points.T
    inside = (x > 0) & (x < 3 * PITCH) & (y > 0) & (y < 3 * PITCH)
    true = 1e3 + 1e5 * x - 2e5 * y
    assert np.abs(field.pressure - true)[inside].max() < 0.05 * 1500
    np.testing.assert_allclose(field.shear, 0.3 * field.pressure, rtol=1e-5)
    np.testing.assert_allclose(field.sigma, 70.0 + 0.01 * field.pressure, rtol=1e-5)


def test_without_the_node_the_field_is_the_pressure_on_the_surface():
    """The pressure is that of the inverse, and its integral is the force of the load."""
    load = Load(DEMO, read_default_script())
    seconds = max(
        np.arange(0, load.period, 0.05), key=lambda time: -load.compute_resultant(time)[0][2]
    )
    stress, gradient = load.compute_stress_field(seconds)
    values = np.concatenate([stress, gradient[:, :3].reshape(-1, 9)], axis=1)
    values[:, ["y" in name for name in COMPONENTS]] = np.nan  # Planar cubes do not observe y.
    surface = Surface(DEMO.poses, load.depth, 12)
    model = FieldModel(surface, DEMO.calibrations)
    model.prepared.result(60)
    field = model.compute(values, None)
    force = field.pressure.sum() * surface.area
    # The cubes are 12 mm apart, and the contact is 5 mm wide.
    assert force == pytest.approx(-load.compute_resultant(seconds)[0][2], rel=0.25)
    pressure = SurfaceInverse(DEMO, depth=load.depth).field(values).pressure
    assert field.pressure.max() == pytest.approx(pressure.max(), rel=0.02)
    assert surface.field(values).pressure.max() < 0.95 * pressure.max()
    assert "on the surface" in field.source


def rows(number: int) -> StressRows:
    """Scan `number` of one cube, with this zz."""
    stress = np.full((1, 6), float(number))
    return StressRows.from_values([0], stress, np.zeros((1, 9)), stamp_ns=number, sequence=number)


def shown(scans: ScanSynchronizer) -> tuple[float, object]:
    scans.advance()
    return scans.latest.values[0, 2], scans.contacts


def test_rows_wait_for_the_contacts_of_the_same_rows():
    scans = ScanSynchronizer(1)
    scans.add_rows(1, rows(1), 0.0)
    assert shown(scans) == (1, None)  # no node runs
    for number in range(2, 6):
        scans.add_rows(number, rows(number), 0.0)
    scans.add_contacts(3, ["three"])
    assert shown(scans) == (3, ["three"])
    scans.add_contacts(4, ["four"])
    scans.add_cloud(3, np.zeros((0, 6)))  # traction of 4 and 5 has not come yet
    assert shown(scans) == (3, ["three"])
    scans.add_cloud(4, np.ones((0, 6)))
    assert shown(scans) == (4, ["four"])
    # The node has ended: no result for more than a second.
    scans.add_rows(2_000_000_000, rows(6), 0.0)
    assert shown(scans) == (6, None)


def test_rows_whose_contacts_never_come_do_not_wait_for_ever():
    scans = ScanSynchronizer(1)
    scans.add_contacts(-1, [])
    for number in range(MAX_WAITING_MESSAGES):
        scans.add_rows(number, rows(number), 0.0)
    assert np.isnan(shown(scans)[0])
    scans.add_rows(1000, rows(1000), 0.0)
    assert shown(scans) == (1000, None)


def test_the_rate_is_that_of_the_samples_whatever_arrives():
    """Half of the rows are missing; the number wraps around; the hub restarts."""
    rate = SampleRate(2)
    period_ns = 8_000_000

    def send(numbers: np.ndarray) -> None:
        for number in numbers[::2]:
            sequence = np.full(1, number % 2**32, np.uint32)
            rate.update(
                rows(0).__class__.from_values(
                    [1],
                    np.zeros((1, 6)),
                    np.zeros((1, 9)),
                    stamp_ns=number * period_ns,
                    sequence=sequence,
                )
            )

    first = 2**32 - 100
    send(np.arange(first, first + 100))
    assert rate.hertz.tolist() == [0, 0]
    send(np.arange(first + 100, first + 400))
    assert rate.hertz == pytest.approx([0, 125])
    period_ns = 4_000_000
    send(np.arange(2 * first, 2 * first + 600))
    assert rate.hertz == pytest.approx([0, 250])


@pytest.mark.parametrize("known", [True, False])
def test_the_deviation_is_a_colour_while_the_node_says_it(poses, known):
    """On the surface and on the cubes below it; grey where it is unknown."""
    surface = Surface(poses, DEPTH)
    pressure = np.linspace(0.0, 9e3, len(surface.points))
    sigma = 100.0 + 0.1 * pressure
    sigma[surface.middle[3]] = np.nan
    field = SurfaceField(pressure, 0 * pressure, "", sigma if known else None)
    values = np.full((16, 15), 5.0)
    none = np.zeros(16, int)
    scan = Scan(values, np.zeros(16), none, none, np.zeros(16), field, [])
    colouring = Colouring.from_scan(scan, surface, DEVIATION, 0.0, 0.0)
    if not known:
        assert np.isnan(colouring.field).all() and np.isnan(colouring.cubes).all()
        assert colouring.above is None
        return
    np.testing.assert_array_equal(colouring.field, sigma)
    np.testing.assert_array_equal(colouring.cubes, sigma[surface.middle])
    assert colouring.top == np.nanmax(sigma)
    at = surface.middle[2]
    near = np.linalg.norm(surface.points - poses.position[2], axis=1)
    assert near[at] == near.min()
    said = f"{pressure[at] / 1e3:.2f} ± {sigma[at] / 1e3:.2f}"
    assert said in markup.make_numbers_table(scan, 2, colouring.above[2])
    assert "on the surface" not in markup.make_numbers_table(scan, 3, colouring.above[3])


class Buffer:
    """What rclpy of ROS 2 Lyrical gives for uint8[] in the memory of a device: no sequence."""

    def __init__(self, data):
        self._data = bytes(data)

    def __len__(self):
        return len(self._data)

    def to_bytes(self):
        return self._data


def test_a_point_cloud_in_a_rosidl_buffer_is_read(poses):
    message = make_traction_message(make_message, 5, "skin_base", cloud_of(poses))
    expected = decode_traction(message)
    # The messages of older releases refuse such a value.
    received = SimpleNamespace(
        fields=message.fields, point_step=message.point_step, data=Buffer(message.data)
    )
    np.testing.assert_array_equal(decode_traction(received), expected)


def test_another_point_cloud_is_refused_in_words(poses):
    message = make_traction_message(make_message, 5, "skin_base", cloud_of(poses))
    message.fields = message.fields[:3]
    with pytest.raises(BagError, match="has the fields x, y, z; those of the topic traction are"):
        decode_traction(message)
