"""The processes of a skin as actions of a launch file.

Imports launch, which every ROS 2 installation has. The ROS 2 wheels lack it.
"""

from __future__ import annotations

import sys
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import LaunchContext, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, ExecuteProcess, LogInfo
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from ..config.load_script import read_script
from ..config.package_data import package_data
from ..config.skin import Skin, read_skin
from ..config.urdf import skin_urdf
from ..core.errors import ConfigError
from ..processes.skin_processes import Process, SimulatedHubs, record_command, skin_processes
from ..processes.temporary import temporary_folder


def switch(name: str, description: str, default: str = "false") -> DeclareLaunchArgument:
    """A launch argument that is true or false."""
    return DeclareLaunchArgument(
        name, default_value=default, choices=["true", "false"], description=description
    )


def start_skin(
    context: LaunchContext, **arguments: LaunchConfiguration
) -> list[LaunchDescriptionEntity]:
    """The actions that start a skin, for an OpaqueFunction.

    arguments: config and namespace; also port, rate, publish_period, simulate, load, composed,
    autostart, markers, contacts, record, rviz and state_publisher if the launch file has them.

    Raises ConfigError if the skin file, the load script or an argument is wrong.
    """
    given = {name: str(argument.perform(context)) for name, argument in arguments.items()}
    config = _path(given["config"])
    skin = read_skin(config)
    namespace = given["namespace"]
    rviz = given.get("rviz") == "true"
    actions = [
        _process_action(process, namespace) for process in _nodes_first(_processes(config, given))
    ]
    if rviz or given.get("state_publisher") == "true":
        actions.append(_state_publisher(skin, namespace))
    if given.get("record") == "true":
        record = ExecuteProcess(cmd=record_command(skin.name, namespace), output="screen")
        actions.append(_if_installed("ros2bag", record))
    if rviz:
        actions.append(_rviz(namespace))
    return actions


def _processes(config: Path, given: dict[str, str]) -> list[Process]:
    def wanted(name: str) -> bool:
        return given.get(name) == "true"

    load = _path(given["load"]) if given.get("load") else None
    if load is not None:
        read_script(load)  # so that a mistake in it is told before anything starts
    simulated = None
    if wanted("simulate"):
        simulated = SimulatedHubs(temporary_folder("cube_ports_"), load, noise=None)
    return skin_processes(
        config,
        port=given.get("port", ""),
        rate=_number(given, "rate", "samples per second"),
        publish_period=_number(given, "publish_period", "seconds"),
        composed=wanted("composed"),
        autostart=given.get("autostart") != "false",
        markers=wanted("markers") or wanted("rviz"),
        contacts=wanted("contacts"),
        simulated=simulated,
    )


def _nodes_first(processes: list[Process]) -> list[Process]:
    """Where a node cannot be started, launch gives up and leaves running what it has started."""
    return sorted(processes, key=lambda process: not process.node)


def _path(text: str) -> Path:
    return Path(text).expanduser().resolve()


def _number(given: dict[str, str], name: str, unit: str) -> float:
    try:
        return float(given.get(name, 0))
    except ValueError:
        raise ConfigError(f"{name}:={given[name]}: must be a number of {unit}") from None


def _process_action(process: Process, namespace: str) -> LaunchDescriptionEntity:
    if not process.node:
        return ExecuteProcess(
            cmd=[sys.executable, "-m", process.module, *process.arguments],
            name=process.executable,
            output="screen",
        )
    # `composed` holds several nodes, which keep their own names.
    name = None if process.executable == "composed" else process.executable
    return Node(
        package="cube_tensor_driver",
        executable=process.executable,
        name=name,
        namespace=namespace,
        parameters=[process.parameters],
        output="screen",
        emulate_tty=True,
    )


def _if_installed(package: str, action: LaunchDescriptionEntity) -> LaunchDescriptionEntity:
    """The action; or, if its package is missing, a line that says how to install it."""
    try:
        get_package_prefix(package)
    except PackageNotFoundError:
        name = package.replace("_", "-")
        return LogInfo(
            msg=f"{package} is not installed: left out (sudo apt install ros-$ROS_DISTRO-{name})"
        )
    return action


def _state_publisher(skin: Skin, namespace: str) -> LaunchDescriptionEntity:
    package = "robot_state_publisher"
    node = Node(
        package=package,
        executable=package,
        namespace=namespace,
        parameters=[{"robot_description": skin_urdf(skin)}],
        output="screen",
    )
    return _if_installed(package, node)


def _rviz(namespace: str) -> LaunchDescriptionEntity:
    arguments = ["-d", str(package_data() / "rviz" / "skin.rviz")]
    node = Node(package="rviz2", executable="rviz2", namespace=namespace, arguments=arguments)
    return _if_installed("rviz2", node)
