"""The processes of a skin as launch actions. Imports launch, which every ROS 2 machine has and the
wheels lack."""

from __future__ import annotations

import sys
import tempfile
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


def switch(name: str, description: str, default: str = "false") -> DeclareLaunchArgument:
    """A launch argument that is true or false."""
    return DeclareLaunchArgument(
        name, default_value=default, choices=["true", "false"], description=description
    )


def start_skin(
    context: LaunchContext, **arguments: LaunchConfiguration
) -> list[LaunchDescriptionEntity]:
    """For an OpaqueFunction: what `skin_processes` says as actions, and what else the arguments ask
    for.

    arguments: config and namespace; port, rate, publish_period, simulate, load, composed,
    autostart, markers, contacts, record, rviz, state_publisher if the launch file has them.
    ConfigError: skin file, load script or an argument is wrong.
    """
    given = {name: str(argument.perform(context)) for name, argument in arguments.items()}
    path = Path(given["config"]).expanduser().resolve()
    skin = read_skin(path)
    namespace = given["namespace"]
    numbers = {}
    for name, what in {"rate": "samples per second", "publish_period": "seconds"}.items():
        try:
            numbers[name] = float(given.get(name, 0))
        except ValueError:
            raise ConfigError(f"{name}:={given[name]}: must be a number of {what}") from None

    load = Path(given["load"]).expanduser().resolve() if given.get("load") else None
    if load is not None:
        read_script(load)

    def wanted(name: str) -> bool:
        return given.get(name) == "true"

    processes = skin_processes(
        path,
        port=given.get("port", ""),
        rate=numbers["rate"],
        publish_period=numbers["publish_period"],
        composed=wanted("composed"),
        autostart=given.get("autostart") != "false",
        markers=wanted("markers") or wanted("rviz"),
        contacts=wanted("contacts"),
        simulated=SimulatedHubs(_port_folder(), load) if wanted("simulate") else None,
    )
    # Nodes first: where one cannot be started launch gives up, and leaves what it has started
    # already.
    actions = [
        _action(process, namespace)
        for process in sorted(processes, key=lambda process: not process.node)
    ]
    if wanted("state_publisher") or wanted("rviz"):
        actions.append(_state_publisher(skin, namespace))
    if wanted("record"):
        record = ExecuteProcess(cmd=record_command(skin.name, namespace), output="screen")
        actions.append(_installed("ros2bag", record))
    if wanted("rviz"):
        actions.append(_rviz(namespace))
    return actions


def _port_folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="cube_ports_"))


def _action(process: Process, namespace: str) -> LaunchDescriptionEntity:
    if process.node:
        return Node(
            package="cube_tensor_driver",
            executable=process.executable,
            # One executable may hold several nodes: they keep their own names.
            name=None if process.executable == "composed" else process.executable,
            namespace=namespace,
            parameters=[process.parameters],
            output="screen",
            emulate_tty=True,
        )
    return ExecuteProcess(
        cmd=[sys.executable, "-m", process.module, *process.arguments],
        name=process.executable,
        output="screen",
    )


def _installed(package: str, action: LaunchDescriptionEntity) -> LaunchDescriptionEntity:
    """The action, or a line that says how to get its package."""
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
    parameters = [{"robot_description": skin_urdf(skin)}]
    return _installed(
        package,
        Node(
            package=package,
            executable=package,
            namespace=namespace,
            parameters=parameters,
            output="screen",
        ),
    )


def _rviz(namespace: str) -> LaunchDescriptionEntity:
    arguments = ["-d", str(package_data() / "rviz" / "skin.rviz")]
    return _installed(
        "rviz2", Node(package="rviz2", executable="rviz2", namespace=namespace, arguments=arguments)
    )
