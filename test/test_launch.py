"""Launch files, the list of processes that they share with the demo, and a skin that starts."""

from __future__ import annotations

import functools
import importlib
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from conftest import ROOT
from cube_tensor_driver.config.package_data import package_data
from cube_tensor_driver.config.yaml import read_yaml
from cube_tensor_driver.processes.skin_processes import (
    SimulatedHubs,
    record_command,
    skin_processes,
)

SKIN = package_data() / "config" / "skin_demo.yaml"


def test_one_list_serves_launch_and_demo():
    names = [
        process.executable
        for process in skin_processes(
            SKIN, simulated=SimulatedHubs(Path("p")), markers=True, contacts=True
        )
    ]
    assert names == ["simulator", "reconstruction", "driver", "markers", "contacts"]
    assert [process.executable for process in skin_processes(SKIN, composed=True)] == ["composed"]
    assert [process.executable for process in skin_processes(SKIN)] == ["reconstruction", "driver"]


def test_every_executable_of_the_list_is_installed_and_runs_its_module(monkeypatch):
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    packages = pytest.importorskip("ament_index_python.packages", reason="needs ROS 2")
    installed = Path(packages.get_package_prefix("cube_tensor_driver")) / "lib/cube_tensor_driver"
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # scripts set up their own Ctrl-C
    started: list[str] = []
    every = skin_processes(
        SKIN, simulated=SimulatedHubs(Path("p")), markers=True, contacts=True
    ) + skin_processes(SKIN, composed=True)
    for process in every:
        module, name = importlib.import_module(process.module), process.executable
        monkeypatch.setattr(module, "main", functools.partial(started.append, name))
        assert os.access(installed / name, os.X_OK)
        runpy.run_path(str(installed / name), run_name="__main__")
        assert started.pop() == name


def test_each_recording_has_a_folder_of_its_own():
    """ros2 bag refuses a folder that exists. It also records the info that was published before it
    started, which is asked for in the words that ros2 bag knows."""
    command = record_command("skin", "left/arm")
    assert re.fullmatch(
        r"left_arm_skin_\d{4}_\d\d_\d\d-\d\d_\d\d_\d\d", command[command.index("-o") + 1]
    )
    assert command[-3:] == ["/left/arm/frequencies", "/left/arm/stress", "/left/arm/info"]
    profiles = read_yaml(Path(command[command.index("--qos-profile-overrides-path") + 1]))
    assert [profiles[topic]["durability"] for topic in command[-3:]] == [
        "volatile",
        "volatile",
        "transient_local",
    ]
    assert record_command("skin")[-1] == "/info" and record_command("skin")[6].startswith("skin_")
    policies = pytest.importorskip("rclpy.qos", reason="needs rclpy")
    for profile in profiles.values():
        for name in ("history", "reliability", "durability"):
            policy = getattr(policies, f"{name.title()}Policy")
            assert policy.get_from_short_key(profile[name]) != policy.UNKNOWN


def test_temporary_folders_end_with_the_process(tmp_path):
    program = """
from pathlib import Path
from cube_tensor_driver.processes.skin_processes import record_command
command = record_command("skin", "left/arm")
print(Path(command[command.index("--qos-profile-overrides-path") + 1]).is_file())
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


@pytest.mark.parametrize("name", ["skin.launch.py", "cube.launch.py"])
def test_every_argument_is_described(name):
    pytest.importorskip("launch", reason="needs launch and launch_ros, which the wheels lack")
    pytest.importorskip("launch_ros", reason="needs launch_ros, which the wheels lack")
    from launch.launch_description_sources import get_launch_description_from_python_launch_file

    description = get_launch_description_from_python_launch_file(str(ROOT / "launch" / name))
    arguments = description.get_launch_arguments()
    assert {"config", "namespace"} <= {argument.name for argument in arguments}
    for argument in arguments:
        assert len(argument.description) > 15 and "no description" not in argument.description, (
            argument.name
        )


def test_a_simulated_skin_starts_and_ends(domain):
    pytest.importorskip("launch_ros", reason="needs launch_ros, which the wheels lack")
    if shutil.which("ros2") is None:
        pytest.skip("needs the command ros2 (ros2cli and ros2launch), which the wheels lack")
    command = [
        "ros2",
        "launch",
        "cube_tensor_driver",
        "skin.launch.py",
        f"config:={SKIN}",
        "simulate:=true",
    ]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        lines = []
        for line in process.stdout:
            lines.append(line)
            if "link hub1: hub 0x2 with 8 cubes of 8 pads" in line:
                break
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=10)
        assert process.returncode == 0, "".join(lines) + output
        assert output.count("process has finished cleanly") == 3
    finally:
        process.kill()


def test_transitions_by_events_of_launch(domain):
    """A LifecycleNode of launch_ros drives a node that does not start by itself. Each step begins
    when the one before is done."""
    pytest.importorskip("launch_ros", reason="needs launch_ros, which the wheels lack")
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
