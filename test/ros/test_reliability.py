# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Tare, live parameters, lifecycle and shutdown of the real nodes."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timezone
from fnmatch import fnmatch
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import psutil
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from played_hub import CUBE_UID, PERIOD_US, SINGLE, PlayedHub, greeting, sample
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from conftest import ROOT, decoded
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.config.tare import write_tare
from cube_tensor_driver.config.yaml import read_yaml, write_yaml
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.msg import SkinFrequencies, SkinInfo, SkinStress
from cube_tensor_driver.processes.children import Children, format_ros_arguments
from cube_tensor_driver.processes.skin_processes import Process, SimulatedHubs, list_skin_processes
from cube_tensor_driver.srv import Tare
from workshop.torture.memory import compute_median_slope

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
CALIBRATION = read_skin(SINGLE).cubes[0].calibration
PERIOD_S = 1e-6 * PERIOD_US


class PlayedSkin:
    """A hub that plays frequencies in real time, both nodes, and what they publish."""

    def __init__(self, ros, tmp_path, children):
        self.ros, self.folder, self.children = ros, tmp_path, children
        self.hub = PlayedHub(tmp_path / "ports", "hub0")
        self.pads = np.full(8, 100e3)
        self.stress = ros.listen(SkinStress, "stress")
        self.infos = ros.listen(SkinInfo, "info", LATCHED)
        self.diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
        self.number = 0
        self.noise = np.random.default_rng(4)

    def start(self):
        self.hub.listen()
        self.hub.requests.clear()
        for process in list_skin_processes(SINGLE, simulated=SimulatedHubs(self.folder / "ports"))[
            1:
        ]:
            if process.executable == "reconstruction":
                process.parameters["tare_folder"] = str(self.folder / "tare")
            self.children.start(process)
        self.ros.wait(lambda: 1 in self.hub.listen())
        self.hub.send(greeting())
        self.ros.wait(lambda: 2 in self.hub.listen())
        self.began = time.monotonic() - self.number * PERIOD_S
        self.wait(lambda: self.stress)

    def play(self):
        """Send the samples that are due."""
        while self.number * PERIOD_S < time.monotonic() - self.began:
            f = self.pads * (1 + 8e-6 * self.noise.standard_normal(8))
            millihertz = np.rint(1e3 * f).astype("<u4")[None]
            self.hub.send(sample(self.number, millihertz))
            self.number += 1

    def wait(self, done, seconds=20.0):
        def step():
            self.play()
            return done()

        self.ros.wait(step, seconds)

    def seconds(self, duration):
        end = self.number + round(duration / PERIOD_S)
        self.wait(lambda: self.number >= end)

    def call(self, kind, service, request):
        return self.ros.call(kind, service, request, self.wait)

    def tare(self, *cubes):
        return self.call(Tare, "/reconstruction/tare", Tare.Request(cubes=list(cubes)))

    def zz(self):
        count = len(self.stress)
        self.wait(lambda: len(self.stress) > count + 5)
        return float(decoded(self.stress[-1]).rows.stress[0, 2])

    def messages(self):
        return [status.message for array in self.diagnostics for status in array.status]

    def says(self, text):
        return any(text in message for message in self.messages())


@pytest.fixture
def stage(ros, tmp_path):
    with Children(tmp_path) as children:
        stage = PlayedSkin(ros, tmp_path, children)
        try:
            yield stage
        finally:
            stage.hub.close()


def loaded(pascal):
    """Frequencies under a uniform zz."""
    stress, gradient = np.zeros((1, 6)), np.zeros((1, 6, 3))
    stress[0, 2] = pascal
    from cube_tensor_driver.simulation.cubes import compute_true_amplitudes

    v = compute_true_amplitudes(CALIBRATION, stress, gradient) @ CALIBRATION.response.T
    return compute_pad_frequency(
        v[0], CALIBRATION.rest_frequency, CALIBRATION.beta, CALIBRATION.modulus
    )


