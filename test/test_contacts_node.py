"""The node `contacts` with the method `inverse`: contacts with ids, and the surface's traction."""

from __future__ import annotations

import time

import numpy as np
import pytest

from cube_tensor_driver.core.defaults import POISSONS_RATIO, SURFACE_DEPTH
from cube_tensor_driver.core.modes import COMPONENTS
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.elastic import contact


def test_contacts_and_traction_of_a_pressed_skin(ros, tmp_path):
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import PointCloud2

    from cube_tensor_driver.bags.message_codec import stress_codec
    from cube_tensor_driver.config.package_data import package_data
    from cube_tensor_driver.config.skin import read_skin
    from cube_tensor_driver.core.pipeline import Pipeline
    from cube_tensor_driver.msg import SkinContacts, SkinInfo, SkinStress
    from cube_tensor_driver.processes.children import Children
    from cube_tensor_driver.processes.skin_processes import Process
    from cube_tensor_driver.ros.messages import info_message

    skin = read_skin(package_data() / "config" / "skin_demo.yaml")
    places = np.array([cube.xyz for cube in skin.cubes])
    centre, force = places[:, :2].mean(axis=0), np.array([0.5, 0.0, -2.0])
    below = np.column_stack([places[:, :2], np.full(len(places), -SURFACE_DEPTH)])
    load = contact.hertz(3e-3, force, centre, order=12)
    stress, gradient = contact.field(below, *load, POISSONS_RATIO)
    gradient = gradient[:, :3].reshape(-1, 9)
    unseen = np.array(["y" in name for name in COMPONENTS])  # by planar cubes
    stress[:, unseen[:6]], gradient[:, unseen[6:]] = np.nan, np.nan

    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    info = ros.node.create_publisher(SkinInfo, "info", latched)
    info.publish(info_message(skin, Pipeline(skin.calibrations), time.time_ns()))
    publisher = ros.node.create_publisher(SkinStress, "stress", 10)
    contacts = ros.listen(SkinContacts, "contacts")
    clouds = ros.listen(PointCloud2, "traction")

    def arrived() -> bool:
        made = StressRows.of(np.arange(len(places)), stress, gradient, stamp_ns=time.time_ns())
        publisher.publish(stress_codec.encode(made, b"skin_base\0"))
        return len(contacts) > 2 and len(clouds) > 2

    with Children(tmp_path) as children:
        given = {"method": "inverse"}
        children.start(Process("contacts", "cube_tensor_driver.ros.contacts", parameters=given))
        ros.wait(arrived)
        children.check()

    last = contacts[-1]
    assert len(last.position) == 1 and last.id[0] == 0
    assert last.normal_force[0] == pytest.approx(2, rel=0.05)
    assert last.force[0].x == pytest.approx(0.5, abs=0.1)
    np.testing.assert_allclose([last.position[0].x, last.position[0].y], centre, atol=0.5e-3)
    assert 0 < last.force_uncertainty[0] < 0.2 and len(last.moment) == 1
    cloud = clouds[-1]
    names = [field.name for field in cloud.fields]
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, len(names))
    assert names == ["x", "y", "z", "pressure", "shear", "sigma"]
    assert cloud.header.frame_id == skin.parent_frame and cloud.width == len(points)
    assert np.isfinite(points).all() and (points[:, 5] > 0).all()
    peak = points[points[:, 3].argmax()]
    assert np.linalg.norm(peak[:2] - centre) < 5e-3 and peak[3] > 5e3
