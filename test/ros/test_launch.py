# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Launch files, the list of processes that they share with the demo, and a skin that starts."""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
import threading
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest

from conftest import ROOT
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.processes.skin_processes import SimulatedHubs, list_skin_processes

SKIN = find_package_data() / "config" / "skin_demo.yaml"

# A sourced ROS 2 has these; the wheels do not.
needs_launch = pytest.mark.skipif(
    not (find_spec("launch") and find_spec("launch_ros")),
    reason="needs launch and launch_ros, which the wheels lack",
)
needs_ros2 = pytest.mark.skipif(
    shutil.which("ros2") is None,
    reason="needs the command ros2 (ros2cli and ros2launch), which the wheels lack",
)


def test_the_demo_starts_what_it_needs_in_order():
    names = [
        process.executable
        for process in list_skin_processes(
            SKIN, simulated=SimulatedHubs(Path("p")), markers=True, contacts=True
        )
    ]
    assert names == ["simulator", "reconstruction", "driver", "markers", "contacts"]
    assert [process.executable for process in list_skin_processes(SKIN, composed=True)] == [
        "composed"
    ]
    assert [process.executable for process in list_skin_processes(SKIN)] == [
        "reconstruction",
        "driver",
    ]


def test_every_executable_of_the_list_is_installed_and_runs_its_module(monkeypatch):
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    packages = pytest.importorskip("ament_index_python.packages", reason="needs ROS 2")
    installed = Path(packages.get_package_prefix("cube_tensor_driver")) / "lib/cube_tensor_driver"
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # scripts set up their own Ctrl-C
    started: list[str] = []
    every = [
        *list_skin_processes(SKIN, simulated=SimulatedHubs(Path("p")), markers=True, contacts=True),
        *list_skin_processes(SKIN, composed=True),
    ]
    for process in every:
        module, name = importlib.import_module(process.module), process.executable
        monkeypatch.setattr(module, "main", functools.partial(started.append, name))
        assert os.access(installed / name, os.X_OK)
        with contextlib.suppress(SystemExit):
            runpy.run_path(str(installed / name), run_name="__main__")
        assert started.pop() == name


def test_temporary_folders_end_with_the_process(tmp_path):
    program = """
from cube_tensor_driver.config.output_files import make_temporary_folder
print(make_temporary_folder("cube_").is_dir())
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "True\n"
    assert list(tmp_path.iterdir()) == []


BLOCK = """
import sys

