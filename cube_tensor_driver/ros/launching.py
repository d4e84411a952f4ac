# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Functions of the launch files: they declare and check launch arguments, and write files.

This module imports the package `launch`, which every installation of ROS 2 has, but not the Python
wheels of ROS 2. So only the launch files import it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple, cast

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import Action, LaunchContext
from launch.actions import DeclareLaunchArgument, EmitEvent, ExecuteProcess
from launch.events import matches_action
from launch.events.process import ProcessExited, ShutdownProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.utilities.namespace_utils import make_namespace_absolute, prefix_namespace

from ..config.load_script import read_script
from ..config.output_files import make_temporary_folder
from ..config.package_data import find_package_data
from ..config.parameters import DRIVER, RECONSTRUCTION
from ..config.rviz import make_rviz_view
from ..config.skin import Skin, read_skin
from ..config.yaml import read_yaml, write_yaml
from ..core.errors import ConfigError
from ..device.live import make_link_configs
from ..processes.skin_processes import Value
from ..simulation.imperfections import read_imperfections

_CONFIG = find_package_data() / "config"
"""Folder of the configuration files that are installed with the package."""

SINGLE_CUBE = _CONFIG / "cube.yaml"
"""Path of the skin file of a single cube, the default of cube.launch.py."""

DEMO_SKIN = _CONFIG / "skin_demo.yaml"
"""Path of the skin file of the demo."""

DEMO_LOAD = _CONFIG / "load_demo.yaml"
"""Path of the load script of the demo, which states the forces on the simulated skin over time."""

SKIN_LAUNCH = find_package_data() / "launch" / "skin.launch.py"
"""Path of the launch file that starts the nodes of a skin."""

RECORD_QOS = _CONFIG / "record_qos.yaml"
"""Path of the file that lists the recorded topics and the quality of service (QoS) of each."""

PARAMETERS = {one.name: one for one in (*RECONSTRUCTION, *DRIVER) if one.name != "config"}
"""Name of a ROS parameter of the nodes `driver` and `reconstruction` -> its declaration.

The parameter `config` is left out, because its default depends on the argument `simulate`.
"""

NEEDED_PACKAGES = {
    "rviz": ("rviz2", "robot_state_publisher"),
    "state_publisher": ("robot_state_publisher",),
    "record": ("ros2bag", "rosbag2_storage_mcap"),
}
"""Name of a launch argument -> the ROS packages that must be installed if the argument is true."""


def declare_text(
    name: str,
    description: str,
    default: str = "",
) -> DeclareLaunchArgument:
    """Return the declaration of a launch argument that takes any text.

    Args:
        name: Name of the argument.
        description: Text that `ros2 launch --show-args` shows.
        default: Default value.
    """
    return DeclareLaunchArgument(
        name,
        default_value=default,
        description=description,
    )


def declare_switch(
    name: str,
    description: str,
    default: str = "false",
) -> DeclareLaunchArgument:
    """Return the declaration of a launch argument that is true or false.

    Args:
        name: Name of the argument.
        description: Text that `ros2 launch --show-args` shows.
        default: "true" or "false". An empty text allows an empty value, too, which leaves the
            decision to the parameter of the same name.
    """
    # Launch files that are written in Python often pass str(True), which is "True".
    choices = ["true", "false", "True", "False"]
    return DeclareLaunchArgument(
        name,
        default_value=default,
        choices=choices if default else ["", *choices],
        description=description,
    )


class SkinArguments(NamedTuple):
    """Checked arguments of skin.launch.py.

    Attributes:
        texts: Name of each argument -> its text.
        switched_on: Names of the arguments that are true.
        config: Absolute path of the skin file.
        skin: Content of the skin file.
        load: Path of the load script, for simulated hubs.
        imperfections: Path of the file with the deviations of simulated pads from ideal ones; None:
            the pads are ideal.
        parameters: Name of a ROS parameter -> its value, for the arguments that set parameters of
            `driver` and `reconstruction`. Empty arguments are left out, so that a value that an
            including launch file sets with SetParameter is kept.
    """

    texts: dict[str, str]
    switched_on: set[str]
    config: Path
    skin: Skin
    load: Path
    imperfections: Path | None
    parameters: dict[str, Value]