def test_tare_is_refused_taken_told_kept_and_undone(stage):
    stage.start()
    stage.pads = loaded(5000.0)
    stage.seconds(0.3)
    answer = stage.tare()
    assert not answer.success and (
        "moves" in answer.message or "data since the start" in answer.message
    )
    answer = stage.tare("nobody")
    assert not answer.success and "no cube 'nobody'" in answer.message and "c0" in answer.message
    stage.seconds(2)
    stage.wait(lambda: abs(stage.zz() - 5000) < 50)
    answer = stage.tare("c0")
    assert answer.success and "kept on disk" in answer.message, answer.message
    stage.wait(lambda: abs(stage.zz()) < 50)
    stage.wait(lambda: abs(stage.infos[-1].cubes[0].rest_frequency[0] / stage.pads[0] - 1) < 1e-5)
    assert stage.infos[-1].cubes[0].uid == CUBE_UID

    # another start: the same rest, from the file of this uid
    stage.children.end(["reconstruction", "driver"])
    stage.stress.clear()
    stage.start()
    stage.wait(lambda: abs(stage.zz()) < 50)
    assert "restored" in stage.children.log("reconstruction")

    assert stage.call(Trigger, "/reconstruction/clear_tare", Trigger.Request()).success
    stage.wait(lambda: abs(stage.zz() - 5000) < 50)
    stage.wait(lambda: stage.infos[-1].cubes[0].rest_frequency[0] == 100e3)
    assert not list((stage.folder / "tare").iterdir())
    stage.children.check()


def test_a_tared_skin_with_uids_starts_again(ros, tmp_path):
    data = read_yaml(find_package_data() / "config" / "cube.yaml")
    for number, cube in enumerate(data["cubes"]):
        cube["uid"] = 0xABC0 + number
        cube.pop("index", None)
    config = tmp_path / "skin.yaml"
    write_yaml(config, data)
    cube = read_skin(config).cubes[0]
    kept = 1.001 * cube.calibration.rest_frequency
    created = datetime.now(timezone.utc)
    write_tare(tmp_path / "tare", cube.uid, cube.calibration, kept, created)
    with Children(tmp_path) as children:
        processes = list_skin_processes(config, simulated=SimulatedHubs(tmp_path / "ports"))
        for process in processes:
            if process.executable == "reconstruction":
                process.parameters["tare_folder"] = str(tmp_path / "tare")
            children.start(process)
        stress = ros.listen(SkinStress, "stress")
        ros.wait(lambda: stress)
        children.wait_for_line("reconstruction", "restored", 5)
        children.check()


def test_a_broken_pad_is_named_left_out_and_taken_back(stage):
    raw = stage.ros.listen(SkinFrequencies, "frequencies")
    stage.start()
    stage.pads = loaded(5000.0)
    stage.pads[2] = 0
    pad = CALIBRATION.layout.pads[2]
    stage.wait(lambda: raw and stage.says(f"pad {pad} short"))
    stage.zz()
    rows = decoded(stage.stress[-1]).rows
    assert rows.status[0] == SkinStress.PAD_FAULT | SkinStress.PAD_SHORT
    # seven pads for seven unknowns: all there still, and right
    assert abs(rows.stress[0, 2] - 5000) < 100
    assert np.isnan(raw[-1].frequency[2])
    stage.pads = loaded(5000.0)
    stage.diagnostics.clear()
    stage.wait(lambda: "ok" in stage.messages())
    stage.zz()
    assert decoded(stage.stress[-1]).rows.status[0] == 0
    assert f"pad {pad} short" in stage.children.log("reconstruction")
    stage.ros.wait(lambda: stage.says("stale: no rows any more"))  # nothing is sent now
    stage.ros.wait(lambda: stage.says("no sample for"))


def test_parameters_live(stage):
    stage.start()

    def change(node, name, value):
        kinds = {float: ("double_value", 3), int: ("integer_value", 2), str: ("string_value", 4)}
        field, number = kinds[type(value)]
        parameter = Parameter(name=name, value=ParameterValue(type=number, **{field: value}))
        answer = stage.call(
            SetParameters, f"/{node}/set_parameters", SetParameters.Request(parameters=[parameter])
        )
        return answer.results[0]

    stage.hub.requests.clear()
    assert change("driver", "rate", 50.0).successful
    stage.wait(lambda: 4 in stage.hub.listen())  # SET_PERIOD
    for node, name, value, words in (
        ("driver", "rate", -1.0, "range"),
        ("driver", "config", "other.yaml", "while the node is configured"),
        ("driver", "port", "spy:///dev/null?file=/nowhere/log", "a device path"),
        ("driver", "qos_reliability", "maybe", "reliable, best_effort"),
        ("reconstruction", "drift_time", float("nan"), ""),
        ("reconstruction", "tare_duration", 60.0, "range"),
    ):
        result = change(node, name, value)
        assert not result.successful and words in result.reason, (name, result)
    assert change("reconstruction", "drift_time", 600).successful
    long = change("driver", "qos_reliability", "x" * 1_000_000)
    assert not long.successful and len(long.reason) < 2000
    # A type that does not exist, and a name that is too long for a file.
    request = SetParameters.Request(
        parameters=[Parameter(name="rate", value=ParameterValue(type=99))]
    )
    for one in stage.call(SetParameters, "/driver/set_parameters", request).results:
        assert not one.successful and "99" in one.reason
    stage.children.check()


