# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What peers send over DDS ends no node: transitions, services, parameters, messages."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Quaternion
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile

from conftest import encoded, free_domain, observer_node
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.msg import SkinFrequencies, SkinInfo, SkinStress
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import SimulatedHubs, list_skin_processes
from cube_tensor_driver.srv import Tare

ACTIVE = 3


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    """A running simulated skin of one cube with all its nodes, and we among its peers."""
    folder = tmp_path_factory.mktemp("skin")
    with (
        free_domain() as domain,
        observer_node(domain) as ros,
        Children(folder) as children,
    ):
        config = find_package_data() / "config" / "cube.yaml"
        hubs = SimulatedHubs(folder / "ports")
        for process in list_skin_processes(config, simulated=hubs, markers=True, contacts=True):
            children.start(process)
        yield ros, ros.listen(SkinStress, "stress"), children


@pytest.fixture
def skin(running):
    """No node has ended after a test, and tensors come."""
    ros, stress, children = running
    ros.wait(lambda: stress)
    yield ros
    count = len(stress)
    ros.wait(lambda: len(stress) > count + 10)
    children.check()


def test_a_transition_that_is_not_possible_now_is_refused(skin):
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
    for node in ("driver", "reconstruction", "markers", "contacts"):
        skin.wait(lambda node=node: state(skin, node) == ACTIVE)
        assert not skin.call(ChangeState, f"/{node}/change_state", request).success, node
        assert state(skin, node) == ACTIVE, node


def state(ros, node):
    return ros.call(GetState, f"/{node}/get_state", GetState.Request()).current_state.id


def test_a_tare_over_no_time_is_refused(skin):
    for duration in (math.nan, math.inf, -math.inf, -1.0, 1e300):
        answer = skin.call(Tare, "/reconstruction/tare", Tare.Request(duration=duration))
        assert not answer.success and "allowed" in answer.message, duration


def test_many_calls_at_once_are_all_answered(skin):
    """The client must hold as many answers, too: with ROS's own depth it drops some of them."""
    client = skin.node.create_client(
        Tare, "/reconstruction/tare", qos_profile=QoSProfile(depth=1000)
    )
    skin.wait(client.service_is_ready)
    calls = [client.call_async(Tare.Request(duration=-1.0)) for _ in range(1000)]
    skin.wait(lambda: all(call.done() for call in calls))


def test_a_rate_that_no_hub_can_have_is_refused(skin):
    for rate in (1e-300, 1e-9, 2e-4, 0.09, 1e9, -1.0):
        value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=rate)
        request = SetParameters.Request(parameters=[Parameter(name="rate", value=value)])
        (result,) = skin.call(SetParameters, "/driver/set_parameters", request).results
        assert not result.successful and "rate" in result.reason, rate


def test_messages_of_any_content_are_refused_and_counted(skin):
    publisher = skin.node.create_publisher(SkinFrequencies, "frequencies", 100)
    diagnostics = skin.listen(DiagnosticArray, "/diagnostics")
    good = encoded(
        FrequencyRows.from_values(np.zeros(1, np.uint16), np.full((1, 8), 1e5, np.float32)),
        b"skin\0",
    )
    rows_at = len(good) - len(good[good.index(b"skin\0") + 8 :])
    for rows in (2**29, 2**31, 2**32 - 1):
        publisher.publish(good[:rows_at] + rows.to_bytes(4, "little") + good[rows_at + 4 :])
    publisher.publish(good[:20])
    many = np.zeros(30_000, np.uint16)
    rows = FrequencyRows.from_values(many, np.zeros((len(many), 8), np.float32))
    publisher.publish(encoded(rows, b"skin\0"))

    def refused() -> bool:
        values = {
            pair.key: pair.value
            for array in diagnostics
            for status in array.status
            if status.name == "/reconstruction: rows"
            for pair in status.values
        }
        assert values.get("callback errors", "0") == "0"
        return values.get("messages that contradict themselves", "0") == "5"

    skin.wait(refused)


INFOS = {
    "a quaternion of length 0": lambda info: setattr(
        info.cubes[0].pose, "orientation", Quaternion(x=0.0, y=0.0, z=0.0, w=0.0)
    ),
    "a position that is NaN": lambda info: setattr(info.cubes[0].pose.position, "x", math.nan),
    "no cubes": lambda info: setattr(info, "cubes", []),
    "no calibrations": lambda info: setattr(info, "calibrations", []),
    "a half side of 0": lambda info: setattr(info.cubes[0], "half_side", 0.0),
    "a half side that is NaN": lambda info: setattr(info.cubes[0], "half_side", math.nan),
}


def test_an_info_of_any_content_ends_no_node(skin):
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    infos = skin.listen(SkinInfo, "info", latched)
    skin.wait(lambda: infos)
    # Markers, contacts and we listen to the one, the reconstruction and we to the other.
    for topic, listeners in (("info", 3), ("driver/info", 2)):
        received = infos if topic == "info" else skin.listen(SkinInfo, topic, latched)
        publisher = skin.node.create_publisher(SkinInfo, topic, latched)
        skin.wait(lambda p=publisher, n=listeners: p.get_subscription_count() >= n)
        for change in INFOS.values():
            info = copy.deepcopy(infos[0])
            change(info)
            count = len(received)
            publisher.publish(info)
            skin.wait(lambda received=received, count=count: len(received) > count)