def write_parameter_file(parameters: dict[str, Value]) -> str:
    """Write a temporary parameter file of ROS, and return its path.

    Args:
        parameters: Name of a parameter of a node -> its value.
    """
    path = make_temporary_folder("cube_parameters_") / "given.yaml"
    write_yaml(path, {"/**": {"ros__parameters": parameters}})
    return str(path)


def write_rviz_file(skin: Skin) -> str:
    """Write a temporary configuration file of RViz for a skin, and return its path."""
    path = make_temporary_folder("cube_rviz_") / "skin.rviz"
    write_yaml(path, make_rviz_view(skin))
    return str(path)


def record_skin(
    context: LaunchContext,
    namespace: str,
    skin_name: str,
) -> ExecuteProcess:
    """Return the action that starts `ros2 bag record` for the topics of the skin.

    An including launch file may set a namespace, remaps and the parameter `qos_reliability` for all
    its nodes. launch_ros applies them to actions of the type Node only, so they are applied to the
    arguments of `ros2 bag` here.

    Args:
        context: Holds what an including launch file has set.
        namespace: Namespace of the skin, relative to that of an including launch file.
        skin_name: Name of the skin, which becomes a part of the name of the bag.
    """
    surroundings: dict[str, Any] = context.launch_configurations
    outer_namespace = surroundings.get("ros_namespace", "")
    relative = prefix_namespace(outer_namespace, namespace)
    full_namespace = (make_namespace_absolute(relative) or "").strip("/")
    qualities = _list_recorded_topics(surroundings, full_namespace)
    overrides = make_temporary_folder("cube_record_") / "qos.yaml"
    write_yaml(overrides, qualities)

    time = f"{datetime.now():%Y_%m_%d-%H_%M_%S}"
    parts = [*full_namespace.split("/"), skin_name, time]
    name = "_".join(part for part in parts if part)
    folder = Path(name).absolute()
    command = ["ros2", "bag", "record", "--storage", "mcap", "--output", str(folder)]
    command += ["--qos-profile-overrides-path", str(overrides)]
    # `ros2 bag record` of Humble lacks the option --topics; all releases have --regex.
    command += ["--regex", f"^({'|'.join(qualities)})$"]
    return ExecuteProcess(
        cmd=command,
        name="recorder",
        output="screen",
    )


def _list_recorded_topics(
    surroundings: dict[str, Any],
    namespace: str,
) -> dict[str, dict[str, object]]:
    """Return the full names of the recorded topics and the quality of service of each.

    Args:
        surroundings: Launch configurations, in which launch_ros stores remaps and parameters that
            an including launch file has set.
        namespace: Namespace of the skin, without slashes at its ends.
    """
    remaps: dict[str, str] = dict(surroundings.get("ros_remaps") or [])
    # The list of global parameters holds pairs of name and value, and paths of parameter files.
    global_parameters = surroundings.get("global_params", [])
    given = [pair for pair in global_parameters if isinstance(pair, tuple)]
    parameters: dict[str, str] = dict(given)
    reliability = parameters.get("qos_reliability", "reliable")

    qualities = {}
    shipped = cast("dict[str, dict[str, object]]", read_yaml(RECORD_QOS))
    for topic, quality in shipped.items():
        name = topic.removeprefix("/")
        name = remaps.get(name, name)
        prefix = f"/{namespace}" if namespace else ""
        full_name = name if name.startswith("/") else f"{prefix}/{name}"
        # The parameter qos_reliability of the nodes sets the reliability of these two topics.
        is_batch = topic in ("/frequencies", "/stress")
        qualities[full_name] = quality | ({"reliability": reliability} if is_batch else {})
    return qualities