XS = "{http://www.w3.org/2001/XMLSchema}"


def schema_errors(
    element: ElementTree.Element, kind: str, schema: ElementTree.Element
) -> list[str]:
    """What an element has that its type does not allow, or lacks.

    Of XML Schema only what the policy can break: names of elements, attributes and their values.
    """
    definition = schema.find(f"{XS}complexType[@name='{kind}']")
    if definition is None:
        return [f"{element.tag}: {element.attrib}"] if element.attrib or len(element) else []
    errors = []
    attributes = {each.get("name"): each for each in definition.iter(f"{XS}attribute")}
    for name, attribute in attributes.items():
        if attribute.get("use") == "required" and name not in element.attrib:
            errors.append(f"{element.tag} lacks {name}")
    for name, value in element.attrib.items():
        attribute = attributes.get(name, ElementTree.Element("none"))
        words = schema.find(f"{XS}simpleType[@name='{attribute.get('type')}']") or ()
        allowed = [each.get("value") for word in words for each in word]
        if name not in attributes or value not in (allowed or [attribute.get("fixed", value)]):
            errors.append(f"{element.tag}: {name}={value}")
    children = {each.get("name"): each.get("type") for each in definition.iter(f"{XS}element")}
    errors += [f"{element.tag}: {child.tag}" for child in element if child.tag not in children]
    if not len(element):
        errors.append(f"{element.tag} is empty")
    for child in element:
        errors += schema_errors(child, children.get(child.tag, ""), schema)
    return errors


def test_the_security_policy_keeps_the_schema_of_sros2():
    schema = ElementTree.parse(ROOT / "test" / "data" / "sros2_policy.xsd").getroot()
    path = find_package_data() / "config" / "security" / "policy.xml"
    policy = ElementTree.parse(path).getroot()
    assert schema_errors(policy, "Policy", schema) == []
    # What the schema cannot say: each node once, and names that ROS allows.
    names = [(profile.get("ns"), profile.get("node")) for profile in policy.iter("profile")]
    assert len(names) >= 7 and len(set(names)) == len(names)
    for expression in (*policy.iter("topic"), *policy.iter("service")):
        assert re.fullmatch(r"(~/|/)?[A-Za-z0-9_/*]+", expression.text), expression.text
    text = path.read_text()
    for right, wrong in (
        ('version="0.2.0"', 'version="0.1.0"'),
        ('<enclave path="', '<enclave name="'),
        ('reply="ALLOW"', 'reply="allow"'),
        ('publish="ALLOW"', 'write="ALLOW"'),
        ("<topic>frequencies</topic>", "<name>frequencies</name>"),
        (' ns="/" node="view"', ' node="view"'),
    ):
        broken = ElementTree.fromstring(text.replace(right, wrong))
        assert schema_errors(broken, "Policy", schema) != [], wrong


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


PLAIN = {"view", "recorder", "player"}
"""Nodes without a lifecycle."""


