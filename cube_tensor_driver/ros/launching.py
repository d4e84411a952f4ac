"""What the launch files need beside the actions of launch.

These are arguments that are checked, and texts and commands that are made from the skin file. This
module imports launch, which every ROS 2 installation has. The ROS 2 wheels lack it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import Action, LaunchContext, Substitution
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    SetLaunchConfiguration,
)
from launch.substitutions import LaunchConfiguration
from launch_ros.utilities.namespace_utils import make_namespace_absolute, prefix_namespace

from ..config.load_script import read_script
from ..config.output_files import temporary_folder
from ..config.package_data import package_data
from ..config.parameters import DRIVER
from ..config.port import port_problem
from ..config.rviz import rviz_view
from ..config.skin import Skin, read_skin
from ..config.yaml import read_yaml, write_yaml
from ..core.errors import ConfigError

_CONFIG = package_data() / "config"

SINGLE_CUBE = _CONFIG / "cube.yaml"
"""Skin file of a single cube."""

DEMO_SKIN = _CONFIG / "skin_demo.yaml"
"""Skin file of the demo."""

DEMO_LOAD = _CONFIG / "load_demo.yaml"
"""Load script of the demo."""

SKIN_LAUNCH = package_data() / "launch" / "skin.launch.py"
"""Launch file of a skin."""

RECORD_QOS = _CONFIG / "record_qos.yaml"
"""Quality of service with which topics are recorded."""

NEEDED_PACKAGES = {
    "rviz": ("rviz2", "robot_state_publisher"),
    "state_publisher": ("robot_state_publisher",),
    "record": ("ros2bag", "rosbag2_storage_mcap"),
}
"""Launch argument -> the ROS packages that it needs beyond our own."""


def declare_text(
    name: str,
    description: str,
    default: str = "",
) -> DeclareLaunchArgument:
    """Declare a launch argument that is a text."""
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
    """Declare a launch argument that is true or false, or empty if that is the default."""
    choices = ["true", "false"] if default else ["", "true", "false"]
    return DeclareLaunchArgument(
        name, default_value=default, choices=choices, description=description
    )


class FromSkin(Substitution):  # type: ignore[misc]
    """A text that is made from the skin file of the launch argument `config`."""

    def __init__(self, make: Callable[[Skin], str]) -> None:
        super().__init__()
        self._make = make

    def describe(self) -> str:
        return f"{self._make.__name__} of config"

    def perform(self, context: LaunchContext) -> str:
        """Return the text. ConfigError: the skin file is wrong."""
        return self._make(_read_skin(context))


class GivenParameters(Substitution):  # type: ignore[misc]
    """The path of a parameter file with the launch arguments of these names that are not empty.

    The others are left to the including launch file: what a node is passed overrides the
    SetParameter of that file.
    """

    def __init__(self, *names: str) -> None:
        super().__init__()
        self._parameters = [parameter for parameter in DRIVER if parameter.name in names]

    def describe(self) -> str:
        return f"parameters {', '.join(parameter.name for parameter in self._parameters)}"

    def perform(self, context: LaunchContext) -> str:
        """Write the file and return its path. ConfigError: a text is not of its type."""
        given = {
            parameter.name: _convert(parameter.name, text, type(parameter.default))
            for parameter in self._parameters
            if (text := _argument(context, parameter.name))
        }
        path = temporary_folder("cube_parameters_") / "given.yaml"
        write_yaml(path, {"/**": {"ros__parameters": given}})
        return str(path)


def rviz_file(skin: Skin) -> str:
    """Write a configuration of RViz for this skin, and return its path."""
    path = temporary_folder("cube_rviz_") / "skin.rviz"
    write_yaml(path, rviz_view(skin))
    return str(path)


def record_skin(context: LaunchContext) -> list[Action]:
    """Return the action that starts `ros2 bag record` for the skin's topics.

    A namespace, remaps and the parameter `qos_reliability` that the including launch file sets
    around the skin are applied here, because `ros2 bag` is no action of launch_ros.
    """
    surroundings: dict[str, Any] = context.launch_configurations
    outer_namespace = surroundings.get("ros_namespace", "")
    relative = prefix_namespace(outer_namespace, _argument(context, "namespace"))
    namespace = (make_namespace_absolute(relative) or "").strip("/")
    qualities = _recorded_topics(surroundings, namespace)
    overrides = temporary_folder("cube_record_") / "qos.yaml"
    write_yaml(overrides, qualities)

    time = f"{datetime.now():%Y_%m_%d-%H_%M_%S}"
    parts = [*namespace.split("/"), _read_skin(context).name, time]
    folder = Path("_".join(part for part in parts if part)).absolute()
    command = ["ros2", "bag", "record", "--storage", "mcap", "--output", str(folder)]
    command += ["--qos-profile-overrides-path", str(overrides)]
    # The option --topics does not exist in Humble, --regex does everywhere.
    command += ["--regex", f"^({'|'.join(qualities)})$"]
    return [
        ExecuteProcess(
            cmd=command,
            name="recorder",
            output="screen",
        )
    ]


def _recorded_topics(surroundings: dict[str, Any], namespace: str) -> dict[str, dict[str, str]]:
    """Return the full names of the recorded topics and the quality of service of each."""
    remaps: dict[str, str] = dict(surroundings.get("ros_remaps") or [])
    # Beside pairs of name and value there may be paths of parameter files.
    given = [pair for pair in surroundings.get("global_params", []) if isinstance(pair, tuple)]
    parameters: dict[str, str] = dict(given)
    reliability = parameters.get("qos_reliability", "reliable")

    qualities = {}
    for topic, quality in read_yaml(RECORD_QOS).items():
        name = topic if topic == "/diagnostics" else topic.removeprefix("/")
        name = remaps.get(name, name)
        prefix = f"/{namespace}" if namespace else ""
        full_name = name if name.startswith("/") else f"{prefix}/{name}"
        # These two have the reliability that a parameter of the nodes gives them.
        is_batch = topic in ("/frequencies", "/stress")
        qualities[full_name] = quality | ({"reliability": reliability} if is_batch else {})
    return qualities


def check_arguments(context: LaunchContext) -> list[Action]:
    """Check all arguments, as the first action of a launch file, before anything starts.

    Returns:
        Actions that set `config` to the path of the skin file, and `port_directory` to a new folder
        if hubs are simulated.

    Raises:
        ConfigError: An argument, the skin file or the load script is wrong, or a ROS package that
            is asked for is not installed. This ends the launch.
    """
    is_simulated = _argument(context, "simulate") == "true"
    config = _argument(context, "config") or (str(DEMO_SKIN) if is_simulated else "")
    if not config:
        raise ConfigError(
            "config is missing: name a skin file, config:=skin.yaml, or try simulate:=true"
        )
    path = Path(config).expanduser().resolve()
    read_skin(path)
    read_script(Path(_argument(context, "load")).expanduser())

    problem = _argument(context, "port") and port_problem(_argument(context, "port"))
    if problem:
        raise ConfigError(f"port: {problem}")
    for name in ("rate", "publish_period"):
        _convert(name, _argument(context, name) or "0", float)
    for name, packages in NEEDED_PACKAGES.items():
        if _argument(context, name) == "true":
            _check_installed(name, packages)

    # Two simulated skins on one host must not share their ports.
    ports = str(temporary_folder("cube_ports_")) if is_simulated else ""
    return [
        SetLaunchConfiguration("config", str(path)),
        SetLaunchConfiguration("port_directory", ports),
    ]


def _argument(context: LaunchContext, name: str) -> str:
    return str(LaunchConfiguration(name).perform(context))


def _read_skin(context: LaunchContext) -> Skin:
    return read_skin(Path(_argument(context, "config")))


def _convert(name: str, text: str, kind: type) -> Any:
    """Return the value of a launch argument. ConfigError: it is not of this type."""
    if kind is bool:
        return text == "true"
    try:
        return kind(text)
    except ValueError:
        raise ConfigError(f"{name}:={text}: must be a number") from None


def _check_installed(name: str, packages: tuple[str, ...]) -> None:
    """Raise ConfigError if a ROS package that a launch argument needs is not installed."""
    for package in packages:
        try:
            get_package_prefix(package)
        except PackageNotFoundError:
            distro = os.environ.get("ROS_DISTRO", "$ROS_DISTRO")
            raise ConfigError(
                f"{name}:=true needs the ROS package {package}: "
                f"sudo apt install ros-{distro}-{package.replace('_', '-')}"
            ) from None
