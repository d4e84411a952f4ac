# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Wrenches as state interfaces of ros2_control, read as its hardware component reads them."""

from __future__ import annotations

import math
import sys
import time
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from rclpy.qos import qos_profile_sensor_data

from conftest import ROOT
from cube_tensor_driver.config.grid import describe_grid
from cube_tensor_driver.config.parameters import RECONSTRUCTION
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.config.yaml import read_yaml, write_yaml
from cube_tensor_driver.core.errors import BagError, ConfigError
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.core.status import INVALID, PAD_FAULT
from cube_tensor_driver.core.tensor import rotation_from_rpy
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import SimulatedHubs, list_skin_processes
from cube_tensor_driver.ros.nodes.state_interfaces import (
    COMPONENTS,
    SkinWrenches,
    make_state_interfaces,
)

SIDE = 0.01
STALE_S = 0.2


@pytest.fixture
def skin_file(tmp_path):
    path = tmp_path / "skin.yaml"
    description = describe_grid(nx=2, ny=2, pitch=0.012, links=2, rate=100.0)
    description["cubes"][3]["pose"] = {"xyz": [0.02, -0.01, 0.03], "rpy": [0.4, -1.0, 2.0]}
    write_yaml(path, description)
    return path


def stress_rows(cube, stress, gradient, status=0) -> StressRows:
    n = len(cube)
    return StressRows(
        cube=np.array(cube, np.uint16),
        sequence=np.zeros(n, np.uint32),
        stamp_ns=np.zeros(n, np.int64),
        stress=np.asarray(stress, np.float32),
        gradient=np.asarray(gradient, np.float32),
        residual=np.zeros(n, np.float32),
        status=np.full(n, status, np.uint16),
        observed=np.zeros(n, np.uint16),
        left_out=np.zeros(n, np.uint32),
    )


def test_wrenches_are_the_integral_of_traction(skin_file):
    """Against a sum over a fine grid of points on the face +z of each cube. The torque about the
    face's normal is not determined by what is measured, so shear is uniform."""
    skin = read_skin(skin_file)
    rng = np.random.default_rng(5)
    stress, gradient = rng.normal(0, 1e4, (4, 6)), rng.normal(0, 1e6, (4, 9))
    wrenches = SkinWrenches(skin, SIDE, STALE_S)
    wrenches.update(stress_rows(range(4), stress, gradient), 0.0)

    middles = (np.arange(200) + 0.5) / 200 - 0.5
    x, y = (SIDE * part.ravel() for part in np.meshgrid(middles, middles))
    area = (SIDE / 200) ** 2
    total = np.zeros(6)
    for number, cube in enumerate(skin.cubes):
        _, _, zz, yz, zx, _ = stress[number]
        pressure = zz + gradient[number, 6] * x + gradient[number, 7] * y
        force = area * np.stack([np.full(x.size, zx), np.full(x.size, yz), pressure], axis=1)
        point = np.stack([x, y, 0 * x], axis=1)
        torque = np.cross(point, force).sum(axis=0)
        expected = np.r_[force.sum(axis=0), torque]
        # Shear with its point has no torque about z; float32 carries 6e-8, the grid 2.5e-5.
        np.testing.assert_allclose(
            wrenches.compute_wrenches()[number], expected, rtol=1e-4, atol=1e-9
        )
        rotation = rotation_from_rpy(*cube.rpy)
        placed = np.asarray(cube.xyz) + point @ rotation.T
        turned = force @ rotation.T
        total += np.r_[turned.sum(axis=0), np.cross(placed, turned).sum(axis=0)]
    np.testing.assert_allclose(wrenches.compute_wrenches()[4], total, rtol=1e-4, atol=1e-8)
    assert wrenches.names == [*skin.names, skin.name]