def prevent_restart(event: ProcessExited, context: LaunchContext) -> Action | None:
    """Return the action that prevents a restart (`respawn`) of a node that ended with `EX_CONFIG`.

    The exit code `EX_CONFIG` (78) means that a parameter or a file cannot be used. After a restart
    the node would end in the same way.

    Args:
        event: The end of the process of the node.
        context: Not used; launch passes it to every handler of an event.
    """
    if event.returncode != os.EX_CONFIG:
        return None
    return EmitEvent(event=ShutdownProcess(process_matcher=matches_action(event.action)))


def check_arguments(
    context: LaunchContext,
    declared: Iterable[str],
) -> SkinArguments:
    """Check all launch arguments, before anything starts.

    Args:
        context: Holds the launch arguments.
        declared: Names of the arguments of the launch file.

    Raises:
        ConfigError: An argument, the skin file or the load script has a mistake, or a ROS package
            that an argument needs is not installed. The error ends the launch.
    """
    _check_names(context, declared)
    texts = {name: str(LaunchConfiguration(name).perform(context)) for name in declared}
    switched_on = {name for name, text in texts.items() if text.lower() == "true"}
    config = texts["config"] or (str(DEMO_SKIN) if "simulate" in switched_on else "")
    if not config:
        raise ConfigError(
            "config is missing: name a skin file, config:=skin.yaml, or try simulate:=true"
        )
    path = Path(config).expanduser().resolve()
    skin = read_skin(path, texts["frame_prefix"])
    load = Path(texts["load"]).expanduser()
    read_script(load)
    imperfections = None
    if texts["imperfections"]:
        imperfections = Path(texts["imperfections"]).expanduser()
        read_imperfections(imperfections)

    parameters: dict[str, Value] = {}
    for name, text in texts.items():
        if not text or name not in PARAMETERS:
            continue
        parameter = PARAMETERS[name]
        parameters[name] = parameter.parse(text)
        refusal = parameter.find_refusal(parameters[name])
        if refusal:
            raise ConfigError(f"{name}:={text}: {refusal}")
    # This call raises an error if the argument `port` is set for a skin with several links.
    make_link_configs(skin, texts["port"])
    for name, packages in NEEDED_PACKAGES.items():
        if name in switched_on:
            _check_installed(name, packages)
    return SkinArguments(
        texts,
        switched_on,
        path,
        skin,
        load,
        imperfections,
        parameters,
    )


def _check_names(context: LaunchContext, declared: Iterable[str]) -> None:
    """Raise ConfigError if the command line of `ros2 launch` has an argument that is not declared.

    Launch itself ignores such arguments. They are checked only if the command line names a launch
    file of this package. Another launch file, which includes one of this package, may declare
    further arguments.
    """
    file_names = {Path(word).name for word in sys.argv}
    own_launch_files = {SKIN_LAUNCH.name, "cube.launch.py"}
    if not file_names & own_launch_files:
        return
    for word in context.argv:
        name = word.partition(":=")[0]
        if name not in declared:
            raise ConfigError(
                f"no launch argument {name}, there are: {', '.join(declared)}. Parameters of nodes "
                "are set in a launch file that includes this one, see docs/robot.md"
            )


def _check_installed(name: str, packages: tuple[str, ...]) -> None:
    """Check that the ROS packages that a launch argument needs are installed.

    Args:
        name: Name of the launch argument.
        packages: Names of the ROS packages.

    Raises:
        ConfigError: A package is not installed.
    """
    for package in packages:
        try:
            get_package_prefix(package)
        except PackageNotFoundError:
            distro = os.environ.get("ROS_DISTRO", "$ROS_DISTRO")
            raise ConfigError(
                f"{name}:=true needs the ROS package {package}: "
                f"sudo apt install ros-{distro}-{package.replace('_', '-')}"
            ) from None
