# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What the reconstruction node publishes on `touch`, against `Touch` and the load."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import Elastomer, Skin, read_skin
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import StressRows, concatenate
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.messages.touch import encode_touch
from cube_tensor_driver.msg import SkinTouch
from cube_tensor_driver.ros.messages import to_ns
from cube_tensor_driver.ros.nodes.touch_publisher import TouchPublisher
from cube_tensor_driver.touch.touch_detection import Touches

SKIN = read_skin(find_package_data() / "config" / "skin_demo.yaml")
START_NS = 1_700_000_000_123_456_789


class Topic:
    """Keeps what is published, as a subscriber would get it."""

    def __init__(self) -> None:
        self.heard: list[SkinTouch] = []
        self.subscribers = 1

    def get_subscription_count(self) -> int:
        return self.subscribers

    def publish(self, data: bytes) -> None:
        self.heard.append(deserialize_message(data, SkinTouch))


def scan(number: int, values: np.ndarray) -> StressRows:
    """Return a scan without noise of the demo's planar cubes."""
    stress, gradient = values[:, :6].copy(), values[:, 6:].copy()
    stress[:, [1, 3, 5]] = np.nan
    gradient[:, [1, 3, 4, 5, 7]] = np.nan
    stamp_ns = START_NS + number * 1_000_000
    return StressRows.from_values(np.arange(16), stress, gradient, stamp_ns=stamp_ns)


def make_publisher(skin: Skin) -> tuple[TouchPublisher, Topic]:
    topic = Topic()
    node = SimpleNamespace(own=lambda one: one, create_lifecycle_publisher=lambda *_: topic)
    return TouchPublisher(node, skin, QoSProfile(depth=1), 1.0, Reconstructor(skin)), topic


def test_each_number_of_a_touch_is_in_its_field():
    touches = Touches(
        stamp_ns=START_NS,
        cube=np.array([3, 5]),
        id=np.array([START_NS, START_NS + 1]),
        pressure=np.array([1.0, 2.0]),
        pressure_uncertainty=np.array([3.0, 4.0]),
        force=np.array([[5.0, 6.0, 7.0], [8.0, 9.0, 10.0]]),
        force_uncertainty=np.array([[11.0, 12.0, 13.0], [14.0, 15.0, 16.0]]),
    )
    message = deserialize_message(encode_touch("wrist", touches), SkinTouch)
    assert to_ns(message.header.stamp) == START_NS and message.header.frame_id == "wrist"
    assert list(message.cube) == [3, 5]
    assert list(message.id) == [START_NS, START_NS + 1]
    expected = {
        "pressure": [1, 2],
        "pressure_uncertainty": [3, 4],
        "normal_force": [-7, -10],
        "force_uncertainty": [13, 16],
        "shear_x": [5, 8],
        "shear_y": [6, 9],
        "shear_x_uncertainty": [11, 14],
        "shear_y_uncertainty": [12, 15],
    }
    assert {name: list(getattr(message, name)) for name in expected} == expected


def test_touch_of_each_scan_is_published():
    skin = replace(SKIN, elastomer=Elastomer(5e-3, np.inf))
    publisher, topic = make_publisher(skin)
    position = skin.poses.position
    force = np.array([0.1, 0.0, -0.5])
    below = position - position[5] - [0, 0, 5e-3]
    stress, slope = contact.field(below, *contact.hertz(2.5e-3, force, (0, 0), 12), 0.48)
    load = np.hstack([stress, slope[:, :3].reshape(16, 9)])
    idle = np.zeros((16, 15))

    # Without a subscriber nothing is computed. The first scan of one starts the set-up.
    topic.subscribers = 0
    publisher.publish(scan(-2, load), 0)
    assert publisher._future is None
    topic.subscribers = 1
    publisher.publish(scan(-1, load), 0)
    publisher._future.result()
    publisher.publish(concatenate([scan(number, idle) for number in range(60)]), 0)
    assert len(topic.heard) == 60 and not any(message.cube for message in topic.heard)
    stamps_ns = [to_ns(message.header.stamp) for message in topic.heard]
    assert stamps_ns == [START_NS + number * 1_000_000 for number in range(60)]
    assert {message.header.frame_id for message in topic.heard} == {skin.parent_frame}
    publisher.publish(scan(60, load), 0)
    message = topic.heard[-1]
    assert message.header.frame_id == skin.parent_frame
    assert to_ns(message.header.stamp) == START_NS + 60_000_000
    assert list(message.cube) == [5]
    assert list(message.id) == [START_NS + 60_000_000]
    assert message.pressure[0] == pytest.approx(-stress[5, 2], rel=1e-6)
    assert message.pressure_uncertainty[0] > 0.009 * message.pressure[0]
    # Planar cubes know the force along x, and the one along y only from their neighbours.
    found = [message.shear_x[0], message.shear_y[0], -message.normal_force[0]]
    stated = [message.shear_x_uncertainty[0], message.shear_y_uncertainty[0]]
    stated.append(message.force_uncertainty[0])
    assert (np.abs(np.subtract(found, force)) < 2 * np.array(stated)).all()
    # At this pitch of 12 mm their rms error is 8 % of the force.
    np.testing.assert_allclose(np.take(found, [0, 2]), np.take(force, [0, 2]), atol=0.08)

    # A tare changes all values: the touch stays, and no other begins.
    publisher.publish(scan(61, load - 500), 1)
    assert list(topic.heard[-1].cube) == [5] and topic.heard[-1].id == message.id
    assert topic.heard[-1].pressure[0] == pytest.approx(message.pressure[0], rel=1e-4)
    topic.subscribers = 0
    publisher.publish(scan(62, load - 500), 1)
    assert len(topic.heard) == 62
    # A later subscriber starts the detection again: what touches then is not found.
    topic.subscribers = 1
    publisher.publish(concatenate([scan(5000 + number, load) for number in range(30)]), 1)
    assert len(topic.heard) == 92 and not any(message.cube for message in topic.heard[62:])