class Undeclared:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {undeclared}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Undeclared())
"""
"""A sitecustomize.py that makes modules unimportable."""


@pytest.fixture
def robot(monkeypatch, tmp_path):
    """Processes that start now import only what package.xml names, as on a robot without pip."""
    tree = ElementTree.parse(ROOT / "package.xml")
    declared = {element.text for element in tree.iter() if element.tag == "exec_depend"}
    by_pip = set(MODULES) - {name for name, key in MODULES.items() if key in declared}
    (tmp_path / "sitecustomize.py").write_text(BLOCK.format(undeclared=by_pip))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ["PYTHONPATH"]]))


MODULES = {
    "rosbags": "python3-rosbags",
    "mcap": "python3-mcap",
    "lz4": "python3-lz4",
    "zstandard": "python3-zstandard",
    "pyarrow": "python3-pyarrow",
    "viser": "python3-viser",
    "websockets": "python3-websockets",
    "skfem": "python3-scikit-fem",
    "mujoco": "python3-mujoco",
    "distributed": "python3-distributed",
    "PIL": "python3-pil",
    "matplotlib": "python3-matplotlib",
    "rich": "python3-rich",
    "psutil": "python3-psutil",
    "scipy": "python3-scipy",
}
"""Modules that this environment has, and the rosdep key by which package.xml would name each."""


def test_every_node_runs_with_what_package_xml_installs(ros, robot, tmp_path):
    from sensor_msgs.msg import PointCloud2
    from visualization_msgs.msg import MarkerArray

    from cube_tensor_driver.msg import SkinContacts
    from cube_tensor_driver.processes.children import Children

    simulated = SimulatedHubs(tmp_path / "ports")
    every = list_skin_processes(SKIN, simulated=simulated, markers=True, contacts=True)
    heard = [
        ros.listen(SkinContacts, "contacts"),
        ros.listen(PointCloud2, "traction"),
        ros.listen(MarkerArray, "markers"),
    ]
    with Children(tmp_path) as children:
        for process in every:
            inverse = {"method": "inverse"} if process.executable == "contacts" else {}
            children.start(replace(process, parameters=process.parameters | inverse))
        ros.wait(lambda: all(heard), 40.0)
        children.check()


@pytest.mark.parametrize("node", ["driver", "reconstruction", "composed"])
def test_a_node_imports_nothing_that_it_does_not_use(node):
    """No scipy and nothing that only displays, so that it starts soon."""
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    program = f"import sys, cube_tensor_driver.ros.nodes.{node}; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    loaded = {name.partition(".")[0] for name in done.stdout.split()}
    assert {"numpy", "rclpy"} <= loaded and not loaded & set(MODULES)
    ours = {
        name.split(".")[1] for name in done.stdout.split() if name.startswith("cube_tensor_driver.")
    }
    assert not ours & {"bags", "browser", "cli", "mechanics", "simulation", "touch", "views"}


@pytest.mark.usefixtures("domain")
def test_a_bag_as_config_names_the_missing_library(robot, tmp_path):
    bag = tmp_path / "run1.mcap"
    bag.write_bytes(b"")
    command = [sys.executable, "-m", "cube_tensor_driver.ros.nodes.reconstruction"]
    node = subprocess.Popen(
        [*command, "--ros-args", "-p", f"config:={bag}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    lines = []
    stop = threading.Timer(30.0, node.kill)
    stop.start()
    try:
        for line in node.stdout:
            lines.append(line)
            if "pip install" in line:
                break
    finally:
        stop.cancel()
        node.kill()
        node.communicate()
    output = "".join(lines)
    assert re.search("needs the Python package (rosbags|mcap|zstandard)", output), output
    assert "Traceback" not in output


@needs_launch
def test_the_recording_follows_namespace_and_remaps():
    """`ros2 bag` gets whole names, long queues, and the reliability that the nodes have."""
    from launch import LaunchContext

    from cube_tensor_driver.config.yaml import read_yaml
    from cube_tensor_driver.ros.launching import record_skin

    context = LaunchContext()
    context.launch_configurations.update(
        {
            "ros_namespace": "/robot1",
            "ros_remaps": [("stress", "felt")],
            "global_params": [("qos_reliability", "best_effort")],
        }
    )
    action = record_skin(context, "hand", "skin")
    command = [words[0].perform(context) for words in action.cmd]
    names = ["frequencies", "felt", "compensation", "info", "driver/info", "diagnostics"]
    whole = [f"/robot1/hand/{name}" for name in names]
    regex = command[command.index("--regex") + 1]
    others = ["/frequencies", "/diagnostics"]
    assert [name for name in [*whole, *others] if re.search(regex, name)] == whole
    qualities = read_yaml(Path(command[command.index("--qos-profile-overrides-path") + 1]))
    assert list(qualities) == whole
    assert qualities["/robot1/hand/felt"]["reliability"] == "best_effort"
    assert qualities["/robot1/hand/info"]["durability"] == "transient_local"
    folder = Path(command[command.index("--output") + 1])
    assert re.fullmatch(r"robot1_hand_skin_\d{4}_\d\d_\d\d-\d\d_\d\d_\d\d", folder.name)


def declared(name: str) -> dict[str, object]:
    """The arguments of a launch file, as `ros2 launch FILE --show-args` lists them."""
    from launch.launch_description_sources import get_launch_description_from_python_launch_file

    description = get_launch_description_from_python_launch_file(str(ROOT / "launch" / name))
    return {argument.name: argument for argument in description.get_launch_arguments()}


@needs_launch
@pytest.mark.parametrize("name", ["skin.launch.py", "cube.launch.py"])
def test_every_argument_is_described(name):
    arguments = declared(name)
    assert {"config", "port", "namespace", "simulate", "record", "rviz", "respawn"} <= set(
        arguments
    )
    for argument in arguments.values():
        assert len(argument.description) > 15 and "no description" not in argument.description


@needs_launch
def test_pages_use_arguments_that_launch_files_have():
    text = "\n".join(
        page.read_text() for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    )
    launches = re.findall(r"ros2 launch cube_tensor_driver (\S+)((?: \S+:=[^\s`]+)*)", text)
    assert launches
    for file, arguments in launches:
        assert set(re.findall(r"(\w+):=", arguments)) <= set(declared(file)), file


def launch_context(**given: str) -> object:
    """The context of skin.launch.py with these arguments of the command line."""
    from launch import LaunchContext

    context = LaunchContext(argv=[f"{name}:={text}" for name, text in given.items()])
    for argument in declared("skin.launch.py").values():
        context.launch_configurations[argument.name] = given.get(
            argument.name, argument.default_value[0].text
        )
    return context


def started_by(**given: str) -> dict[str, object]:
    """The actions of skin.launch.py with these arguments, by the names of their executables."""
    from launch.actions import OpaqueFunction
    from launch.launch_description_sources import get_launch_description_from_python_launch_file
    from launch_ros.actions import Node

    path = str(ROOT / "launch" / "skin.launch.py")
    description = get_launch_description_from_python_launch_file(path)
    (start,) = (one for one in description.entities if isinstance(one, OpaqueFunction))
    return {
        action.node_executable if isinstance(action, Node) else action.name[0].text: action
        for action in start.execute(launch_context(**given))
    }


@needs_launch
def test_the_launch_file_starts_what_its_arguments_ask_for(monkeypatch):
    """In the order in which the processes must start."""
    monkeypatch.setitem(launching().NEEDED_PACKAGES, "rviz", ())
    monkeypatch.setitem(launching().NEEDED_PACKAGES, "record", ())
    assert list(started_by(config=str(SKIN))) == ["reconstruction", "driver"]
    rviz = started_by(config=str(SKIN), composed="true", rviz="True")
    assert list(rviz) == ["composed", "markers", "robot_state_publisher", "rviz2"]
    others = started_by(simulate="true", contacts="true", record="true")
    assert list(others) == ["simulator", "reconstruction", "driver", "contacts", "recorder"]
    words = [word[0] for word in others["simulator"].cmd]
    assert {word.text for word in words[1:]} >= {"--config", str(SKIN), "--ports", "--load"}
    assert "--noise" not in {word.text for word in words[1:]}


@needs_launch
def test_empty_arguments_set_no_parameter(monkeypatch):
    """Then a parameter that an including launch file sets stays."""
    module = launching()
    written = []
    monkeypatch.setattr(module, "write_yaml", lambda path, content: written.append(content))

    def parameters(**given: str) -> list[dict[str, object]]:
        written.clear()
        started_by(config=str(SKIN), contacts="true", **given)
        return [content["/**"]["ros__parameters"] for content in written]

    both = {"config": str(SKIN)}
    assert parameters() == [both, both, {}]
    both |= {"rate": 80.0, "autostart": False, "frame_prefix": "left_"}
    given = {"rate": "80", "autostart": "False", "frame_prefix": "left_"}
    assert parameters(**given) == [both, both, {"autostart": False}]


def launching() -> object:
    return importlib.import_module("cube_tensor_driver.ros.launching")


def arguments_refused(**given: str) -> str:
    """Why skin.launch.py starts nothing with these arguments of the command line."""
    from cube_tensor_driver.core.errors import ConfigError

    with pytest.raises(ConfigError) as refused:
        launching().check_arguments(launch_context(**given), declared("skin.launch.py"))
    return str(refused.value)


@needs_launch
def test_arguments_that_cannot_work_are_refused_before_anything_starts():
    assert "config is missing" in arguments_refused()
    assert "gone.yaml" in arguments_refused(config="gone.yaml")
    assert "gone.yaml" in arguments_refused(simulate="true", load="gone.yaml")
    assert "rate:=fast" in arguments_refused(simulate="true", rate="fast")
    assert "allowed: 0, or 0.1 to 10000" in arguments_refused(simulate="True", rate="-5")
    assert "allowed: 0 to 1" in arguments_refused(simulate="true", publish_period="5")
    assert "parameter port: " in arguments_refused(config=str(SKIN), port="socket://::::")
    assert "has 2 links" in arguments_refused(config=str(SKIN), port="/dev/ttyACM0")
    assert "a letter first" in arguments_refused(simulate="true", frame_prefix="/left")


@needs_launch
def test_an_argument_that_no_launch_file_has_is_refused(monkeypatch):
    """Unless another launch file includes this one: then it may be an argument of that one."""
    monkeypatch.setattr(sys, "argv", ["ros2", "launch", "cube_tensor_driver", "skin.launch.py"])
    assert "no launch argument drift_time" in arguments_refused(simulate="true", drift_time="9")
    monkeypatch.setattr(sys, "argv", ["ros2", "launch", "robot.launch.xml"])
    assert "config is missing" in arguments_refused(drift_time="9")


@needs_launch
@pytest.mark.parametrize(("code", "starts"), [(1, 3), (os.EX_CONFIG, 1)])
def test_a_node_that_ends_with_a_configuration_error_stays_ended(code, starts):
    from launch import LaunchDescription, LaunchService
    from launch.actions import ExecuteProcess

    from cube_tensor_driver.ros.launching import prevent_restart

    ended = []

    def on_exit(event, context):
        ended.append(event.returncode)
        return prevent_restart(event, context)

    node = ExecuteProcess(
        cmd=[sys.executable, "-c", f"raise SystemExit({code})"],
        respawn=True,
        respawn_delay=0.1,
        respawn_max_retries=2,
        on_exit=on_exit,
    )
    service = LaunchService(noninteractive=True)
    service.include_launch_description(LaunchDescription([node]))
    assert service.run() == 0
    assert ended == [code] * starts


ROBOT = """
<launch>
  <group>
    <push_ros_namespace namespace="robot1"/>
    <set_parameter name="drift_time" value="33"/>
    <set_parameter name="publish_period" value="0.05"/>
    <set_parameter name="rate" value="50.0"/>
    <set_remap from="stress" to="felt"/>
    <include file="$(find-pkg-share cube_tensor_driver)/launch/skin.launch.py">
      <arg name="simulate" value="True"/>
      <arg name="frame_prefix" value="robot1_"/>
      <arg name="state_publisher" value="true"/>
      <arg name="namespace" value="hand"/>
      <arg name="record" value="true"/>
      <arg name="rate" value="80"/>
    </include>
  </group>