def test_the_security_policy_allows_what_the_nodes_do(stage, tmp_path):
    """Each topic and service of each node, as SROS 2 names them, and nothing that no node has."""
    stage.start()  # first, or seven processes start at a time
    poses = tmp_path / "poses.yaml"
    poses.write_text("poses: [[0, 0, 0, 0, 0, 0, 0]]")
    motion = {"config": SINGLE, "imperfections": poses, "port_directory": tmp_path / "ports"}
    for name, parameters in (("markers", {}), ("contacts", {}), ("simulated_imu", motion)):
        module = f"cube_tensor_driver.ros.nodes.{name}"
        given = {key: str(value) for key, value in parameters.items()}
        stage.children.start(Process(name, module, parameters=given))
    bag = str(ROOT / "test" / "data" / "bag")
    for name, *arguments in (
        ("view", "view", "--port", str(free_port())),
        ("recorder", "record", "-o", str(tmp_path / "bag")),
        ("player", "replay", bag, "--stress", "--clock", "--loop"),
    ):
        command = Process(name, "cube_tensor_driver.cli", False, arguments=tuple(arguments))
        stage.children.start(command)
    node = stage.ros.node
    profiles = list(
        ElementTree.parse(find_package_data() / "config" / "security" / "policy.xml").iter(
            "profile"
        )
    )
    found = {
        "publish": node.get_publisher_names_and_types_by_node,
        "subscribe": node.get_subscriber_names_and_types_by_node,
        "reply": node.get_service_names_and_types_by_node,
        "request": node.get_client_names_and_types_by_node,
    }
    assert {profile.get("node") for profile in profiles} == {
        "driver",
        "reconstruction",
        "markers",
        "contacts",
        "simulated_imu",
        "view",
        "recorder",
        "player",
    }
    for profile in profiles:
        name = profile.get("node")
        stage.wait(lambda name=name: (name, "/") in node.get_node_names_and_namespaces())
        stage.wait(
            lambda name=name: len(found["reply"](name, "/")) >= (6 if name in PLAIN else 11)
        )  # 6 of parameters, 5 of the lifecycle
        for part in (*profile.iter("topics"), *profile.iter("services")):
            (what,) = part.attrib
            names = [item.text.replace("~", f"/{name}") for item in part]
            allowed = {each if each.startswith("/") else f"/{each}" for each in names}

            def there(name: str = name, what: str = what) -> list[str]:
                return [each for each, _ in found[what](name, "/")]

            def idle(there: Callable = there, allowed: set = allowed) -> set[str]:
                return {each for each in allowed if not any(fnmatch(one, each) for one in there())}

            # Discovery tells of a node before it tells of its last topic. The clock is there with
            # use_sim_time, topics of cubes when somebody listens, and others with their parameters.
            not_in_the_bag = {"/diagnostics", "/driver/info", "/compensation"}
            by_parameter = {"/touch", "/traction", "/imu", "/tf", "/tf_static"}
            may_be_idle = {"/clock", "/cubes/*"} | by_parameter
            may_be_idle |= not_in_the_bag if name == "player" else set()
            stage.wait(lambda idle=idle, allowed=may_be_idle: idle() <= allowed)
            more = [one for one in there() if not any(fnmatch(one, each) for each in allowed)]
            assert more == [], (name, what)
    stage.children.check()


@pytest.mark.parametrize("executable", ["driver", "reconstruction"])
def test_a_hundred_lifecycle_cycles_leak_nothing(ros, tmp_path, executable, monkeypatch):
    """Beside the other node, which goes on: what comes in meanwhile must not leak either.

    Objects are counted by their type. In the memory, one message per cycle would not show beside
    the steps of the allocator.
    """
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "test"), prepend=os.pathsep)
    counts = tmp_path / "counts.json"
    processes = list_skin_processes(SINGLE, simulated=SimulatedHubs(tmp_path / "ports"))
    place = [process.executable for process in processes].index(executable)
    counted = processes[place]
    counted.parameters["autostart"] = False
    arguments = (str(counts), counted.module, *counted.arguments)
    processes[place] = replace(counted, module="counted_node", arguments=arguments)
    kind = Transition
    cycle = (
        kind.TRANSITION_CONFIGURE,
        kind.TRANSITION_ACTIVATE,
        kind.TRANSITION_DEACTIVATE,
        kind.TRANSITION_CLEANUP,
    )
    with Children(tmp_path) as children:
        for process in processes:
            children.start(process)
        client = ros.node.create_client(ChangeState, f"/{executable}/change_state")
        ros.wait(client.service_is_ready)
        ros.call(GetState, f"/{executable}/get_state", GetState.Request())  # they have met
        process = psutil.Process(children.find_pid(executable))

        def run(cycles):
            """The memory in MB after each cycle."""
            sizes_mb = []
            for _ in range(cycles):
                for number in cycle:
                    future = client.call_async(
                        ChangeState.Request(transition=Transition(id=number))
                    )
                    ros.wait(future.done)
                    assert future.result().success, children.log(executable)[-500:]
                sizes_mb.append(process.memory_info().rss / 2**20)
            return np.array(sizes_mb)

        def count():
            process.send_signal(signal.SIGUSR1)
            ros.wait(counts.exists)
            found = Counter(json.loads(counts.read_text()))
            counts.unlink()
            return found

        run(20)
        threads, fds = process.num_threads(), process.num_fds()
        sizes_mb = run(50)
        # DDS ends a thread of its own now and then; what grows would have grown by 50.
        ends = process.num_threads() - threads, process.num_fds() - fds
        assert max(ends) < 5, ends
        # The median of the slopes leaves out the steps of the allocator.
        slope_kb = 1024 * compute_median_slope(np.arange(50), sizes_mb)
        assert slope_kb < 40
        early, _, middle, _, late = count(), run(20), count(), run(20), count()
        children.check()
        assert "a callback failed" not in children.log(executable)
    # What is made once, such as a cache, does not grow twice.
    grown = {name: min(middle[name] - early[name], late[name] - middle[name]) for name in late}
    leaks = {name: number for name, number in grown.items() if number >= 20}
    # rclpy keeps a weak reference to each entity that a cycle makes and destroys.
    assert leaks.keys() <= {"ReferenceType"}, leaks