def test_an_unknown_wrench_is_nan(skin_file):
    """A cube without rows, with an invalid row or with too old a row has an unknown wrench.

    The wrench of the whole skin is unknown then, too.
    """
    skin = read_skin(skin_file)
    wrenches = SkinWrenches(skin, None, STALE_S)

    def known():
        return np.isfinite(wrenches.compute_wrenches()).all(axis=1).tolist()

    ones, zeros = np.ones((4, 6)), np.zeros((4, 9))
    wrenches.update(stress_rows(range(3), ones[:3], zeros[:3]), 1.0)
    assert known() == [True, True, True, False, False]
    wrenches.update(stress_rows([3, 9], ones[:2], zeros[:2]), 1.15)
    assert known() == [True] * 5
    assert not wrenches.forget_stale(1.19)
    assert wrenches.forget_stale(1.21) and known() == [False, False, False, True, False]
    assert not wrenches.forget_stale(1.22), "it is said once"
    wrenches.update(stress_rows(range(4), ones, zeros), 1.3)
    invalid = np.full((1, 6), np.nan)
    wrenches.update(stress_rows([2], invalid, zeros[:1], status=PAD_FAULT | INVALID), 1.3)
    assert known() == [True, True, False, True, False]


def test_what_the_parameter_cannot_be_is_one_line(skin_file, monkeypatch):
    parameter = next(one for one in RECONSTRUCTION if one.name == "hardware_name")
    assert parameter.find_refusal("Skin/Left_2") == parameter.find_refusal("") == ""
    assert "letters, digits, _ and /" in parameter.find_refusal("2 skins")
    values = {"hardware_name": "skin", "wrench_side": 0.0, "publish_period": 0.0}
    node = SimpleNamespace(read_value=values.get)
    monkeypatch.setitem(sys.modules, "pal_statistics_msgs.msg", None)
    with pytest.raises(BagError, match="messages of pal_statistics_msgs are not installed") as none:
        make_state_interfaces(node, read_skin(skin_file))
    assert "\n" not in str(none.value)
    twice = SimpleNamespace(names=("c00", "skin"), name="skin", rate=None)
    with pytest.raises(ConfigError, match="rename"):
        make_state_interfaces(node, twice)
    assert make_state_interfaces(SimpleNamespace(read_value=lambda name: ""), twice) is None


def test_the_example_names_what_is_published():
    """Sensors in URDF and controllers are those of the skin, frames those of URDF or cubes."""
    examples = ROOT / "config" / "examples"
    skin = read_skin(ROOT / "config" / "skin_demo.yaml")
    published = SkinWrenches(skin, None, STALE_S).names
    robot = ElementTree.parse(examples / "ros2_control.urdf").getroot()
    (component,) = robot.findall("ros2_control[@name='tactile_skin']")
    assert component.findtext("hardware/plugin") == "cm_topic_hardware_component/CMTopicSystem"
    sensors = {
        sensor.get("name"): tuple(state.get("name") for state in sensor)
        for sensor in component.findall("sensor")
    }
    assert sensors and sensors.keys() <= set(published) and set(sensors.values()) == {COMPONENTS}

    controllers = read_yaml(examples / "ros2_control.yaml")
    manager = controllers.pop("controller_manager")["ros__parameters"]
    assert controllers.keys() == manager.keys() - {"update_rate"}
    links = {link.get("name") for link in robot.findall("link")}
    joints = {joint.get("name") for joint in robot.findall("joint[@type='revolute']")}
    own = {skin.make_frame_id(cube) for cube in skin.cubes}
    assert skin.parent_frame in links
    admittance = controllers.pop("admittance_controller")["ros__parameters"]
    assert set(admittance["joints"]) == joints and admittance["ft_sensor"]["name"] in sensors
    frames = [admittance[name]["frame"]["id"] for name in ("ft_sensor", "control")]
    frames += [admittance["kinematics"]["base"], admittance["kinematics"]["tip"]]
    assert set(frames) <= links
    for broadcaster in controllers.values():
        values = broadcaster["ros__parameters"]
        assert values["sensor_name"] in sensors and values["frame_id"] in links | own