</launch>
"""


def make_package(prefix: Path, name: str, command: str) -> Path:
    """A ROS package in its own install space whose executable is a command of the shell."""
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    (index / name).touch()
    program = prefix / "lib" / name / name
    program.parent.mkdir(parents=True)
    program.write_text(f"#!/bin/sh\n{command}\n")
    program.chmod(0o755)
    return prefix


@needs_launch
@needs_ros2
def test_a_robot_includes_a_simulated_skin(ros, tmp_path):
    """Its namespace, remaps and parameters reach the nodes and the recorder; an argument of the
    launch file beats a parameter that was set around it. Its frames have the prefix, and its
    state publisher is none of the robot. A driver that dies starts again; one Ctrl-C ends all
    without a warning and leaves a whole bag."""
    from rcl_interfaces.srv import GetParameters

    from cube_tensor_driver.bags.read import Bag
    from cube_tensor_driver.bags.source import open_bag
    from cube_tensor_driver.msg import SkinStress

    prefixes = os.environ["AMENT_PREFIX_PATH"]
    (tmp_path / "robot.launch.xml").write_text(ROBOT)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    packages = make_package(tmp_path / "packages", "robot_state_publisher", "echo publisher: $*")
    process = subprocess.Popen(
        ["ros2", "launch", str(tmp_path / "robot.launch.xml")],
        cwd=tmp_path,
        env=os.environ | {"TMPDIR": str(temporary), "AMENT_PREFIX_PATH": f"{packages}:{prefixes}"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    too_late = threading.Timer(60.0, process.send_signal, [signal.SIGINT])
    too_late.start()
    lines: list[str] = []

    def wait_for(text: str) -> str:
        for line in process.stdout:
            lines.append(line)
            if text in line:
                return line
        raise AssertionError("".join(lines))

    try:
        driver = int(re.findall(r"pid \[(\d+)\]", wait_for("[driver-3]: process started"))[0])
        wait_for("link hub1: hub 0x2 with 8 cubes of 8 pads")
        heard = ros.listen(SkinStress, "/robot1/hand/felt", 100)
        ros.wait(lambda: len(heard) > 20)
        assert heard[-1].header.frame_id == "robot1_skin_base"
        os.kill(driver, signal.SIGKILL)
        wait_for("link hub1: hub 0x2 with 8 cubes of 8 pads")
        asked = GetParameters.Request(names=["rate", "publish_period", "config"])

        def parameters() -> tuple[float, float, str]:
            rate, period, config = ros.call(
                GetParameters, "/robot1/hand/driver/get_parameters", asked
            ).values
            return rate.double_value, period.double_value, config.string_value

        assert parameters() == (80.0, 0.05, str(SKIN))
        begun = len(heard)
        ros.wait(lambda: len(heard) > begun + 20)
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=20)
    finally:
        too_late.cancel()
        with contextlib.suppress(ProcessLookupError):  # its nodes too, where the test fails
            os.killpg(process.pid, signal.SIGKILL)
    output = "".join(lines) + output
    assert process.returncode == 0, output
    assert output.count("process has finished cleanly") == 5
    assert "No such file" not in output
    assert not re.search(r"WARN\]|lost", output.partition("ctrl-c")[2]), output
    publisher = re.search("publisher: (.*)", output)[1]
    assert "__node:=skin_state_publisher" in publisher
    assert "robot_description:=skin_description" in publisher
    (folder,) = tmp_path.glob("robot1_hand_skin_*")
    with open_bag(folder) as source:
        assert source.skin.make_frame_id(source.skin.cubes[0]) == "robot1_skin_c00"
    with Bag(folder) as bag:
        recorded = {connection.topic for connection in bag.connections}
    names = ("frequencies", "felt", "compensation", "info", "driver/info", "diagnostics")
    assert recorded == {f"/robot1/hand/{name}" for name in names}
    assert not [path for path in temporary.iterdir() if path.name.startswith("cube_")]


@needs_launch
def test_transitions_by_events_of_launch(domain):
    """A LifecycleNode of launch_ros drives a node that does not start by itself. Each step begins
    when the one before is done."""
    from launch import LaunchDescription, LaunchService
    from launch.actions import (
        EmitEvent,
        OpaqueFunction,
        RegisterEventHandler,
        Shutdown,
        TimerAction,
    )
    from launch.event_handlers import OnProcessStart
    from launch.events import matches_action
    from launch_ros.actions import LifecycleNode
    from launch_ros.event_handlers import OnStateTransition
    from launch_ros.events.lifecycle import ChangeState
    from lifecycle_msgs.msg import Transition

    node = LifecycleNode(
        package="cube_tensor_driver",
        executable="reconstruction",
        name="reconstruction",
        namespace="",
        parameters=[{"config": str(SKIN), "autostart": False}],
    )
    seen = []

    def change(number: int) -> EmitEvent:
        return EmitEvent(
            event=ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=number)
        )

    def then(state: str, action: object) -> RegisterEventHandler:
        note = OpaqueFunction(function=lambda _: seen.append(state))
        return RegisterEventHandler(
            OnStateTransition(target_lifecycle_node=node, goal_state=state, entities=[note, action])
        )

    service = LaunchService(noninteractive=True)
    service.include_launch_description(
        LaunchDescription(
            [
                node,
                RegisterEventHandler(
                    OnProcessStart(
                        target_action=node, on_start=[change(Transition.TRANSITION_CONFIGURE)]
                    )
                ),
                then("inactive", change(Transition.TRANSITION_ACTIVATE)),
                then("active", Shutdown(reason="done")),
                TimerAction(period=30.0, actions=[Shutdown(reason="too late")]),
            ]
        )
    )
    assert service.run() == 0
    assert seen == ["inactive", "active"]