def test_lifecycle_in_the_middle_of_a_reconnect(ros, tmp_path, deaf):
    _, _, driver = list_skin_processes(SINGLE, simulated=SimulatedHubs(tmp_path))
    driver.parameters.update(autostart=False, port_directory="", port=deaf)
    kind = Transition
    with Children(tmp_path) as children:
        children.start(driver)
        process = psutil.Process(children.find_pid("driver"))

        def change(number):
            begun = time.monotonic()
            request = ChangeState.Request(transition=kind(id=number))
            assert ros.call(ChangeState, "/driver/change_state", request).success
            return time.monotonic() - begun

        ros.call(GetState, "/driver/get_state", GetState.Request())  # they have met
        change(kind.TRANSITION_CONFIGURE)
        idle = process.num_threads()
        for end in (kind.TRANSITION_CLEANUP, kind.TRANSITION_INACTIVE_SHUTDOWN):
            said = children.log("driver").count("hub0: waiting")
            change(kind.TRANSITION_ACTIVATE)
            ros.wait(lambda said=said: children.log("driver").count("hub0: waiting") > said)
            # the one reader of all links; DDS has a thread more for a moment now and then
            ros.wait(lambda: process.num_threads() == idle + 1)
            assert change(kind.TRANSITION_DEACTIVATE) < 2.0
            ros.wait(lambda: process.num_threads() == idle)
            assert change(end) < 2.0
            if end == kind.TRANSITION_CLEANUP:
                change(kind.TRANSITION_CONFIGURE)
        children.check()
        assert "Traceback" not in children.log("driver")


@pytest.mark.parametrize(
    ("what", "words", "number"),
    [
        ("missing", "plug the hub in", signal.SIGINT),
        ("forbidden", "dialout", signal.SIGTERM),
        ("deaf", "waiting", signal.SIGINT),
        ("deaf", "switch the bridge on", signal.SIGTERM),
    ],
)
def test_what_cannot_be_opened_is_said_with_the_fix_and_shut_down_at_once(
    domain, deaf, what, words, number
):
    """Signals come in the middle of a reconnect."""
    near, far = os.openpty()
    tty = os.ttyname(far)
    port = {
        "missing": "/nowhere/ttyACM0",
        "deaf": deaf,
    }.get(what, tty)
    command = [sys.executable, "-u", "-m", "cube_tensor_driver.ros.nodes.driver", "--ros-args"]
    command += format_ros_arguments({"config": str(SINGLE), "port": port})
    if what == "forbidden":
        Path(tty).chmod(0)
        if os.geteuid() == 0:  # root without what lets it pass
            command = ["setpriv", "--bounding-set", "-dac_override,-dac_read_search", *command]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ
    )
    said = ""
    try:
        while words not in said:
            said += process.stdout.readline()
            assert process.poll() is None, said
        start = time.monotonic()
        process.send_signal(number)
        rest, _ = process.communicate(timeout=10)
        assert process.returncode == 0, said + rest
        assert time.monotonic() - start < 2.0
        assert "Traceback" not in said + rest
        assert f"link hub0: waiting: {port}: " in said + rest or words == "waiting"
    finally:
        process.kill()
        os.close(near)
        os.close(far)


def test_a_driver_that_cannot_read_any_more_ends_with_an_error(domain):
    """Not foreseen, so that it has to be made: it must not go on as if all hubs were silent."""
    code = (
        "from cube_tensor_driver.device.links.reader import Reader\n"
        "from cube_tensor_driver.ros.nodes.driver import main\n"
        "Reader._plan_gathering = lambda *_: 1 / 0\n"
        "main()"
    )
    command = [
        sys.executable,
        "-c",
        code,
        "--ros-args",
        *format_ros_arguments({"config": str(SINGLE)}),
    ]
    process = subprocess.run(
        command, capture_output=True, text=True, env=os.environ, timeout=30, check=False
    )
    assert process.returncode == 1
    assert "cannot go on: ZeroDivisionError" in process.stderr