def test_the_last_values_are_nan_for_longer_than_a_cycle_of_controllers(skin_file, monkeypatch):
    """DDS discards a message that is not yet taken when its publisher is destroyed."""

    class Publisher(list):
        def publish(self, message):
            self.append((time.monotonic(), np.array(message.values)))

    values = {"hardware_name": "skin", "wrench_side": 0.0, "publish_period": 0.0}
    publishers, cleanup = {}, []
    node = SimpleNamespace(
        read_value=values.get,
        create_publisher=lambda kind, topic, quality: publishers.setdefault(topic, Publisher()),
        create_timer=lambda period, function: None,
        own=lambda entity: entity,
        call_at_cleanup=cleanup.append,
    )
    messages = SimpleNamespace(StatisticsNames=SimpleNamespace, StatisticsValues=SimpleNamespace)
    monkeypatch.setitem(sys.modules, "pal_statistics_msgs.msg", messages)
    interfaces = make_state_interfaces(node, read_skin(skin_file))
    interfaces.publish(stress_rows(range(4), np.ones((4, 6)), np.zeros((4, 9))), 0)
    (forget,) = cleanup
    forget()
    (_, known), *last = publishers["skin/values"]
    assert np.isfinite(known).all() and all(np.isnan(unknown).all() for _, unknown in last)
    stamps = [at for at, _ in last]
    # A controller manager at 100 Hz that misses ten cycles still takes one of them.
    assert stamps[-1] - stamps[0] > 0.1 and len(stamps) > 2


class Component:
    """What cm_topic_hardware_component makes of the topics (its `read`)."""

    def __init__(self, ros, messages, topic):
        self.names_by_version = {}
        self.names_messages = 0
        self.newest = None
        self.states = {}
        node, quality = ros.node, qos_profile_sensor_data
        node.create_subscription(messages.StatisticsNames, f"{topic}/names", self._name, quality)
        node.create_subscription(messages.StatisticsValues, f"{topic}/values", self._take, quality)

    def _name(self, message):
        self.names_by_version[message.names_version] = list(message.names)
        self.names_messages += 1

    def _take(self, message):
        self.newest = message

    def read(self):
        if self.newest is None or not self.names_by_version:
            return self.states
        assert self.newest.names_version != 0
        names = self.names_by_version.get(self.newest.names_version, [])
        prefix = "state_interface."
        for name, value in zip(names, self.newest.values, strict=True):
            if name.startswith(prefix):
                self.states[name.removeprefix(prefix)] = value
        return self.states

    def known(self, sensor):
        """How many components of a sensor have a value; 0 if the sensor is not known."""
        states = self.read()
        if f"{sensor}/force.x" not in states:
            return None
        return sum(math.isfinite(states[f"{sensor}/{part}"]) for part in COMPONENTS)


def test_a_hardware_component_gets_wrenches_until_they_are_unknown(ros, tmp_path, skin_file):
    """NaN comes when the hubs fall silent, and when the node ends."""
    messages = pytest.importorskip(
        "pal_statistics_msgs.msg",
        reason="needs pal_statistics_msgs, which has no wheel: "
        "sudo apt install ros-$ROS_DISTRO-pal-statistics-msgs",
    )
    skin = read_skin(skin_file)
    with Children(tmp_path) as children:
        for process in list_skin_processes(skin_file, simulated=SimulatedHubs(tmp_path / "ports")):
            if process.executable == "reconstruction":
                process.parameters["hardware_name"] = "Skin/Hand"
            children.start(process)
        component = Component(ros, messages, "skin_hand")
        ros.wait(lambda: component.known(skin.name) == 6)
        assert len(component.states) == 6 * 5 and len(component.names_by_version) == 1
        late = Component(ros, messages, "skin_hand")
        ros.wait(lambda: late.known(skin.names[0]) == 6)
        ros.wait(lambda: late.names_messages > 2)  # repeated, also without new subscribers
        children.pause("simulator")
        ros.wait(lambda: not any(map(component.known, (skin.names[0], skin.name))))
        children.resume("simulator")
        ros.wait(lambda: component.known(skin.name) == 6)
        children.end(["reconstruction"])
        ros.wait(lambda: not any(map(component.known, (skin.names[0], skin.name))))
